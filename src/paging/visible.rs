//! Which pages a view needs, by a conservative test of their boxes against the planes of the view.

use crate::base::ids::PageNo;
use crate::scene::camera::Camera;
use crate::scene::page_meta::{PageBounds, PageMeta};

/// Sigmas to which a row is drawn.
const EXTENT_SIGMAS: f32 = 3.33;

/// Numbers of the pages that `camera` may see, ascending.
pub fn visible_pages(index: &[PageMeta], camera: &Camera, out: &mut Vec<PageNo>) {
    out.clear();
    let seen = |meta: &PageMeta| !meta.bounds.is_empty() && may_see(camera, &meta.bounds);
    out.extend((0..index.len()).filter(|&i| seen(&index[i])).map(|i| PageNo(i as u32)));
}

fn may_see(camera: &Camera, bounds: &PageBounds) -> bool {
    let (centre, half) = centre_and_half(bounds);
    let m = &camera.viewmat;
    // Largest value over the box of an affine function of the position, given in camera axes.
    let largest = |a: [f32; 3], constant: f32| {
        let mut value = constant;
        for j in 0..3 {
            let slope = a[0] * m[0][j] + a[1] * m[1][j] + a[2] * m[2][j];
            value += slope * centre[j] + slope.abs() * half[j] + 1e-5 * slope.abs() * (centre[j].abs() + half[j]);
        }
        let shift = a[0] * m[0][3] + a[1] * m[1][3] + a[2] * m[2][3];
        value + shift + 1e-5 * shift.abs()
    };
    let z_ok =
        largest([0.0, 0.0, 1.0], -camera.near_plane) >= 0.0 && largest([0.0, 0.0, -1.0], camera.far_plane) >= 0.0;
    let axis = |size: u32, f: f32, c: f32, row: usize| {
        let size = size as f32;
        let blur = (EXTENT_SIGMAS * 0.3f32.sqrt() + 1.0) / f;
        let (low, high, margin) = (c / f, (size - c) / f, 0.15 * size / f);
        let limit = (low + margin).abs().max((high + margin).abs());
        let reach = EXTENT_SIGMAS * (1.0 + limit * limit).sqrt() * bounds.sigma_max * 1.001;
        let plane = |sign: f32, edge: f32| {
            let mut a = [0.0; 3];
            a[row] = sign;
            a[2] = edge + blur + 1e-3 * (edge.abs() + blur);
            largest(a, reach) >= 0.0
        };
        plane(1.0, low) && plane(-1.0, high)
    };
    z_ok && axis(camera.width, camera.fx, camera.cx, 0) && axis(camera.height, camera.fy, camera.cy, 1)
}

fn centre_and_half(bounds: &PageBounds) -> ([f32; 3], [f32; 3]) {
    let of = |sign: f32| std::array::from_fn(|i| 0.5 * bounds.hi[i] + sign * 0.5 * bounds.lo[i]);
    (of(1.0), of(-1.0))
}
