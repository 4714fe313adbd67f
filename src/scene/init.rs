//! Creates the first Gaussians from points, and random points for datasets without any.
//!
//! Not here: reading points, choosing the local frame.
//!
//! Invariants: 1. every value made here is finite, for any points; 2. a draw depends on the seed and the row (or point)
//! alone; 3. row i holds the i-th point kept, and its uid is i.

use super::camera::Camera;
use super::columns::{Column, Columns};
use super::neighbours::nearest_dist2;
use crate::base::math::logit;
use crate::base::rng::{Purpose, Stream, hash64};
use rayon::prelude::*;

/// Value of the constant SH basis function, 1 / (2 sqrt(pi)): colour = C0 sh0 + 1/2 at degree 0.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// First word of the hash that selects points when there are too many.
const SUBSAMPLE: u64 = 0x7375_6273_616d_706c;

/// Scale of the rows if all points coincide, in units of the scene scale.
const LONE_POINT_SCALE: f64 = 0.01;

/// Smallest and largest first scale, in scene scales.
const MIN_SCALE: f32 = 1e-6;
const MAX_SCALE: f32 = 10.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitOptions {
    /// SH degree of the stored rows, 0 to 3. The higher bands start at zero.
    pub sh_degree: u8,
    /// First opacity, in (0, 1).
    pub opacity: f32,
    /// First scale in units of the distance to the neighbours.
    pub scale_factor: f32,
    pub seed: u64,
    pub max_gaussians: Option<usize>,
    /// Size of the scene, local units.
    pub scene_scale: f32,
}

impl Default for InitOptions {
    fn default() -> Self {
        InitOptions { sh_degree: 3, opacity: 0.1, scale_factor: 1.0, seed: 0, max_gaussians: None, scene_scale: 1.0 }
    }
}

