//! A short tour through all places, each visited once.
//!
//! Two first tours (a serpentine over strips of the widest plane, and a walk to the nearest unvisited place) are shortened by
//! reversing parts of them (2-opt: Croes 1958, "A method for solving traveling-salesman problems"), and the shorter one is taken.
//! The serpentine finds flights in strips, the walk finds orbits.
//!
//! Invariants: 1. the tour is a function of the places alone; 2. time grows with the number of places, but for the walk,
//! which is tried up to `NEAREST_MAX` places.

use super::places::{Place, distance_sq};

/// Most places for which the way to the nearest is tried: its time grows with their square.
const NEAREST_MAX: usize = 6000;
/// Longest part of the way that is turned round.
const PART_MAX: usize = 120;
/// Rounds over the whole way.
const ROUNDS_MAX: usize = 30;
/// Iterations that find a principal direction; captures need no accuracy here.
const POWER_ITERATIONS: usize = 60;

/// The numbers of all places in the order of the way.
pub fn tour(places: &[Place]) -> Vec<u32> {
    let mut way = serpentine(places);
    shorten(places, &mut way);
    if places.len() > NEAREST_MAX {
        return way;
    }
    let mut other = nearest(places, way.first().copied().unwrap_or(0));
    shorten(places, &mut other);
    if length(places, &other) < length(places, &way) { other } else { way }
}

fn step(places: &[Place], a: u32, b: u32) -> f64 {
    distance_sq(&places[a as usize], &places[b as usize]).sqrt()
}

pub fn length(places: &[Place], way: &[u32]) -> f64 {
    way.windows(2).map(|pair| step(places, pair[0], pair[1])).sum()
}

/// Strips of the plane of the two widest directions, there and back.
fn serpentine(places: &[Place]) -> Vec<u32> {
    let mut left: Vec<Place> = centred(places);
    let (along, extent) = extract_principal_axis(&mut left);
    let (across, breadth) = extract_principal_axis(&mut left);
    let mut way: Vec<u32> = (0..places.len() as u32).collect();
    // Square cells: as many strips as places across.
    let strips = (places.len() as f64 * breadth / extent.max(1e-300)).sqrt().clamp(1.0, places.len().max(1) as f64);
    let strips = (strips + 0.5) as usize;
    let by = |values: &[f64], a: u32, b: u32| values[a as usize].total_cmp(&values[b as usize]).then(a.cmp(&b));
    way.sort_unstable_by(|&a, &b| by(&across, a, b));
    let size = places.len().div_ceil(strips).max(1);
    for (strip, part) in way.chunks_mut(size).enumerate() {
        part.sort_unstable_by(|&a, &b| by(&along, a, b));
        if strip % 2 == 1 {
            part.reverse();
        }
    }
    way
}

fn centred(places: &[Place]) -> Vec<Place> {
    let mut middle = [0.0; 6];
    for place in places {
        (0..6).for_each(|i| middle[i] += place[i] / places.len() as f64);
    }
    places.iter().map(|place| std::array::from_fn(|i| place[i] - middle[i])).collect()
}

/// The coordinates along the direction in which centred places vary most, with their standard deviation; the places
/// lose that direction.
fn extract_principal_axis(places: &mut [Place]) -> (Vec<f64>, f64) {
    // Started from the coordinate that varies most, which is never across the widest direction.
    let spread = |i: usize| places.iter().map(|p| p[i] * p[i]).sum::<f64>();
    let widest = (0..6).fold(0, |best, i| if spread(i) > spread(best) { i } else { best });
    let mut direction: Place = std::array::from_fn(|i| f64::from(u8::from(i == widest)));
    for _ in 0..POWER_ITERATIONS {
        let mut next = [0.0; 6];
        for place in places.iter() {
            let along: f64 = (0..6).map(|i| place[i] * direction[i]).sum();
            (0..6).for_each(|i| next[i] += along * place[i]);
        }
        let norm = next.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm <= 0.0 || !norm.is_finite() {
            break;
        }
        direction = next.map(|x| x / norm);
    }
    let along: Vec<f64> = places.iter().map(|p| (0..6).map(|i| p[i] * direction[i]).sum()).collect();
    for (place, x) in places.iter_mut().zip(&along) {
        (0..6).for_each(|i| place[i] -= x * direction[i]);
    }
    let variance = along.iter().map(|x| x * x).sum::<f64>() / along.len().max(1) as f64;
    (along, variance.sqrt())
}

/// From `first`, always on to the nearest place that is left.
fn nearest(places: &[Place], first: u32) -> Vec<u32> {
    let mut left: Vec<u32> = (0..places.len() as u32).filter(|&p| p != first).collect();
    let mut way = vec![first];
    way.truncate(places.len());
    while let Some(&last) = way.last().filter(|_| !left.is_empty()) {
        let mut best = (f64::INFINITY, 0);
        for (i, &place) in left.iter().enumerate() {
            let d = distance_sq(&places[last as usize], &places[place as usize]);
            if d < best.0 || (d == best.0 && place < left[best.1]) {
                best = (d, i);
            }
        }
        way.push(left.swap_remove(best.1));
    }
    way
}

/// Turns round parts of the way as long as that makes it shorter. The ends are free.
fn shorten(places: &[Place], way: &mut [u32]) {
    for _ in 0..ROUNDS_MAX {
        let mut gained = false;
        for i in 0..way.len().saturating_sub(1) {
            for j in i + 1..way.len().min(i + PART_MAX) {
                // The part i..=j; its steps from and to the rest change.
                let before = |i: usize, to: u32| if i == 0 { 0.0 } else { step(places, way[i - 1], to) };
                let after = |j: usize, from: u32| way.get(j + 1).map_or(0.0, |&next| step(places, from, next));
                let now = before(i, way[i]) + after(j, way[j]);
                let turned = before(i, way[j]) + after(j, way[i]);
                if turned < now * (1.0 - 1e-9) {
                    way[i..=j].reverse();
                    gained = true;
                }
            }
        }
        if !gained {
            break;
        }
    }
}
