//! Applying logged events to rows.
//!
//! Invariant: an event gives a table the same rows whether it is applied on time or late, to the whole or to parts.

use crate::base::ids::PageId;
use crate::densify::ops;
use crate::densify::stats::{may_exceed, mean_grad2d};
use crate::optim::bounds::SplitLimits;
use crate::optim::deferred::DeferredAdam;
use crate::scene::columns::Columns;
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::page_layout::read_page;
use crate::scene::page_meta::PageMeta;
use crate::scene::rows::Rows;
use crate::scene::state::SceneState;

/// What an event changed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EventOutcome {
    /// What a densification round did.
    pub round: ops::RoundCounts,
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
    let at = adam.at(event.now());
    match event.kind {
        EventKind::RaiseShDegree { .. } => EventOutcome::default(),
        EventKind::ResetOpacity { max_opacity } => {
            EventOutcome { reset_rows: ops::reset_opacities(&at, state, max_opacity), ..EventOutcome::default() }
        }
        EventKind::Densify(thresholds) => {
            let round = ops::apply_round(&at, state, &thresholds, seed, index as u64);
            EventOutcome { round, ..EventOutcome::default() }
        }
    }
}

/// What bringing a page to now depends on besides its rows and the log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PageRules {
    /// Seed of the run.
    pub seed: u64,
    /// Rows that a page holds at most.
    pub page_rows: usize,
    /// When rows may split before they are seen again.
    pub splits: SplitLimits,
}

/// A page that has applied all events.
#[derive(Debug, Clone)]
pub struct CaughtUp {
    /// The page, or what it split into, ascending by id.
    pub parts: Vec<(PageMeta, SceneState)>,
    /// Growth that the rounds were promised for the rows of the page.
    pub promised: u64,
}

/// Applies to a copy of a page's rows what it misses of the log.
pub fn caught_up(
    rows: &Rows<'_>,
    meta: &PageMeta,
    events: &EventLog,
    adam: &DeferredAdam,
    rules: &PageRules,
) -> CaughtUp {
    let mut state = read_page(rows);
    let mut promised = 0;
    for (index, event) in events.pending(meta.events_applied as usize) {
        if let EventKind::Densify(thresholds) = event.kind {
            let grows = |(&grad2d, &count): (&f32, &u32)| {
                count > 0 && may_exceed(mean_grad2d(grad2d, count), thresholds.grow_grad2d)
            };
            promised += state.grad2d.iter().zip(&state.count).filter(|&x| grows(x)).count() as u64;
        }
        if let EventKind::RaiseShDegree { degree } = event.kind {
            raise(&mut state, degree);
        }
        apply_event(&mut state, adam, rules.seed, index, &event);
    }
    let mut parts = Vec::new();
    split(meta.id, state, rules.page_rows, &mut parts);
    let parts = parts.into_iter().map(|(id, state)| {
        let bounds = adam.page_bounds(&state.view(), &rules.splits);
        let events_applied = events.len() as u32;
        (PageMeta { id, rows: state.rows() as u32, sh_degree: state.sh_degree(), events_applied, bounds }, state)
    });
    CaughtUp { parts: parts.collect(), promised }
}

fn raise(state: &mut SceneState, degree: u8) {
    let rows = state.rows();
    for table in [&mut state.columns, &mut state.exp_avg, &mut state.exp_avg_sq] {
        let old = std::mem::take(&mut table.sh_n);
        let (from, to) = (old.len() / rows.max(1), Columns::zeros(1, degree).sh_n.len());
        table.sh_degree = degree;
        table.sh_n = vec![0.0; to * rows];
        if from > 0 {
            table.sh_n.chunks_exact_mut(to).zip(old.chunks_exact(from)).for_each(|(n, o)| n[..from].copy_from_slice(o));
        }
    }
}

fn split(id: PageId, state: SceneState, page_rows: usize, parts: &mut Vec<(PageId, SceneState)>) {
    let rows = state.rows();
    let Some([low_id, high_id]) = id.children().filter(|_| rows > page_rows) else {
        return parts.push((id, state));
    };
    let key = |row: usize| (ordered(state.columns.means[3 * row]), row);
    let mut order: Vec<usize> = (0..rows).collect();
    order.sort_unstable_by_key(|&r| key(r));
    let mut is_low = vec![false; rows];
    order[..rows / 2].iter().for_each(|&r| is_low[r] = true);
    let (mut low, mut high) = (state.clone(), state);
    low.retain(|row| is_low[row]);
    high.retain(|row| !is_low[row]);
    split(low_id, low, page_rows, parts);
    split(high_id, high, page_rows, parts);
}

fn ordered(x: f32) -> i32 {
    let bits = x.to_bits() as i32;
    bits ^ (((bits >> 31) as u32) >> 1) as i32
}
