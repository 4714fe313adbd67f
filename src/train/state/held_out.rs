//! Training views that are held out while the run decides its count.
//!
//! As long as the scene may grow, some evenly spread training views are not trained on; in the turn of such a view, the run
//! trains the view after it. Afterwards they are training views like all others. Evaluation views have no part in this.
//!
//! Not here: the checks that they serve (`growth_checks`).
//!
//! With too few training views to hold some out, the gain from more Gaussians is unknown, and the run keeps the number that
//! it starts with.
//!
//! Invariant: which view a step trains on is a function of the step and the views.

use crate::densify::strategy::Strategy;
use std::sync::Arc;

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
    positions: Vec<usize>,
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

    pub fn positions(&self) -> &[usize] {
        &self.positions
    }

    /// The position that a step trains on whose turn is at `position`.
    pub fn trained_at(&self, step: u32, position: usize) -> usize {
        let is_open = self.strategy.as_ref().is_some_and(|strategy| strategy.may_check_growth(step));
        let is_held = is_open && self.positions.binary_search(&position).is_ok();
        if is_held { (position + 1) % self.views } else { position }
    }
}

/// Whether so many training views are too few for a run to decide its count by them.
pub(crate) fn are_too_few_to_decide(views: usize) -> bool {
    views < TRAIN_VIEWS_LEAST
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
    fn a_share_of_the_views_is_held_out_while_the_scene_may_grow() {
        let of = |max_gaussians: u64| {
            let config = TrainConfig { strategy: StrategyName::LongAxis, max_gaussians, ..TrainConfig::default() };
            RunOptions::new(&config, 1.0).strategy
        };
        let (decides, capped) = (of(0), of(1000));
        for (views, held) in [(11, 0), (12, 3), (15, 3), (150, 9), (256, 16), (10_000, 16)] {
            let held_out = HeldOut::new(&decides, views);
            assert_eq!(held_out.positions().len(), held, "{views} views");
            assert!(HeldOut::new(&capped, views).positions().is_empty());
            // Every position has its turn, held-out ones once no check can come any more.
            let trained = |step: u32| (0..views).map(|at| held_out.trained_at(step, at)).collect::<Vec<usize>>();
            assert!(trained(1600).iter().all(|at| *at < views && !held_out.positions().contains(at)));
            assert_eq!(trained(1700), (0..views).collect::<Vec<usize>>());
        }
    }
}
