//! Exposure and colours of photos, vignetting of cameras (`--appearance`): [`crate::appearance`] in the steps of a run.
//!
//! Not here: the correction and its values.

use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter, PhotoStep, views_by_name, write_values};
use super::saved::{Encoded, ValuesError};
use crate::appearance::AppearanceMode;
use crate::appearance::first_values::first_exposures;
use crate::appearance::fit::Pair;
use crate::appearance::model::CHANNEL_VALUES;
use crate::appearance::picture::Look;
use crate::appearance::state::{AppearanceState, Found, camera_groups, find};
use crate::base::error::InputResult;
use crate::dataset::exif;
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::report::chart::{Chart, Mark};
use crate::report::html::Page;
use crate::report::run_report::{POINTS_MAX, read_json};
use crate::scene::image::Target;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// Exposure and colours of each photo, vignetting of each camera.
const FILE: &str = "appearance.json";

pub(super) const KIND: Kind = Kind { name: "appearance", file: Some(FILE), first, check, section };

/// Photos that a warning names.
const NAMED: usize = 3;

struct Appearance {
    mode: AppearanceMode,
    /// For each view, the number of its group of equal cameras.
    camera_groups: Vec<usize>,
    state: AppearanceState,
    /// Photos whose exposure started from EXIF data.
    first_exposures: u32,
    /// The correction of the step.
    look: Look,
    /// The picture of the step as it was drawn, `[3][height][width]`.
    drawn: Vec<f32>,
    /// The values that fit the photo best under the last picture.
    found: Option<Found>,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    let camera_groups = camera_groups(dataset.views.iter().map(|view| &view.camera));
    options.appearance.is_on().then(|| -> Box<dyn PhotoParameter> {
        Box::new(Appearance {
            mode: options.appearance,
            state: AppearanceState::new(&camera_groups),
            camera_groups,
            first_exposures: 0,
            look: Look::default(),
            drawn: Vec::new(),
            found: None,
        })
    })
}

/// As [`PhotoParameter::save`] writes them: the values, and how many exposures started from EXIF data.
fn decoded(saved: &Encoded) -> Result<(AppearanceState, u32), ValuesError> {
    saved.decoded(|(state, _): &(AppearanceState, u32)| state.check())
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    decoded(saved).map(drop)
}

/// The warning that the EXIF data of photos cannot be read: each a view and the reason.
fn damaged_exif(dataset: &Dataset, damaged: &[(usize, &str)]) -> Option<String> {
    let (&(first, why), rest) = damaged.split_first()?;
    let name = |view: usize| dataset.views[view].name.as_str();
    let others = rest.iter().take(NAMED - 1).map(|&(view, _)| format!(", {}", name(view))).collect::<String>();
    let more = match rest.len().saturating_sub(NAMED - 1) {
        0 => String::new(),
        more => format!(", and {more} more"),
    };
    Some(format!("damaged EXIF data are ignored: {} ({why}){others}{more}", name(first)))
}

