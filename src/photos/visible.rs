//! Which of some points a photo shows: those in its frame that no other of them hides.
//!
//! Not here: what colour they have there ([`super::diagnosis`]), and what pictures show there ([`super::outlier::landmarks`]).

use crate::scene::camera::Camera;
use rayon::prelude::*;

/// Cells of the longer side of a photo, for what hides what: a point beyond this multiple of the nearest depth in its cell is hidden.
const CELLS: f64 = 48.0;
const DEPTH_MOST: f64 = 1.15;

/// A point in a photo.
#[derive(Clone, Copy)]
pub struct Drawn {
    /// Its place in the photo, pixels from the upper left corner.
    pub at: [f64; 2],
    /// Along the view, local units.
    pub depth: f64,
    /// Its number among the points.
    pub point: usize,
}

/// The points in the frame of a camera, in their order. `position`: of a point, local frame.
pub fn points_in<P: Sync>(points: &[P], position: fn(&P) -> [f32; 3], camera: &Camera) -> Vec<Drawn> {
    let size = [camera.width, camera.height].map(f64::from);
    let project = |(point, of): (usize, &P)| {
        let (at, depth) = camera.project(position(of).map(f64::from))?;
        (0..2).all(|axis| (0.0..size[axis]).contains(&at[axis])).then_some(Drawn { at, depth, point })
    };
    points.par_iter().enumerate().filter_map(project).collect()
}

/// As [`points_in`], without those that are probably hidden: they lie behind others in a cell of the photo.
pub fn visible_points<P: Sync>(points: &[P], position: fn(&P) -> [f32; 3], camera: &Camera) -> Vec<Drawn> {
    let cell = f64::from(camera.width.max(camera.height)) / CELLS;
    let row = CELLS as usize + 1;
    let cell_of = |point: &Drawn| row * (point.at[1] / cell) as usize + (point.at[0] / cell) as usize;
    let mut nearest = vec![f64::INFINITY; row * row];
    let mut drawn = points_in(points, position, camera);
    for point in &drawn {
        let nearest = &mut nearest[cell_of(point)];
        *nearest = nearest.min(point.depth);
    }
    drawn.retain(|point| point.depth <= DEPTH_MOST * nearest[cell_of(point)]);
    drawn
}
