//! Which view a step trains on, and which training views are held out while the run decides its count.
//!
//! As long as the scene may grow, some evenly spread training views are not trained on; in the turn of such a view, the run
//! trains the view after it. Afterwards they are training views like all others. Evaluation views have no part in this. With too few
//! training views to hold some out, the gain from more Gaussians is unknown, and the run keeps the number that it starts with.
//!
//! Not here: the checks that they serve (`growth_checks`).
//!
//! Invariant: the view is a function of the step, the order and what is known of photos; a plan of coming views changes no bit of
//! the result.

use crate::dataset::loader::Dataset;
use crate::densify::growth::counted_pixels;
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

    /// [`counted_pixels`] of the training photos.
    pub fn pixels(&self, dataset: &Dataset) -> u64 {
        self.views.iter().map(|&view| counted_pixels(dataset.views[view].camera.pixels() as u64)).sum()
    }

    /// The training views that are held out while the run decides its count, as indices in `dataset.views`.
    pub fn held_out_views(&self) -> impl Iterator<Item = usize> {
        self.held_out.positions.iter().map(|&position| self.views[position])
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

    /// The view that trains in the turn of `position`. Held-out and left-out views give their turns to later views,
    /// left-out views in each epoch to another.
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

/// One in this many training views is held out, if that makes at least [`VIEWS_LEAST`] and at most [`VIEWS_MOST`].
const ONE_OF: usize = 16;
const VIEWS_LEAST: usize = 3;
const VIEWS_MOST: usize = 16;
/// Fewest training views with which a run decides its count: a quarter of them is held out. With fewer, it keeps its count.
const TRAIN_VIEWS_LEAST: usize = 4 * VIEWS_LEAST;

/// The held-out training views, as positions in the list of training views.
#[derive(Debug, Clone, Default)]
pub(crate) struct HeldOut {
    /// Ascending.
    pub positions: Vec<usize>,
    /// Training views.
    views: usize,
    /// While it may check growth, the positions are held out.
    strategy: Option<Arc<dyn Strategy>>,
}

/// Every how many training views one is held out.
fn stride(views: usize) -> usize {
    ONE_OF.min(views / VIEWS_LEAST).max(views.div_ceil(VIEWS_MOST)).max(1)
}

impl HeldOut {
    /// The views that a run with this strategy holds out of `views` training views; none if it does not decide its count.
    pub fn new(strategy: &Arc<dyn Strategy>, views: usize) -> HeldOut {
        let strategy = Some(strategy.clone()).filter(|strategy| strategy.growth().is_some());
        let is_wanted = strategy.is_some() && views >= TRAIN_VIEWS_LEAST;
        let stride = stride(views);
        HeldOut { positions: (stride / 2..views).step_by(stride).filter(|_| is_wanted).collect(), views, strategy }
    }

    /// The position that a step trains on whose turn is at `position`.
    pub fn trained_at(&self, step: u32, position: usize) -> usize {
        let is_open = self.strategy.as_ref().is_some_and(|strategy| strategy.may_check_growth(step));
        let is_held = is_open && self.positions.binary_search(&position).is_ok();
        if is_held { (position + 1) % self.views } else { position }
    }
}

/// Whether a run that is to decide its count has too few training views for it, and so keeps the count that it starts with.
pub(crate) fn keeps_first_count(strategy: &Arc<dyn Strategy>, views: usize) -> bool {
    strategy.growth().is_some() && views < TRAIN_VIEWS_LEAST
}

/// What a run with so few training views says about it.
pub(crate) fn too_few_to_decide(views: usize) -> String {
    format!(
        "the run keeps the number of Gaussians with which it starts: {views} training photos are too few to hold some out and to decide \
         the number by them ({TRAIN_VIEWS_LEAST} are enough); --max-gaussians sets another number"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::file::TrainConfig;
    use crate::config::limits::RunOptions;
    use crate::densify::strategy::StrategyName;

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

    #[test]
    fn a_share_of_the_views_is_held_out_while_the_scene_may_grow() {
        let of = |max_gaussians: u64| {
            let config = TrainConfig { strategy: StrategyName::LongAxis, max_gaussians, ..TrainConfig::default() };
            RunOptions::new(&config, 1.0).strategy
        };
        let (decides, capped) = (of(0), of(1000));
        for (views, held) in [(11, 0), (12, 3), (15, 3), (150, 9), (256, 16), (10_000, 16)] {
            let held_out = HeldOut::new(&decides, views);
            assert_eq!(held_out.positions.len(), held, "{views} views");
            assert!(HeldOut::new(&capped, views).positions.is_empty());
            // Every position has its turn, held-out ones once no check can come any more.
            let trained = |step: u32| (0..views).map(|at| held_out.trained_at(step, at)).collect::<Vec<usize>>();
            assert!(trained(2200).iter().all(|at| *at < views && !held_out.positions.contains(at)));
            assert_eq!(trained(2300), (0..views).collect::<Vec<usize>>());
        }
    }
}
