//! The coming views of a run, and the pages that they need: the plan by which pages move between the tiers.
//!
//! Invariant: the plan changes no bit of the result. It says what to bring and what to evict, never what a step works on.

use super::trainer::Trainer;
use crate::dataset::loader::Dataset;
use crate::scene::camera::Camera;

/// Steps between two updates of the pager's plan, and the least and most views that a plan covers.
const LOOK_AHEAD_EVERY: u32 = 8;
const LOOK_AHEAD_LEAST: u32 = 64;
const LOOK_AHEAD_MOST: u32 = 8192;

/// The turns of a view that is left out go to this many views after it.
const SUBSTITUTES: usize = 8;

/// Memory for the plan of a run in memory whose device holds a part of the pages, bytes.
const DEVICE_PLAN_BYTES: usize = 4 << 20;

impl Trainer {
    /// Updates the pager's plan every [`LOOK_AHEAD_EVERY`] steps; doing it at every step would cost too much.
    pub(super) fn look_ahead(&mut self, dataset: &Dataset) {
        let pages = self.scene.pager.index().len();
        let is_on_device_in_part = self.device.as_ref().is_some_and(|tier| tier.slots() < pages);
        let has_plan = !self.is_in_memory() || is_on_device_in_part;
        self.expect_edits();
        // The step in flight has begun already.
        let first = usize::from(self.is_ahead());
        // Views are judged between epochs.
        let is_due = self.state.step.is_multiple_of(LOOK_AHEAD_EVERY)
            || self.state.step.is_multiple_of(self.train_views.len() as u32);
        if !has_plan || !is_due {
            return;
        }
        if self.is_in_memory() {
            self.scene.pager.plan_for_tier_above(DEVICE_PLAN_BYTES);
        }
        // Two epochs contain a use of every page that any view needs.
        let count = (2 * self.train_views.len() as u32).clamp(LOOK_AHEAD_LEAST, LOOK_AHEAD_MOST);
        let cameras: Vec<Camera> =
            self.coming_views(count).iter().skip(first).map(|&view| self.camera(dataset, view)).collect();
        let cameras: Vec<&Camera> = cameras.iter().collect();
        self.scene.pager.look_ahead(self.state.step + first as u32, &cameras);
    }

    /// Tells the device which coming step is the next after which events edit every page: an opacity reset, or a raise of the SH degree.
    fn expect_edits(&mut self) {
        let options = &self.options;
        let raises = |step: u32| options.sh_degree_at(step + 1) > options.sh_degree_at(step);
        if let Some(tier) = &mut self.device {
            let edits_all = |step| options.strategy.edits_all_after(step) || raises(step);
            tier.expect_edits(self.state.step, options.steps, edits_all);
        }
    }

    /// Indices in `dataset.views` of the views of the coming steps, at most `count`.
    pub(super) fn coming_views(&self, count: u32) -> Vec<usize> {
        let (step, mut coming) = (self.state.step, Vec::new());
        self.order.upcoming(step, count.min(self.options.steps - step), &mut coming);
        (step..).zip(&coming).map(|(at, &position)| self.view_in_turn(at, position)).collect()
    }

    /// Index in `dataset.views` of the view of a step whose turn is at `position` of the training views. A view that is held out or left out
    /// gives its turn to one of the next ones, in each epoch another.
    pub(super) fn view_in_turn(&self, step: u32, position: usize) -> usize {
        let views = self.train_views.len();
        let at = |position: usize| self.train_views[self.held_out.trained_at(step, position)];
        let gives_away = |position: usize| self.photos.iter().any(|photo| photo.is_replaced_at(at(position), step));
        at(substitute((position, views), step as usize / views, gives_away))
    }
}

/// The position of 0..views that trains in the turn of `position` in an epoch: `position`, unless it gives its turn away. Where all positions give
/// their turns away, each keeps its own.
fn substitute((position, views): (usize, usize), epoch: usize, gives_away: impl Fn(usize) -> bool) -> usize {
    if !gives_away(position) {
        return position;
    }
    let first = position + 1 + epoch % SUBSTITUTES;
    (first..first + views).map(|at| at % views).find(|&at| !gives_away(at)).unwrap_or(position)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_that_is_given_away_goes_to_the_next_ones_in_turn() {
        let of = |position: usize, epoch: usize| substitute((position, 12), epoch, |at| at == 3 || at == 5);
        assert!((0..20).all(|epoch| of(7, epoch) == 7));
        let taken: Vec<usize> = (0..9).map(|epoch| of(3, epoch)).collect();
        assert_eq!(taken, [4, 6, 6, 7, 8, 9, 10, 11, 4]);
        assert_eq!(of(5, 7), 1, "beyond the last");
        assert_eq!(substitute((3, 12), 2, |_| true), 3);
        assert_eq!(substitute((0, 1), 2, |_| true), 0);
    }
}
