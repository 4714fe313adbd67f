//! Places (what views look at and from, as points), cuts of them into neighbourhoods, and a short tour through all of them.
//!
//! A place has six coordinates: the camera's centre with a small weight, and the point that the camera looks at, which lies at the
//! same depth in front of all cameras of a capture. Views that look at the same point see the same pages, wherever their cameras
//! are: on a tilted flight with strips of all headings, 25 groups by both with equal weight read .105 of the pages that
//! they need from a quarter of the frames, by these weights .029, by the point alone .029. Around an object the points
//! are all the same, and centres decide.
//!
//! Two first tours (a serpentine over strips of the widest plane, and a walk to the nearest unvisited place) are shortened by
//! reversing parts of them (2-opt: Croes 1958, "A method for solving traveling-salesman problems"), and the shorter one is taken.
//! The serpentine finds flights in strips, the walk finds orbits.
//!
//! Invariants: 1. all results are functions of the cameras (and the draws given) alone, the same on every platform; ties are broken by the
//! number of the view; 2. time grows with the number of places, but for the walk, which is tried up to `NEAREST_MAX` places.

use crate::base::rng::Stream;
use crate::scene::camera::Camera;

/// Most places for which the way to the nearest is tried: its time grows with their square.
const NEAREST_MAX: usize = 6000;
/// Longest part of the way that is turned round.
const PART_MAX: usize = 120;
/// Rounds over the whole way.
const ROUNDS_MAX: usize = 30;
/// Iterations that find a principal direction; captures need no accuracy here.
const POWER_ITERATIONS: usize = 60;

/// The numbers of all places in the order of the way.
pub fn tour(places: &[ViewPlace]) -> Vec<u32> {
    let mut way = serpentine(places);
    shorten(places, &mut way);
    if places.len() > NEAREST_MAX {
        return way;
    }
    let mut other = nearest(places, way.first().copied().unwrap_or(0));
    shorten(places, &mut other);
    if length(places, &other) < length(places, &way) { other } else { way }
}

fn step(places: &[ViewPlace], a: u32, b: u32) -> f64 {
    distance_sq(&places[a as usize], &places[b as usize]).sqrt()
}

pub fn length(places: &[ViewPlace], way: &[u32]) -> f64 {
    way.windows(2).map(|pair| step(places, pair[0], pair[1])).sum()
}

