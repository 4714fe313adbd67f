//! The interface of a kind of photo parameters: its values for all photos of a run, and what it does in each step.
//!
//! A step calls [`PhotoParameter::begin_step`], then [`PhotoParameter::correct`] and [`PhotoParameter::target`] between the
//! picture and its loss, [`PhotoParameter::picture_back`] and [`PhotoParameter::row_gradients`] on the way of the gradient, and
//! [`PhotoParameter::end_step`]. A step that lacked memory is repeated from `begin_step` on. A commit holds the values as
//! bytes under the name of their kind. So a new kind changes no layout, and a kind that a commit lacks begins with its start values.
//!
//! Invariants: 1. values change in `start`, `end_step` and `restore` alone, so that a step can be repeated or rehearsed; 2. what
//! a kind does not override does nothing; 3. equal values have equal bytes.

use super::PhotoOptions;
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::{self, EncodingError};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::image::{Image, PictureGradient, Target};
use serde::de::{DeserializeOwned, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

pub struct Kind {
    /// Its name in commits; see [`PhotoParameter::name`].
    pub name: &'static str,
    /// The file that it writes into the folder of a run.
    pub file: Option<&'static str>,
    /// Its parameters in a run that has seen nothing; `None` in a run without it.
    pub first: fn(&PhotoOptions, &Dataset) -> Option<Box<dyn PhotoParameter>>,
    pub check: fn(&Encoded) -> Result<(), ValuesError>,
    /// What the report of a run says about it, if anything, from its file (null without) and the run's summary.json.
    pub finding: fn(&Value, &Value) -> Option<Finding>,
}

/// What a report says about a kind, as plain data.
#[derive(Debug, Default)]
pub struct Finding {
    pub title: &'static str,
    /// A paragraph; empty for none.
    pub text: String,
    /// Headings of a table, and its rows of texts and numbers.
    pub table: Option<([&'static str; 3], Vec<[Value; 3]>)>,
    pub curve: Option<Curve>,
}

#[derive(Debug)]
pub struct Curve {
    pub title: &'static str,
    pub unit: &'static str,
    /// A value for each photo, in the order of names.
    pub values: Vec<f64>,
    pub caption: String,
}

/// Steps from the last opacity reset to step `step`; `None` before the first one.
pub fn steps_after_reset(events: &EventLog, step: u32) -> Option<u32> {
    let is_reset = |event: &&Event| matches!(event.kind, EventKind::ResetOpacity { .. });
    let reset = events.events().iter().rev().find(is_reset);
    reset.map(|reset| step.saturating_sub(reset.step))
}

/// A coming step, or the rehearsal of one.
#[derive(Debug, Clone, Copy)]
pub struct PhotoStep<'a> {
    pub view: usize,
    /// Steps done.
    pub step: u32,
    pub camera: &'a Camera,
    pub events: &'a EventLog,
    /// Only the loss is measured: the view is not trained on.
    pub is_left_out: bool,
    /// The step is a rehearsal: it takes the memory and the time of a step that uses everything of the kind, and its results are dropped.
    pub is_rehearsal: bool,
}

/// Steps after an opacity reset in which pictures are too dark for a judgement.
pub const STEPS_AFTER_RESET: u32 = 500;

impl PhotoStep<'_> {
    /// Whether an opacity reset is so near that the picture says nothing about its photo.
    pub fn follows_reset(&self) -> bool {
        steps_after_reset(self.events, self.step).is_some_and(|steps| steps <= STEPS_AFTER_RESET)
    }
}

#[derive(Debug, Clone, Copy)]
pub struct PhotoOutcome<'a> {
    pub view: usize,
    /// The step, from 0.
    pub step: u32,
    /// The step was skipped: its picture may not be sound.
    pub is_skipped: bool,
    /// The view was left out: its picture was compared with the photo, and nothing else was done with it.
    pub is_left_out: bool,
    /// The number of views of the group (`schedule::order`) that ends with this step, if one does.
    pub ended_group: Option<usize>,
    /// Steps since the last opacity reset; `None` before the first one.
    pub after_reset: Option<u32>,
    /// Mean squared error of the picture, of values in 0..1.
    pub mse: f64,
    pub photo: &'a Target,
    pub dataset: &'a Dataset,
}

