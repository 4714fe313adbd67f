//! Applies the pending events of a page to its rows.
//!
//! Not here: when pages are pinned, and where the parts of a split page are stored.
//!
//! Each event acts on the values of its own step, so a late replay gives the same result as on time, as a set of (uid,
//! bits). A page is copied only if the number of its rows or their width changes; other edits are in place.
//!
//! Invariants: 1. the outcome is a function of the page's rows, the log, the seed and the page capacity; 2. a page that
//! outgrew its capacity is split once, after the last event, by the positions of its rows at that event. A row grows in
//! at most one of the rounds that a page missed, so a page has at most doubled by then.

use super::ops::{self, RoundEdits};
use super::strategy::{Effect, Extremes, Round, effect_of};
use crate::base::ids::PageId;
use crate::optim::bounds::{SplitLimits, lowest_opacity, page_bounds};
use crate::optim::deferred::{AdamNow, DeferredAdam};
use crate::scene::columns::Column;
use crate::scene::events::{Event, EventLog};
use crate::scene::page_layout::read_page;
use crate::scene::page_split::{SplitTooDeep, split_page};
use crate::scene::rows::{Rows, RowsMut, RowsNow};
use crate::scene::sightings::{VIEWS_MOST, of_mean_weight};
use crate::scene::state::SceneState;
use std::sync::OnceLock;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageRound {
    /// Rows after the round minus rows before.
    pub rows_change: i64,
    /// Growth of this page that [`Round::promised`] counted when the round was logged.
    pub promised: u64,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub enum PageEdit {
    /// No byte changed; the page stays clean.
    #[default]
    Unchanged,
    /// Statistics were cleared in place, and nothing else changed.
    Cleared,
    InPlace,
    /// These pages replace the page, ordered by name: the page itself, possibly without rows, or its parts. The rows in
    /// the frame are obsolete.
    Replaced(Vec<(PageId, SceneState)>),
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct PageReplay {
    pub edit: PageEdit,
    /// The rounds among the events, in order.
    pub rounds: Vec<PageRound>,
}

/// Bounds on the rows of a page whose payload lies on a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageFacts {
    /// At least the mean growth score of every row.
    pub largest_mean: f32,
    /// At most the mean blending weight of every row that rounds judge by it; infinite without such rows.
    pub least_weight: f32,
    /// Bounds of the rows, for any later step until a step touches the page.
    pub extremes: Extremes,
    /// SH degree with which the page is stored.
    pub sh_degree: u8,
}

/// The event log of a run with the inputs of a replay. Cheap to create for every step; the pages of a step share one.
pub struct PendingEvents<'a> {
    adam: &'a DeferredAdam,
    seed: u64,
    page_rows: usize,
    events: &'a [Event],
    /// The optimizer at the step of each event, created on first use.
    at: Vec<OnceLock<Box<AdamNow<'a>>>>,
}

impl<'a> PendingEvents<'a> {
    /// The events so far, for pages with a capacity of `page_rows` rows.
    pub fn new(adam: &'a DeferredAdam, seed: u64, page_rows: usize, log: &'a EventLog) -> Self {
        let events = log.events();
        PendingEvents { adam, seed, page_rows, events, at: events.iter().map(|_| OnceLock::new()).collect() }
    }

