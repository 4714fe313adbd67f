//! The interface of densification strategies. A [`Strategy`] decides what steps collect and which events follow a step.
//! A [`Round`] is a logged event that decides the [`Fate`] of each row.
//!
//! A round does not depend on the strategy of the run: a page may apply a round late, when the config has changed, and
//! must get the result of applying the round on time. The event therefore holds every value that the decision needs.
//!
//! Invariants: 1. strategies and rounds are functions of their arguments, without side effects; 2. an event gives a row
//! the same fate whenever it is applied.

use super::growth::GrowthRule;
use super::stats::{DrawnRows, GradHistogram, accumulate, rows_from_bin};
use crate::optim::bounds::SplitLimits;
use crate::scene::columns::{Columns, Gradients};
use crate::scene::events::EventKind;
use crate::scene::rows::{Rows, RowsMut};
use std::fmt;
use std::sync::Arc;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StrategyName {
    Default,
    LongAxis,
    Mcmc,
    None,
}

impl StrategyName {
    /// Whether the number of Gaussians may grow.
    pub fn grows(self) -> bool {
        self != StrategyName::None
    }
}

/// When the rounds of a strategy happen; steps are 0-based.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoundSteps {
    /// Rounds happen only after this step.
    pub start: u32,
    /// Rounds and statistics end before this step.
    pub stop: u32,
    /// Steps between rounds.
    pub every: u32,
}

impl RoundSteps {
    pub fn is_round(&self, step: u32) -> bool {
        step > self.start && step < self.stop && step.is_multiple_of(self.every)
    }
}

/// Rows of a view with their gradients, before the update.
#[derive(Debug)]
pub struct ViewGradients<'a> {
    /// Values of the rows at the step.
    pub columns: &'a Columns,
    /// Gradients of the rows; one entry per row of `columns`.
    pub gradients: &'a mut Gradients,
    /// Rows of the whole view, of which these may be a batch.
    pub rows_of_view: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RowCount {
    /// Upper bound of the rows before the first event.
    pub rows: u64,
    /// The most rows that the run allows at this step. If the strategy has a cap of its own, the smaller of the two applies.
    pub allowed: u64,
}

impl RowCount {
    pub fn unlimited(rows: u64) -> RowCount {
        RowCount { rows, allowed: u64::MAX }
    }
}

/// A densification strategy: when rounds happen, and which statistics steps collect.
pub trait Strategy: fmt::Debug + Send + Sync {
    /// When rounds happen; `None` for a strategy without rounds.
    fn rounds(&self) -> Option<&RoundSteps>;

    /// The strategy of a run whose views come region by region, in epochs of `epoch` steps. An `epoch` of 0: any
    /// sequence of views shows all regions. `None` if the strategy needs no change.
    fn for_regions(&self, _epoch: u32) -> Option<Arc<dyn Strategy>> {
        None
    }

    /// Whether the number of Gaussians may grow.
    fn grows(&self) -> bool {
        self.rounds().is_some()
    }

    fn collects(&self, step: u32) -> bool {
        self.rounds().is_some_and(|rounds| step < rounds.stop)
    }

    /// Whether [`Strategy::events_after`] reads the histogram after this step.
    fn reads_histogram(&self, step: u32) -> bool {
        self.rounds().is_some_and(|rounds| rounds.is_round(step))
    }

    /// Whether [`Strategy::collect`] reads [`Gradients::weights`], which the renderer collects on demand only.
    fn needs_weights(&self) -> bool {
        false
    }

    /// Whether a device that updates the pages can collect the statistics: the norm of the gradient as the score and, where
    /// [`Strategy::needs_weights`] says so, the blending weight.
    fn collects_on_device(&self) -> bool {
        !self.needs_weights()
    }

    /// Adds the gradients of a step to the statistics of the rows and updates the histogram, which counts every row
    /// that has statistics. Returns the number of rows that changed.
    fn collect(&self, view: &mut RowsMut<'_>, drawn: &DrawnRows<'_>, histogram: &mut GradHistogram) -> usize {
        accumulate(view, drawn, histogram)
    }

