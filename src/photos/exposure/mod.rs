//! Appearance (`--appearance`): what differs between the photos of one scene besides the pose. An exposure and a colour homography per
//! photo, and vignetting per camera, act on the rendered picture before the loss ([`model`]: that of PPISP, arXiv 2601.18336, without
//! its response curve).
//!
//! A brighter scene under darker exposures gives the same pictures. So what acts on a photo is its value less the mean over
//! the photos seen ([`state`]), and small weights pull it towards no change.
//!
//! Values follow one damped Gauss-Newton step per sighting ([`fit`]) instead of Adam: a run of 1,500 steps sees each of
//! 150 photos ten times, in which Adam at a rate of .002 would move an exposure by .02 stops. The nine values of a
//! photo are well determined by one sighting. Later sightings count less, so that the values settle.
//!
//! Invariants: 1. sums over pixels are f64 in row order, so the bits are the same for any number of threads; 2. no value
//! that is not finite, or out of bounds, is stored; 3. masked pixels count nowhere.
//!
//! Not here: the exposures that evaluation fits without a run (`train::state::eval`).

pub mod fit;
pub mod model;
pub mod picture;
pub mod predict;
pub mod state;

use super::PhotoOptions;
use super::outlier::spread;
use super::parameter::{
    Correction, Curve, Encoded, Finding, Kind, PastViews, PhotoOutcome, PhotoParameter, PhotoStep, ValuesError,
    views_by_name, write_values,
};
use crate::base::error::{InputError, InputResult};
use crate::base::names::names;
use crate::base::text::read_text;
use crate::dataset::exif;
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::scene::image::{PictureGradient, Target};
use fit::{FittedPair, bounded};
use model::{CHANNEL_VALUES, IMAGE_VALUES};
use picture::Look;
use predict::{PhotoPlace, predict};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use state::{AppearanceState, Found, camera_groups, find, first_exposures};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Which corrections are trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AppearanceMode {
    #[default]
    Off,
    Exposure,
    /// As `Exposure`. After four passes over the photos the run drops the exposures if they hardly differ, and is one without appearance from then on.
    IfNeeded,
    /// Exposure and colour homography per photo, vignetting per camera.
    Full,
}

names!(AppearanceMode { Off = "off", Exposure = "exposure", IfNeeded = "if-needed", Full = "full" });

impl AppearanceMode {
    /// Whether anything is corrected.
    pub fn is_on(self) -> bool {
        self != AppearanceMode::Off
    }

    /// How many of a photo's values are trained, from the first.
    pub fn image_values(self) -> usize {
        match self {
            AppearanceMode::Off => 0,
            AppearanceMode::Exposure | AppearanceMode::IfNeeded => 1,
            AppearanceMode::Full => IMAGE_VALUES,
        }
    }
}

/// Exposure and colours of each photo, vignetting of each camera.
pub const FILE: &str = "appearance.json";
/// Longest such file: a million photos have some 400 MB.
pub(crate) const FILE_BYTES_MAX: u64 = 1 << 30;

pub(super) const KIND: Kind = Kind { name: "appearance", file: Some(FILE), first, check, finding };

/// Photos that a warning names.
const NAMED: usize = 3;
/// Stops by which photos differ (robust standard deviation) from which on their exposures are trained. Measured before training: .01 to .13 on
/// clean scenes; .37 with exposures within half a stop. After two passes over random points: .05 and .30.
pub(super) const EXPOSURE_SPREAD: f64 = 0.2;
/// Fewest photos for a remedy.
pub(super) const PHOTOS_FOR_REMEDIES: usize = 8;
/// Passes over the training photos after which exposures that are corrected [`AppearanceMode::IfNeeded`] are judged.
const PASSES: usize = 4;

struct Appearance {
    mode: AppearanceMode,
    /// The number of steps after which exposures are judged, if they are.
    judged_after: Option<u32>,
    /// Steps since these values began: fewer than the steps of a run that was given more steps, since its values begin anew.
    steps: u32,
    /// The values are those of a commit.
    is_restored: bool,
    /// For each view, the number of its group of equal cameras.
    camera_groups: Vec<usize>,
    state: AppearanceState,
    /// Photos whose exposure started from EXIF data.
    first_exposures: u32,
    /// What another run has found.
    given: Option<GivenValues>,
    look: Look,
    /// The picture of the step as it was drawn, `[3][height][width]`.
    drawn: Vec<f32>,
    /// The values that fit the photo best under the last picture.
    found: Option<Found>,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    let camera_groups = camera_groups(dataset.views.iter().map(|view| &view.camera));
    let passes = PASSES * dataset.train_views().len();
    let is_judged = options.appearance == AppearanceMode::IfNeeded;
    options.appearance.is_on().then(|| -> Box<dyn PhotoParameter> {
        Box::new(Appearance {
            mode: options.appearance,
            judged_after: is_judged.then_some(u32::try_from(passes).unwrap_or(u32::MAX)),
            steps: 0,
            is_restored: false,
            state: AppearanceState::new(&camera_groups),
            camera_groups,
            first_exposures: 0,
            given: options.first_appearance.clone(),
            look: Look::default(),
            drawn: Vec::new(),
            found: None,
        })
    })
}

