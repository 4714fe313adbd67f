//! The run state as bytes: everything besides pages that a run needs to resume exactly.
//!
//! Invariants: 1. decoding returns the encoded state, bit for bit; 2. the version comes first, so that the state of
//! another program version is distinguished from damage; 3. decoding untrusted bytes gives a valid state or an error,
//! never a panic.
//!
//! Layout: [`VERSION`] as u32, then the values in the order of `encode` and `decode`, as
//! [`crate::page::format::encoding`] writes them. A new value is a field of [`TrainerState`], a place at the end of `encode` and
//! `decode`, and a new version. A new kind of values of photos changes nothing here: these are encoded by [`crate::photos`], each
//! kind under its name.

use crate::base::identity::RunId;
use crate::densify::growth::GrowthState;
use crate::page::format::encoding::{self, EncodingError};
use crate::paging::stats::PagerStats;
use crate::photos;
use crate::photos::parameter::{PastViews, SavedValues, ValuesError};
use crate::scene::events::{Event, EventKind, EventLog};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the layout below.
pub const VERSION: u32 = 12;

/// Digests of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewPrint {
    /// Digest of name, set, size and pose.
    pub pose: u64,
    /// Digest of the files of its photo and its mask.
    pub photo: u64,
}

/// Digests and numbers of the dataset properties on which training depends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DatasetPrint {
    /// Views in the dataset's order.
    pub views: Vec<ViewPrint>,
    /// Number of first Gaussians.
    pub first_rows: u64,
    /// Digest of the points or Gaussians from which they are made.
    pub points: u64,
    /// Scene scale, local units.
    pub scene_scale: f32,
    /// World position of the local origin.
    pub origin: [f64; 3],
    /// World length of one local unit.
    pub scale: f64,
}

impl DatasetPrint {
    /// Where each view lies in the dataset of before: as the view of the same name and pose, or else of the same photo, which stands in
    /// its place if several are equal.
    pub fn past_views(&self, before: &DatasetPrint) -> PastViews {
        let at = |digest: fn(&ViewPrint) -> u64| -> BTreeMap<u64, usize> {
            before.views.iter().enumerate().map(|(at, view)| (digest(view), at)).collect()
        };
        let (of_pose, of_photo) = (at(|view| view.pose), at(|view| view.photo));
        let past = |(at, view): (usize, &ViewPrint)| {
            let in_place = before.views.get(at).filter(|then| then.photo == view.photo).map(|_| at);
            of_pose.get(&view.pose).copied().or(in_place).or_else(|| of_photo.get(&view.photo).copied())
        };
        PastViews(self.views.iter().enumerate().map(past).collect())
    }
}

/// The last evaluation on the held-out views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LastTest {
    /// Steps done at the evaluation.
    pub step: u32,
    /// Views in the means.
    pub views: u32,
    /// Mean PSNR, dB.
    pub psnr: f64,
    pub ssim: f64,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunIdentity {
    pub id: RunId,
    /// Its output folder, absolute; empty if unknown.
    pub out: String,
    /// Its scene, absolute; empty if unknown.
    pub scene: String,
}

/// How a run was started. Constant while it runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Origin {
    /// The config, every key, as TOML.
    pub config: String,
    /// Resolved instruction path.
    pub simd: String,
    /// SH degree of the first step.
    pub sh_degree_start: u8,
    pub dataset: DatasetPrint,
    pub run: RunIdentity,
}

/// The last steps in a row that changed no Gaussian.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IdleSteps {
    pub steps: u32,
    /// Steps whose photo is masked completely.
    pub masked: u32,
    /// Steps whose view had rows.
    pub with_rows: u32,
    /// Steps whose view drew a row.
    pub with_drawn: u32,
}

/// The part of a run's state that the trainer itself holds and changes. A commit saves it whole, and a resume restores
/// it whole.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrainerState {
    /// Steps done.
    pub step: u32,
    /// Row updates skipped because a value was not finite.
    pub rows_skipped: u64,
    /// Steps skipped because the loss or gradients were not finite.
    pub steps_skipped: u32,
    /// Number of the last steps in a row that were skipped or that skipped more than .01 % of their rows.
    pub steps_skipped_in_a_row: u32,
    pub idle: IdleSteps,
    /// Seconds spent in steps.
    pub train_seconds: f64,
    /// The last evaluation on the held-out views, if there was one.
    pub test: Option<LastTest>,
    /// State of the decision about the count.
    pub growth: GrowthState,
}

/// The state of a run between two steps, without its pages.
#[derive(Debug, Clone, PartialEq)]
pub struct RunState {
    /// How the run was started.
    pub origin: Origin,
    /// Name of the renderer.
    pub device: String,
    pub trainer: TrainerState,
    /// What the run knows of its photos.
    pub photos: SavedValues,
    pub events: Vec<Event>,
    /// Histogram since the last round: non-empty bins with their numbers of rows.
    pub histogram: Vec<(u16, u32)>,
    /// Rows of the stored pages.
    pub rows: u64,
    /// Upper bound of the rows after all events.
    pub rows_bound: u64,
    /// Length of metrics.jsonl.
    pub metrics_bytes: u64,
    /// Traffic between the tiers so far.
    pub traffic: PagerStats,
}

/// The message about values that no run has.
fn impossible(what: &str) -> String {
    format!("the run state is inconsistent: {what}")
}

/// The message about bytes that are no run state.
fn unreadable(error: EncodingError) -> String {
    format!("the run state is {error}")
}