impl PhotoOutcome<'_> {
    /// Whether the step has changed the scene.
    pub fn has_trained(&self) -> bool {
        !self.is_skipped && !self.is_left_out
    }
}

/// Corrects a picture `[3][height][width]` of this width in place.
pub type Correction = Box<dyn Fn(&mut [f32], usize)>;

/// The parameters of one kind: their values for all photos, and their buffers for a step.
pub trait PhotoParameter {
    /// The name of the kind in commits. It stands for the layout of its values: another layout needs another name, unless the older one is
    /// told apart and read too.
    fn name(&self) -> &'static str;

    /// The values as a commit holds them. Errors: the values cannot be encoded.
    fn save(&self) -> Result<Encoded, EncodingError>;

    /// Restores saved values, of the photos that `past` names also where there are others now. Errors: no run can have written the values.
    fn restore(&mut self, saved: &Encoded, past: &PastViews) -> Result<(), ValuesError>;

    /// Sets start values from the dataset, unless values were restored. Returns warnings for the user.
    fn start(&mut self, _: &Dataset) -> Vec<String> {
        Vec::new()
    }

    /// What the plan of a run says about photos.
    fn plan_text(&self) -> Option<String> {
        None
    }

    /// The camera of a view, from the camera before it.
    fn camera(&self, _view: usize, camera: Camera) -> Camera {
        camera
    }

    /// Whether a view is compared with its photo, but not trained on.
    fn leaves_out(&self, _view: usize) -> bool {
        false
    }

    /// Whether another view trains at `step` in the turn of this view.
    fn is_replaced_at(&self, _view: usize, _step: u32) -> bool {
        false
    }

    fn corrects(&self) -> bool {
        false
    }

    /// The corrections of the pictures of views that the run does not train on, as their neighbours suggest; `None` of a kind that does not
    /// correct pictures.
    fn predict(&self, _: &Dataset, _views: &[usize]) -> Option<Vec<Correction>> {
        None
    }

    /// Whether the kind adds a term to the loss: [`PhotoParameter::target`] compares picture and photo, [`PhotoParameter::loss`] gives the
    /// value, and [`PhotoParameter::picture_back`] adds the gradient.
    fn adds_loss(&self) -> bool {
        false
    }

    /// Whether the host acts between picture and gradient at 0-based `step`, so that a device cannot be given this step ahead.
    fn needs_host(&self, _step: u32) -> bool {
        self.corrects() || self.adds_loss()
    }

