//! What a densification strategy is: a [`Strategy`] says what steps collect and which events follow them; a [`Round`], which
//! the log keeps, says what becomes of a row.
//!
//! A round is not asked through the strategy of the run: pages apply a round late, by then perhaps under other keys, and must
//! do what it would have done on time. So everything that a round decides by stands in its event.
//!
//! To add a strategy: a file beside [`super::default`] with its keys as a struct that implements [`Strategy`]; a name in
//! [`StrategyName`]; its keys in `config/file.rs`, and their way into the struct in `config/limits.rs`. If it decides by other things than [`crate::scene::events::RoundThresholds`] holds, its round is a
//! kind of event in `scene/events.rs` that implements [`Round`] and that [`effect_of`] names.
//!
//! Invariants: 1. strategies and rounds are functions of their arguments, without side effects; 2. the same event decides the
//! same for a row whenever it is applied.

use super::stats::{GradHistogram, accumulate};
use crate::optim::bounds::SplitLimits;
use crate::scene::events::EventKind;
use crate::scene::rows::{Rows, RowsMut};
use std::fmt;

/// The value of `--strategy`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StrategyName {
    /// [`super::default::DefaultStrategy`].
    Default,
    /// [`NoStrategy`].
    None,
}

impl StrategyName {
    /// The names in config files and on the command line.
    pub const NAMES: [&str; 2] = ["default", "none"];

    /// The name in config files and on the command line: one of [`StrategyName::NAMES`].
    pub fn name(self) -> &'static str {
        match self {
            StrategyName::Default => "default",
            StrategyName::None => "none",
        }
    }

    /// The strategy with this name.
    pub fn from_name(name: &str) -> Option<StrategyName> {
        [StrategyName::Default, StrategyName::None].into_iter().find(|strategy| strategy.name() == name)
    }

    /// Whether a scene may come to have more Gaussians than it begins with.
    pub fn grows(self) -> bool {
        self != StrategyName::None
    }
}

/// Rows of a view that a step drew, with what the renderer knows of them.
#[derive(Debug, Clone, Copy)]
pub struct DrawnRows<'a> {
    /// The rows, ascending, numbered as the view's.
    pub rows: &'a [u32],
    /// For each, the gradient of the loss with respect to its position in the picture, pixel units.
    pub v_means2d: &'a [[f32; 2]],
    /// For each, its radii in the picture, pixels; a row with a zero radius was not drawn.
    pub radii: &'a [[u32; 2]],
    /// Width and height of the picture, pixels.
    pub image_size: [u32; 2],
}

/// When a scene densifies, and what steps collect for it.
pub trait Strategy: fmt::Debug + Send + Sync {
    /// Whether the scene may come to have more Gaussians than it begins with.
    fn grows(&self) -> bool;

    /// Whether this step collects statistics.
    fn collects(&self, step: u32) -> bool;

    /// Adds what a step drew to the statistics of rows; returns the number of rows that changed. Every row with statistics
    /// counts in the histogram.
    fn collect(&self, view: &mut RowsMut<'_>, drawn: &DrawnRows<'_>, histogram: &mut GradHistogram) -> usize {
        accumulate(view, drawn.rows, drawn.v_means2d, drawn.radii, drawn.image_size, histogram)
    }

    /// The events that follow this step, in order. `scene_scale` is in local units, `rows` is an upper bound of the rows
    /// before the first of these events, `histogram` holds their statistics. The caller clears the histogram after a round.
    fn events_after(&self, step: u32, scene_scale: f32, rows: u64, histogram: &GradHistogram) -> Vec<EventKind>;

    /// What bounds of pages must count on: no round splits a row that these leave out.
    fn split_limits(&self, scene_scale: f32) -> SplitLimits;
}

/// Densifies never.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoStrategy;

impl Strategy for NoStrategy {
    fn grows(&self) -> bool {
        false
    }

    fn collects(&self, _: u32) -> bool {
        false
    }

    fn events_after(&self, _: u32, _: f32, _: u64, _: &GradHistogram) -> Vec<EventKind> {
        Vec::new()
    }

    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits::NEVER
    }
}

/// What a round knows of a row at the event's time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowFacts {
    /// Mean of the gradient norms collected since the last round, NDC units.
    pub mean_grad2d: f32,
    /// Largest log-scale.
    pub log_scale: f32,
    /// Logit of the opacity.
    pub opacity: f32,
}

/// Bounds of the rows of a page at any later step, if nobody touches them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extremes {
    /// Lowest logit of an opacity.
    pub lowest_opacity: f32,
    /// Largest standard deviation.
    pub sigma_max: f32,
}

/// What a round does with a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// Nothing.
    Keep,
    /// Removed.
    Prune,
    /// Gets a copy of itself; or, when what it is would be pruned, both go.
    Duplicate {
        /// Whether the row and its copy are pruned at once.
        pruned: bool,
    },
    /// Replaced by two smaller children; or by nothing, when those would be pruned.
    Split {
        /// Whether the children are pruned at once.
        children_pruned: bool,
    },
}

/// A logged round: what becomes of each row.
pub trait Round: Sync {
    /// What becomes of a row.
    fn fate(&self, row: &RowFacts) -> Fate;

    /// Whether some row may grow. False only where [`Round::fate`] makes no row out of any of these.
    fn may_grow(&self, rows: &Rows<'_>) -> bool;

    /// Whether rows within these bounds stay as long as they do not grow: a page that missed many rounds is looked at once
    /// then, not once a round.
    fn spares(&self, extremes: &Extremes) -> bool;

    /// Rows that may grow when the round is logged: at least those that do. There are at most `rows`, and the histogram
    /// holds their statistics.
    fn promised(&self, rows: u64, histogram: &GradHistogram) -> u64;

    /// Rows of a view that [`Round::promised`] counted, when their statistics are still those of the round.
    fn promised_rows(&self, rows: &Rows<'_>) -> u64;
}

/// What an event does to rows.
#[derive(Clone, Copy)]
pub enum Effect<'a> {
    /// A round of a strategy.
    Round(&'a dyn Round),
    /// Opacities above the given one are set to it.
    ResetOpacity {
        /// Largest opacity (after activation) that remains.
        max_opacity: f32,
    },
    /// Rows that are stored without the bands up to this degree get zeros.
    RaiseShDegree {
        /// The degree.
        degree: u8,
    },
}

/// What an event of this kind does to rows. The only place that names the rounds of all strategies.
pub fn effect_of(kind: &EventKind) -> Effect<'_> {
    match *kind {
        EventKind::Densify(ref thresholds) => Effect::Round(thresholds),
        EventKind::ResetOpacity { max_opacity } => Effect::ResetOpacity { max_opacity },
        EventKind::RaiseShDegree { degree } => Effect::RaiseShDegree { degree },
    }
}
