//! Places: what views look at and from, as points; and cuts of such points into neighbourhoods.
//!
//! A place has six coordinates: the camera's centre with a small weight, and the point that the camera looks at, which lies at the
//! same depth in front of all cameras of a capture. Views that look at the same point see the same pages, wherever their cameras
//! are: on a tilted flight with strips of all headings, 25 groups by both with equal weight read .105 of the pages that
//! they need from a quarter of the frames, by these weights .029, by the point alone .029. Around an object the points
//! are all the same, and centres decide.
//!
//! Invariants: 1. all results are functions of the cameras (and the draws given) alone, the same on every platform;
//! 2. ties are broken by the number of the view.

use crate::base::rng::Stream;
use crate::scene::camera::Camera;

/// Weight of a difference of centres against one of the points looked at: any from 0 to 0.25 groups a tilted flight
/// alike, and this one gives the shortest tour.
const CENTRE_WEIGHT: f64 = 0.1;

/// Weighted centre, and point looked at.
pub type Place = [f64; 6];

/// Part of the mean curvature added to the system for the common point, so that parallel axes have one too: their centre.
const RIDGE: f64 = 1e-6;

pub fn places(cameras: &[Camera]) -> Vec<Place> {
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
pub fn distance_sq(a: &Place, b: &Place) -> f64 {
    (0..6).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum()
}

/// Cuts `views` into `groups` neighbourhoods (at least one view each, so at most as many as there are views) by halving
/// along the longest axis, again and again. Every cut is moved by up to `play` of a group's size at random.
pub fn cut(places: &[Place], mut views: Vec<u32>, groups: usize, play: f64, draws: &mut Stream) -> Vec<Vec<u32>> {
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

fn longest_axis(places: &[Place], views: &[u32]) -> usize {
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
pub fn mean(places: &[Place], views: &[u32]) -> Place {
    let sum = |i: usize| views.iter().map(|&v| places[v as usize][i]).sum::<f64>();
    std::array::from_fn(|i| sum(i) / views.len() as f64)
}