    /// Prepares for a step, and forgets what an earlier attempt has found.
    fn begin_step(&mut self, _: &PhotoStep<'_>) {}

    /// Corrects the picture `[3][height][width]` before it is compared with the photo.
    fn correct(&mut self, _picture: &mut [f32], _photo: &Target) {}

    /// Whether [`PhotoParameter::target`] needs the corrected picture in this step.
    fn needs_picture(&self) -> bool {
        false
    }

    /// The photo that the picture is compared with. `_picture` is the corrected picture, if a parameter needs it.
    fn target<'a>(&'a mut self, _picture: Option<&Image>, photo: &'a Target) -> &'a Target {
        photo
    }

    /// Whether the step must not train on the photo, as the picture has shown. After [`PhotoParameter::target`].
    fn leaves_out_now(&self) -> bool {
        false
    }

    /// What the kind adds to the loss of the step. After [`PhotoParameter::target`].
    fn loss(&self) -> f64 {
        0.0
    }

    /// Turns the gradient with respect to the corrected picture into that with respect to the drawn one; a term of the loss adds its own. The last kind of the list comes first.
    fn picture_back(&mut self, _photo: &Target, _gradient: &mut PictureGradient) {}

    /// Takes the gradients of the rows of a batch, drawn with bands up to `sh_degree`. Not called with rows on a device.
    fn row_gradients(&mut self, _rows: &Columns, _gradients: &Columns, _camera: &Camera, _sh_degree: u8) {}

    /// Learns from a step. Returns warnings for the user.
    fn end_step(&mut self, _: &PhotoOutcome<'_>) -> Vec<String> {
        Vec::new()
    }

    /// Bytes of the buffers for a step.
    fn buffer_bytes(&self) -> u64 {
        0
    }

    fn free_buffers(&mut self) {}

    /// For the forecast: most bytes of the values during a run, with the copies that a commit makes.
    fn value_bytes(&self, _: &Dataset) -> u64 {
        0
    }

    /// Figures for summary.json, by name.
    fn figures(&self, _: &Dataset) -> Vec<(&'static str, Value)> {
        Vec::new()
    }

    /// Writes the values as people and other programs read them into the folder of the run.
    /// Errors: the folder cannot be written.
    fn write_file(&self, _folder: &Path, _: &Dataset) -> InputResult<()> {
        Ok(())
    }
}

/// Writes a file of values. Errors: the folder cannot be written.
pub fn write_values(path: &Path, values: &impl Serialize) -> InputResult<()> {
    let text = serde_json::to_string_pretty(values).map_err(|e| InputError::io(path, "writing", &e.into()))?;
    write_whole(path, (text + "\n").as_bytes())
}

/// The training photos in the order of their names, as files list them.
pub fn views_by_name(dataset: &Dataset) -> Vec<usize> {
    let mut views = dataset.train_views();
    views.sort_by(|&a, &b| dataset.views[a].name.cmp(&dataset.views[b].name));
    views
}

/// By name of the kind.
pub type SavedValues = BTreeMap<String, Encoded>;

/// Values of one kind.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Encoded(Vec<u8>);

/// Why bytes are not values of a kind.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValuesError {
    #[error(transparent)]
    Encoding(#[from] EncodingError),
    /// No run can have written them.
    #[error("{0}")]
    Impossible(&'static str),
}

impl Encoded {
    /// Encodes values. Errors: the type contains something that cannot be encoded.
    pub fn of<T: Serialize>(values: &T) -> Result<Encoded, EncodingError> {
        encoding::to_bytes(values).map(Encoded)
    }

    /// Decodes values, and checks them. Errors: the bytes are no such values, or `check` refuses them.
    pub fn decoded<T: DeserializeOwned>(
        &self,
        check: impl Fn(&T) -> Result<(), &'static str>,
    ) -> Result<T, ValuesError> {
        let values = encoding::from_bytes(&self.0)?;
        check(&values).map_err(ValuesError::Impossible)?;
        Ok(values)
    }
}

/// Where the values of each photo lie among those that were saved: by view of the dataset now, `None` for a photo that is new.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PastViews(pub Vec<Option<usize>>);

impl PastViews {
    /// The saved values in the order of the views now; those of a start for photos that are new.
    pub fn of<T: Clone + Default>(&self, saved: &[T]) -> Vec<T> {
        self.0.iter().map(|at| at.and_then(|at| saved.get(at)).cloned().unwrap_or_default()).collect()
    }
}

/// As one run of bytes: a list would be written byte by byte.
impl Serialize for Encoded {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Encoded {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Encoded, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Encoded;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }

            fn visit_byte_buf<E>(self, bytes: Vec<u8>) -> Result<Encoded, E> {
                Ok(Encoded(bytes))
            }
        }
        d.deserialize_byte_buf(Bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_say_nothing_for_500_steps_after_a_reset() {
        let camera = Camera::along_z(0.0, [20.0, 20.0, 2.0, 2.0], [4, 4]);
        let mut events = EventLog::default();
        let follows = |events: &EventLog, step: u32| {
            PhotoStep { view: 0, step, camera: &camera, events, is_left_out: false, is_rehearsal: false }
                .follows_reset()
        };
        assert!(!follows(&events, 100));
        events.push(Event { step: 99, kind: EventKind::ResetOpacity { max_opacity: 0.01 } });
        events.push(Event { step: 150, kind: EventKind::RaiseShDegree { degree: 1 } });
        assert!(follows(&events, 151) && follows(&events, 599) && !follows(&events, 600));
    }
}
