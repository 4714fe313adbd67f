//! Takes one photo: casts a ray through every pixel, and more where surfaces meet; then applies the camera's tone curve.
//!
//! Invariants: 1. a pixel depends on (scene, shot, options, view, pixel) alone, so photos have the same bytes for any
//! number of threads; 2. a pixel gets either one ray, with textures averaged over the whole pixel, or up to
//! `supersample`^2 more; the choice depends only on rays of the pixel and the first rays of its neighbours.

use super::CityOptions;
use super::flight::Shot;
use super::shade::{Sample, Scene};
use crate::base::rng::{Purpose, Stream};
use crate::dataset::model::Intrinsics;
use glam::Vec3;
use rayon::prelude::*;

/// Relative spread of brightness among a pixel and its neighbours above which more rays are cast.
const CONTRAST: f32 = 0.35;

/// A photo: interleaved 8-bit RGB, and the number of rays.
pub(super) struct ShotPhoto {
    pub(super) rgb: Vec<u8>,
    pub(super) rays: u64,
}

/// The camera's tone curve: a soft shoulder, then a square root.
pub(super) fn tone(light: Vec3) -> Vec3 {
    let shoulder = |x: f32| ((1.18 * x) / (1.0 + 0.18 * x)).max(0.0).sqrt();
    Vec3::new(shoulder(light.x), shoulder(light.y), shoulder(light.z))
}

pub(super) fn to_byte(x: f32) -> u8 {
    (x.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Gain of one photo, at least 0.2; 1 without exposure changes.
pub(super) fn gain(options: &CityOptions, view: u32) -> f32 {
    let mut draws = Stream::new(options.seed, Purpose::Sensor, u64::from(view), u64::MAX);
    (1.0 + options.exposure * draws.normal_within(3.0)).max(0.2) as f32
}

pub(super) fn take(scene: &Scene, k: &Intrinsics, shot: &Shot, view: u32, options: &CityOptions) -> ShotPhoto {
    let (width, height) = (k.width as usize, k.height as usize);
    let spread = 1.0 / k.fx;
    let mut first = vec![Sample { light: Vec3::ZERO, surface: 0 }; width * height];
    first.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, sample) in row.iter_mut().enumerate() {
            *sample = scene.sample(&shot.ray(k, x as f64 + 0.5, y as f64 + 0.5), spread);
        }
    });
    let gain = gain(options, view);
    let mut rgb = vec![0u8; 3 * width * height];
    let extra: u64 = rgb
        .par_chunks_mut(3 * width)
        .enumerate()
        .map(|(y, row)| {
            let mut noise = Stream::new(options.seed, Purpose::Sensor, u64::from(view), y as u64);
            let mut extra = 0;
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let mut light = first[y * width + x].light;
                if options.supersample > 1 && is_mixed(&first, width, height, x, y) {
                    let own = &first[y * width + x];
                    let (mean, rays) = many_rays(scene, k, shot, (x, y), options.supersample, own);
                    light = mean;
                    extra += rays;
                }
                let mut value = tone(light) * gain;
                if options.noise > 0.0 {
                    let mut draw = || (options.noise * noise.normal()) as f32;
                    value += Vec3::new(draw(), draw(), draw());
                }
                pixel.copy_from_slice(&[to_byte(value.x), to_byte(value.y), to_byte(value.z)]);
            }
            extra
        })
        .sum();
    ShotPhoto { rgb, rays: (width * height) as u64 + extra }
}

/// Whether the 3x3 pixels around (x, y) show more than one surface or differ much in brightness.
fn is_mixed(first: &[Sample], width: usize, height: usize, x: usize, y: usize) -> bool {
    let centre = first[y * width + x].surface;
    let (mut low, mut high) = (f32::INFINITY, 0.0f32);
    for row in y.saturating_sub(1)..(y + 2).min(height) {
        for sample in &first[row * width + x.saturating_sub(1)..row * width + (x + 2).min(width)] {
            if sample.surface != centre {
                return true;
            }
            let g = sample.light.y;
            (low, high) = (low.min(g), high.max(g));
        }
    }
    high - low > CONTRAST * (high + low)
}

/// Mean light of n x n rays through one pixel, and their number. The four corners are cast first: if they agree with the
/// pixel's first ray, the border between surfaces is in a neighbour, and the corners suffice.
fn many_rays(
    scene: &Scene,
    k: &Intrinsics,
    shot: &Shot,
    (x, y): (usize, usize),
    n: u32,
    first: &Sample,
) -> (Vec3, u64) {
    let cell = 1.0 / f64::from(n);
    let spread = cell / k.fx;
    let cast = |i: u32, j: u32| {
        let (px, py) = (x as f64 + (f64::from(i) + 0.5) * cell, y as f64 + (f64::from(j) + 0.5) * cell);
        let sample = scene.sample(&shot.ray(k, px, py), spread);
        // A sample is at most twice white, as in a sensor that saturates.
        Sample { light: sample.light.min(Vec3::splat(2.0)), ..sample }
    };
    let corners = [(0, 0), (n - 1, 0), (0, n - 1), (n - 1, n - 1)].map(|(i, j)| cast(i, j));
    let mut sum = corners[0].light + corners[1].light + corners[2].light + corners[3].light;
    if n == 2 {
        return (sum / 4.0, 4);
    }
    let (low, high) =
        corners.iter().fold((first.light.y, first.light.y), |(low, high), s| (low.min(s.light.y), high.max(s.light.y)));
    if corners.iter().all(|s| s.surface == first.surface) && high - low <= CONTRAST * (high + low) {
        return ((sum + first.light) / 5.0, 4);
    }
    for j in 0..n {
        for i in 0..n {
            let is_corner = (i == 0 || i == n - 1) && (j == 0 || j == n - 1);
            if !is_corner {
                sum += cast(i, j).light;
            }
        }
    }
    (sum / (n * n) as f32, u64::from(n * n))
}