/// Creates one isotropic Gaussian per point, as gsplat's trainer does: the scale is the root mean square distance to
/// the three nearest points times `scale_factor`, the rotation is random, the colour is the point's.
///
/// Differences to gsplat concern clouds that it cannot start from: with fewer than four points the mean is over the
/// existing neighbours; a point whose neighbours all coincide with it gets the median distance of the others (0.01
/// scene scales if there are none); scales are limited to 1e-6 to 10 scene scales; non-finite points get no row. Rotations are
/// uniform on the sphere and of unit length, where gsplat's are uniform in [0, 1)^4; since the first Gaussians are
/// round, no picture shows the difference.
///
/// If there are more than `max_gaussians` points, those with the smallest hashes of (seed, index) are kept, in order,
/// and distances are those among the kept points.
pub fn gaussians_from_points(points: &[[f32; 3]], colors: &[[u8; 3]], options: &InitOptions) -> Columns {
    let mut kept: Vec<usize> = (0..points.len()).filter(|&i| points[i].iter().all(|v| v.is_finite())).collect();
    if let Some(most) = options.max_gaussians.filter(|&most| most < kept.len()) {
        kept.sort_by_cached_key(|&i| subsample_key(options.seed, i as u64));
        kept.truncate(most);
        kept.sort_unstable();
    }
    let means: Vec<[f32; 3]> = kept.iter().map(|&i| points[i]).collect();
    let scales = log_scales(&means, options);
    let point = |row: usize| FirstPoint {
        point: means[row],
        row: row as u32,
        color: colors.get(kept[row]).copied().unwrap_or([128; 3]),
        log_scale: scales[row],
    };
    first_gaussians(kept.len(), point, options)
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FirstPoint {
    pub point: [f32; 3],
    /// Row among all first Gaussians: part of the key of its random rotation.
    pub row: u32,
    /// sRGB.
    pub color: [u8; 3],
    pub log_scale: f32,
}

pub fn first_gaussians(rows: usize, point: impl Fn(usize) -> FirstPoint, options: &InitOptions) -> Columns {
    let mut columns = Columns::zeros(rows, options.sh_degree);
    columns.opacities.fill(logit(options.opacity));
    for row in 0..rows {
        let FirstPoint { point, row: key, color, log_scale } = point(row);
        columns.row_mut(Column::Means, row).copy_from_slice(&point);
        columns.row_mut(Column::Scales, row).fill(log_scale);
        let quat = random_rotation(&mut Stream::new(options.seed, Purpose::InitQuat, u64::from(key), 0));
        columns.row_mut(Column::Quats, row).copy_from_slice(&quat);
        for (sh0, byte) in columns.row_mut(Column::Sh0, row).iter_mut().zip(color) {
            *sh0 = ((f64::from(byte) / 255.0 - 0.5) / SH_C0) as f32;
        }
    }
    columns
}

/// Key for selecting points when there are too many: those with the smallest keys stay. For one seed a bijection of the
/// index, so there are no ties.
pub fn subsample_key(seed: u64, index: u64) -> u64 {
    hash64(&[seed, SUBSAMPLE, index])
}

/// Root mean square of the distances to the existing neighbours; 0 without any.
pub fn rms_distance(dist2: &[f32; 3]) -> f64 {
    let there = dist2.iter().filter(|d| d.is_finite());
    let (sum, count) = there.fold((0.0, 0u32), |(sum, count), &d| (sum + f64::from(d), count + 1));
    if count == 0 { 0.0 } else { libm::sqrt(sum / f64::from(count)) }
}

/// Converts distances to first log-scales.
#[derive(Debug, Clone, Copy)]
pub struct ScaleRule {
    factor: f64,
    fallback: f64,
    low: f64,
    high: f64,
}

impl ScaleRule {
    /// The rule; `typical` is the median of the positive distances ([`middle_rank`]), if any.
    pub fn new(options: &InitOptions, typical: Option<f64>) -> ScaleRule {
        let scene_scale = f64::from(options.scene_scale);
        ScaleRule {
            factor: f64::from(options.scale_factor),
            fallback: typical.unwrap_or(LONE_POINT_SCALE * scene_scale),
            low: f64::from(MIN_SCALE) * scene_scale,
            high: f64::from(MAX_SCALE) * scene_scale,
        }
    }

    pub fn log_scale(&self, distance: f64) -> f32 {
        let distance = if distance > 0.0 { distance } else { self.fallback };
        // max, then min: clamp would panic for a scene scale that is no number.
        libm::log((distance * self.factor).max(self.low).min(self.high)) as f32
    }
}

/// Rank of the value used as the median.
pub fn middle_rank(count: usize) -> usize {
    count / 2
}

/// Log of the first scale of each point.
fn log_scales(points: &[[f32; 3]], options: &InitOptions) -> Vec<f32> {
    let distances: Vec<f64> = nearest_dist2(points).par_iter().map(rms_distance).collect();
    let mut positive: Vec<f64> = distances.iter().copied().filter(|&v| v > 0.0).collect();
    let middle = middle_rank(positive.len());
    let median = (!positive.is_empty()).then(|| *positive.select_nth_unstable_by(middle, f64::total_cmp).1);
    let rule = ScaleRule::new(options, median);
    distances.par_iter().map(|&distance| rule.log_scale(distance)).collect()
}

/// A rotation from the uniform distribution, w x y z (Marsaglia 1972, "Choosing a point from the surface of a sphere").
fn random_rotation(stream: &mut Stream) -> [f32; 4] {
    let mut in_disk = || loop {
        let (a, b) = (stream.range(-1.0, 1.0), stream.range(-1.0, 1.0));
        let r2 = a * a + b * b;
        // The lower limit keeps the division below finite.
        if r2 < 1.0 && r2 > 1e-12 {
            return (a, b, r2);
        }
    };
    let (w, x, first) = in_disk();
    let (y, z, second) = in_disk();
    let stretch = libm::sqrt((1.0 - first) / second);
    [w as f32, x as f32, (y * stretch) as f32, (z * stretch) as f32]
}

/// `count` points with random colours in the views' frusta, for datasets without points: a random camera, a random
/// pixel, a depth uniform in [near, far). Uniform depth thins out as 1/z^2 in space, which gives as many points per
/// pixel near as far. Empty without cameras.
pub fn random_points_in_frusta(
    cameras: &[Camera],
    count: usize,
    near: f32,
    far: f32,
    seed: u64,
) -> (Vec<[f32; 3]>, Vec<[u8; 3]>) {
    if cameras.is_empty() {
        return (Vec::new(), Vec::new());
    }
    let point = |i: usize| {
        let mut s = Stream::new(seed, Purpose::InitPoint, i as u64, 0);
        let camera = &cameras[s.below(cameras.len() as u64) as usize];
        let u = s.range(0.0, f64::from(camera.width));
        let v = s.range(0.0, f64::from(camera.height));
        let z = s.range(f64::from(near), f64::from(far));
        (camera.unproject([u, v], z), std::array::from_fn(|_| s.below(256) as u8))
    };
    (0..count).into_par_iter().map(point).unzip()
}
