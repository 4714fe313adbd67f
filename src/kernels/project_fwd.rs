//! Stage "project": rows to footprints on the screen. Perspective projection of the mean, the locally affine
//! projection of the covariance (Zwicker et al. 2001, "EWA volume splatting"), its inverse, and the footprint's box.
//!
//! Not here: colours, tiles, gradients (`project_bwd` reuses [`geometry`]).
//!
//! Invariants: 1. a row with non-finite numbers, or one that no pixel can see, is culled: radii [0, 0] and zeros
//! elsewhere, never NaN; 2. only + - * / sqrt, nothing fused: the same bits on every instruction path; 3. the
//! determinant of the 2D covariance is a sum of squares, so the short side of needles stays accurate in f32.

use crate::base::math::{exp32, sigmoid};
use crate::base::room;
use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
use crate::kernels::constants::{ALPHA_MIN, EXTENT_SIGMAS};
use crate::kernels::lanes::{ROWS_PER_CHUNK, block_of, block_of_mut, chunk_of, gather, lane, scatter, set_lane};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use rayon::prelude::*;

/// Footprints of rows, one entry per row of the working set; entries of culled rows are not valid.
#[derive(Debug, Clone, Default)]
pub struct Projected {
    /// Pixel position of the mean.
    pub means2d: Vec<[f32; 2]>,
    /// Inverse of the blurred 2D covariance: xx, xy, yy.
    pub conics: Vec<[f32; 3]>,
    /// Camera-space z.
    pub depths: Vec<f32>,
    /// Half extents of the footprint's box in pixels, rounded up; [0, 0] marks a culled row.
    pub radii: Vec<[u32; 2]>,
    /// Opacity after activation.
    pub opacities: Vec<f32>,
}

impl Projected {
    pub fn rows(&self) -> usize {
        self.radii.len()
    }

    /// Changes the number of rows; keeps the allocation.
    pub fn resize(&mut self, rows: usize) {
        room::resize(&mut self.means2d, rows, [0.0; 2]);
        room::resize(&mut self.conics, rows, [0.0; 3]);
        room::resize(&mut self.depths, rows, 0.0);
        room::resize(&mut self.radii, rows, [0; 2]);
        room::resize(&mut self.opacities, rows, 0.0);
    }
}

/// A quaternion whose squared length is outside this range has no usable direction in f32: its row is culled.
const QUAT_NORM_SQ: std::ops::Range<f32> = 1e-30..1e30;

crate::wgsl_struct! {
    /// Camera constants of the stages on rows, computed once per view: on a device the uniform `View` of
    /// `shaders/shared/camera.wgsl`, which documents the fields.
    pub struct View {
        pub world_to_camera: [[f32; 4]; 3],
        pub cofactors: [[f32; 4]; 3],
        pub centre: [f32; 3],
        pub eps2d: f32,
        pub focal: [f32; 2],
        pub principal: [f32; 2],
        pub size: [f32; 2],
        pub depth_range: [f32; 2],
        pub slope_low: [f32; 2],
        pub slope_high: [f32; 2],
        pub row_count: u32,
        pub first_row: u32,
        pub _pad: [u32; 2],
    }
}

impl View {
    /// The constants for a camera; `row_count` and `first_row` are set for each window of rows on a device.
    pub fn new(camera: &Camera, eps2d: f32) -> View {
        let rotation = camera.viewmat.map(|[x, y, z, _]| [x, y, z]);
        let cofactors: [[f32; 3]; 3] = std::array::from_fn(|i| cross(rotation[(i + 1) % 3], rotation[(i + 2) % 3]));
        let size = [camera.width as f32, camera.height as f32];
        let focal = [camera.fx, camera.fy];
        let principal = [camera.cx, camera.cy];
        let margin: [f32; 2] = std::array::from_fn(|i| 0.3 * (0.5 * size[i] / focal[i]));
        View {
            world_to_camera: camera.viewmat,
            cofactors: cofactors.map(|[x, y, z]| [x, y, z, 0.0]),
            centre: camera.centre(),
            eps2d,
            focal,
            principal,
            size,
            depth_range: [camera.near_plane, camera.far_plane],
            slope_low: std::array::from_fn(|i| -(principal[i] / focal[i] + margin[i])),
            slope_high: std::array::from_fn(|i| (size[i] - principal[i]) / focal[i] + margin[i]),
            row_count: 0,
            first_row: 0,
            _pad: [0; 2],
        }
    }
}

