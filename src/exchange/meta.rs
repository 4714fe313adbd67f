//! What a file says of its Gaussians beside their values: step, frame, axes.
//!
//! Not here: the change of frame ([`super::frames`]), the words of a format.
//!
//! There are two frames. Scenes are trained in a *local* frame: `dataset = local * scale + origin`, computed in f64. A
//! file holds either frame, with origin and scale, so that each frame can be derived from the other. A file may also be
//! turned so that viewers show it upright ([`SceneMeta::upright`]).

use crate::base::names::names;
use crate::scene::rotation::Rotation;
use std::path::PathBuf;

/// Beyond this many scene radii an offset is not written into f32 positions: one unit in the last place of such an
/// offset is more than 6e-5 radii, which is pixels in a photo.
pub const MAX_OFFSET_RADII: f64 = 1000.0;

/// A position that is rounded by more than this share of the largest sigma counts as moved.
pub const ROUNDING_LEAST: f64 = 0.1;

/// The frame of the Gaussians in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFrame {
    /// The dataset's own coordinates.
    Dataset,
    /// The trainer's coordinates, without origin and scale.
    Local,
}

names!(ExportFrame { Dataset = "dataset", Local = "local" });

impl ExportFrame {
    /// The frame that f32 can hold: `Local` if `origin` is more than [`MAX_OFFSET_RADII`] times `scene_radius` (dataset
    /// units) from zero, otherwise the requested one.
    #[must_use]
    pub fn fitting_f32(self, origin: [f64; 3], scene_radius: f64) -> ExportFrame {
        let offset = libm::sqrt(origin.iter().map(|x| x * x).sum());
        if offset > MAX_OFFSET_RADII * scene_radius { ExportFrame::Local } else { self }
    }
}

/// Metadata of the Gaussians in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneMeta {
    /// Optimizer steps done; `None` if the file does not say.
    pub step: Option<u64>,
    /// Origin of the local frame in dataset coordinates; zeros if the file does not say.
    pub origin: [f64; 3],
    /// Dataset units per local unit; 1 if the file does not say.
    pub scale: f64,
    /// When writing: the requested frame. When reading: the frame of the values; files of other programs are in the
    /// dataset's.
    pub frame: ExportFrame,
    /// The rotation from the axes of the dataset to those of the file, whose up is -y ([`crate::scene::rotation::VIEWER_UP`]);
    /// applied after the change of frame. `None` where the file has the axes of the dataset.
    pub upright: Option<Rotation>,
    /// When writing: extent of the scene in dataset units, which decides whether f32 can hold the dataset frame (see
    /// [`ExportFrame::fitting_f32`]). Not stored; reading sets it to `scale`.
    pub scene_radius: f64,
    /// When reading: whether training used an opacity compensation ("mip", "antialiased") that this renderer lacks.
    pub antialiased: bool,
    /// When reading: whether the file itself states frame and axes.
    pub is_stated: bool,
    /// When reading: the file beside it from which frame and axes are, because the file does not state them.
    pub transform: Option<PathBuf>,
    /// When reading: number of rows dropped because a value was not finite.
    pub dropped: u64,
    /// When reading: number of infinite opacities (logits of 0 and 1), which are read as logits of 1e-6 and 1 - 1e-6.
    pub opacities_clamped: u64,
    /// When reading: number of rows that f32 moves by more than [`ROUNDING_LEAST`] of their size, in a file of f64 positions.
    pub moved: u64,
}

impl Default for SceneMeta {
    fn default() -> Self {
        SceneMeta {
            step: None,
            origin: [0.0; 3],
            scale: 1.0,
            frame: ExportFrame::Dataset,
            upright: None,
            scene_radius: 1.0,
            antialiased: false,
            is_stated: false,
            transform: None,
            dropped: 0,
            opacities_clamped: 0,
            moved: 0,
        }
    }
}
