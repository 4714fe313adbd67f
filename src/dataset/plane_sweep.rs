//! First points for a scene without any: pixels of photos, at the depths at which other photos show the same.
//!
//! A plane sweep (Collins 1996, "A space-sweep approach to true multi-image matching"). A patch of a photo is moved through a range of depths.
//! At each depth it is projected into photos that were taken nearby, and the brightness there is compared with the patch by normalised
//! cross-correlation, which no exposure changes. A depth at which most of these photos agree, far better than at others, is that of a surface.
//! The first points need no more: training moves them. A tenth of them may be wrong, and places without texture get none.
//!
//! Invariants: 1. the result is a function of photos, poses and seed; 2. one photo is decoded at a time, and only the shrunken photos
//! of a batch are in memory.

use super::loader::{Dataset, View};
use super::photo::decode;
use super::resize::resize_area;
use crate::base::rng::{Purpose, Stream};
use crate::scene::camera::Camera;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Longer side of the photos that are compared, pixels.
const SIDE: u32 = 240;
/// Patches that are tried in all, unless [`PATCHES_OF_PHOTO`] asks for more.
const PATCHES: usize = 24_000;
/// Fewest patches of a photo that gives patches.
const PATCHES_OF_PHOTO: usize = 64;
/// Of n photos, one in n / `PHOTOS` gives patches, and at least one in `EVERY_MOST`.
const PHOTOS: usize = 128;
const EVERY_MOST: usize = 8;
/// Photos that give patches and are worked on together.
const BATCH: usize = 16;
/// Which photos a patch is looked for in, by nearness. Near ones look alike, far ones tell depths apart.
const NEIGHBOURS: [usize; 8] = [0, 1, 2, 3, 5, 8, 12, 17];
/// Smallest cosine between the axes of photos that are compared.
const COSINE_LEAST: f32 = 0.5;
/// Least distance between the cameras of photos that are compared, in scales of the scene: nearer ones see no depth.
const BASELINE_LEAST: f32 = 1e-3;
/// Nearest and farthest depth, in scales of the scene.
const DEPTH_RANGE: [f64; 2] = [0.1, 10.0];
/// Depths of the search, in steps of equal ratio.
const DEPTHS: usize = 128;
/// Depths between two of the search, among which the best is refined.
const PARTS: usize = 8;
/// Pixels of a patch on each side of its centre.
const RADIUS: usize = 2;
const TAPS: usize = (2 * RADIUS + 1) * (2 * RADIUS + 1);
/// Least standard deviation of a patch, of values in 0..255.
const TEXTURE_LEAST: f32 = 2.5;
/// Least root of the sum of squares of the pixels that a patch is compared with, less their mean. Flatter pixels agree with nothing.
const SPREAD_LEAST: f32 = 1.0;
/// Photos that must show a patch at a depth.
const SHOWN_LEAST: usize = 3;
/// Share of the photos that show a patch which must agree: in the others something may hide it.
const SHARE_AGREEING: f64 = 0.6;
/// Least mean correlation at the depth of a surface.
const CORRELATION_LEAST: f32 = 0.75;
/// Least difference between that correlation and the correlation at the median depth: a patch that agrees everywhere tells no depth.
const PEAK_LEAST: f32 = 0.3;

