//! Whether Gaussians (or points) and cameras belong together: a file in another frame, or of another scene, is noticed by what the
//! cameras see of it.
//!
//! Not here: the frame that a file states ([`crate::exchange`]).
//!
//! Invariants: 1. memory and time are bounded for any number of rows and cameras; 2. the result depends on the rows, their order
//! and the cameras alone.

use crate::dataset::loader::View;
use crate::scene::frustum::Frustum;
use rayon::prelude::*;
use std::path::Path;

/// Most positions in a sample.
const SAMPLE_MOST: usize = 1 << 15;
/// Positions that are looked for in every camera.
const LOOKED_FOR: usize = 1 << 11;
/// Cameras that are searched for a position.
const CAMERAS_ASKED: usize = 256;
/// Least share of the positions that some camera sees. In four scenes of photos and a generated city it is 0.9 or more; with
/// other axes, another scale or another origin mostly below 0.6.
const SEEN_LEAST: f64 = 2.0 / 3.0;
/// Positions for each camera without which a camera may see none by chance.
const POSITIONS_A_CAMERA: usize = 20;
/// Median distance of the cameras from the box of the positions, in diagonals of the box, beyond which photos show a dot.
const FAR_DIAGONALS: f32 = 20.0;

/// A sample of positions in the local frame: every row, or every second, fourth and so on.
#[derive(Debug, Clone)]
pub(crate) struct PositionSample {
    positions: Vec<[f32; 3]>,
    rows: u64,
    stride: u64,
}

impl Default for PositionSample {
    fn default() -> PositionSample {
        PositionSample { positions: Vec::new(), rows: 0, stride: 1 }
    }
}

impl PositionSample {
    /// Adds the rows of a column of positions.
    pub fn add(&mut self, means: &[f32]) {
        for &position in means.as_chunks::<3>().0 {
            if self.rows.is_multiple_of(self.stride) {
                if self.positions.len() == SAMPLE_MOST {
                    let mut number = 0;
                    self.positions.retain(|_| {
                        number += 1;
                        number % 2 == 1
                    });
                    self.stride *= 2;
                }
                if self.rows.is_multiple_of(self.stride) {
                    self.positions.push(position);
                }
            }
            self.rows += 1;
        }
    }

    /// The lower and upper corner of the box of the sample without a twentieth on each side.
    fn robust_box(&self) -> [[f32; 3]; 2] {
        let of_axis = |axis: usize| {
            let mut values: Vec<f32> = self.positions.iter().map(|p| p[axis]).collect();
            values.sort_unstable_by(f32::total_cmp);
            let cut = values.len() / 20;
            (values[cut], values[values.len() - 1 - cut])
        };
        let axes = [0, 1, 2].map(of_axis);
        [axes.map(|(low, _)| low), axes.map(|(_, high)| high)]
    }

    /// Half the diagonal of the box that holds nine tenths of the rows on each axis: the size of the scene where no cameras
    /// state it. `None` without rows, or if all are in one place.
    pub fn radius(&self) -> Option<f32> {
        if self.positions.is_empty() {
            return None;
        }
        let [low, high] = self.robust_box();
        Some(distance(low, high) / 2.0).filter(|radius| radius.is_normal())
    }

    /// The warning that the rows of `file` and the cameras of the views do not fit each other, if they do not.
    pub fn warning(&self, file: &Path, views: &[View]) -> Option<String> {
        if self.positions.is_empty() || views.is_empty() {
            return None;
        }
        let frustums: Vec<Frustum> = views.iter().map(|view| Frustum::new(&view.camera)).collect();
        let step = self.positions.len().div_ceil(LOOKED_FOR);
        let looked_for: Vec<[f32; 3]> = self.positions.iter().step_by(step).copied().collect();
        let seen = looked_for.par_iter().filter(|&&p| frustums.iter().any(|f| f.may_draw(p, 0.0))).count();
        let seen = seen as f64 / looked_for.len() as f64;
        let asked: Vec<&Frustum> = frustums.iter().step_by(views.len().div_ceil(CAMERAS_ASKED)).collect();
        let blind = asked.par_iter().filter(|f| !self.positions.iter().any(|&p| f.may_draw(p, 0.0))).count();
        let blind = blind as f64 / asked.len() as f64;
        let blind_by_chance = self.stride > 1 && self.positions.len() < POSITIONS_A_CAMERA * views.len();
        let away = self.diagonals_away(views);
        let problem = match () {
            () if seen < SEEN_LEAST => format!("only {:.0} % of its rows are in view of any camera", 100.0 * seen),
            () if blind > 0.5 && !blind_by_chance => {
                format!("{:.0} % of the cameras see none of its rows", 100.0 * blind)
            }
            () if away > FAR_DIAGONALS => format!("most cameras stand {away:.0} times its size away from it"),
            () => return None,
        };
        Some(format!(
            "{}: it does not fit the cameras: {problem}. It may be of another scene, or in another frame: a file that an editor \
             saved has lost the comments that say its frame, so keep the transform.json of the original beside it",
            file.display()
        ))
    }

    /// Median distance of the cameras from the box, in its diagonals; 0 for a box without extent.
    fn diagonals_away(&self, views: &[View]) -> f32 {
        let [low, high] = self.robust_box();
        let diagonal = distance(low, high);
        if !diagonal.is_normal() {
            return 0.0;
        }
        let mut away: Vec<f32> = views
            .iter()
            .map(|view| {
                let m = &view.camera.viewmat;
                let centre = [0, 1, 2].map(|k| -(m[0][k] * m[0][3] + m[1][k] * m[1][3] + m[2][k] * m[2][3]));
                let nearest = [0, 1, 2].map(|k| centre[k].max(low[k]).min(high[k]));
                distance(centre, nearest) / diagonal
            })
            .collect();
        let middle = away.len() / 2;
        *away.select_nth_unstable_by(middle, f32::total_cmp).1
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    [0, 1, 2].map(|k| (a[k] - b[k]) * (a[k] - b[k])).iter().sum::<f32>().sqrt()
}
