//! One event, applied on time to all rows of a table and without shortcuts: the reference for late replays of pages.

use gsscale::densify::ops::{apply_edits, plan_round, reset_opacity_rows};
use gsscale::densify::strategy::{Effect, effect_of};
use gsscale::optim::deferred::DeferredAdam;
use gsscale::scene::events::Event;
use gsscale::scene::state::SceneState;

/// Applies event number `index` of a log. Returns the number of rows that a reset rewrote.
pub fn apply_event(state: &mut SceneState, adam: &DeferredAdam, seed: u64, index: usize, event: &Event) -> usize {
    let now = adam.at(event.now());
    match effect_of(&event.kind) {
        Effect::Round(round) => {
            let edits = plan_round(&now, &state.view(), round, seed, index as u64);
            apply_edits(state, &edits);
        }
        Effect::ResetOpacity { max_opacity } => {
            return reset_opacity_rows(&now, &mut state.view_mut(), max_opacity);
        }
        Effect::RaiseShDegree { degree } => state.raise_sh_degree(degree),
    }
    0
}