/// As [`PhotoParameter::save`] writes them: the values, how many exposures started from EXIF data, and the steps.
fn decoded(saved: &Encoded) -> Result<(AppearanceState, u32, u32), ValuesError> {
    saved.decoded(|(state, ..): &(AppearanceState, u32, u32)| state.check())
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    decoded(saved).map(drop)
}

/// The exposure of a photo by its EXIF data, stops; `None` if they lack it. Errors: the reason why the data cannot be read.
fn stated_exposure(dataset: &Dataset, view: usize) -> Result<Option<f64>, String> {
    let photo = &dataset.views[view].photo;
    photo.header.exif.map_or(Ok(None), |place| exif::brightness(&photo.image_path, place))
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
        Encoded::of(&(&self.state, self.first_exposures, self.steps))
    }

    fn restore(&mut self, saved: &Encoded, past: &PastViews) -> Result<(), ValuesError> {
        let (state, first_exposures, steps) = decoded(saved)?;
        // A run that has dropped its exposures has none.
        let is_dropped = state.images.is_empty();
        if !is_dropped || self.judged_after.is_some() {
            self.state = if is_dropped { state } else { state.of_views(past, self.state.cameras.len()) };
            (self.first_exposures, self.steps, self.is_restored) = (first_exposures, steps, true);
        }
        Ok(())
    }

    /// Starts from another run's values and holds the mean at theirs, or else starts the exposures from EXIF data if
    /// more than half of the training photos state one. The result depends on the files alone. Values of a commit stay.
    fn start(&mut self, dataset: &Dataset) -> Vec<String> {
        if self.is_restored {
            return Vec::new();
        }
        if let Some(given) = &self.given {
            let value = |view: usize| given.get(&dataset.views[view].name).map(|&(values, seen)| (view, values, seen));
            let values: Vec<_> = dataset.train_views().into_iter().filter_map(value).collect();
            self.state.tie(&values);
            return Vec::new();
        }
        let views = dataset.train_views();
        let read = |&view: &usize| stated_exposure(dataset, view);
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
        !self.is_dropped()
    }

    fn predict(&self, dataset: &Dataset, views: &[usize]) -> Option<Vec<Correction>> {
        if self.is_dropped() {
            return None;
        }
        let camera = |view: usize| &dataset.views[view].camera;
        let place = |&view: &usize| PhotoPlace {
            camera: camera(view),
            stated: stated_exposure(dataset, view).unwrap_or_default(),
        };
        let mut known = dataset.train_views();
        known.retain(|&view| self.state.images.get(view).is_some_and(|image| image.sightings > 0));
        let of_known = |view: &usize| (place(view), self.state.acting(*view, self.mode.image_values()));
        let said = predict(
            &known.par_iter().map(of_known).collect::<Vec<_>>(),
            &views.par_iter().map(place).collect::<Vec<_>>(),
        );
        let look = |(&view, image): (&usize, _)| -> Correction {
            let group = self.camera_groups.get(view).copied().unwrap_or_default();
            let look = Look { image, ..self.state.look(self.mode, (view, group), camera(view)) };
            Box::new(move |picture, width| look.correct(picture, width, None))
        };
        Some(views.iter().zip(said).map(look).collect())
    }

    fn begin_step(&mut self, step: &PhotoStep<'_>) {
        let of_view = (step.view, self.camera_groups.get(step.view).copied().unwrap_or_default());
        self.look = self.state.look(self.mode, of_view, step.camera);
        self.found = None;
    }

    fn correct(&mut self, picture: &mut [f32], photo: &Target) {
        self.drawn.clear();
        self.drawn.extend_from_slice(picture);
        self.found = find(&FittedPair { drawn: &self.drawn, photo }, &self.look, self.mode);
        self.look.correct(picture, photo.width as usize, Some(photo));
    }

    fn picture_back(&mut self, photo: &Target, gradient: &mut PictureGradient) {
        if self.is_dropped() {
            return;
        }
        self.look.back(&self.drawn, photo, &mut gradient.v_rgb);
    }

    /// Fits also a photo that is left out: otherwise an exposure that was fitted to a rough scene could keep out a sound photo.
    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        let found = self.found.take().filter(|_| !outcome.is_skipped);
        if let (Some(found), Some(&group)) = (found, self.camera_groups.get(outcome.view)) {
            match outcome.is_left_out {
                true => self.state.move_image(self.mode, outcome.view, &found, 1.0),
                false => self.state.learn(self.mode, (outcome.view, group), &found),
            }
        }
        self.steps = self.steps.saturating_add(1);
        let is_due = self.judged_after == Some(self.steps) && !self.is_dropped();
        if is_due { self.judge(outcome.dataset).into_iter().collect() } else { Vec::new() }
    }

    fn buffer_bytes(&self) -> u64 {
        4 * self.drawn.capacity() as u64
    }

    fn free_buffers(&mut self) {
        self.drawn = Vec::new();
    }

    fn write_file(&self, folder: &Path, dataset: &Dataset) -> InputResult<()> {
        let path = folder.join(FILE);
        if self.is_dropped() {
            // An earlier part of the run may have ended before the exposures were judged.
            return match std::fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(InputError::io(&path, "removing", &e)),
                _ => Ok(()),
            };
        }
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
            model: self.mode.name().into(),
            exposures_from_exif: self.first_exposures,
            images: views_by_name(dataset).into_iter().map(of_image).collect(),
            cameras: trained.map(|(group, camera)| (group, camera.falloff)).filter_map(of_camera).collect(),
        };
        write_values(&path, &file)
    }
}

