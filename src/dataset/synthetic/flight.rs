//! Plans the flight: the camera's pose for every photo.
//!
//! The flight has two passes of parallel strips at one altitude; the second pass crosses the first. The camera looks
//! forward and down, and neighbouring strips have opposite directions, so that every wall is seen. Strips cover the
//! places that the camera aims at: the camera itself starts outside the city.
//!
//! Overview photos follow after the two passes: straight down from high above the middle of the city.
//!
//! Invariants: 1. poses depend on the options alone; 2. within a pass, photos overlap by 75 % along a strip and by 60 %
//! across (in the middle of the pictures), unless the user chose the number of blocks.

use super::CityOptions;
use super::trace::Ray;
use super::world::PITCH;
use crate::base::rng::{Purpose, Stream};
use crate::dataset::model::{Intrinsics, Lens, Pose};
use glam::{DMat3, DVec2, DVec3};

/// Camera height above the ground, metres.
const ALTITUDE: f64 = 82.0;
/// Focal length as a fraction of the picture's width.
const FOCAL: f64 = 0.9;
/// Overlap of neighbouring photos in a strip, and of neighbouring strips.
const FORWARD_OVERLAP: f64 = 0.75;
const SIDE_OVERLAP: f64 = 0.60;

/// One photo's camera, in the city's frame (without the offset).
#[derive(Debug, Clone)]
pub(super) struct Shot {
    /// World to camera.
    pub(super) rotation: DMat3,
    pub(super) centre: DVec3,
    /// Place on the ground that the camera aims at.
    pub(super) aim: DVec2,
    /// Copies of the city that the photo shows; `None`: one.
    copies: Option<Copies>,
}

/// Copies of the city, side by side.
#[derive(Debug, Clone, Copy)]
struct Copies {
    /// Side of one copy, metres.
    side: f64,
    /// Number along x and y.
    counts: [u32; 2],
}

impl Copies {
    /// The ray, moved into the copy where it meets the ground. At the border of two copies the picture lacks the parts of
    /// roofs that hide another copy's ground.
    fn fold(&self, ray: Ray) -> Ray {
        let ground = ray.at(-ray.from.z * ray.inverse.z);
        let copy = |x: f64, count: u32| (x / self.side).round().clamp(0.0, f64::from(count - 1));
        let offset = DVec3::new(copy(ground.x, self.counts[0]), copy(ground.y, self.counts[1]), 0.0) * self.side;
        Ray { from: ray.from - offset, ..ray }
    }
}

/// The flight: one camera, one pose per photo.
pub(super) struct CityFlight {
    pub(super) intrinsics: Intrinsics,
    pub(super) shots: Vec<Shot>,
    pub(super) blocks: u32,
}

impl Shot {
    pub(super) fn pose(&self, offset: DVec3) -> Pose {
        Pose { rotation: self.rotation, translation: -(self.rotation * (self.centre + offset)) }
    }

    pub(super) fn ray(&self, k: &Intrinsics, x: f64, y: f64) -> Ray {
        let d = DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
        let ray = Ray::new(self.centre, self.rotation.transpose() * (d / d.length()));
        self.copies.map_or(ray, |copies| copies.fold(ray))
    }

    /// Picture position of a point, if it is in front of the camera and inside the picture.
    pub(super) fn project(&self, k: &Intrinsics, point: DVec3) -> Option<DVec2> {
        let p = self.rotation * (point - self.centre);
        if p.z <= 0.1 {
            return None;
        }
        let at = DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(k.width) && at.y < f64::from(k.height);
        inside.then_some(at)
    }
}

