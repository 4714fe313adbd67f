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
use super::strategy::{Effect, Extremes, Round, effect_of};
use crate::base::ids::PageId;
use crate::optim::bounds::SplitLimits;
use crate::optim::deferred::{AdamNow, DeferredAdam};
use crate::scene::columns::Column;
use crate::scene::events::{Event, EventLog};
use crate::scene::page_layout::read_page;
use crate::scene::page_split::{SplitTooDeep, split_page};
use crate::scene::rows::{Rows, RowsMut, RowsNow};
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

/// Applies event number `index` of the log to all rows of a table, the whole scene or one page of it, when it happens and
/// without shortcuts: what [`PendingEvents`] must amount to.
pub fn apply_event(
    state: &mut SceneState,
    adam: &DeferredAdam,
    seed: u64,
    index: usize,
    event: &Event,
) -> EventOutcome {
    let mut outcome = EventOutcome::default();
    match effect_of(&event.kind) {
        Effect::Round(round) => {
            outcome.round = ops::apply_round(&adam.at(event.now()), state, round, seed, index as u64);
        }
        Effect::ResetOpacity { max_opacity } => {
            outcome.reset_rows = ops::reset_opacities(&adam.at(event.now()), state, max_opacity);
        }
        Effect::RaiseShDegree { degree } => state.raise_sh_degree(degree),
    }
    outcome
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
        let mut edited = EditedRows { page: rows, table: None };
        self.replay(applied, &mut edited, &mut replay);
        if let Some(state) = edited.table {
            replay.edit = PageEdit::Replaced(self.split(id, state)?);
        }
        Ok(replay)
    }

    /// Applies the events from number `applied` on to a table that nobody splits or stores: rows as evaluation and
    /// export see them.
    pub fn apply_to_table(&self, applied: usize, state: &mut SceneState) {
        let mut no_page = SceneState::default();
        let mut edited = EditedRows { page: &mut no_page.view_mut(), table: Some(std::mem::take(state)) };
        self.replay(applied, &mut edited, &mut Replay::default());
        *state = edited.table.unwrap_or_default();
    }

    /// Applies the events from number `from` on.
    fn replay(&self, from: usize, rows: &mut EditedRows<'_, '_>, replay: &mut Replay) {
        // Of rows that were not rewritten since.
        let mut extremes = None;
        for index in from..self.events.len() {
            match effect_of(&self.events[index].kind) {
                Effect::RaiseShDegree { degree } => rows.raise_sh_degree(degree),
                Effect::ResetOpacity { max_opacity } => {
                    let reset_rows = rows.reset_opacities(self.at(index), max_opacity);
                    replay.reset_rows += reset_rows;
                    replay.touch(reset_rows > 0);
                    extremes = None;
                }
                Effect::Round(round) => {
                    let (done, edits) = self.plan(index, round, &rows.view(), &mut extremes);
                    replay.rounds.push(done);
                    if let Some(edits) = edits {
                        ops::apply_edits(rows.table(), &[(0, edits)]);
                        extremes = None;
                    } else {
                        replay.touch(rows.clear_statistics());
                    }
                }
            }
        }
    }

    /// What a round does to rows; no edits when that is nothing, statistics aside.
    fn plan(
        &self,
        index: usize,
        round: &dyn Round,
        rows: &Rows<'_>,
        extremes: &mut Option<Extremes>,
    ) -> (PageRound, Option<RoundEdits>) {
        let promised = round.promised_rows(rows);
        let mut done = PageRound { event: index, rows_change: 0, promised, counts: RoundCounts::default() };
        let nothing_grows = promised == 0 && !round.may_grow(rows);
        if nothing_grows && round.spares(extremes.get_or_insert_with(|| self.extremes(rows))) {
            return (done, None);
        }
        let edits = ops::plan_round(self.at(index), rows, round, self.seed, index as u64);
        done.rows_change = edits.added.rows() as i64 - edits.removed.len() as i64;
        done.counts = edits.counts;
        let is_nothing = edits.removed.is_empty() && edits.added.rows() == 0;
        (done, (!is_nothing).then_some(edits))
    }

    fn extremes(&self, rows: &Rows<'_>) -> Extremes {
        Extremes {
            lowest_opacity: self.adam.lowest_opacity(rows),
            sigma_max: self.adam.page_bounds(rows, &SplitLimits::NEVER).sigma_max,
        }
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

/// Rows that events are applied to.
struct EditedRows<'a, 'r> {
    /// The rows of a page, edited where they are while there is no table.
    page: &'a mut RowsMut<'r>,
    /// The rows from when their number or their width changes.
    table: Option<SceneState>,
}

impl EditedRows<'_, '_> {
    fn view(&self) -> Rows<'_> {
        self.table.as_ref().map_or_else(|| self.page.as_ref(), SceneState::view)
    }

    /// The rows as a table.
    fn table(&mut self) -> &mut SceneState {
        self.table.get_or_insert_with(|| read_page(&self.page.as_ref()))
    }

    fn raise_sh_degree(&mut self, degree: u8) {
        if degree > self.view().columns.sh_degree {
            self.table().raise_sh_degree(degree);
        }
    }

    /// Returns the number of rows that were rewritten.
    fn reset_opacities(&mut self, values: &AdamNow<'_>, max_opacity: f32) -> usize {
        match &mut self.table {
            Some(state) => ops::reset_opacities(values, state, max_opacity),
            None => ops::reset_opacity_rows(values, self.page, max_opacity),
        }
    }

    /// Returns whether there were any.
    fn clear_statistics(&mut self) -> bool {
        match &mut self.table {
            Some(state) => clear_statistics(&mut state.view_mut()),
            None => clear_statistics(self.page),
        }
    }
}

/// Forgets the statistics of rows; returns whether there were any.
fn clear_statistics(rows: &mut RowsMut<'_>) -> bool {
    let had = rows.count.iter().any(|&n| n != 0) || rows.grad2d.iter().any(|&g| g.to_bits() != 0);
    rows.grad2d.fill(0.0);
    rows.count.fill(0);
    had
}
