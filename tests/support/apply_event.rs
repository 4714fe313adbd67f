//! One event, applied on time to all rows of a table and without shortcuts: the reference for late replays of pages.

use gsscale::densify::ops::{RoundCounts, apply_edits, plan_round, reset_opacity_rows};
use gsscale::densify::strategy::{Effect, effect_of};
use gsscale::optim::deferred::DeferredAdam;
use gsscale::scene::events::Event;
use gsscale::scene::state::SceneState;

/// Applies event number `index` of a log. Returns what a round did, and the number of rows that a reset rewrote.
pub fn apply_event(
    state: &mut SceneState,
    adam: &DeferredAdam,
    seed: u64,
    index: usize,
    event: &Event,
) -> (RoundCounts, usize) {
    let now = adam.at(event.now());
    match effect_of(&event.kind) {
        Effect::Round(round) => {
            let edits = plan_round(&now, &state.view(), round, seed, index as u64);
            apply_edits(state, &edits);
            return (edits.counts, 0);
        }
        Effect::ResetOpacity { max_opacity } => {
            return (RoundCounts::default(), reset_opacity_rows(&now, &mut state.view_mut(), max_opacity));
        }
        Effect::RaiseShDegree { degree } => state.raise_sh_degree(degree),
    }
    (RoundCounts::default(), 0)
}