/// Points on surfaces, local frame, and as many sRGB colours: those of the photos that the points were found in. At most as many as patches
/// are tried. Photos that cannot be read give none: training names them.
pub fn sweep(dataset: &Dataset, seed: u64) -> (Vec<[f32; 3]>, Vec<[u8; 3]>) {
    let views = dataset.train_views();
    let every = (views.len() / PHOTOS).clamp(1, EVERY_MOST);
    let sources: Vec<usize> = views.iter().copied().step_by(every).collect();
    let count = (PATCHES / sources.len().max(1)).max(PATCHES_OF_PHOTO);
    let depths = Depths::new(f64::from(dataset.scene_scale));
    let mut photos: BTreeMap<usize, SmallPhoto> = BTreeMap::new();
    let mut found = Vec::new();
    for batch in sources.chunks(BATCH) {
        let near: Vec<Vec<usize>> = batch.par_iter().map(|&view| neighbours(dataset, &views, view)).collect();
        let needed: BTreeSet<usize> = batch.iter().chain(near.iter().flatten()).copied().collect();
        photos.retain(|view, _| needed.contains(view));
        for view in needed {
            if !photos.contains_key(&view) {
                photos.extend(SmallPhoto::read(&dataset.views[view]).map(|photo| (view, photo)));
            }
        }
        for (view, near) in batch.iter().zip(near) {
            let Some(photo) = photos.get(view) else { continue };
            let near: Vec<&SmallPhoto> = near.iter().filter_map(|view| photos.get(view)).collect();
            let of_patch = |patch: usize| {
                let mut draws = Stream::new(seed, Purpose::SweptPatch, *view as u64, patch as u64);
                PhotoPatch::drawn(photo, &mut draws)?.point(&near, &depths)
            };
            found.par_extend((0..count).into_par_iter().filter_map(of_patch));
        }
    }
    found.into_iter().unzip()
}

/// The photos in which patches of a view are looked for.
fn neighbours(dataset: &Dataset, views: &[usize], view: usize) -> Vec<usize> {
    let camera = |view: usize| &dataset.views[view].camera;
    let (centre, [_, _, axis]) = (camera(view).centre(), camera(view).viewmat);
    let least = BASELINE_LEAST * dataset.scene_scale;
    let mut near: Vec<(f32, usize)> = Vec::new();
    for &other in views {
        let [_, _, along] = camera(other).viewmat;
        let cosine: f32 = (0..3).map(|i| axis[i] * along[i]).sum();
        let distance = camera(other).centre().iter().zip(&centre).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt();
        if other != view && cosine >= COSINE_LEAST && distance >= least {
            near.push((distance, other));
        }
    }
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    NEIGHBOURS.iter().filter_map(|&rank| near.get(rank).map(|&(_, view)| view)).collect()
}

struct Depths {
    /// Of the search, ascending, local units.
    coarse: Vec<f64>,
    /// Ratio of neighbouring depths of the refinement.
    fine_ratio: f64,
}

impl Depths {
    fn new(scale: f64) -> Depths {
        let [near, far] = DEPTH_RANGE;
        let fine_ratio = libm::pow(far / near, 1.0 / ((DEPTHS - 1) * PARTS) as f64);
        let coarse = (0..DEPTHS).map(|k| scale * near * libm::pow(fine_ratio, (k * PARTS) as f64)).collect();
        Depths { coarse, fine_ratio }
    }
}

struct SmallPhoto {
    camera: Camera,
    /// Brightness in 0..255, and sRGB.
    gray: Vec<f32>,
    rgb: Vec<u8>,
    /// 255 where all of a pixel counts; `None` if all pixels count.
    mask: Option<Vec<u8>>,
}

impl SmallPhoto {
    fn read(view: &View) -> Option<SmallPhoto> {
        let photo = decode(&view.photo).ok()?;
        let from = (photo.width, photo.height);
        let longer = from.0.max(from.1);
        let side = |pixels: u32| (u64::from(pixels) * u64::from(SIDE.min(longer)) / u64::from(longer)).max(1) as u32;
        let to = (side(from.0), side(from.1));
        let mask = photo.mask.map(|mask| {
            let whole: Vec<u8> = mask.iter().map(|&byte| if byte == 0 { 0 } else { u8::MAX }).collect();
            resize_area(&whole, 1, from, to)
        });
        let rgb = resize_area(&photo.rgb, 3, from, to);
        let gray = |p: &[u8]| 0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2]);
        let [right, down] = [to.0 as f32 / from.0 as f32, to.1 as f32 / from.1 as f32];
        let Camera { fx, fy, cx, cy, .. } = view.camera;
        let [fx, fy, cx, cy] = [fx * right, fy * down, cx * right, cy * down];
        let camera = Camera { fx, fy, cx, cy, width: to.0, height: to.1, ..view.camera };
        Some(SmallPhoto { camera, gray: rgb.chunks_exact(3).map(gray).collect(), rgb, mask })
    }
}