/// Strips of the plane of the two widest directions, there and back.
fn serpentine(places: &[ViewPlace]) -> Vec<u32> {
    let mut left: Vec<ViewPlace> = centred(places);
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

fn centred(places: &[ViewPlace]) -> Vec<ViewPlace> {
    let mut middle = [0.0; 6];
    for place in places {
        (0..6).for_each(|i| middle[i] += place[i] / places.len() as f64);
    }
    places.iter().map(|place| std::array::from_fn(|i| place[i] - middle[i])).collect()
}

/// The coordinates along the direction in which centred places vary most, with their standard deviation; the places
/// lose that direction.
fn extract_principal_axis(places: &mut [ViewPlace]) -> (Vec<f64>, f64) {
    // Started from the coordinate that varies most, which is never across the widest direction.
    let spread = |i: usize| places.iter().map(|p| p[i] * p[i]).sum::<f64>();
    let widest = (0..6).fold(0, |best, i| if spread(i) > spread(best) { i } else { best });
    let mut direction: ViewPlace = std::array::from_fn(|i| f64::from(u8::from(i == widest)));
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
fn nearest(places: &[ViewPlace], first: u32) -> Vec<u32> {
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
fn shorten(places: &[ViewPlace], way: &mut [u32]) {
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

/// Weight of a difference of centres against one of the points looked at: any from 0 to 0.25 groups a tilted flight
/// alike, and this one gives the shortest tour.
const CENTRE_WEIGHT: f64 = 0.1;

/// Weighted centre, and point looked at.
pub type ViewPlace = [f64; 6];

/// Part of the mean curvature added to the system for the common point, so that parallel axes have one too: their centre.
const RIDGE: f64 = 1e-6;

pub fn places(cameras: &[Camera]) -> Vec<ViewPlace> {
    let depth = depth_of_subject(cameras);
    let place = |camera: &Camera| {
        let (c, f) = (centre(camera), forward(camera));
        std::array::from_fn(|i| if i < 3 { CENTRE_WEIGHT * c[i] } else { c[i - 3] + depth * f[i - 3] })
    };
    cameras.iter().map(place).collect()
}

fn centre(camera: &Camera) -> [f64; 3] {
    camera.centre().map(f64::from)
}

fn forward(camera: &Camera) -> [f64; 3] {
    std::array::from_fn(|i| f64::from(camera.viewmat[2][i]))
}

/// How far in front of the cameras their subject lies: the mean depth of the point that is closest to all optical axes.
/// Around an object this is the distance to it; on a flight with tilted cameras it is the distance to the ground, since
/// strips of all headings cover the same ground. 0 where axes part or are parallel: then places are centres alone.
fn depth_of_subject(cameras: &[Camera]) -> f64 {
    let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
    let mut middle = [0.0; 3];
    for camera in cameras {
        let (c, f) = (centre(camera), forward(camera));
        for i in 0..3 {
            middle[i] += c[i] / cameras.len() as f64;
        }
        for i in 0..3 {
            for j in 0..3 {
                // The projection along the axis: what is left of a difference is its distance from the axis.
                let across = f64::from(u8::from(i == j)) - f[i] * f[j];
                a[i][j] += across;
                b[i] += across * c[j];
            }
        }
    }
    let ridge = RIDGE * (a[0][0] + a[1][1] + a[2][2]) / 3.0;
    for i in 0..3 {
        a[i][i] += ridge;
        b[i] += ridge * middle[i];
    }
    let point = solve(a, b);
    let depth = |camera: &Camera| {
        let (c, f) = (centre(camera), forward(camera));
        (0..3).map(|i| f[i] * (point[i] - c[i])).sum::<f64>() / cameras.len() as f64
    };
    let mean: f64 = cameras.iter().map(depth).sum();
    if mean.is_finite() { mean.max(0.0) } else { 0.0 }
}

/// Cramer's rule.
fn solve(a: [[f64; 3]; 3], b: [f64; 3]) -> [f64; 3] {
    let det = |m: [[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let whole = det(a);
    std::array::from_fn(|column| {
        let mut replaced = a;
        (0..3).for_each(|row| replaced[row][column] = b[row]);
        det(replaced) / whole
    })
}

/// Squared distance of two places.
pub fn distance_sq(a: &ViewPlace, b: &ViewPlace) -> f64 {
    (0..6).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum()
}

/// Cuts `views` into `groups` neighbourhoods (at least one view each, so at most as many as there are views) by halving
/// along the longest axis, again and again. Every cut is moved by up to `play` of a group's size at random.
pub fn cut(places: &[ViewPlace], mut views: Vec<u32>, groups: usize, play: f64, draws: &mut Stream) -> Vec<Vec<u32>> {
    if groups <= 1 || views.len() <= 1 {
        return vec![views];
    }
    let axis = longest_axis(places, &views);
    let order = |&a: &u32, &b: &u32| places[a as usize][axis].total_cmp(&places[b as usize][axis]).then(a.cmp(&b));
    views.sort_unstable_by(order);
    let (left, right) = (groups / 2, groups - groups / 2);
    let at = views.len() as f64 / groups as f64 * (left as f64 + play * draws.range(-1.0, 1.0));
    // Each side keeps a view for each of its groups.
    let most = views.len().saturating_sub(right).max(1);
    let high = views.split_off((at as usize).max(left).min(most));
    let mut out = cut(places, views, left, play, draws);
    out.append(&mut cut(places, high, right, play, draws));
    out
}

fn longest_axis(places: &[ViewPlace], views: &[u32]) -> usize {
    let mut axis = (0, f64::NEG_INFINITY);
    for i in 0..6 {
        let (low, high) = views.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| {
            let x = places[v as usize][i];
            (low.min(x), high.max(x))
        });
        if high - low > axis.1 {
            axis = (i, high - low);
        }
    }
    axis.0
}

/// Mean of the places of `views`, which is not empty.
pub fn mean(places: &[ViewPlace], views: &[u32]) -> ViewPlace {
    let sum = |i: usize| views.iter().map(|&v| places[v as usize][i]).sum::<f64>();
    std::array::from_fn(|i| sum(i) / views.len() as f64)
}
