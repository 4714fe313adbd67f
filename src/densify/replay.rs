//! Events on rows: one at a time on a table, or all that a page missed since it was last touched.
//!
//! Each event acts on the rows' values of its own step, so replaying late gives what applying on time would have
//! given, as a set of (uid, bits). A page is copied only when its rows change in number or in width; everything else is
//! edited in place. When pages are acquired, and where their parts are stored, is not decided here.
//!
//! Invariants: 1. the outcome is a function of the page's rows, the log, the seed and the page capacity; 2. a page that
//! outgrew its capacity is cut once, after the last event, by its rows' positions at that event's time: rows grow in
//! at most one of the rounds that a page missed, so it has at most doubled by then.

use super::ops::{self, RoundCounts, RoundEdits};
use super::stats::promised_growth;
use crate::base::ids::PageId;
use crate::base::math::sigmoid;
use crate::optim::bounds::SplitLimits;
use crate::optim::deferred::{AdamNow, DeferredAdam};
use crate::scene::columns::Column;
use crate::scene::events::{Event, EventKind, EventLog, RoundThresholds};
use crate::scene::page_layout::read_page;
use crate::scene::page_split::{SplitTooDeep, split_page};
use crate::scene::rows::{Rows, RowsMut, RowsNow, mean_grad2d};
use crate::scene::state::SceneState;
use std::sync::OnceLock;

/// What an event changed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EventOutcome {
    /// What a densification round did.
    pub round: RoundCounts,
    /// Rows that an opacity reset rewrote.
    pub reset_rows: usize,
}

/// Applies event number `index` of the log to all rows of a table: the whole scene or one page of it.
pub fn apply_event(
    state: &mut SceneState,
    adam: &DeferredAdam,
    seed: u64,
    index: usize,
    event: &Event,
) -> EventOutcome {
    match event.kind {
        EventKind::RaiseShDegree { degree } => {
            state.raise_sh_degree(degree);
            EventOutcome::default()
        }
        EventKind::ResetOpacity { max_opacity } => {
            let at = adam.at(event.now());
            EventOutcome { reset_rows: ops::reset_opacities(&at, state, max_opacity), ..EventOutcome::default() }
        }
        EventKind::Densify(thresholds) => {
            let round = ops::apply_round(&adam.at(event.now()), state, &thresholds, seed, index as u64);
            EventOutcome { round, ..EventOutcome::default() }
        }
    }
}

/// What one round did to a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageRound {
    /// Index of the event.
    pub event: usize,
    /// Rows after it, less rows before.
    pub rows_change: i64,
    /// Rows that the round's threshold had promised to this page ([`super::stats::GradHistogram::promised`]).
    pub promised: u64,
    /// What it did.
    pub counts: RoundCounts,
}

/// What became of a page.
#[derive(Debug, Clone, PartialEq)]
pub enum PageEdit {
    /// No byte changed: the page stays clean.
    Unchanged,
    /// The rows given were edited where they are.
    InPlace,
    /// The page is to be rewritten as these, ordered by name: the page itself, possibly without rows, or its parts. The
    /// rows given are not to be used any more.
    Replaced(Vec<(PageId, SceneState)>),
}

/// Outcome of a replay.
#[derive(Debug, Clone, PartialEq)]
pub struct Replay {
    /// What became of the page.
    pub edit: PageEdit,
    /// The rounds among the events, in order.
    pub rounds: Vec<PageRound>,
    /// Rows that opacity resets rewrote.
    pub reset_rows: usize,
}

/// The log of a run with what replaying it needs. Cheap to make for every step; shared by the pages of one.
pub struct PendingEvents<'a> {
    adam: &'a DeferredAdam,
    seed: u64,
    page_rows: usize,
    events: &'a [Event],
    /// The optimizer at the time of each event, once somebody asked for it.
    at: Vec<OnceLock<Box<AdamNow<'a>>>>,
}

impl<'a> PendingEvents<'a> {
    /// The events so far, for pages of a capacity.
    pub fn new(adam: &'a DeferredAdam, seed: u64, page_rows: usize, log: &'a EventLog) -> Self {
        let events = log.events();
        PendingEvents { adam, seed, page_rows, events, at: events.iter().map(|_| OnceLock::new()).collect() }
    }

    /// Number of events: what a page has applied after a replay.
    pub fn len(&self) -> usize {
        self.events.len()
    }

    /// Whether nothing has happened yet.
    pub fn is_empty(&self) -> bool {
        self.events.is_empty()
    }