/// A patch of a photo: brightness less its mean, in the order of rows.
struct PhotoPatch<'a> {
    photo: &'a SmallPhoto,
    x: usize,
    y: usize,
    values: [f32; TAPS],
    /// Root of the sum of the squares of the values.
    norm: f32,
}

impl<'a> PhotoPatch<'a> {
    /// A patch at a drawn place; `None` where it has no texture, or does not count.
    fn drawn(photo: &'a SmallPhoto, draws: &mut Stream) -> Option<PhotoPatch<'a>> {
        let (width, height) = (photo.camera.width as usize, photo.camera.height as usize);
        let [across, down] = [width, height].map(|side| side.saturating_sub(2 * RADIUS) as u64);
        if across == 0 || down == 0 {
            return None;
        }
        let [x, y] = [across, down].map(|room| draws.below(room) as usize + RADIUS);
        if photo.mask.as_ref().is_some_and(|mask| mask[y * width + x] != u8::MAX) {
            return None;
        }
        let mut values = [0.0; TAPS];
        for (tap, value) in values.iter_mut().enumerate() {
            let [right, down] = offset(tap);
            *value = photo.gray[(y + down - RADIUS) * width + x + right - RADIUS];
        }
        let mean = values.iter().sum::<f32>() / TAPS as f32;
        values.iter_mut().for_each(|value| *value -= mean);
        let norm = values.iter().map(|value| value * value).sum::<f32>().sqrt();
        let has_texture = norm >= TEXTURE_LEAST * (TAPS as f32).sqrt();
        has_texture.then_some(PhotoPatch { photo, x, y, values, norm })
    }

    /// The surface that the patch shows, and its colour.
    fn point(&self, near: &[&SmallPhoto], depths: &Depths) -> Option<([f32; 3], [u8; 3])> {
        let seen: Vec<SeenPatch<'_>> = near.iter().map(|photo| SeenPatch::new(self, photo)).collect();
        let mut shown = Vec::with_capacity(DEPTHS);
        let mut best = (f32::NEG_INFINITY, 0.0);
        for &depth in &depths.coarse {
            let Some(agreement) = agreement(&seen, self, depth) else { continue };
            shown.push(agreement);
            if agreement > best.0 {
                best = (agreement, depth);
            }
        }
        let middle = shown.len().checked_sub(1)? / 2;
        let median = *shown.select_nth_unstable_by(middle, f32::total_cmp).1;
        if best.0 < CORRELATION_LEAST - PEAK_LEAST {
            return None;
        }
        let first = best.1 / libm::pow(depths.fine_ratio, PARTS as f64);
        for part in 1..2 * PARTS {
            let depth = first * libm::pow(depths.fine_ratio, part as f64);
            if let Some(agreement) = agreement(&seen, self, depth).filter(|agreement| *agreement > best.0) {
                best = (agreement, depth);
            }
        }
        let (agreement, depth) = best;
        if agreement < CORRELATION_LEAST || agreement - median < PEAK_LEAST {
            return None;
        }
        let camera = &self.photo.camera;
        let pixel = 3 * (self.y * camera.width as usize + self.x);
        let color = std::array::from_fn(|c| self.photo.rgb[pixel + c]);
        Some((camera.unproject([self.x as f64 + 0.5, self.y as f64 + 0.5], depth), color))
    }
}

/// Pixels right and down of the first pixel of a patch.
fn offset(tap: usize) -> [usize; 2] {
    let side = 2 * RADIUS + 1;
    [tap % side, tap / side]
}

/// Mean correlation with the photos that agree best; `None` where too few show the patch.
fn agreement(seen: &[SeenPatch<'_>], patch: &PhotoPatch<'_>, depth: f64) -> Option<f32> {
    let mut correlations: Vec<f32> = seen.iter().filter_map(|seen| seen.correlation(patch, depth as f32)).collect();
    if correlations.len() < SHOWN_LEAST {
        return None;
    }
    correlations.sort_by(|a, b| b.total_cmp(a));
    let best = ((SHARE_AGREEING * correlations.len() as f64).ceil() as usize).max(SHOWN_LEAST);
    Some(correlations[..best].iter().sum::<f32>() / best as f32)
}

/// A patch as another photo sees it: in the frame of that camera, tap i at depth z is at `origin + z * rays[i]`.
struct SeenPatch<'a> {
    photo: &'a SmallPhoto,
    origin: [f32; 3],
    rays: [[f32; 3]; TAPS],
}

impl<'a> SeenPatch<'a> {
    fn new(patch: &PhotoPatch<'_>, photo: &'a SmallPhoto) -> SeenPatch<'a> {
        let (from, to) = (&patch.photo.camera, &photo.camera);
        let turned = |v: [f64; 3]| to.viewmat.map(|row| (0..3).map(|i| f64::from(row[i]) * v[i]).sum::<f64>());
        let centre = from.centre().map(f64::from);
        let origin = turned(centre);
        let origin = std::array::from_fn(|i| (origin[i] + f64::from(to.viewmat[i][3])) as f32);
        let ray = |tap: usize| {
            let [right, down] = offset(tap);
            let u = (patch.x + right - RADIUS) as f64 + 0.5 - f64::from(from.cx);
            let v = (patch.y + down - RADIUS) as f64 + 0.5 - f64::from(from.cy);
            let [x, y] = [u / f64::from(from.fx), v / f64::from(from.fy)];
            let m = &from.viewmat;
            let in_world =
                std::array::from_fn(|i| x * f64::from(m[0][i]) + y * f64::from(m[1][i]) + f64::from(m[2][i]));
            turned(in_world).map(|value| value as f32)
        };
        SeenPatch { photo, origin, rays: std::array::from_fn(ray) }
    }

