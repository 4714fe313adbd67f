//! Whether photos show moving things at all, judged at places that many photos show.
//!
//! Landmarks are some of the first points. A block that shows a landmark has a residual, and so have the blocks of the other photos that
//! show the landmark. Fine detail that the scene has not learnt yet has large residuals on all of these photos. A car that drove on has
//! one on its own photo alone: that is a contradiction.
//!
//! Not here: which blocks are masked ([`super::blocks`]); places that no landmark marks.
//!
//! Invariant: the result is a function of landmarks, cameras and residuals alone, the same for any number of threads.

use super::grid::BlockGrid;
use crate::photos::visible::visible_points;
use crate::scene::camera::Camera;
use rayon::prelude::*;

pub const LANDMARKS_MOST: usize = 4096;
/// A contradiction has at least this residual, of values in 0..1 ...
const RESIDUAL_LEAST: f64 = 0.08;
/// ... and at least this many times the median residual of the other photos, which counts as [`OTHERS_LEAST`] if less.
const TIMES_OTHERS: f64 = 4.0;
const OTHERS_LEAST: f64 = 0.01;
/// Fewest other photos that show a landmark.
const OTHERS: usize = 2;
/// Fewest sightings, of all landmarks in all photos, for a result.
const SIGHTINGS_LEAST: usize = 256;

/// A photo that was measured.
pub struct ViewResiduals<'a> {
    pub camera: &'a Camera,
    /// The residual of each block of its grid, of values in 0..1; `None` for a block without used pixels.
    pub of_block: Vec<Option<f64>>,
}

/// The share of the sightings of landmarks (local frame) that are contradictions, 0..1; `None` if there are too few sightings.
pub fn contradicted_share(landmarks: &[[f32; 3]], views: &[ViewResiduals<'_>]) -> Option<f64> {
    let seen_in = |view: &ViewResiduals<'_>| {
        let grid = BlockGrid::of(view.camera.width, view.camera.height);
        let seen = visible_points(landmarks, |position| *position, view.camera).into_iter();
        let residual = |at: [f64; 2]| view.of_block.get(grid.block_at(at)).copied().flatten();
        seen.filter_map(|point| Some((point.point, residual(point.at)?))).collect::<Vec<_>>()
    };
    let seen: Vec<Vec<(usize, f64)>> = views.par_iter().map(seen_in).collect();
    let mut of_landmark = vec![Vec::new(); landmarks.len()];
    seen.into_iter().flatten().for_each(|(landmark, residual)| of_landmark[landmark].push(residual));
    let (mut contradicted, mut sightings) = (0, 0);
    for residuals in of_landmark.iter_mut().filter(|residuals| residuals.len() > OTHERS) {
        residuals.sort_unstable_by(f64::total_cmp);
        sightings += residuals.len();
        // For a residual above this value, this value is the median of all others. Residuals below are no contradictions.
        let others = residuals[(residuals.len() - 2) / 2].max(OTHERS_LEAST);
        contradicted += residuals.iter().filter(|&&own| own >= RESIDUAL_LEAST && own >= TIMES_OTHERS * others).count();
    }
    (sightings >= SIGHTINGS_LEAST).then(|| contradicted as f64 / sightings as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [64, 48];

    /// A plane of landmarks that all of five cameras see, and residuals by view and block.
    fn share(residual: impl Fn(usize, usize) -> Option<f64>) -> Option<f64> {
        let cameras = [0.0, 0.1, 0.2, 0.3, 0.4].map(|x: f32| Camera::along_z(-x, [40.0, 40.0, 32.0, 24.0], SIZE));
        let places = (0..12).flat_map(|y| (0..16).map(move |x| [x as f32 / 20.0 - 0.6, y as f32 / 20.0 - 0.3, 2.0]));
        let blocks = BlockGrid::of(SIZE[0], SIZE[1]).blocks();
        let of = |(view, camera)| ViewResiduals { camera, of_block: (0..blocks).map(|b| residual(view, b)).collect() };
        let views: Vec<ViewResiduals<'_>> = cameras.iter().enumerate().map(of).collect();
        contradicted_share(&places.collect::<Vec<_>>(), &views)
    }

    #[test]
    fn what_one_photo_shows_alone_is_contradicted_and_what_is_hard_for_all_is_not() {
        assert_eq!(share(|_, _| Some(0.01)), Some(0.0));
        assert_eq!(share(|_, _| Some(0.3)), Some(0.0));
        let of_one = share(|view, _| Some(if view == 2 { 0.3 } else { 0.02 })).unwrap();
        assert!((of_one - 0.2).abs() < 0.01, "{of_one}: one of five photos");
        // Too small for an object, and too near to the others.
        assert_eq!(share(|view, _| Some(if view == 2 { 0.07 } else { 0.005 })), Some(0.0));
        assert_eq!(share(|view, _| Some(if view == 2 { 0.3 } else { 0.08 })), Some(0.0));
        // Two of five photos cannot outvote the three.
        let of_two = share(|view, _| Some(if view < 2 { 0.3 } else { 0.02 })).unwrap();
        assert!((of_two - 0.4).abs() < 0.01, "{of_two}");
    }

    #[test]
    fn few_sightings_say_nothing() {
        assert_eq!(share(|view, _| (view < 2).then_some(0.02)), None, "two photos are no majority");
        assert_eq!(share(|_, block| (block % 16 == 5).then_some(0.02)), None);
        assert_eq!(contradicted_share(&[], &[]), None);
    }
}
