//! Which view a step trains on.
//!
//! Invariant: the view is a function of the step, the order and what is known of photos; a plan of coming views changes no bit of
//! the result.

use super::held_out::HeldOut;
use crate::densify::strategy::Strategy;
use crate::photos::PhotoParameters;
use crate::schedule::order::ViewOrder;
use std::sync::Arc;

/// The turns of a view that is left out go to this many views after it.
const SUBSTITUTES: usize = 8;

/// The turns of the training views.
pub(crate) struct Turns {
    pub order: ViewOrder,
    /// Training views, as indices in `dataset.views`; turns are positions in this list.
    pub views: Vec<usize>,
    /// Training views that the run decides its count by.
    pub held_out: HeldOut,
    /// Steps of the run.
    steps: u32,
}

impl Turns {
    /// The turns of a run of so many steps with this strategy.
    pub fn new(order: ViewOrder, views: Vec<usize>, strategy: &Arc<dyn Strategy>, steps: u32) -> Turns {
        Turns { order, held_out: HeldOut::new(strategy, views.len()), views, steps }
    }

    /// Index in `dataset.views` of the view of a 0-based step.
    pub fn view_at(&mut self, step: u32, photos: &PhotoParameters) -> usize {
        let position = self.order.view_at(step);
        self.view_in_turn(step, position, photos)
    }

    /// Indices in `dataset.views` of the views of at most `count` steps from `step` on.
    pub fn coming(&self, step: u32, count: u32, photos: &PhotoParameters) -> Vec<usize> {
        let mut coming = Vec::new();
        self.order.upcoming(step, count.min(self.steps - step), &mut coming);
        (step..).zip(&coming).map(|(at, &position)| self.view_in_turn(at, position, photos)).collect()
    }

    /// A view that is held out or left out gives its turn to one of the next ones, in each epoch another.
    fn view_in_turn(&self, step: u32, position: usize, photos: &PhotoParameters) -> usize {
        let views = self.views.len();
        let at = |position: usize| self.views[self.held_out.trained_at(step, position)];
        let gives_away = |position: usize| photos.iter().any(|photo| photo.is_replaced_at(at(position), step));
        at(substitute(position, views, step as usize / views, gives_away))
    }
}

/// The position of 0..views that trains in the turn of `position` in an epoch: `position`, unless it gives its turn away. Where all positions give
/// their turns away, each keeps its own.
fn substitute(position: usize, views: usize, epoch: usize, gives_away: impl Fn(usize) -> bool) -> usize {
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
        let of = |position: usize, epoch: usize| substitute(position, 12, epoch, |at| at == 3 || at == 5);
        assert!((0..20).all(|epoch| of(7, epoch) == 7));
        let taken: Vec<usize> = (0..9).map(|epoch| of(3, epoch)).collect();
        assert_eq!(taken, [4, 6, 6, 7, 8, 9, 10, 11, 4]);
        assert_eq!(of(5, 7), 1, "beyond the last");
        assert_eq!(substitute(3, 12, 2, |_| true), 3);
        assert_eq!(substitute(0, 1, 2, |_| true), 0);
    }
}