    fn at(&self, index: usize) -> &AdamNow<'a> {
        self.at[index].get_or_init(|| Box::new(self.adam.at(self.events[index].now())))
    }

    /// Applies what page `id` missed to its rows, `applied` being the number of events that they contain.
    ///
    /// # Errors
    /// The page must be split and cannot be.
    pub fn apply(&self, id: PageId, applied: usize, rows: &mut RowsMut<'_>) -> Result<Replay, SplitTooDeep> {
        let mut replay = Replay::default();
        let mut quiet = None;
        for index in applied..self.events.len() {
            let edits = match self.events[index].kind {
                EventKind::RaiseShDegree { degree } if degree <= rows.columns.sh_degree => continue,
                EventKind::RaiseShDegree { .. } => None,
                EventKind::ResetOpacity { max_opacity } => {
                    let reset_rows = ops::reset_opacity_rows(self.at(index), rows, max_opacity);
                    (replay.reset_rows, quiet) = (replay.reset_rows + reset_rows, None);
                    replay.touch(reset_rows > 0);
                    continue;
                }
                EventKind::Densify(thresholds) => {
                    let (round, edits) = self.plan(index, &thresholds, &rows.as_ref(), &mut quiet);
                    replay.rounds.push(round);
                    if edits.is_none() {
                        replay.touch(clear_statistics(rows));
                        continue;
                    }
                    edits
                }
            };
            // From here on the rows are a table of their own.
            let mut state = read_page(&rows.as_ref());
            let rest = index + usize::from(edits.is_some());
            if let Some(edits) = edits {
                ops::apply_edits(&mut state, &[(0, edits)]);
            }
            self.replay_table(rest, &mut state, &mut replay);
            replay.edit = PageEdit::Replaced(self.split(id, state)?);
            break;
        }
        Ok(replay)
    }

    /// Applies the events from number `applied` on to a table that nobody splits or stores: rows as evaluation and
    /// export see them.
    pub fn apply_to_table(&self, applied: usize, state: &mut SceneState) {
        self.replay_table(applied, state, &mut Replay::default());
    }

    fn replay_table(&self, from: usize, state: &mut SceneState, replay: &mut Replay) {
        let mut quiet = None;
        for index in from..self.events.len() {
            match self.events[index].kind {
                EventKind::RaiseShDegree { degree } => state.raise_sh_degree(degree),
                EventKind::ResetOpacity { max_opacity } => {
                    replay.reset_rows += ops::reset_opacities(self.at(index), state, max_opacity);
                    quiet = None;
                }
                EventKind::Densify(thresholds) => {
                    let (round, edits) = self.plan(index, &thresholds, &state.view(), &mut quiet);
                    replay.rounds.push(round);
                    if let Some(edits) = edits {
                        ops::apply_edits(state, &[(0, edits)]);
                        quiet = None;
                    } else {
                        clear_statistics(&mut state.view_mut());
                    }
                }
            }
        }
    }

    /// What a round does to rows; no edits when that is nothing, statistics aside.
    fn plan(
        &self,
        index: usize,
        thresholds: &RoundThresholds,
        rows: &Rows<'_>,
        quiet: &mut Option<Extremes>,
    ) -> (PageRound, Option<RoundEdits>) {
        let promised = promised_growth(rows, thresholds.grow_grad2d);
        let mut round = PageRound { event: index, rows_change: 0, promised, counts: RoundCounts::default() };
        let nothing_grows = promised == 0 && !may_grow(rows, thresholds);
        if nothing_grows && quiet.get_or_insert_with(|| Extremes::of(self.adam, rows)).survive(thresholds) {
            return (round, None);
        }
        let edits = ops::plan_round(self.at(index), rows, thresholds, self.seed, index as u64);
        round.rows_change = edits.added.rows() as i64 - edits.removed.len() as i64;
        round.counts = edits.counts;
        let is_nothing = edits.removed.is_empty() && edits.added.rows() == 0;
        (round, (!is_nothing).then_some(edits))
    }

    /// The table as pages within the capacity, cut by the positions after the last event.
    fn split(&self, id: PageId, state: SceneState) -> Result<Vec<(PageId, SceneState)>, SplitTooDeep> {
        if state.rows() <= self.page_rows {
            return Ok(vec![(id, state)]);
        }
        let at = self.at(self.events.len() - 1);
        let rows = state.view();
        let mean = |i: usize| at.evaluate_element(&rows, Column::Means, i / 3, i % 3);
        let means: Vec<f32> = (0..rows.rows() * 3).map(mean).collect();
        split_page(id, state, &means, self.page_rows)
    }
}

impl Replay {
    fn touch(&mut self, is_changed: bool) {
        if is_changed {
            self.edit = PageEdit::InPlace;
        }
    }
}

impl Default for Replay {
    fn default() -> Self {
        Replay { edit: PageEdit::Unchanged, rounds: Vec::new(), reset_rows: 0 }
    }
}

/// Bounds of what rows that nobody touches are pruned by, at any later step. A page that sleeps through many rounds is
/// looked at once, unless some row comes close to being pruned.
struct Extremes {
    lowest_opacity: f32,
    sigma_max: f32,
}

impl Extremes {
    fn of(adam: &DeferredAdam, rows: &Rows<'_>) -> Extremes {
        let sigma_max = adam.page_bounds(rows, &SplitLimits::NEVER).sigma_max;
        Extremes { lowest_opacity: adam.lowest_opacity(rows), sigma_max }
    }

    /// Whether no row is pruned. The slack is for the roundings of the sigmoid, some 4e-7.
    fn survive(&self, thresholds: &RoundThresholds) -> bool {
        sigmoid(self.lowest_opacity) >= thresholds.prune_opacity * (1.0 + 1e-5)
            && self.sigma_max <= thresholds.prune_scale
    }
}

/// Whether the statistics of some row exceed the threshold.
fn may_grow(rows: &Rows<'_>, thresholds: &RoundThresholds) -> bool {
    let means = rows.grad2d.iter().zip(rows.count).map(|(&grad2d, &count)| mean_grad2d(grad2d, count));
    means.fold(false, |any, mean| any | (mean > thresholds.grow_grad2d))
}

/// Forgets the statistics of rows; returns whether there were any.
fn clear_statistics(rows: &mut RowsMut<'_>) -> bool {
    let had = rows.count.iter().any(|&n| n != 0) || rows.grad2d.iter().any(|&g| g.to_bits() != 0);
    rows.grad2d.fill(0.0);
    rows.count.fill(0);
    had
}
