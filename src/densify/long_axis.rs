//! The strategy `long-axis`: rows with the highest growth scores are split along their longest axis as far as the cap
//! allows, and once the cap is reached, rows of little weight are removed so that better rows can take their places. The cap
//! is `--max-gaussians`, or what the run allows at this step ([`super::growth`]). There are no opacity resets.
//!
//! A round splits the rows in the top bins of the score histogram, as many whole bins as fit under the cap. A round recycles (removes)
//! the rows in the lowest bins of the histogram of mean blending weights: at most a share of the rows that enough views weighed since the
//! last round. So if views come in spatial groups, each region loses its share when its views come. Only later rounds use the places of
//! removed rows, so the cap holds at every step. If the run allows fewer rows than there are, the surplus is removed in the same way.
//!
//! Where views come region by region, in epochs longer than `refine_every`, a round within an epoch would have the statistics of
//! a few regions. So rounds come at the ends of epochs ([`Strategy::for_regions`]), and a round recycles as much as all rounds of a
//! shuffled epoch. A run in which two such rounds do not fit keeps its rounds, which share the room.
//!
//! Growth scores, per row and view: the norm of the gradient of the projected mean (NDC units), the squared error of
//! the picture under the row (sum over pixels of blending weight times squared error, mean over channels), or the
//! geometric mean of both.
//!
//! Invariants: 1. a round never leaves more rows than the cap, unless there were more before; 2. a decision is a function of the step
//! and of statistics; 3. nothing is drawn at random.

use super::growth::GrowthRule;
use super::stats::{DrawnRows, GradHistogram, WEIGHED_VIEWS, accumulate_scores, reaches_bin, weight_bin};
use super::strategy::{Extremes, Fate, Round, RoundSteps, RowCount, RowFacts, Strategy};
use crate::base::math::sigmoid;
use crate::optim::bounds::SplitLimits;
use crate::scene::events::{EventKind, LONG_AXIS_OFFSET, LongAxisRound};
use crate::scene::rows::{Rows, RowsMut};
use crate::scene::sightings::views;
use std::sync::Arc;

/// Rows are recycled once this share of the cap is reached.
const FULL_FROM: f64 = 0.9;
/// The largest share of the weighed rows that a round of an epoch recycles, unless the user asked for more: places are free until the
/// next round, which may be an epoch away.
const RECYCLED_MOST: f64 = 0.25;

/// The value of `--growth-score`: which rows grow first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GrowthScore {
    Gradient,
    /// Squared error under the row.
    Error,
    /// Geometric mean of both, view by view.
    Mixed,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LongAxisStrategy {
    pub score: GrowthScore,
    /// Share of the weighed rows that a round removes at the cap; 0: none.
    pub recycle: f64,
    /// A row is removed if its opacity is below this value.
    pub prune_opa: f32,
    pub rounds: RoundSteps,
    /// When the checks of [`LongAxisStrategy::growth`] may happen. Checks come by steps, also where rounds come by epochs.
    pub checks: RoundSteps,
    /// Whether all rounds share the room under the cap, because each of them has the statistics of some regions only.
    pub shares_room: bool,
    /// Most rows of the scene.
    pub max_gaussians: u64,
    /// How the run decides the cap; `None` for a run whose cap is given.
    pub growth: Option<GrowthRule>,
}

impl LongAxisStrategy {
    /// Share of the room under the cap that the round after this step may take.
    fn share_of_room(&self, step: u32) -> f64 {
        if !self.shares_room {
            return 1.0;
        }
        let RoundSteps { stop, every, .. } = self.rounds;
        1.0 / f64::from(((stop - 1) / every + 1 - step / every).max(1))
    }

    /// The round after this step. The last round removes nothing by weight, since no round would give the places away.
    pub fn round(&self, step: u32, count: RowCount, histogram: &GradHistogram) -> LongAxisRound {
        let RowCount { rows, allowed } = count;
        let cap = self.max_gaussians.min(allowed);
        let is_full = rows as f64 >= FULL_FROM * cap as f64;
        let is_last = step.saturating_add(self.rounds.every) >= self.rounds.stop;
        let surplus = rows.saturating_sub(allowed) as f64 / rows.max(1) as f64;
        let recycled = if is_full && !is_last { self.recycle } else { 0.0 };
        let removed = (surplus.max(recycled) * histogram.weighed_rows() as f64) as u64;
        let room = self.share_of_room(step) * cap.saturating_sub(rows) as f64;
        LongAxisRound {
            split_from_bin: histogram.split_bin(room.round() as u64),
            remove_below_bin: if removed > 0 { histogram.remove_bin(removed) } else { 0 },
            remove_views: WEIGHED_VIEWS,
            prune_opacity: self.prune_opa,
        }
    }