pub(super) fn plan(options: &CityOptions) -> CityFlight {
    let (width, height) = (f64::from(options.width), f64::from(options.height));
    let focal = FOCAL * width;
    let intrinsics = Intrinsics {
        width: options.width,
        height: options.height,
        fx: focal,
        fy: focal,
        cx: 0.5 * width,
        cy: 0.5 * height,
        lens: Lens::Pinhole,
    };
    let half_height = libm::atan(0.5 * height / focal);
    // The angle to the vertical is smaller for tall pictures, so that the horizon stays outside.
    let tilt = (40.0f64).min(66.0 - half_height.to_degrees()).max(0.0).to_radians();
    let length = ALTITUDE * (libm::tan(tilt + half_height) - libm::tan(tilt - half_height));
    let breadth = ALTITUDE / libm::cos(tilt) * width / focal;
    let (step, spacing) = ((1.0 - FORWARD_OVERLAP) * length, (1.0 - SIDE_OVERLAP) * breadth);
    let per_pass = 0.5 * f64::from(options.views);
    let side = (per_pass * step * spacing).sqrt();
    // Rounded down to whole blocks, which only increases the overlap.
    let blocks = options.blocks.unwrap_or(((side / PITCH) as u32).max(1));
    let side = f64::from(blocks) * PITCH;
    let mut shots = Vec::with_capacity(options.photos() as usize);
    let first = options.views.div_ceil(2);
    for (pass, views) in [(0u32, first), (1, options.views - first)] {
        fly_pass(options, pass, views, side, tilt, step / spacing, &mut shots);
    }
    (0..options.overviews).for_each(|_| shots.push(overview(options, side, shots.len() as u64)));
    CityFlight { intrinsics, shots, blocks }
}

/// A photo straight down on the middle of all copies that shows the options' `overview_area` of them; `side` is that of one copy.
fn overview(options: &CityOptions, side: f64, number: u64) -> Shot {
    let (width, height) = (f64::from(options.width), f64::from(options.height));
    let [across, along] = options.tiles.map(f64::from);
    let breadth = side * (options.overview_area * across * along * width / height).sqrt();
    let mut draws = Stream::new(options.seed, Purpose::City, number, 5);
    let shift = DVec2::new(draws.normal_within(2.5), draws.normal_within(2.5)) * (0.02 * side);
    let aim = DVec2::new(across - 1.0, along - 1.0) * (0.5 * side) + shift;
    let heading = DVec2::new(0.0, 1.0);
    let copies = (options.tiles != [1, 1]).then_some(Copies { side, counts: options.tiles });
    Shot { rotation: attitude(heading, 0.0, 0.0, 0.0), centre: aim.extend(FOCAL * breadth), aim, copies }
}

/// One pass of strips over the square of this side; `ratio` is step / spacing.
fn fly_pass(options: &CityOptions, pass: u32, views: u32, side: f64, tilt: f64, ratio: f64, shots: &mut Vec<Shot>) {
    if views == 0 {
        return;
    }
    let strips = ((f64::from(views) * ratio).sqrt() + 0.5).clamp(1.0, f64::from(views)) as u32;
    let back = ALTITUDE * libm::tan(tilt);
    // The user's tilt turns cameras up or down at their places: they look past the places that they aimed at.
    let tilt = options.tilt.map_or(tilt, f64::to_radians);
    for strip in 0..strips {
        let (from, to) = (views * strip / strips, views * (strip + 1) / strips);
        let across = (f64::from(strip) + 0.5) / f64::from(strips) * side - 0.5 * side;
        let sign = if strip % 2 == 0 { 1.0 } else { -1.0 };
        for k in 0..to - from {
            let along = ((f64::from(k) + 0.5) / f64::from(to - from) * side - 0.5 * side) * sign;
            let (aim, heading) = if pass == 0 {
                (DVec2::new(along, across), DVec2::new(sign, 0.0))
            } else {
                (DVec2::new(across, along), DVec2::new(0.0, sign))
            };
            let mut draws = Stream::new(options.seed, Purpose::City, shots.len() as u64, 5);
            let shift = DVec3::new(draws.normal_within(2.5), draws.normal_within(2.5), 0.6 * draws.normal_within(2.5));
            let level = (aim - heading * back).extend(ALTITUDE) + shift * 1.2;
            let (yaw, pitch, roll) =
                (0.035 * draws.normal_within(2.5), 0.025 * draws.normal_within(2.5), 0.02 * draws.normal_within(2.5));
            shots.push(Shot { rotation: attitude(heading, yaw, tilt + pitch, roll), centre: level, aim, copies: None });
        }
    }
}

