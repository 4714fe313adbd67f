//! appearance.json: the trained corrections of photos and cameras, as plain numbers for people and other programs.

use crate::appearance::model::CHANNEL_VALUES;
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::dataset::loader::Dataset;
use crate::train::state::trainer::Trainer;
use serde::Serialize;
use std::path::Path;

/// The file. The model is that of [`crate::appearance::model`].
#[derive(Debug, Serialize)]
struct AppearanceFile {
    /// `exposure` or `full`.
    model: &'static str,
    /// Training photos whose exposure started from EXIF data.
    exposures_from_exif: u32,
    /// The training photos, in the order of their names.
    images: Vec<ImageValues>,
    /// The cameras; empty without vignetting.
    cameras: Vec<CameraValues>,
}

#[derive(Debug, Serialize)]
struct ImageValues {
    name: String,
    /// Stops, against the mean of all photos.
    exposure: f64,
    /// Row-major 3x3 matrix on (R/S - 1/3, G/S - 1/3, 1) with S = R + G + B.
    homography: [f64; 9],
    /// Steps that have seen the photo; an exposure from EXIF data counts as one.
    sightings: u32,
}

#[derive(Debug, Serialize)]
struct CameraValues {
    /// Pixels.
    width: u32,
    /// Pixels.
    height: u32,
    /// Of red, green and blue: a1, a2, a3, and the optical centre relative to the principal point, in halves of the
    /// diagonal.
    vignetting: [[f64; CHANNEL_VALUES]; 3],
}

/// Writes the values that act; nothing for a run that corrects nothing.
///
/// # Errors
/// The folder cannot be written.
pub(super) fn write_appearance(path: &Path, dataset: &Dataset, trainer: &Trainer) -> InputResult<()> {
    let mode = trainer.options().appearance;
    if !mode.is_on() {
        return Ok(());
    }
    let state = trainer.appearance();
    let mut views = dataset.train_views();
    views.sort_by(|&a, &b| dataset.views[a].name.cmp(&dataset.views[b].name));
    let of_image = |view: usize| {
        let [exposure, h @ ..] = state.acting(view, mode.image_values());
        ImageValues {
            name: dataset.views[view].name.clone(),
            exposure,
            homography: [1.0 + h[0], h[1], h[2], h[3], 1.0 + h[4], h[5], h[6], h[7], 1.0],
            sightings: state.images.get(view).map_or(0, |image| image.sightings),
        }
    };
    let file = AppearanceFile {
        model: mode.name(),
        exposures_from_exif: trainer.first_exposures(),
        images: views.into_iter().map(of_image).collect(),
        cameras: trainer
            .cameras_of(dataset)
            .into_iter()
            .map(|(camera, falloff)| CameraValues { width: camera.width, height: camera.height, vignetting: falloff })
            .collect(),
    };
    let text = serde_json::to_string_pretty(&file).map_err(|e| InputError::io(path, "writing", &e.into()))?;
    write_whole(path, (text + "\n").as_bytes())
}