    /// Normalised cross-correlation; `None` where the photo does not show the whole patch.
    fn correlation(&self, patch: &PhotoPatch<'_>, depth: f32) -> Option<f32> {
        let Camera { fx, fy, cx, cy, width, height, near_plane, .. } = self.photo.camera;
        let [right, bottom] = [width, height].map(|side| side.saturating_sub(1) as f32);
        let (mut sum, mut squares, mut product) = (0.0, 0.0, 0.0);
        for (ray, value) in self.rays.iter().zip(&patch.values) {
            let [x, y, z] = std::array::from_fn(|i| self.origin[i] + depth * ray[i]);
            let (u, v) = (fx * x / z + cx - 0.5, fy * y / z + cy - 0.5);
            // Also false where a number is not finite.
            let is_inside = z > near_plane && u >= 0.0 && u < right && v >= 0.0 && v < bottom;
            if !is_inside {
                return None;
            }
            let (column, row) = (u as usize, v as usize);
            let (across, down) = (u - column as f32, v - row as f32);
            let at = row * width as usize + column;
            let [upper, lower] = [at, at + width as usize]
                .map(|i| self.photo.gray[i] + across * (self.photo.gray[i + 1] - self.photo.gray[i]));
            let there = upper + down * (lower - upper);
            sum += there;
            squares += there * there;
            product += value * there;
        }
        let spread = (squares - sum * sum / TAPS as f32).max(0.0).sqrt();
        Some(if spread > SPREAD_LEAST { product / (spread * patch.norm) } else { 0.0 })
    }
}