    fn at(&self, index: usize) -> &AdamNow<'a> {
        self.at[index].get_or_init(|| Box::new(self.adam.at(self.events[index].now())))
    }

    /// Applies the pending events of page `id` to its rows, which have applied the first `applied` events.
    /// Errors: the page outgrew its capacity and cannot be split.
    pub fn apply(&self, id: PageId, applied: usize, rows: &mut RowsMut<'_>) -> Result<PageReplay, SplitTooDeep> {
        let mut replay = PageReplay::default();
        let mut edited = EditedRows { page: rows, table: None };
        self.replay(id, applied, &mut edited, &mut replay);
        if let Some(state) = edited.table {
            replay.edit = PageEdit::Replaced(self.split(id, state)?);
        }
        Ok(replay)
    }

    /// Whether the events from number `applied` on certainly do nothing to a page but clear its statistics, judged by
    /// `page`. If so, at least one of them is a round, and none changes a count of rows.
    pub fn only_clears(&self, applied: usize, page: &PageFacts) -> bool {
        let (mut largest_mean, mut least_weight, mut rounds) = (page.largest_mean, page.least_weight, 0);
        let keeps = self.events[applied..].iter().all(|event| match effect_of(&event.kind) {
            Effect::RaiseShDegree { degree } => degree <= page.sh_degree,
            Effect::ResetOpacity { .. } => false,
            Effect::Round(round) => {
                rounds += 1;
                // Three rows stand for the page, since rounds judge rows one by one: the largest score, the most views,
                // the least weight. Later rounds see cleared statistics.
                let weight = std::mem::replace(&mut least_weight, f32::INFINITY);
                let weighed = if weight.is_finite() { of_mean_weight(weight) } else { 1 };
                let (grad2d, count) = ([std::mem::take(&mut largest_mean), 0.0, 0.0], [1, VIEWS_MOST, weighed]);
                let rows = Rows { grad2d: &grad2d, count: &count, ..Rows::default() };
                round.promised_rows(&rows) == 0 && !round.may_edit(&rows) && round.keeps_all(&page.extremes)
            }
        });
        keeps && rounds > 0
    }

    /// Applies the events from number `applied` on to the table of page `id`, which is neither split nor stored, for evaluation and
    /// export.
    pub fn apply_to_table(&self, id: PageId, applied: usize, state: &mut SceneState) {
        let mut no_page = SceneState::default();
        let mut edited = EditedRows { page: &mut no_page.view_mut(), table: Some(std::mem::take(state)) };
        self.replay(id, applied, &mut edited, &mut PageReplay::default());
        *state = edited.table.unwrap_or_default();
    }

    /// Applies the events from number `from` on. Frozen pages only get the bands that the renderer asks for.
    fn replay(&self, id: PageId, from: usize, rows: &mut EditedRows<'_, '_>, replay: &mut PageReplay) {
        // Valid until rows are rewritten.
        let mut extremes = None;
        for index in from..self.events.len() {
            match effect_of(&self.events[index].kind) {
                Effect::RaiseShDegree { degree } if degree > rows.view().columns.sh_degree => {
                    rows.table().raise_sh_degree(degree);
                }
                Effect::RaiseShDegree { .. } => {}
                _ if id.is_frozen() => {}
                Effect::ResetOpacity { max_opacity } => {
                    let at = self.at(index);
                    if rows.in_place(|rows| ops::reset_opacity_rows(at, rows, max_opacity)) > 0 {
                        replay.edit = PageEdit::InPlace;
                    }
                    extremes = None;
                }
                Effect::Round(round) => {
                    let (done, edits) = self.plan(index, round, &rows.view(), &mut extremes);
                    replay.rounds.push(done);
                    if let Some(edits) = edits {
                        ops::apply_edits(rows.table(), &edits);
                        extremes = None;
                    } else if rows.in_place(clear_statistics) && replay.edit == PageEdit::Unchanged {
                        replay.edit = PageEdit::Cleared;
                    }
                }
            }
        }
    }

    /// The effect of a round on rows; no edits if the round changes statistics only.
    fn plan(
        &self,
        index: usize,
        round: &dyn Round,
        rows: &Rows<'_>,
        extremes: &mut Option<Extremes>,
    ) -> (PageRound, Option<RoundEdits>) {
        let promised = round.promised_rows(rows);
        let mut done = PageRound { rows_change: 0, promised };
        let by_bounds = promised == 0 && !round.may_edit(rows);
        if by_bounds && round.keeps_all(extremes.get_or_insert_with(|| self.extremes(rows))) {
            return (done, None);
        }
        let edits = ops::plan_round(self.at(index), rows, round, self.seed, index as u64);
        done.rows_change = edits.added.rows() as i64 - edits.removed.len() as i64;
        let is_nothing = edits.removed.is_empty() && edits.added.rows() == 0;
        (done, (!is_nothing).then_some(edits))
    }

    fn extremes(&self, rows: &Rows<'_>) -> Extremes {
        Extremes {
            lowest_opacity: lowest_opacity(self.adam, rows),
            sigma_max: page_bounds(self.adam, rows, &SplitLimits::NEVER).sigma_max,
        }
    }

    /// Splits the table into pages within the capacity, by the positions after the last event.
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

struct EditedRows<'a, 'r> {
    /// The rows of a page, edited in place until `table` exists.
    page: &'a mut RowsMut<'r>,
    /// A copy of the rows, from the first event that changes their number or width.
    table: Option<SceneState>,
}

impl EditedRows<'_, '_> {
    fn view(&self) -> Rows<'_> {
        self.table.as_ref().map_or_else(|| self.page.as_ref(), SceneState::view)
    }

    /// The rows as a table, copied on first use.
    fn table(&mut self) -> &mut SceneState {
        self.table.get_or_insert_with(|| read_page(&self.page.as_ref()))
    }

    fn in_place<T>(&mut self, edit: impl FnOnce(&mut RowsMut<'_>) -> T) -> T {
        match &mut self.table {
            Some(state) => edit(&mut state.view_mut()),
            None => edit(self.page),
        }
    }
}

/// Clears the statistics of rows; returns whether a row had statistics.
fn clear_statistics(rows: &mut RowsMut<'_>) -> bool {
    let had_statistics = rows.count.iter().any(|&n| n != 0) || rows.grad2d.iter().any(|&g| g.to_bits() != 0);
    rows.clear_statistics();
    had_statistics
}