    /// Score and weight of the row at a place in the gradients.
    fn of_row(&self, drawn: &DrawnRows<'_>, place: usize) -> (f32, Option<f32>) {
        let gradient = || drawn.gradient_norm(place);
        let [weight, error] = drawn.gradients.weights.get(place).copied().unwrap_or_default();
        let score = match self.score {
            GrowthScore::Gradient => gradient(),
            GrowthScore::Error => error,
            GrowthScore::Mixed => (gradient() * error).sqrt(),
        };
        (score, (self.recycle > 0.0 || self.growth.is_some()).then_some(weight))
    }
}

impl Strategy for LongAxisStrategy {
    fn rounds(&self) -> Option<&RoundSteps> {
        Some(&self.rounds)
    }

    fn for_regions(&self, epoch: u32) -> Option<Arc<dyn Strategy>> {
        if epoch <= self.rounds.every {
            return None;
        }
        let at_ends = RoundSteps { every: epoch, ..self.rounds };
        let first = u64::from(at_ends.start / epoch + 1) * u64::from(epoch);
        if first + u64::from(epoch) >= u64::from(at_ends.stop) {
            return Some(Arc::new(LongAxisStrategy { shares_room: true, ..*self }));
        }
        let of_rounds = self.recycle * f64::from(epoch) / f64::from(self.rounds.every);
        let recycle = of_rounds.min(RECYCLED_MOST.max(self.recycle));
        Some(Arc::new(LongAxisStrategy { rounds: at_ends, recycle, ..*self }))
    }

    fn needs_weights(&self) -> bool {
        self.score != GrowthScore::Gradient || self.recycle > 0.0 || self.growth.is_some()
    }

    fn collects_on_device(&self) -> bool {
        self.score == GrowthScore::Gradient
    }

    fn collect(&self, view: &mut RowsMut<'_>, drawn: &DrawnRows<'_>, histogram: &mut GradHistogram) -> usize {
        accumulate_scores(view, drawn, histogram, |place| self.of_row(drawn, place))
    }

    fn growth(&self) -> Option<&GrowthRule> {
        self.growth.as_ref()
    }

    fn is_growth_checked(&self, step: u32) -> bool {
        let before = step.checked_sub(self.checks.every).filter(|before| self.checks.is_round(*before));
        self.checks.is_round(step) && self.growth.is_some_and(|rule| rule.is_due(before, step))
    }

    fn may_check_growth(&self, step: u32) -> bool {
        self.growth.is_some_and(|rule| step < self.checks.stop && rule.is_open(step, self.checks.every))
    }

    fn events_after(&self, step: u32, _: f32, count: RowCount, histogram: &GradHistogram) -> Vec<EventKind> {
        if self.rounds.is_round(step) {
            vec![EventKind::LongAxis(self.round(step, count, histogram))]
        } else {
            Vec::new()
        }
    }

    /// A row grows only from bin 1 on, so only with a score above 0.
    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits { grow_grad2d: 0.0, split_scale: 0.0, reach: LONG_AXIS_OFFSET as f32 }
    }
}

impl LongAxisRound {
    fn removes_by_weight(&self, count: u32) -> bool {
        views(count) >= self.remove_views && weight_bin(count).is_some_and(|bin| bin < self.remove_below_bin)
    }

    fn splits(&self, grad2d: f32, count: u32) -> bool {
        reaches_bin(grad2d, count, self.split_from_bin)
    }
}

impl Round for LongAxisRound {
    /// Removal first: a row whose place is taken does not grow.
    fn fate(&self, row: &RowFacts) -> Fate {
        if sigmoid(row.opacity) < self.prune_opacity || self.removes_by_weight(row.count) {
            Fate::Prune
        } else if self.splits(row.grad2d, row.count) {
            Fate::SplitLongAxis
        } else {
            Fate::Keep
        }
    }

    fn may_edit(&self, rows: &Rows<'_>) -> bool {
        let mut statistics = rows.grad2d.iter().zip(rows.count);
        statistics.any(|(&grad2d, &count)| self.splits(grad2d, count) || self.removes_by_weight(count))
    }

    /// The slack of 1e-5 covers the rounding of the sigmoid, some 4e-7.
    fn keeps_all(&self, extremes: &Extremes) -> bool {
        sigmoid(extremes.lowest_opacity) >= self.prune_opacity * (1.0 + 1e-5)
    }