    /// Adds gradients of the strategy's own to those of the loss. Not called where the optimizer runs on a device.
    fn add_gradients(&self, _view: &mut ViewGradients<'_>) {}

    /// Changes rows after the update of 0-based `step`, before bounds are taken: only rows of the list with the stamp `step + 1`,
    /// which are those that the update rewrote. `listed` numbers them in the table that contains `view`. Calls come in parallel. Not
    /// called where the optimizer runs on a device.
    fn after_update(&self, _view: &mut RowsMut<'_>, _listed: &[u32], _step: u32) {}

    /// The rule by which the run decides how many rows it allows; `None` where it does not.
    fn growth(&self) -> Option<&GrowthRule> {
        None
    }

    /// Whether a [`GrowthRule::check`] is due before the events of this step.
    fn is_growth_checked(&self, _step: u32) -> bool {
        false
    }

    /// Whether such a check may come at this step or a later one.
    fn may_check_growth(&self, _step: u32) -> bool {
        false
    }

    /// The events that follow this step, in order. `scene_scale` is in local units. `histogram` counts the rows by
    /// statistics; the caller clears it after a round.
    fn events_after(&self, step: u32, scene_scale: f32, count: RowCount, histogram: &GradHistogram) -> Vec<EventKind>;

    /// Whether the events that follow this step edit every page, whatever the statistics say. A device keeps no payload for steps behind
    /// it; a wrong answer costs copies and changes no result.
    fn edits_all_after(&self, _step: u32) -> bool {
        false
    }

    /// Limits for the bounds of pages: a round splits only rows within these limits, and children lie within their reach. Bounds and
    /// the cull of a device rely on it, so a limit that is too narrow loses rows from pictures without an error.
    fn split_limits(&self, scene_scale: f32) -> SplitLimits;
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoStrategy;

impl Strategy for NoStrategy {
    fn rounds(&self) -> Option<&RoundSteps> {
        None
    }

    fn events_after(&self, _: u32, _: f32, _: RowCount, _: &GradHistogram) -> Vec<EventKind> {
        Vec::new()
    }

    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits::NEVER
    }
}

/// The values of a row at the time of the event, as input of [`Round::fate`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowFacts {
    /// Sum of the growth scores since the last round; for the strategy `default`, of gradient norms, NDC units.
    pub grad2d: f32,
    /// Views that drew the row since the last round, and its weight in them ([`crate::scene::sightings`]).
    pub count: u32,
    /// Largest log-scale.
    pub log_scale: f32,
    /// Logit of the opacity.
    pub opacity: f32,
}

/// Bounds over the rows of a page, for any later step until a step touches the page.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extremes {
    /// Lower bound of the opacity logits.
    pub lowest_opacity: f32,
    /// Upper bound of the standard deviations.
    pub sigma_max: f32,
}

/// The decision of a round about a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// The row stays unchanged.
    Keep,
    /// The row is removed.
    Prune,
    Duplicate {
        /// Whether the same round prunes both copies.
        pruned: bool,
    },
    /// Two smaller children replace the row.
    Split {
        /// Whether the same round prunes both children.
        children_pruned: bool,
    },
    /// Two children replace the row, side by side along its longest axis.
    SplitLongAxis,
    /// Two rows replace the row, both at its place, which together look like it.
    SplitInPlace,
}

pub trait Round: Sync {
    fn fate(&self, row: &RowFacts) -> Fate;

    /// Whether statistics decide the fate of any of these rows. If not, every row must have the fate that it would have
    /// with statistics of 0, so that the caller may skip the statistics.
    fn may_edit(&self, rows: &Rows<'_>) -> bool;

    /// Whether all rows without statistics whose values lie within these bounds survive the round unchanged. A page that
    /// missed many rounds then computes its bounds once instead of deciding every row in every round.
    fn keeps_all(&self, extremes: &Extremes) -> bool;

    /// The first bin of scores whose rows may grow: whether a row grows must follow from the bin of its score.
    fn grows_from_bin(&self) -> u32;

    /// The most rows that the round adds, from the histogram alone, when the round is logged: pages apply the round later, and the cap
    /// must hold until they have.
    fn promised(&self, histogram: &GradHistogram) -> u64 {
        histogram.rows_from_bin(self.grows_from_bin())
    }

    /// The part of [`Round::promised`] for a page with these rows that has not applied the round yet. The sum over all pages is at most
    /// [`Round::promised`].
    fn promised_rows(&self, rows: &Rows<'_>) -> u64 {
        rows_from_bin(rows, self.grows_from_bin())
    }
}

#[derive(Clone, Copy)]
pub enum Effect<'a> {
    Round(&'a dyn Round),
    ResetOpacity {
        /// The cap, after activation.
        max_opacity: f32,
    },
    /// Rows that are stored with a lower SH degree get zeros for the missing bands.
    RaiseShDegree {
        degree: u8,
    },
}

/// The effect of an event kind on rows. The only place that names the rounds of all strategies.
pub fn effect_of(kind: &EventKind) -> Effect<'_> {
    match *kind {
        EventKind::Densify(ref thresholds) => Effect::Round(thresholds),
        EventKind::LongAxis(ref thresholds) => Effect::Round(thresholds),
        EventKind::Relocate(ref thresholds) => Effect::Round(thresholds),
        EventKind::ResetOpacity { max_opacity } => Effect::ResetOpacity { max_opacity },
        EventKind::RaiseShDegree { degree } => Effect::RaiseShDegree { degree },
    }
}
