//! Disturbances of poses: photos that change places, cameras that move.

use super::{Draw, stream};
use crate::base::rng::Stream;
use crate::dataset::loader::{Dataset, View};
use crate::dataset::model::Pose;
use crate::scene::camera::Camera;
use glam::DVec3;

/// Points by which it is judged what views share, about.
const POINTS: usize = 2000;
/// Most of what one of two views sees that the other may see, for their photos to change places.
const SHARED_MOST: f64 = 0.5;

/// For each view the view whose photo it shows: `share` of them have changed places in pairs, one pair at least. A pair
/// shares less than half of what either sees; a view without such a partner stays.
pub(super) fn swapped(dataset: &Dataset, views: &[&View], share: f64, seed: u64) -> Vec<usize> {
    let stride = dataset.points.len().div_ceil(POINTS).max(1);
    let points: Vec<[f32; 3]> = dataset.points.iter().copied().step_by(stride).collect();
    let seen: Vec<Vec<bool>> =
        views.iter().map(|view| points.iter().map(|point| sees(&view.camera, *point)).collect()).collect();
    let is_far = |a: usize, b: usize| {
        let count = |of: &dyn Fn(usize) -> bool| (0..points.len()).filter(|&i| of(i)).count() as f64;
        let both = count(&|i| seen[a][i] && seen[b][i]);
        both < SHARED_MOST * count(&|i| seen[a][i]).min(count(&|i| seen[b][i]))
    };
    let mut order: Vec<usize> = (0..views.len()).collect();
    stream(seed, Draw::Swaps, 0).shuffle(&mut order);
    let mut shown: Vec<usize> = (0..views.len()).collect();
    let mut pairs = (share * views.len() as f64 / 2.0).ceil() as usize;
    for &a in &order {
        // Photos of one size, so that the photo fits its camera.
        let fits = |&b: &usize| {
            let size = |view: usize| (views[view].camera.width, views[view].camera.height);
            b != a && shown[b] == b && size(a) == size(b) && is_far(a, b)
        };
        if pairs == 0 || shown[a] != a {
            continue;
        }
        if let Some(b) = order.iter().copied().find(fits) {
            shown.swap(a, b);
            pairs -= 1;
        }
    }
    shown
}

/// Whether a point lies in the picture of a camera.
fn sees(camera: &Camera, point: [f32; 3]) -> bool {
    let [x, y, z] = camera.viewmat.map(|row| row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);
    let (u, v) = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy);
    z > camera.near_plane && (0.0..camera.width as f32).contains(&u) && (0.0..camera.height as f32).contains(&v)
}

/// The pose with its camera moved by normal noise of this standard deviation along each axis.
pub(super) fn moved(pose: Pose, deviation: f64, draws: &mut Stream) -> Pose {
    let by = DVec3::from(std::array::from_fn::<f64, 3, _>(|_| deviation * draws.normal()));
    Pose { translation: pose.translation - pose.rotation * by, ..pose }
}