    fn grows_from_bin(&self) -> u32 {
        self.split_from_bin
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::math::logit;
    use crate::base::rng::{Purpose, Stream};
    use crate::densify::growth::Quality;
    use crate::scene::columns::{Columns, Gradients};
    use crate::scene::state::SceneState;

    fn strategy(score: GrowthScore, max_gaussians: u64) -> LongAxisStrategy {
        LongAxisStrategy {
            score,
            recycle: 0.02,
            prune_opa: 0.005,
            rounds: RoundSteps { start: 500, stop: 2400, every: 100 },
            checks: RoundSteps { start: 500, stop: 2400, every: 100 },
            shares_room: false,
            max_gaussians,
            growth: None,
        }
    }

    /// A table of `rows` rows, `views` views of which drew with random gradients, weights and errors.
    fn drawn(strategy: &LongAxisStrategy, rows: usize, views: u64) -> (SceneState, GradHistogram) {
        let mut state = SceneState::from_columns(Columns::zeros(rows, 0));
        let mut histogram = GradHistogram::default();
        let numbers: Vec<u32> = (0..rows as u32).collect();
        for view in 0..views {
            let mut draws = Stream::new(5, Purpose::Test, view, 0);
            let means2d = numbers.iter().map(|_| [draws.normal() as f32, 0.5]).collect();
            let weights =
                numbers.iter().map(|&row| [row as f32 + draws.uniform() as f32, draws.uniform() as f32]).collect();
            let gradients = Gradients { means2d, radii: vec![[1, 1]; rows], weights, ..Gradients::default() };
            let drawn =
                DrawnRows { step: view as u32, rows: &numbers, gradients: &gradients, first: 0, image_size: [20, 10] };
            strategy.collect(&mut state.view_mut(), &drawn, &mut histogram);
        }
        (state, histogram)
    }

    fn facts(state: &SceneState, row: usize) -> RowFacts {
        RowFacts { grad2d: state.grad2d[row], count: state.count[row], log_scale: 0.0, opacity: logit(0.5) }
    }

    #[test]
    fn scores_are_gradients_errors_or_their_geometric_mean() {
        let [gradient, error, mixed] = [GrowthScore::Gradient, GrowthScore::Error, GrowthScore::Mixed]
            .map(|score| drawn(&strategy(score, 100), 50, 1).0.grad2d);
        for row in 0..50 {
            assert!(gradient[row] > 0.0 && error[row] > 0.0);
            assert_eq!(mixed[row], (gradient[row] * error[row]).sqrt());
        }
        assert!(!LongAxisStrategy { recycle: 0.0, ..strategy(GrowthScore::Gradient, 9) }.needs_weights());
        assert!(strategy(GrowthScore::Gradient, 9).needs_weights());
    }

    #[test]
    fn growth_takes_the_highest_scores_that_fit() {
        let strategy = strategy(GrowthScore::Mixed, 1300);
        let (state, histogram) = drawn(&strategy, 1000, 4);
        let round = strategy.round(700, RowCount::unlimited(1000), &histogram);
        assert_eq!(round.remove_below_bin, 0, "there is room");
        let grows = |row: usize| round.fate(&facts(&state, row)) == Fate::SplitLongAxis;
        let (grown, kept): (Vec<usize>, Vec<usize>) = (0..1000).partition(|&row| grows(row));
        // A bin is under 1 % wide: some ten of a thousand rows may share the first bin that does not fit.
        assert!((290..=300).contains(&grown.len()), "{}", grown.len());
        let score = |row: &usize| state.grad2d[*row];
        let least = grown.iter().map(score).fold(f32::INFINITY, f32::min);
        assert!(kept.iter().map(score).all(|kept| kept < least));
        assert_eq!(round.promised(&histogram), grown.len() as u64);
        assert_eq!(round.promised_rows(&state.view()), grown.len() as u64);
        assert!(round.may_edit(&state.view()) && !round.may_edit(&SceneState::default().view()));
        // Without room nothing grows, and rows without statistics never do.
        let full = strategy.round(700, RowCount::unlimited(1300), &histogram);
        assert_eq!(full.promised(&histogram), 0);
        assert!(!round.splits(0.0, 0) && !round.splits(0.0, 9));
    }

    #[test]
    fn recycling_removes_the_least_weights_at_the_cap_until_the_last_round() {
        let strategy = strategy(GrowthScore::Error, 1000);
        let (state, histogram) = drawn(&strategy, 1000, 4);
        assert_eq!(histogram.weighed_rows(), 1000);
        let round = strategy.round(700, RowCount::unlimited(1000), &histogram);
        let removed: Vec<usize> = (0..1000).filter(|&row| round.fate(&facts(&state, row)) == Fate::Prune).collect();
        // The weight of a row is its number and a bit: the 20 least are the first ones.
        assert!(removed.len() > 15 && removed.len() <= 20, "{removed:?}");
        assert!(removed.iter().all(|&row| row < 20), "{removed:?}");
        assert_eq!(strategy.round(2300, RowCount::unlimited(1000), &histogram).remove_below_bin, 0, "the last round");
        assert_eq!(strategy.round(700, RowCount::unlimited(800), &histogram).remove_below_bin, 0, "below the cap");
        // Too few views say nothing about a row.
        let (_, few) = drawn(&strategy, 1000, u64::from(WEIGHED_VIEWS) - 1);
        assert_eq!((few.weighed_rows(), strategy.round(700, RowCount::unlimited(1000), &few).remove_below_bin), (0, 0));
    }

    #[test]
    fn rows_beyond_what_the_run_allows_go_even_in_the_last_round() {
        let strategy = LongAxisStrategy { recycle: 0.0, max_gaussians: u64::MAX, ..strategy(GrowthScore::Gradient, 0) };
        let (state, histogram) = drawn(&LongAxisStrategy { recycle: 0.02, ..strategy }, 1000, 4);
        for step in [700, 2300] {
            let round = strategy.round(step, RowCount { allowed: 500, ..RowCount::unlimited(1000) }, &histogram);
            let removed = (0..1000).filter(|&row| round.fate(&facts(&state, row)) == Fate::Prune).count();
            // A bin of large weights holds several rows.
            assert!((480..=500).contains(&removed), "{removed}");
            assert_eq!(round.promised(&histogram), 0, "nothing grows");
        }
        let round = strategy.round(700, RowCount { allowed: 1000, ..RowCount::unlimited(1000) }, &histogram);
        assert_eq!(round.remove_below_bin, 0);
    }

    fn rounds(strategy: &dyn Strategy) -> Vec<u32> {
        (0..4000).filter(|&step| strategy.reads_histogram(step)).collect()
    }

    #[test]
    fn rounds_come_at_the_ends_of_epochs_that_visit_one_region_after_the_other() {
        let rule = GrowthRule::new(Quality::Normal, 3000);
        let by_steps = LongAxisStrategy { growth: Some(rule), ..strategy(GrowthScore::Gradient, 2000) };
        // A shuffle, and an epoch within a round.
        assert!(by_steps.for_regions(0).is_none() && by_steps.for_regions(100).is_none());
        let by_epochs = by_steps.for_regions(150).unwrap();
        assert_eq!(rounds(&*by_epochs), (4..16).map(|epoch| 150 * epoch).collect::<Vec<u32>>());
        assert_eq!(rounds(&*by_steps.for_regions(799).unwrap()), [799, 1598, 2397]);
        // The checks of growth come as before.
        let checks =
            |strategy: &dyn Strategy| (0..4000).filter(|step| strategy.is_growth_checked(*step)).collect::<Vec<_>>();
        assert_eq!(checks(&*by_epochs), [800, 1000, 1200, 1400, 1600, 1800, 2000, 2200]);
        assert_eq!(checks(&by_steps), checks(&*by_epochs));
        // Two rounds do not fit: the rounds stay.
        for epoch in [1300, 2400, 50_000, u32::MAX] {
            assert_eq!(rounds(&*by_steps.for_regions(epoch).unwrap()), rounds(&by_steps), "{epoch}");
        }
    }

    #[test]
    fn a_round_at_the_end_of_an_epoch_recycles_as_much_as_those_of_a_shuffle() {
        let by_steps = strategy(GrowthScore::Error, 1000);
        let (state, histogram) = drawn(&by_steps, 1000, 4);
        let removed = |recycle: f64| {
            let strategy = LongAxisStrategy { recycle, ..by_steps }.for_regions(300).unwrap();
            let events = strategy.events_after(600, 1.0, RowCount::unlimited(1000), &histogram);
            let [EventKind::LongAxis(round)] = events[..] else { panic!("no round") };
            (0..1000).filter(|&row| round.fate(&facts(&state, row)) == Fate::Prune).count()
        };
        // Bins hold up to ten rows here. Three rounds of a shuffle take 2 % each; a quarter goes at most.
        assert!((50..=60).contains(&removed(0.02)), "{}", removed(0.02));
        assert!((240..=250).contains(&removed(0.2)), "{}", removed(0.2));
    }

    #[test]
    fn rounds_that_see_some_regions_share_the_room() {
        let strategy = LongAxisStrategy { shares_room: true, ..strategy(GrowthScore::Gradient, 2000) };
        let mut rows = 1000.0;
        let take = |step: u32| {
            let taken = strategy.share_of_room(step) * (2000.0 - rows);
            rows += taken;
            taken
        };
        let grown: Vec<f64> = rounds(&strategy).into_iter().map(take).collect();
        assert!(grown.iter().all(|taken| (taken - 1000.0 / 18.0).abs() < 1e-9), "{grown:?}");
        assert_eq!(LongAxisStrategy { shares_room: false, ..strategy }.share_of_room(600), 1.0);
    }
}