/// One row seen by a view: the projected ellipsoid before inversion, and what the gradient reuses.
///
/// With T = J W (2x3, the Jacobian of the projection times the world-to-camera rotation) and R the row's rotation,
/// `axes[k]` is column k of T R: the image of the unit vector along the ellipsoid's axis k.
#[derive(Debug, Clone, Copy)]
pub struct Geometry {
    /// Camera-space z.
    pub depth: f32,
    /// 1/z.
    pub inv_depth: f32,
    /// X/Z, Y/Z.
    pub ray: [f32; 2],
    /// The same, clamped for the Jacobian.
    pub slope: [f32; 2],
    /// Unit quaternion, w x y z.
    pub quat: [f32; 4],
    /// 1 / length of the stored quaternion.
    pub inv_quat_norm: f32,
    /// Whether that length is usable.
    pub quat_ok: bool,
    /// Images of the ellipsoid's axes, px per world unit.
    pub axes: [[f32; 2]; 3],
    /// Cross products of the images: (1,2), (2,0), (0,1).
    pub minors: [f32; 3],
    /// Camera-space z of the ellipsoid's axes.
    pub axes_z: [f32; 3],
    /// Squared standard deviations.
    pub scale_sq: [f32; 3],
    /// Blurred covariance xx, xy, yy, px^2.
    pub cov2d: [f32; 3],
    pub det: f32,
}

#[inline(always)]
pub(crate) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn cut(x: f32, low: f32, high: f32) -> f32 {
    let x = if x < low { low } else { x };
    if x > high { high } else { x }
}

