//! Samples points as structure from motion finds them: visible places with matching noise, and tracks of the photos that
//! see them.
//!
//! Invariants: 1. point k depends on (scene, flight, options, k) alone; 2. a track contains each photo at most once, in
//! ascending order; 3. overview photos see no points; 4. every observation is the projection of the true place plus noise, and inside its photo.

use super::CityOptions;
use super::flight::{CityFlight, Shot};
use super::photo::{to_byte, tone};
use super::shade::{Hit, Scene};
use crate::base::rng::{Purpose, Stream};
use crate::dataset::colmap_write::{Observation, Point};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Number of neighbouring photos that are searched for further observations.
const NEIGHBOURS: usize = 16;
/// Noise of one observation, pixels per coordinate.
const MATCH_NOISE: f64 = 0.5;
/// Most draws for a place that two photos see; the last draw is used in any case.
const TRIES: u32 = 6;

/// Samples the points. A point whose draws all see the sky is left out.
pub(super) fn sample(scene: &Scene, flight: &CityFlight, options: &CityOptions) -> Vec<Point> {
    let neighbours = neighbours(&flight.shots[..options.views as usize]);
    (0..options.points).into_par_iter().filter_map(|k| one_point(scene, flight, options, &neighbours, k)).collect()
}

/// For each photo, the other photos with the nearest aims.
fn neighbours(shots: &[Shot]) -> Vec<Vec<u32>> {
    shots
        .par_iter()
        .enumerate()
        .map(|(k, shot)| {
            let mut others: Vec<(f64, u32)> = (0..shots.len())
                .filter(|&j| j != k)
                .map(|j| ((shots[j].aim - shot.aim).length_squared(), j as u32))
                .collect();
            let keep = NEIGHBOURS.min(others.len());
            if keep < others.len() {
                others.select_nth_unstable_by(keep, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                others.truncate(keep);
            }
            others.into_iter().map(|(_, j)| j).collect()
        })
        .collect()
}

fn one_point(
    scene: &Scene,
    flight: &CityFlight,
    options: &CityOptions,
    neighbours: &[Vec<u32>],
    number: u32,
) -> Option<Point> {
    let k = &flight.intrinsics;
    let view = number % options.views;
    let shot = &flight.shots[view as usize];
    let mut draws = Stream::new(options.seed, Purpose::City, u64::from(number), 6);
    let mut found = None;
    for _ in 0..TRIES {
        let at = DVec2::new(draws.range(0.0, f64::from(k.width)), draws.range(0.0, f64::from(k.height)));
        let ray = shot.ray(k, at.x, at.y);
        let Some(hit) = scene.hit(&ray) else { continue };
        let mut seen = vec![(view, at)];
        for &j in &neighbours[view as usize] {
            let other = &flight.shots[j as usize];
            if let Some(there) = other.project(k, hit.point)
                && scene.sees(other.centre, &hit)
            {
                seen.push((j, there));
            }
        }
        let enough = seen.len() >= 2;
        found = Some((ray, hit, seen));
        if enough {
            break;
        }
    }
    let (ray, hit, mut seen) = found?;
    let color = tone(scene.shade(&ray, &hit, 1.0 / k.fx).light);
    seen.sort_unstable_by_key(|&(j, _)| j);
    let position = disturbed(&hit, shot, 1.0 / k.fx, &mut draws);
    let mut observations = Vec::with_capacity(seen.len());
    let mut error = 0.0;
    for (j, at) in seen {
        let noise = DVec2::new(draws.normal_within(3.0), draws.normal_within(3.0)) * MATCH_NOISE;
        let border = DVec2::new(f64::from(k.width), f64::from(k.height)) - 1e-3;
        let seen_at = (at + noise).clamp(DVec2::ZERO, border);
        let exact = flight.shots[j as usize].project(k, position).unwrap_or(at);
        error += (exact - seen_at).length();
        observations.push(Observation { image: j, at: seen_at.into() });
    }
    let rgb = [to_byte(color.x), to_byte(color.y), to_byte(color.z)];
    let error = error / observations.len() as f64;
    Some(Point { position: (position + DVec3::from(options.offset)).into(), rgb, error, observations })
}

/// Moves the place by the matching error: half a pixel across the line of sight, one pixel along it.
fn disturbed(hit: &Hit, shot: &Shot, spread: f64, draws: &mut Stream) -> DVec3 {
    let pixel = hit.t * spread * MATCH_NOISE;
    let noise = DVec3::new(draws.normal_within(3.0), draws.normal_within(3.0), 2.0 * draws.normal_within(3.0)) * pixel;
    hit.point + shot.rotation.transpose() * noise
}