/// World-to-camera rotation (x right, y down, z forward) of a camera that looks along `heading` rotated by `yaw`, at the
/// angle `tilt` to the vertical, rotated by `roll` about its axis.
fn attitude(heading: DVec2, yaw: f64, tilt: f64, roll: f64) -> DMat3 {
    let (c, s) = (libm::cos(yaw), libm::sin(yaw));
    let ahead = DVec2::new(c * heading.x - s * heading.y, s * heading.x + c * heading.y);
    let forward = (ahead * libm::sin(tilt)).extend(-libm::cos(tilt));
    let right = DVec3::new(ahead.y, -ahead.x, 0.0);
    let down = forward.cross(right);
    let (c, s) = (libm::cos(roll), libm::sin(roll));
    DMat3::from_cols(right * c + down * s, down * c - right * s, forward).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_overview_photo_shows_its_share_of_the_city() {
        for (tiles, overview_area) in [([1, 1], 0.4), ([2, 3], 0.4), ([2, 3], 0.1)] {
            let options = CityOptions { views: 100, overviews: 2, overview_area, tiles, ..CityOptions::default() };
            let flight = plan(&options);
            let k = &flight.intrinsics;
            let side = PITCH * f64::from(flight.blocks);
            let places = |n: u32, copies: u32| (f64::from(n) + 0.5) / 100.0 * side * f64::from(copies) - 0.5 * side;
            for shot in &flight.shots[100..] {
                let at = |x, y| DVec3::new(places(x, tiles[0]), places(y, tiles[1]), 0.0);
                let grid = (0..100).flat_map(|x| (0..100).map(move |y| at(x, y)));
                let seen = grid.filter(|place| shot.project(k, *place).is_some()).count();
                // A grid of 100 by 100 places counts a row or column too many or too few.
                assert!((seen as f64 - 1e4 * overview_area).abs() <= 100.0, "{seen} of 10,000 places");
                let ray = shot.ray(k, 0.0, 0.0);
                let ground = ray.at(-ray.from.z * ray.inverse.z);
                assert!(ground.x.abs().max(ground.y.abs()) <= 0.5 * side * 1.0001, "{ground} lies in the first copy");
            }
        }
    }

    #[test]
    fn cameras_that_look_higher_stand_where_the_others_do_and_see_the_sky() {
        let shots = |tilt| plan(&CityOptions { tilt, ..CityOptions::default() });
        let (level, high) = (shots(None), shots(Some(80.0)));
        for (level, shot) in level.shots.iter().zip(&high.shots) {
            let k = &high.intrinsics;
            let [top, bottom] = [0.0, 2.0 * k.cy].map(|y| shot.ray(k, k.cx, y).inverse.z);
            assert!(shot.centre == level.centre && top > 0.0 && bottom < 0.0, "{shot:?}");
        }
    }

    #[test]
    fn neighbours_overlap_as_promised_and_cameras_look_at_the_city() {
        for views in [60, 400] {
            let flight = plan(&CityOptions { views, ..CityOptions::default() });
            assert_eq!(flight.shots.len(), views as usize);
            let half = 0.5 * PITCH * f64::from(flight.blocks);
            let mut pairs = 0;
            for pair in flight.shots.windows(2) {
                for s in pair {
                    assert!(s.aim.x.abs() <= half && s.aim.y.abs() <= half);
                    assert!((s.rotation.determinant() - 1.0).abs() < 1e-12);
                    let k = &flight.intrinsics;
                    let hit = s.ray(k, k.cx, k.cy);
                    let ground = hit.at(-hit.from.z * hit.inverse.z);
                    // Attitude jitter (2.5 sigma of 2 degrees at 107 m, stretched by the tilt) and position jitter.
                    assert!((ground.truncate() - s.aim).length() < 20.0);
                }
                // Neighbours of one strip: the aim moves along the heading by no more than a quarter picture,
                // whose length on the ground is 82 m (tan 58.4 - tan 21.6) = 101 m.
                let step = pair[1].aim - pair[0].aim;
                let ahead = pair[0].rotation.row(2).truncate().normalize();
                if step.dot(ahead) > 0.9 * step.length() {
                    pairs += 1;
                    // A tenth more where strips do not divide the views evenly.
                    assert!(step.length() < 0.25 * 101.0 * 1.1, "{step}");
                }
            }
            assert!(pairs > views as usize / 2);
        }
    }
}