/// Columns of the rotation of a unit quaternion.
#[inline(always)]
fn rotation_columns(q: [f32; 4]) -> [[f32; 3]; 3] {
    let [w, x, y, z] = q;
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
        [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
        [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Projects one row; `quat` need not be unit, `scale` is after activation (standard deviations).
///
/// det(A A^T + eps I) = sum of the squared 2x2 minors of A (Cauchy-Binet) + eps tr(A A^T) + eps^2 with A = T R S. The
/// minors of T R are the rotated cross product of T's rows, so nothing is subtracted.
#[inline(always)]
pub fn geometry(view: &View, mean: [f32; 3], quat: [f32; 4], scale: [f32; 3]) -> Geometry {
    let w = &view.world_to_camera.map(|[x, y, z, _]| [x, y, z]);
    let p: [f32; 3] = std::array::from_fn(|i| dot(w[i], mean) + view.world_to_camera[i][3]);
    let inv_depth = 1.0 / p[2];
    let ray = [p[0] * inv_depth, p[1] * inv_depth];
    let slope: [f32; 2] = std::array::from_fn(|i| cut(ray[i], view.slope_low[i], view.slope_high[i]));

    let norm_sq = (quat[0] * quat[0] + quat[1] * quat[1]) + (quat[2] * quat[2] + quat[3] * quat[3]);
    let inv_quat_norm = 1.0 / norm_sq.sqrt();
    let unit = quat.map(|x| x * inv_quat_norm);
    let columns = rotation_columns(unit);

    let per_unit = [view.focal[0] * inv_depth, view.focal[1] * inv_depth];
    let t: [[f32; 3]; 2] =
        std::array::from_fn(|i| std::array::from_fn(|j| per_unit[i] * (w[i][j] - slope[i] * w[2][j])));
    let k = &view.cofactors;
    let area = per_unit[0] * per_unit[1];
    let normal: [f32; 3] = std::array::from_fn(|j| area * (k[2][j] + slope[0] * k[0][j] + slope[1] * k[1][j]));

    let axes: [[f32; 2]; 3] = columns.map(|c| [dot(t[0], c), dot(t[1], c)]);
    let minors = columns.map(|c| dot(normal, c));
    let axes_z = columns.map(|c| dot(w[2], c));
    let scale_sq = scale.map(|s| s * s);
    let moment = |i: usize, j: usize| {
        scale_sq[0] * (axes[0][i] * axes[0][j])
            + scale_sq[1] * (axes[1][i] * axes[1][j])
            + scale_sq[2] * (axes[2][i] * axes[2][j])
    };
    let (xx, xy, yy) = (moment(0, 0), moment(0, 1), moment(1, 1));
    let m = [scale[1] * scale[2] * minors[0], scale[2] * scale[0] * minors[1], scale[0] * scale[1] * minors[2]];
    let eps = view.eps2d;
    Geometry {
        depth: p[2],
        inv_depth,
        ray,
        slope,
        quat: unit,
        inv_quat_norm,
        quat_ok: QUAT_NORM_SQ.contains(&norm_sq),
        axes,
        minors,
        axes_z,
        scale_sq,
        cov2d: [xx + eps, xy, yy + eps],
        det: dot(m, m) + eps * (xx + yy) + eps * eps,
    }
}

/// Footprint of one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Footprint {
    /// Whether the row is drawn; if not, all other fields are zero.
    pub visible: bool,
    /// Pixel position of the mean.
    pub mean2d: [f32; 2],
    /// Inverse of the blurred covariance.
    pub conic: [f32; 3],
    /// Camera-space z.
    pub depth: f32,
    /// Half extents of the box, whole pixels.
    pub radii: [f32; 2],
    /// Opacity after activation.
    pub opacity: f32,
}

/// Natural logarithm for x in [1, 256), within 3e-7 + 2e-7 |ln x|: x = m 2^e, ln m = 2 atanh((m - 1) / (m + 1)).
/// Returns an unspecified number outside this range.
#[inline(always)]
fn ln_1_to_256(x: f32) -> f32 {
    // Subtracting the bits of 2/3 first puts m into [2/3, 4/3).
    let shifted = x.to_bits().wrapping_sub(0x3f2a_aaab);
    let e = (shifted as i32 >> 23) as f32;
    let m = f32::from_bits((shifted & 0x007f_ffff).wrapping_add(0x3f2a_aaab));
    let r = (m - 1.0) / (m + 1.0);
    let r_sq = r * r;
    let series = 1.0 + r_sq * (1.0 / 3.0 + r_sq * (1.0 / 5.0 + r_sq * (1.0 / 7.0 + r_sq * (1.0 / 9.0))));
    e * std::f32::consts::LN_2 + 2.0 * r * series
}

/// Inverts the covariance, bounds the region where alpha can reach 1/255, and decides whether to draw the row.
///
/// alpha = opacity exp(-r^2/2) reaches 1/255 at r = sqrt(2 ln(255 opacity)) standard deviations; the box of that
/// ellipse has half extents r sqrt(cov_xx), r sqrt(cov_yy).
#[inline(always)]
pub fn footprint(view: &View, g: &Geometry, opacity: f32) -> Footprint {
    let inv_det = 1.0 / g.det;
    let conic = [g.cov2d[2] * inv_det, -(g.cov2d[1] * inv_det), g.cov2d[0] * inv_det];
    let mean2d: [f32; 2] = std::array::from_fn(|i| view.focal[i] * g.ray[i] + view.principal[i]);
    let reach = (2.0 * ln_1_to_256(opacity * 255.0)).sqrt();
    let reach = if reach < EXTENT_SIGMAS { reach } else { EXTENT_SIGMAS };
    let radii = [(reach * g.cov2d[0].sqrt()).ceil(), (reach * g.cov2d[2].sqrt()).ceil()];

    let mut visible = g.quat_ok & (opacity >= ALPHA_MIN) & (g.det > 0.0) & g.det.is_finite();
    visible &= (g.depth > view.depth_range[0]) & (g.depth < view.depth_range[1]);
    for i in 0..2 {
        visible &= (mean2d[i] + radii[i] > 0.0) & (mean2d[i] - radii[i] < view.size[i]);
        visible &= mean2d[i].is_finite() & radii[i].is_finite() & (radii[i] > 0.0);
    }
    for c in conic {
        visible &= c.is_finite();
    }
    let keep = |x: f32| if visible { x } else { 0.0 };
    Footprint {
        visible,
        mean2d: mean2d.map(keep),
        conic: conic.map(keep),
        depth: keep(g.depth),
        radii: radii.map(keep),
        opacity: keep(opacity),
    }
}

/// Projects every row of a batch for `camera`. The footprints are written to `out` from row `first` on, and `out` ends
/// with them.
pub fn project_fwd(rows: &Columns, camera: &Camera, eps2d: f32, simd: SimdPath, first: usize, out: &mut Projected) {
    out.resize(first + rows.rows());
    let view = View::new(camera, eps2d);
    let Projected { means2d, conics, depths, radii, opacities } = out;
    (means2d[first..].par_chunks_mut(ROWS_PER_CHUNK), conics[first..].par_chunks_mut(ROWS_PER_CHUNK))
        .into_par_iter()
        .zip((depths[first..].par_chunks_mut(ROWS_PER_CHUNK), radii[first..].par_chunks_mut(ROWS_PER_CHUNK)))
        .zip(opacities[first..].par_chunks_mut(ROWS_PER_CHUNK))
        .enumerate()
        .for_each(|(chunk, (((means2d, conics), (depths, radii)), opacities))| {
            let stored = StoredChunk::new(rows, chunk);
            dispatch(simd, ProjectChunk { view: &view, stored, means2d, conics, depths, radii, opacities });
        });
}

/// The stored geometry of a chunk of rows.
#[derive(Clone, Copy)]
pub(crate) struct StoredChunk<'a> {
    pub means: &'a [f32],
    pub quats: &'a [f32],
    pub scales: &'a [f32],
    pub opacities: &'a [f32],
}

impl<'a> StoredChunk<'a> {
    pub fn new(rows: &'a Columns, chunk: usize) -> Self {
        StoredChunk {
            means: chunk_of(&rows.means, chunk, 3),
            quats: chunk_of(&rows.quats, chunk, 4),
            scales: chunk_of(&rows.scales, chunk, 3),
            opacities: chunk_of(&rows.opacities, chunk, 1),
        }
    }
}

struct ProjectChunk<'a> {
    view: &'a View,
    stored: StoredChunk<'a>,
    means2d: &'a mut [[f32; 2]],
    conics: &'a mut [[f32; 3]],
    depths: &'a mut [f32],
    radii: &'a mut [[u32; 2]],
    opacities: &'a mut [f32],
}

