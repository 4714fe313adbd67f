//! Which Gaussians exports leave out (`--export-clean`): those that too few training photos hold in place.
//!
//! A photo holds a Gaussian if its disc of one sigma, the largest, reaches into the picture, and if it does not hang before the lens:
//! nearer than [`NEAR_SHARE`] of the depth at which the photo's scene begins. Giants that many photos see stay whatever their size:
//! on three aerial scenes they are the ground behind gaps, and without them held-out photos lose 2 to 4 dB.
//!
//! Not here: reading the rows, writing the files.
//!
//! Invariants: 1. the answer for a row is a function of the row, the cameras and the sample alone; 2. a row with a position or
//! scale that is not finite counts as held: sinks count such rows.

use crate::base::math::exp32;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::frustum::{Frustum, PagePlanes};
use crate::scene::page_meta::PageBounds;
use rayon::prelude::*;

/// Photos that must hold a Gaussian.
const PHOTOS_LEAST: u8 = 2;
/// Share of the depth at which a photo's scene begins. Nearer Gaussians hang before the lens.
const NEAR_SHARE: f64 = 0.3;
/// `auto` leaves out at most this share. Where more Gaussians have a single photo, photos overlap little, and held-out photos need
/// these Gaussians: .5 dB of brighton's 18 photos.
const AUTO_SHARE_MOST: f64 = 0.005;
/// Rows whose cameras are found together.
const BLOCK_ROWS: usize = 1024;

/// Points of `sample` in the picture of `camera`: pixel position and depth.
pub(super) fn in_picture(camera: &Camera, sample: &[[f64; 3]]) -> impl Iterator<Item = ([f64; 2], f64)> {
    let [width, height] = [camera.width, camera.height].map(f64::from);
    let seen = sample.iter().filter_map(|&point| camera.project(point));
    seen.filter(move |([u, v], _)| (0.0..width).contains(u) && (0.0..height).contains(v))
}

/// The depth at which the scene of a photo begins: a tenth of its points are nearer. Sorts the depths; 0 without points.
pub(super) fn first_depth(depths: &mut [f64]) -> f64 {
    depths.sort_unstable_by(f64::total_cmp);
    depths.get(depths.len() / 10).copied().unwrap_or(0.0)
}

struct Photo {
    camera: Camera,
    planes: PagePlanes,
    nearest: f64,
}

/// The photos that hold Gaussians in place.
pub struct HoldingPhotos(Vec<Photo>);

impl HoldingPhotos {
    /// Of the cameras of training photos, for a scene of which `sample` are means (both in the local frame).
    pub fn new(cameras: &[Camera], sample: &[[f64; 3]]) -> HoldingPhotos {
        let photo = |camera: &Camera| {
            let mut depths: Vec<f64> = in_picture(camera, sample).map(|(_, depth)| depth).collect();
            let nearest = NEAR_SHARE * first_depth(&mut depths);
            Photo { camera: *camera, planes: Frustum::new(camera).planes(), nearest }
        };
        HoldingPhotos(cameras.par_iter().map(photo).collect())
    }

    /// The number of photos that hold each row, at most [`PHOTOS_LEAST`].
    pub fn of_rows(&self, rows: &Columns) -> Vec<u8> {
        let mut counts = vec![PHOTOS_LEAST; rows.rows()];
        counts.par_chunks_mut(BLOCK_ROWS).enumerate().for_each(|(block, counts)| {
            let first = block * BLOCK_ROWS;
            let of_row = |row: usize| {
                let (mean, scales) = (rows.row(Column::Means, row), rows.row(Column::Scales, row));
                let sigma = exp32(scales[0].max(scales[1]).max(scales[2]));
                let is_finite = mean.iter().chain(scales).all(|v| v.is_finite()) && sigma.is_finite();
                is_finite.then(|| ([mean[0], mean[1], mean[2]], sigma))
            };
            let mut bounds = PageBounds::EMPTY;
            for (mean, sigma) in (first..first + counts.len()).filter_map(of_row) {
                bounds.lo = [0, 1, 2].map(|i| bounds.lo[i].min(mean[i]));
                bounds.hi = [0, 1, 2].map(|i| bounds.hi[i].max(mean[i]));
                bounds.sigma_max = bounds.sigma_max.max(sigma);
            }
            let near: Vec<&Photo> = self.0.iter().filter(|photo| photo.planes.may_intersect(&bounds)).collect();
            for (row, count) in (first..).zip(counts) {
                let Some((mean, sigma)) = of_row(row) else { continue };
                let holding = near.iter().filter(|photo| photo.holds(mean.map(f64::from), f64::from(sigma)));
                *count = holding.take(usize::from(PHOTOS_LEAST)).count() as u8;
            }
        });
        counts
    }
}

impl Photo {
    fn holds(&self, mean: [f64; 3], sigma: f64) -> bool {
        let Camera { fx, fy, width, height, .. } = self.camera;
        let inside = |at: f64, size: u32, f: f32, depth: f64| {
            let reach = sigma * f64::from(f) / depth;
            at > -reach && at < f64::from(size) + reach
        };
        self.camera.project(mean).is_some_and(|([u, v], depth)| {
            depth >= self.nearest && inside(u, width, fx, depth) && inside(v, height, fy, depth)
        })
    }
}

/// The photos that must hold an exported Gaussian, at least: 0 exports all. `is_on` is `None` for `auto`, which takes the
/// strictest limit that leaves out few of the rows with these `counts`.
pub fn photos_required(is_on: Option<bool>, counts: &[u8]) -> u8 {
    let lacks = |least: u8| counts.iter().filter(|&&count| count < least).count() as f64;
    let leaves_few = |least: &u8| lacks(*least) <= AUTO_SHARE_MOST * counts.len() as f64;
    match is_on {
        Some(false) => 0,
        Some(true) => PHOTOS_LEAST,
        None => (1..=PHOTOS_LEAST).rev().find(leaves_few).unwrap_or(0),
    }
}
