//! Which Gaussians exports leave out (`--export-clean`): those that fewer than two training photos see.
//!
//! A photo sees a Gaussian if the disc of its largest sigma reaches into the picture, and if the Gaussian is no floater: a floater is
//! nearer to the camera than `NEAR_SHARE` of the depth at which the photo's scene begins. Large Gaussians stay: they are the background
//! in the gaps of a scene; without 19 to 78 of them held-out photos of one aerial scene lose 2.5 to 10.6 dB.
//!
//! Not here: reading the rows, writing the files.
//!
//! Invariants: 1. the answer for a row is a function of the row, the cameras and the sample alone; 2. a row with a position or
//! scale that is not finite counts as seen: sinks count such rows.

use crate::base::math::exp32;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::frustum::{Frustum, PagePlanes};
use crate::scene::page_meta::PageBounds;
use rayon::prelude::*;

/// Photos that must see a Gaussian.
const PHOTOS_LEAST: u8 = 2;
/// A Gaussian nearer than this share of the depth at which a photo's scene begins is a floater of that photo.
const NEAR_SHARE: f64 = 0.3;
/// `auto` leaves out at most this share. Where more Gaussians have a single photo, photos overlap little, and held-out photos need
/// these Gaussians: .1 dB of brighton with a share of .13 %, .28 dB of seneca with .36 %, 0 with .06 %.
const AUTO_SHARE_MOST: f64 = 0.001;
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

struct SeeingPhoto {
    camera: Camera,
    planes: PagePlanes,
    nearest: f64,
}

/// The training photos of a scene, to count those that see a Gaussian.
pub struct SeeingPhotos(Vec<SeeingPhoto>);

impl SeeingPhotos {
    /// Of the cameras of training photos, for a scene of which `sample` are means (both in the local frame).
    pub fn new(cameras: &[Camera], sample: &[[f64; 3]]) -> SeeingPhotos {
        let photo = |camera: &Camera| {
            let mut depths: Vec<f64> = in_picture(camera, sample).map(|(_, depth)| depth).collect();
            let nearest = NEAR_SHARE * first_depth(&mut depths);
            SeeingPhoto { camera: *camera, planes: Frustum::new(camera).planes(), nearest }
        };
        SeeingPhotos(cameras.par_iter().map(photo).collect())
    }

    /// The number of photos that see each row, at most `PHOTOS_LEAST`.
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
            let near: Vec<&SeeingPhoto> = self.0.iter().filter(|photo| photo.planes.may_intersect(&bounds)).collect();
            for (row, count) in (first..).zip(counts) {
                let Some((mean, sigma)) = of_row(row) else { continue };
                let seeing = near.iter().filter(|photo| photo.sees(mean.map(f64::from), f64::from(sigma)));
                *count = seeing.take(usize::from(PHOTOS_LEAST)).count() as u8;
            }
        });
        counts
    }
}

impl SeeingPhoto {
    fn sees(&self, mean: [f64; 3], sigma: f64) -> bool {
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

/// How many photos must see a Gaussian for it to be exported; 0 exports all. `is_on` is `None` for `auto`, which takes the
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    /// At `x`, y = z = 0, looking along z. The picture shows |x|, |y| < depth / 2.
    fn camera(x: f32) -> Camera {
        Camera::along_z(x, [100.0, 100.0, 50.0, 50.0], [100, 100])
    }

    /// Rows of these means and largest sigmas.
    fn rows(of: &[([f32; 3], f32)]) -> Columns {
        let mut rows = Columns::zeros(of.len(), 0);
        for (row, (mean, sigma)) in of.iter().enumerate() {
            rows.means[3 * row..][..3].copy_from_slice(mean);
            rows.scales[3 * row..][..3].copy_from_slice(&[-9.0, sigma.ln(), -8.0]);
        }
        rows
    }

    #[test]
    fn photos_see_what_reaches_their_pictures_but_no_floaters() {
        // A wall at depth 10, so that the scene of a photo begins there.
        let wall: Vec<[f64; 3]> = (0..20).map(|i| [f64::from(i) - 8.0, 0.0, 10.0]).collect();
        let photos = SeeingPhotos::new(&[camera(0.0), camera(4.0)], &wall);
        let cases = [
            (([2.0, 0.0, 10.0], 0.1), 2, "in both pictures"),
            (([-3.0, 0.0, 10.0], 0.1), 1, "in the left picture"),
            (([-3.0, 0.0, 10.0], 2.1), 2, "its disc reaches the right picture"),
            (([-7.0, 0.0, 10.0], 0.1), 0, "beside both"),
            (([2.0, 6.0, 10.0], 0.9), 0, "below both, and its disc ends before"),
            (([2.0, 0.0, -10.0], 99.0), 0, "behind both"),
            (([2.0, 0.0, 2.9], 2.0), 0, "before the lenses"),
            (([2.0, 0.0, 3.1], 2.0), 2, "far enough from the lenses"),
            (([2.0, 0.0, 1e4], 1e3), 2, "a giant behind the scene"),
            (([f32::NAN, 0.0, 10.0], 0.1), 2, "not finite"),
            (([-7.0, 0.0, 10.0], f32::INFINITY), 2, "not finite either"),
        ];
        let counts = photos.of_rows(&rows(&cases.map(|(row, ..)| row)));
        for ((_, count, what), found) in cases.iter().zip(&counts) {
            assert_eq!(count, found, "{what}");
        }
        // Without a sample, nothing is known of depths.
        assert_eq!(SeeingPhotos::new(&[camera(2.0)], &[]).of_rows(&rows(&[([2.0, 0.0, 1.0], 0.1)])), [1]);
    }

    #[test]
    fn parts_and_threads_change_no_answer() {
        let mut stream = Stream::new(7, Purpose::Test, 0, 0);
        let mut normal = || stream.normal() as f32;
        let many: Vec<([f32; 3], f32)> =
            (0..3000).map(|_| ([9.0 * normal(), 4.0 * normal(), 9.0 + 2.0 * normal()], 0.1 * normal().exp())).collect();
        let sample: Vec<[f64; 3]> = many.iter().map(|(mean, _)| mean.map(f64::from)).collect();
        let cameras: Vec<Camera> = (-2..3).map(|x| camera(6.0 * x as f32)).collect();
        let photos = SeeingPhotos::new(&cameras, &sample);
        let whole = photos.of_rows(&rows(&many));
        let parts: Vec<u8> = many.chunks(700).flat_map(|part| photos.of_rows(&rows(part))).collect();
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(whole, parts);
        assert_eq!(whole, alone.install(|| SeeingPhotos::new(&cameras, &sample).of_rows(&rows(&many))));
        assert!((0..=2).all(|count| whole.iter().filter(|&&found| found == count).count() > 100));
    }

    #[test]
    fn auto_leaves_out_few() {
        let of = |none: usize, one: usize| [vec![0; none], vec![1; one], vec![2; 1000 - none - one]].concat();
        for ((none, one), required) in [((0, 1), 2), ((1, 0), 2), ((0, 2), 1), ((1, 900), 1), ((2, 0), 0)] {
            assert_eq!(photos_required(None, &of(none, one)), required, "{none} {one}");
        }
        assert_eq!((photos_required(Some(true), &of(9, 9)), photos_required(Some(false), &of(9, 9))), (2, 0));
        assert_eq!(photos_required(None, &[]), 2);
    }
}
