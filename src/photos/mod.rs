//! What a run knows of each photo, and how it acts on the steps that see the photo: the one list of [`KINDS`].
//!
//! A kind is a file or folder here: its values, their mathematics, and a [`PhotoParameter`] with its [`Kind`]. [`exposure`] corrects
//! pictures, [`pose`] moves cameras, [`outlier`] judges photos. The trainer, the run state, the forecast, the summary and
//! the report walk the list, and name no kind.
//!
//! A kind that is off is not in the list of a run. The kinds that judge photos are always in it.
//!
//! Not here: evaluation, which fits exposures without a run (`train::state::eval`), and which optimizer a kind needs
//! (`TrainConfig::check`).
//!
//! Invariants: 1. a step that was skipped teaches nothing but the error of its view; 2. what is known after a step is a function of
//! steps and photos alone, and lies in the saved values, so a resumed run knows the same; 3. all corrections of a picture come
//! before all looks at it; 4. a kind that adds to the loss stands behind the kinds that correct, and behind masks, so that it
//! compares what the loss compares, and its gradient is taken back through the corrections.

pub mod diagnosis;
pub mod exposure;
pub mod outlier;
pub mod parameter;
pub mod pose;
mod visible;

use crate::base::error::{InputError, InputResult};
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::scene::camera::Camera;
use exposure::{AppearanceMode, GivenValues};
use outlier::blocks::BlockMasks;
use parameter::{Kind, PastViews, PhotoParameter, SavedValues, ValuesError};
use std::path::Path;

/// What the user asked for, and what the kinds need of the other options of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotoOptions {
    /// Which corrections of the picture are trained.
    pub appearance: AppearanceMode,
    /// What another run has found, to start from and to hold the mean at.
    pub first_appearance: Option<GivenValues>,
    /// Whether views that contradict the scene are left out.
    pub robust_views: bool,
    /// Whether blocks of photos that contradict the scene are masked.
    pub robust_pixels: BlockMasks,
    /// Some of the first points, local frame, by which a run finds out whether masks are needed; none where they do not fit the photos.
    pub landmarks: Vec<[f32; 3]>,
    pub refine_poses: bool,
    pub steps: u32,
    /// Scene scale, local units.
    pub scene_scale: f32,
}

/// All kinds, in the order in which they correct a picture; gradients pass them in the opposite order. The sections of the report have
/// this order too.
pub const KINDS: [Kind; 4] = [exposure::KIND, pose::KIND, outlier::views::KIND, outlier::blocks::KIND];

pub type PhotoParameters = Vec<Box<dyn PhotoParameter>>;

/// The parameters of a run of these options that has seen nothing.
pub fn first_parameters(options: &PhotoOptions, dataset: &Dataset) -> PhotoParameters {
    KINDS.iter().filter_map(|kind| (kind.first)(options, dataset)).collect()
}

/// The camera of a view as steps see it: its pose in the dataset, moved by the parameters.
pub fn camera(parameters: &PhotoParameters, dataset: &Dataset, view: usize) -> Camera {
    parameters.iter().fold(dataset.views[view].camera, |camera, parameter| parameter.camera(view, camera))
}

/// The values as a commit holds them. Errors: a value cannot be encoded; none of a valid kind.
pub fn save(parameters: &PhotoParameters) -> Result<SavedValues, EncodingError> {
    parameters.iter().map(|parameter| Ok((parameter.name().to_string(), parameter.save()?))).collect()
}

/// Restores saved values. Values that are missing stay as at a start, and so do those of photos that are new. Errors: as [`check`].
pub fn restore(parameters: &mut PhotoParameters, saved: &SavedValues, past: &PastViews) -> Result<(), ValuesError> {
    let saved_of = |name: &str| saved.get(name);
    parameters.iter_mut().try_for_each(|p| saved_of(p.name()).map_or(Ok(()), |bytes| p.restore(bytes, past)))
}

/// Checks values from a file.
/// Errors: they are of a kind that this program does not know, or values that no run can have written.
pub fn check(saved: &SavedValues) -> Result<(), ValuesError> {
    saved.iter().try_for_each(|(name, bytes)| match KINDS.iter().find(|kind| kind.name == name) {
        Some(kind) => (kind.check)(bytes),
        None => Err(ValuesError::Impossible("it has values of photos of a kind that this program does not know")),
    })
}

/// Writes the values into the folder of a run, for people and other programs. Files of kinds that are off by now are those of earlier steps,
/// and are removed.
/// Errors: the folder cannot be written.
pub fn write_files(parameters: &PhotoParameters, folder: &Path, dataset: &Dataset) -> InputResult<()> {
    let is_off = |kind: &&Kind| parameters.iter().all(|parameter| parameter.name() != kind.name);
    for file in KINDS.iter().filter(is_off).filter_map(|kind| kind.file).map(|name| folder.join(name)) {
        if file.is_file() {
            std::fs::remove_file(&file).map_err(|e| InputError::io(&file, "removing what earlier steps wrote", &e))?;
        }
    }
    parameters.iter().try_for_each(|parameter| parameter.write_file(folder, dataset))
}

/// The files that kinds write into the folder of a run.
pub fn files() -> impl Iterator<Item = &'static str> {
    KINDS.iter().filter_map(|kind| kind.file)
}