impl RunState {
    /// The state of a run of `rows` Gaussians without history: not trained yet, or history unknown.
    pub fn without_history(origin: Origin, device: String, rows: u64) -> RunState {
        let dataset = DatasetPrint { first_rows: rows, ..origin.dataset };
        RunState {
            origin: Origin { dataset, ..origin },
            device,
            trainer: TrainerState::default(),
            photos: SavedValues::default(),
            events: Vec::new(),
            histogram: Vec::new(),
            rows,
            rows_bound: rows,
            metrics_bytes: 0,
            traffic: PagerStats::default(),
        }
    }

    /// Encodes the state.
    /// Errors: the state is not valid; a valid one never fails.
    pub fn to_bytes(&self) -> Result<Vec<u8>, String> {
        let mut bytes = VERSION.to_le_bytes().to_vec();
        bytes.extend(self.encode().map_err(unreadable)?);
        Ok(bytes)
    }

    /// Decodes a state.
    /// Errors: the bytes are not a run state, or have another version.
    pub fn from_bytes(bytes: &[u8]) -> Result<RunState, String> {
        let (version, body) = bytes.split_first_chunk().ok_or_else(|| impossible("it is empty"))?;
        let version = u32::from_le_bytes(*version);
        if version != VERSION {
            return Err(format!("the run state has version {version}; this program knows version {VERSION}"));
        }
        let state = RunState::decode(body).map_err(unreadable)?;
        state.check()?;
        Ok(state)
    }

    /// The values in the order of the layout. Tuples add no byte; serde implements tuples of at most 16 values.
    fn encode(&self) -> Result<Vec<u8>, EncodingError> {
        let RunState { origin, device, trainer, photos, events, histogram, rows, .. } = self;
        let RunState { rows_bound, metrics_bytes, traffic, .. } = self;
        let Origin { config, simd, sh_degree_start, dataset, run } = origin;
        let TrainerState { step, rows_skipped, steps_skipped, steps_skipped_in_a_row, .. } = trainer;
        let TrainerState { idle, train_seconds, test, growth, .. } = trainer;
        encoding::to_bytes(&(
            (step, config, simd, device, sh_degree_start, dataset),
            (events, histogram, rows, rows_bound),
            (rows_skipped, steps_skipped, steps_skipped_in_a_row, train_seconds, idle),
            (metrics_bytes, test, traffic, run),
            (growth, photos),
        ))
    }

    /// The counterpart of [`RunState::encode`].
    fn decode(bytes: &[u8]) -> Result<RunState, EncodingError> {
        let (
            (step, config, simd, device, sh_degree_start, dataset),
            (events, histogram, rows, rows_bound),
            (rows_skipped, steps_skipped, steps_skipped_in_a_row, train_seconds, idle),
            (metrics_bytes, test, traffic, run),
            (growth, photos),
        ) = encoding::from_bytes(bytes)?;
        let origin = Origin { config, simd, sh_degree_start, dataset, run };
        let trainer = TrainerState {
            step,
            rows_skipped,
            steps_skipped,
            steps_skipped_in_a_row,
            idle,
            train_seconds,
            test,
            growth,
        };
        Ok(RunState { origin, device, trainer, photos, events, histogram, rows, rows_bound, metrics_bytes, traffic })
    }

    /// The events as a log.
    /// Errors: the events are out of order.
    pub fn event_log(&self) -> Result<EventLog, String> {
        EventLog::from_events(self.events.clone()).ok_or_else(|| impossible("its events are out of order"))
    }

    fn check(&self) -> Result<(), String> {
        let log = self.event_log()?;
        let refuse = |what: &str| Err(impossible(what));
        if log.events().last().is_some_and(|last| last.step >= self.trainer.step) {
            return refuse("an event lies in its future");
        }
        let is_too_high = |e: &Event| matches!(e.kind, EventKind::RaiseShDegree { degree } if degree > 3);
        if self.origin.sh_degree_start > 3 || log.events().iter().any(is_too_high) {
            return refuse("a degree is above 3");
        }
        if self.rows_bound < self.rows {
            return refuse("it has more Gaussians than its bound");
        }
        // The logit of any other value is infinite or NaN.
        let is_opacity = |x: f32| x > 0.0 && x < 1.0;
        let is_wrong =
            |e: &Event| matches!(e.kind, EventKind::ResetOpacity { max_opacity } if !is_opacity(max_opacity));
        if log.events().iter().any(is_wrong) {
            return refuse("an event resets opacities to an invalid value");
        }
        if !self.histogram.windows(2).all(|pair| pair[0].0 < pair[1].0) {
            return refuse("its statistics have bins out of order");
        }
        let DatasetPrint { origin, scale, .. } = &self.origin.dataset;
        if !(origin.iter().all(|x| x.is_finite()) && scale.is_normal() && *scale > 0.0) {
            return refuse("its local frame is invalid");
        }
        let is_time = |seconds: f64| seconds >= 0.0 && seconds.is_finite();
        let TrainerState { step, train_seconds, test, .. } = self.trainer;
        if !is_time(train_seconds) || !is_time(self.traffic.stall_seconds) || !is_time(self.traffic.other_stall_seconds)
        {
            return refuse("its training or waiting time is invalid");
        }
        if test.is_some_and(|test| test.step > step || !test.psnr.is_finite() || !test.ssim.is_finite()) {
            return refuse("its last evaluation is invalid");
        }
        photos::check(&self.photos).map_err(|error| match error {
            ValuesError::Encoding(error) => unreadable(error),
            ValuesError::Impossible(what) => impossible(what),
        })?;
        self.trainer.growth.check(step).or_else(refuse)
    }
}