impl PhotoParameter for Appearance {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&(&self.state, self.first_exposures))
    }

    fn restore(&mut self, saved: &Encoded) -> Result<(), ValuesError> {
        let (state, first_exposures) = decoded(saved)?;
        if state.has_same_counts(&self.state) {
            (self.state, self.first_exposures) = (state, first_exposures);
        }
        Ok(())
    }

    /// Starts the exposures from EXIF data if more than half of the training photos state one. A function of the files alone.
    fn start(&mut self, dataset: &Dataset) -> Vec<String> {
        if !self.state.is_new() {
            return Vec::new();
        }
        let views = dataset.train_views();
        let read = |&view: &usize| {
            let photo = &dataset.views[view].photo;
            photo.header.exif.map_or(Ok(None), |place| exif::brightness(&photo.image_path, place))
        };
        let read: Vec<Result<Option<f64>, String>> = views.par_iter().map(read).collect();
        let damaged = views.iter().zip(&read);
        let damaged = damaged.filter_map(|(&view, read)| Some((view, read.as_ref().err()?.as_str())));
        let mut warnings: Vec<String> = damaged_exif(dataset, &damaged.collect::<Vec<_>>()).into_iter().collect();
        let brightness: Vec<Option<f64>> = read.into_iter().map(Result::unwrap_or_default).collect();
        let known = brightness.iter().flatten().count();
        if let Some(exposures) = first_exposures(&brightness) {
            self.state.begin_with(views.iter().zip(exposures).filter_map(|(&view, first)| Some((view, first?))));
            self.first_exposures = known as u32;
        } else if known > 0 {
            warnings.push(format!(
                "only {known} of {} training photos state their exposure in EXIF data: exposures are trained from zero, \
                 because a start from EXIF data takes more than half of the photos",
                brightness.len()
            ));
        }
        warnings
    }

    fn plan_text(&self) -> Option<String> {
        (self.first_exposures > 0).then(|| format!("{} exposures start from EXIF data", self.first_exposures))
    }

    fn corrects(&self) -> bool {
        true
    }

    fn begin_step(&mut self, step: &PhotoStep<'_>) {
        let of_view = (step.view, self.camera_groups.get(step.view).copied().unwrap_or_default());
        self.look = self.state.look(self.mode, of_view, step.camera);
        self.found = None;
    }

    fn correct(&mut self, picture: &mut [f32], photo: &Target) {
        self.drawn.clear();
        self.drawn.extend_from_slice(picture);
        self.found = find(&Pair { drawn: &self.drawn, photo }, &self.look, self.mode);
        self.look.correct(picture, photo.width as usize, Some(photo));
    }

    fn picture_back(&mut self, photo: &Target, v_rgb: &mut [f32]) {
        self.look.back(&self.drawn, photo, v_rgb);
    }

    /// A photo that is left out is fitted too, or the exposure of a first look, at a rough scene, would keep a right photo out.
    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        let found = self.found.take().filter(|_| !outcome.is_skipped);
        if let (Some(found), Some(&group)) = (found, self.camera_groups.get(outcome.view)) {
            match outcome.is_left_out {
                true => self.state.replace(self.mode, outcome.view, &found),
                false => self.state.learn(self.mode, (outcome.view, group), &found),
            }
        }
        Vec::new()
    }

    fn buffer_bytes(&self) -> u64 {
        4 * self.drawn.capacity() as u64
    }

    fn free_buffers(&mut self) {
        self.drawn = Vec::new();
    }

    fn write_file(&self, folder: &Path, dataset: &Dataset) -> InputResult<()> {
        let of_image = |view: usize| {
            let [exposure, h @ ..] = self.state.acting(view, self.mode.image_values());
            ImageValues {
                name: dataset.views[view].name.clone(),
                exposure,
                homography: [1.0 + h[0], h[1], h[2], h[3], 1.0 + h[4], h[5], h[6], h[7], 1.0],
                sightings: self.state.images.get(view).map_or(0, |image| image.sightings),
            }
        };
        let of_camera = |(group, vignetting)| {
            let camera = &dataset.views[self.camera_groups.iter().position(|of| *of == group)?].camera;
            Some(CameraValues { width: camera.width, height: camera.height, vignetting })
        };
        let trained = self.state.cameras.iter().enumerate().filter(|(_, camera)| camera.sightings > 0);
        let file = AppearanceFile {
            model: self.mode.name(),
            exposures_from_exif: self.first_exposures,
            images: views_by_name(dataset).into_iter().map(of_image).collect(),
            cameras: trained.map(|(group, camera)| (group, camera.falloff)).filter_map(of_camera).collect(),
        };
        write_values(&folder.join(FILE), &file)
    }
}

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

/// A chart of the exposures of the photos, if the run has trained them.
fn section(page: &mut Page, folder: &Path, _: &Value) {
    let values = read_json(&folder.join(FILE)).unwrap_or(Value::Null);
    let images = values["images"].as_array().map_or(&[][..], Vec::as_slice);
    let stops = |(i, image): (usize, &Value)| Some((i as f64, image["exposure"].as_f64()?));
    let points: Vec<(f64, f64)> = images.iter().enumerate().filter_map(stops).collect();
    if points.is_empty() {
        return;
    }
    page.heading("Appearance");
    let stride = points.len().div_ceil(POINTS_MAX);
    let points = points.into_iter().step_by(stride).collect();
    let chart = Chart::new("Exposure", "photo, by name", "stops").with("", points, Mark::LineAndDots);
    let first = match values["exposures_from_exif"].as_u64() {
        None | Some(0) => String::new(),
        Some(count) => format!(" {count} exposures started from EXIF data."),
    };
    let caption = format!(
        "Exposure of each training photo against the mean of all, as trained.{first} appearance.json has the numbers."
    );
    page.charts(&[(chart.svg(), caption)]);
}