impl Kernel for ProjectChunk<'_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let view = *self.view;
        let s = self.stored;
        for block in 0..self.depths.len().div_ceil(LANES) {
            let means = gather::<3>(block_of(s.means, block, 3));
            let quats = gather::<4>(block_of(s.quats, block, 4));
            let scales = gather::<3>(block_of(s.scales, block, 3));
            let logits = gather::<1>(block_of(s.opacities, block, 1));
            let mut means2d = [[0.0; LANES]; 2];
            let mut conics = [[0.0; LANES]; 3];
            let mut radii = [[0u32; LANES]; 2];
            let mut depths = [[0.0; LANES]; 1];
            let mut opacities = [[0.0; LANES]; 1];
            for l in 0..LANES {
                let g = geometry(&view, lane(&means, l), lane(&quats, l), lane(&scales, l).map(exp32));
                let f = footprint(&view, &g, sigmoid(logits[0][l]));
                set_lane(&mut means2d, l, f.mean2d);
                set_lane(&mut conics, l, f.conic);
                depths[0][l] = f.depth;
                opacities[0][l] = f.opacity;
                radii[0][l] = f.radii[0] as u32;
                radii[1][l] = f.radii[1] as u32;
            }
            scatter(&means2d, block_of_mut(self.means2d, block, 1).as_flattened_mut());
            scatter(&conics, block_of_mut(self.conics, block, 1).as_flattened_mut());
            scatter(&depths, block_of_mut(self.depths, block, 1));
            scatter(&opacities, block_of_mut(self.opacities, block, 1));
            for (l, out) in block_of_mut(self.radii, block, 1).iter_mut().enumerate() {
                *out = [radii[0][l], radii[1][l]];
            }
        }
    }
}