impl Appearance {
    /// Whether the exposures have been judged and hardly differ. A commit holds the values of no photo then.
    fn is_dropped(&self) -> bool {
        self.state.images.is_empty()
    }

    /// Drops the exposures if they differ by less than [`EXPOSURE_SPREAD`]. Returns what the user is told; nothing of a single photo.
    fn judge(&mut self, dataset: &Dataset) -> Option<String> {
        let views = dataset.train_views();
        let seen = views.into_iter().filter(|&view| self.state.images[view].sightings > 1);
        let exposures: Vec<f64> = seen.map(|view| self.state.acting(view, 1)[0]).collect();
        let (count, spread) = (exposures.len(), spread(exposures));
        let said = format!("exposures differ by {spread:.2} stops between photos");
        if count >= PHOTOS_FOR_REMEDIES && spread >= EXPOSURE_SPREAD {
            return Some(format!("{said}: they stay corrected"));
        }
        (self.state, self.drawn) = (AppearanceState::default(), Vec::new());
        (count > 1).then(|| format!("{said}: they are no longer corrected"))
    }
}

/// The corrections of another run's photos, by name, with the number of steps that had seen each. Vignetting is not taken over.
pub type GivenValues = Arc<BTreeMap<String, ([f64; IMAGE_VALUES], u32)>>;

/// Reads the appearance.json of a run.
/// Errors: the file cannot be read, or is none.
pub fn read_values(file: &Path) -> InputResult<GivenValues> {
    let remedy = "name the appearance.json of a run with --appearance";
    let text = read_text(file, FILE_BYTES_MAX, remedy)?;
    let read: AppearanceFile = serde_json::from_str(&text).map_err(|e| InputError::new(file, e.to_string(), remedy))?;
    let mut values = BTreeMap::new();
    for ImageValues { name, exposure, homography: h, sightings } in read.images.into_iter().filter(|i| i.sightings > 0)
    {
        let of_photo = [exposure, h[0] - 1.0, h[1], h[2], h[3], h[4] - 1.0, h[5], h[6], h[7]];
        let refuse = || InputError::new(file, "a value is not finite", remedy).at(name.clone());
        values.insert(name.clone(), (bounded(of_photo).ok_or_else(refuse)?, sightings));
    }
    Ok(Arc::new(values))
}

#[derive(Debug, Serialize, Deserialize)]
struct AppearanceFile {
    /// `exposure`, `if-needed` or `full`.
    model: Cow<'static, str>,
    /// Training photos whose exposure started from EXIF data.
    exposures_from_exif: u32,
    /// The training photos, in the order of their names.
    images: Vec<ImageValues>,
    /// The cameras; empty without vignetting.
    cameras: Vec<CameraValues>,
}

#[derive(Debug, Serialize, Deserialize)]
struct ImageValues {
    name: String,
    /// Stops, against the mean of all photos.
    exposure: f64,
    /// Row-major 3x3 matrix on (R/S - 1/3, G/S - 1/3, 1) with S = R + G + B.
    homography: [f64; 9],
    /// Steps that have seen the photo; an exposure from EXIF data counts as one.
    sightings: u32,
}

#[derive(Debug, Serialize, Deserialize)]
struct CameraValues {
    /// Pixels.
    width: u32,
    /// Pixels.
    height: u32,
    /// Of red, green and blue: a1, a2, a3, and the optical centre relative to the principal point, in halves of the
    /// diagonal.
    vignetting: [[f64; CHANNEL_VALUES]; 3],
}

/// The exposures of the photos, if the run has trained them.
fn finding(file: &Value, _: &Value) -> Option<Finding> {
    let images = file["images"].as_array().map_or(&[][..], Vec::as_slice);
    let values: Vec<f64> = images.iter().filter_map(|image| image["exposure"].as_f64()).collect();
    let first = match file["exposures_from_exif"].as_u64() {
        None | Some(0) => String::new(),
        Some(count) => format!(" {count} exposures started from EXIF data."),
    };
    let caption = format!(
        "Exposure of each training photo against the mean of all, as trained.{first} appearance.json has the numbers."
    );
    let curve = (!values.is_empty()).then_some(Curve { title: "Exposure", unit: "stops", values, caption })?;
    Some(Finding { title: "Appearance", curve: Some(curve), ..Finding::default() })
}