#[cfg(test)]
pub(in crate::kernels) mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    pub(in crate::kernels) fn camera() -> Camera {
        let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, -0.6, 0.2], [0.0, 0.6, 0.8, 3.0]];
        Camera::pinhole(viewmat, [70.0, 60.0, 33.0, 22.0], [64, 48])
    }

    fn random_rows(n: usize) -> Columns {
        let mut rng = Stream::new(3, Purpose::Test, 0, 0);
        let mut rows = Columns::zeros(n, 0);
        rows.means.fill_with(|| rng.range(-3.0, 3.0) as f32);
        rows.quats.fill_with(|| rng.range(-1.0, 1.0) as f32);
        rows.scales.fill_with(|| rng.range(-5.0, 0.0) as f32);
        rows.opacities.fill_with(|| rng.range(-6.0, 5.0) as f32);
        rows
    }

    fn project(rows: &Columns, simd: SimdPath) -> Projected {
        let mut out = Projected::default();
        project_fwd(rows, &camera(), 0.3, simd, 0, &mut out);
        out
    }

    /// A row in front of the camera, which is drawn.
    fn one_row() -> Columns {
        let mut rows = Columns::zeros(1, 0);
        rows.quats[0] = 1.0;
        rows.scales.fill(-2.0);
        rows
    }

    #[test]
    fn every_path_gives_the_same_bits() {
        // Not a multiple of the block, and more than one chunk.
        let rows = random_rows(ROWS_PER_CHUNK + 37);
        let want = project(&rows, SimdPath::Baseline);
        let drawn = want.radii.iter().filter(|r| **r != [0, 0]).count();
        assert!(drawn > rows.rows() / 10 && drawn < rows.rows(), "{drawn} drawn");
        for simd in SimdPath::ALL {
            assert_eq!(format!("{want:?}"), format!("{:?}", project(&rows, simd)), "{simd:?}");
        }
        let view = View::new(&camera(), 0.3);
        for row in 0..rows.rows() {
            let quat = std::array::from_fn(|c| rows.quats[4 * row + c]);
            let mean = std::array::from_fn(|c| rows.means[3 * row + c]);
            let g = geometry(&view, mean, quat, std::array::from_fn(|c| exp32(rows.scales[3 * row + c])));
            let f = footprint(&view, &g, sigmoid(rows.opacities[row]));
            assert_eq!((f.mean2d, f.conic, f.depth), (want.means2d[row], want.conics[row], want.depths[row]));
        }
    }

    #[test]
    fn bad_rows_are_culled_and_leave_no_nan() {
        assert_ne!(project(&one_row(), SimdPath::best()).radii[0], [0, 0], "the row they are made from is drawn");
        type Edit = (&'static str, fn(&mut Columns));
        let edits: [Edit; 14] = [
            ("NaN mean", |r| r.means[1] = f32::NAN),
            ("infinite mean", |r| r.means[0] = f32::INFINITY),
            ("far to the side", |r| r.means[0] = 1e30),
            ("behind the camera", |r| r.means[2] = -30.0),
            ("beside the image", |r| r.means[0] = 30.0),
            ("zero quaternion", |r| r.quats[0] = 0.0),
            ("tiny quaternion", |r| r.quats[0] = 1e-25),
            ("huge quaternion", |r| r.quats[0] = 1e25),
            ("NaN quaternion", |r| r.quats[3] = f32::NAN),
            ("infinite scale", |r| r.scales[0] = 1e3),
            ("squares overflow", |r| r.scales.fill(60.0)),
            ("NaN scale", |r| r.scales[2] = f32::NAN),
            ("opacity below 1/255", |r| r.opacities[0] = -5.6),
            ("NaN opacity", |r| r.opacities[0] = f32::NAN),
        ];
        for (what, edit) in edits {
            let mut rows = one_row();
            edit(&mut rows);
            let p = project(&rows, SimdPath::best());
            assert_eq!(p.radii[0], [0, 0], "{what}");
            let zeros = (p.means2d[0], p.conics[0], p.depths[0], p.opacities[0]);
            assert_eq!(zeros, ([0.0; 2], [0.0; 3], 0.0, 0.0), "{what}");
        }
    }

    #[test]
    fn flat_rows_and_rows_of_size_zero_are_drawn() {
        for scales in [[-200.0, -2.0, -2.0], [-200.0, -200.0, -200.0]] {
            let mut rows = one_row();
            rows.scales.copy_from_slice(&scales);
            let p = project(&rows, SimdPath::best());
            assert_ne!(p.radii[0], [0, 0]);
            // The blur alone bounds the conic: its largest eigenvalue is at most 1/eps2d.
            assert!(p.conics[0][0] <= 1.0 / 0.3 + 1e-5 && p.conics[0][2] <= 1.0 / 0.3 + 1e-5);
        }
    }

    #[test]
    fn the_logarithm_is_accurate_on_its_range() {
        let mut x = 1.0f32;
        while x < 256.0 {
            let want = libm::log(f64::from(x));
            let got = f64::from(ln_1_to_256(x));
            assert!((got - want).abs() <= 3e-7 + 2e-7 * want, "ln({x}) = {got}, want {want}");
            x *= 1.0007;
        }
    }
}
