//! gsplat's `DefaultStrategy`: rows with a large gradient of their projected mean are duplicated or split, faint rows
//! and large rows are pruned, and opacities are reset at intervals.
//!
//! Invariants: 1. a round never leaves more than `max_gaussians` rows; 2. an interval of 0 means never; 3. no opacities
//! are reset so late in the planned run that they cannot recover.

use super::ops::{child_log_scale, sigma};
use super::stats::{GradHistogram, bin_above};
use super::strategy::{Extremes, Fate, Round, RoundSteps, RowCount, RowFacts, Strategy};
use crate::base::math::sigmoid;
use crate::optim::bounds::SplitLimits;
use crate::scene::events::{EventKind, RoundThresholds, SPLIT_SIGMAS};
use crate::scene::rows::{Rows, mean_grad2d};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DefaultStrategy {
    /// A row grows if its mean gradient norm is above this value, NDC units.
    pub grow_grad2d: f32,
    /// A growing row up to this size is duplicated, a larger one is split; in units of the scene scale.
    pub grow_scale3d: f32,
    /// A row is pruned if its opacity is below this value.
    pub prune_opa: f32,
    /// A row is pruned if it is larger than this size, after step `reset_every`; in units of the scene scale.
    pub prune_scale3d: f32,
    /// When rounds happen; resets end with them.
    pub rounds: RoundSteps,
    /// Steps between opacity resets.
    pub reset_every: u32,
    /// Steps of the planned run: no reset comes shortly before its end.
    pub schedule_steps: u32,
    /// Most rows of the scene.
    pub max_gaussians: u64,
}

/// Steps that opacities get to recover from the last reset before the planned end of a run; a third of the reset interval if that is less.
const RECOVERY_STEPS: u32 = 1000;

impl Default for DefaultStrategy {
    fn default() -> Self {
        DefaultStrategy {
            grow_grad2d: 2e-4,
            grow_scale3d: 0.01,
            prune_opa: 0.005,
            prune_scale3d: 0.1,
            rounds: RoundSteps { start: 500, stop: 15_000, every: 100 },
            reset_every: 3000,
            schedule_steps: u32::MAX,
            max_gaussians: u64::MAX,
        }
    }
}

impl DefaultStrategy {
    /// Whether an opacity reset follows this step (after its round). Resets need pruning by opacity: with `prune_opa` 0
    /// the cap would be 0, which has no finite logit. They also need the steps after them in which opacities recover.
    pub fn is_reset(&self, step: u32) -> bool {
        let recovery = RECOVERY_STEPS.min(self.reset_every / 3);
        let is_late = step.saturating_add(1).saturating_add(recovery) > self.schedule_steps;
        let is_due = step > 0 && step < self.rounds.stop && step.is_multiple_of(self.reset_every);
        self.prune_opa > 0.0 && is_due && !is_late
    }

    /// Thresholds of the round after this step. Every growing row adds one row, so at most `max_gaussians - rows` rows
    /// may grow. If more rows exceed `grow_grad2d`, the threshold rises to the highest bins of the histogram that fit.
    /// The limit ignores the prunes of the same round.
    pub fn thresholds(&self, step: u32, scene_scale: f32, rows: u64, histogram: &GradHistogram) -> RoundThresholds {
        let room = self.max_gaussians.saturating_sub(rows);
        let was_reset = self.reset_every > 0 && step > self.reset_every;
        RoundThresholds {
            grow_grad2d: histogram.threshold(self.grow_grad2d, room),
            split_scale: self.grow_scale3d * scene_scale,
            prune_opacity: self.prune_opa,
            prune_scale: if was_reset { self.prune_scale3d * scene_scale } else { f32::INFINITY },
        }
    }
}

impl Strategy for DefaultStrategy {
    fn rounds(&self) -> Option<&RoundSteps> {
        Some(&self.rounds)
    }

    fn edits_all_after(&self, step: u32) -> bool {
        self.is_reset(step)
    }

    /// A round, then a reset.
    fn events_after(&self, step: u32, scene_scale: f32, count: RowCount, histogram: &GradHistogram) -> Vec<EventKind> {
        let mut events = Vec::new();
        if self.rounds.is_round(step) {
            events.push(EventKind::Densify(self.thresholds(step, scene_scale, count.rows, histogram)));
        }
        if self.is_reset(step) {
            events.push(EventKind::ResetOpacity { max_opacity: 2.0 * self.prune_opa });
        }
        events
    }

    /// The thresholds of a round are never below the keys.
    fn split_limits(&self, scene_scale: f32) -> SplitLimits {
        let (grow_grad2d, split_scale) = (self.grow_grad2d, self.grow_scale3d * scene_scale);
        SplitLimits { grow_grad2d, split_scale, reach: SPLIT_SIGMAS as f32 }
    }
}

impl Round for RoundThresholds {
    /// Growth first, then pruning of old and new rows.
    fn fate(&self, row: &RowFacts) -> Fate {
        let is_faint = sigmoid(row.opacity) < self.prune_opacity;
        let is_pruned = |log_scale: f32| is_faint || sigma(log_scale) > self.prune_scale;
        let grows = mean_grad2d(row.grad2d, row.count) > self.grow_grad2d;
        if !grows {
            return if is_pruned(row.log_scale) { Fate::Prune } else { Fate::Keep };
        }
        if sigma(row.log_scale) <= self.split_scale {
            Fate::Duplicate { pruned: is_pruned(row.log_scale) }
        } else {
            Fate::Split { children_pruned: is_pruned(child_log_scale(row.log_scale)) }
        }
    }

    fn may_edit(&self, rows: &Rows<'_>) -> bool {
        let means = rows.grad2d.iter().zip(rows.count).map(|(&grad2d, &count)| mean_grad2d(grad2d, count));
        means.fold(false, |any, mean| any | (mean > self.grow_grad2d))
    }

    /// The slack of 1e-5 covers the rounding of the sigmoid, some 4e-7.
    fn keeps_all(&self, extremes: &Extremes) -> bool {
        sigmoid(extremes.lowest_opacity) >= self.prune_opacity * (1.0 + 1e-5) && extremes.sigma_max <= self.prune_scale
    }

    fn grows_from_bin(&self) -> u32 {
        bin_above(self.grow_grad2d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::math::logit;

    #[test]
    fn the_schedule_is_that_of_the_default_strategy() {
        let config = DefaultStrategy::default();
        let rounds: Vec<u32> = (0..20_000).filter(|&s| config.rounds.is_round(s)).collect();
        assert_eq!((rounds[0], rounds[1], rounds[rounds.len() - 1]), (600, 700, 14_900));
        let resets: Vec<u32> = (0..20_000).filter(|&s| config.is_reset(s)).collect();
        assert_eq!(resets, [3000, 6000, 9000, 12_000]);
        assert!(config.collects(14_999) && !config.collects(15_000));
        let events = config.events_after(3000, 1.0, RowCount::unlimited(10), &GradHistogram::default());
        let EventKind::Densify(round) = events[0] else { panic!("{events:?}") };
        assert_eq!(round.prune_scale, f32::INFINITY);
        assert_eq!(events[1], EventKind::ResetOpacity { max_opacity: 0.01 });
        assert_eq!(config.thresholds(3100, 2.0, 10, &GradHistogram::default()).prune_scale, 0.2);
        // A run that ends 1,000 steps after a reset has it; a shorter one has not.
        for (schedule_steps, last) in [(4001, Some(3000)), (4000, None), (3001, None), (3000, None), (7001, Some(6000))]
        {
            let short = DefaultStrategy { schedule_steps, ..config };
            assert_eq!((0..schedule_steps).rfind(|&s| short.is_reset(s)), last, "{schedule_steps} steps");
        }
        let often = DefaultStrategy { reset_every: 45, schedule_steps: 100, ..config };
        assert_eq!((0..100).filter(|&s| often.is_reset(s)).collect::<Vec<_>>(), [45]);
        let never = DefaultStrategy { rounds: RoundSteps { every: 0, ..config.rounds }, reset_every: 0, ..config };
        assert!((0..20_000).all(|s| !never.rounds.is_round(s) && !never.is_reset(s)));
        let unpruned = DefaultStrategy { prune_opa: 0.0, ..DefaultStrategy::default() };
        assert!((0..20_000).all(|s| !unpruned.is_reset(s)));
        assert_eq!(never.thresholds(9000, 1.0, 10, &GradHistogram::default()).prune_scale, f32::INFINITY);
    }

    #[test]
    fn rows_grow_before_they_are_pruned() {
        let t = RoundThresholds { grow_grad2d: 1.0, split_scale: 0.1, prune_opacity: 0.005, prune_scale: 0.5 };
        let (solid, faint) = (logit(0.5), logit(0.004));
        let of = |sigma: f32, mean_grad2d: f32, opacity: f32| {
            t.fate(&RowFacts { grad2d: 2.0 * mean_grad2d, count: 2, log_scale: sigma.ln(), opacity })
        };
        assert_eq!(of(0.05, 1.0, solid), Fate::Keep);
        assert_eq!(of(0.05, 1.1, solid), Fate::Duplicate { pruned: false });
        assert_eq!(of(0.05, 1.1, faint), Fate::Duplicate { pruned: true });
        assert_eq!(of(0.2, 1.1, solid), Fate::Split { children_pruned: false });
        // 0.7 exceeds the prune limit of 0.5; a child of 0.7 / 1.6 does not.
        assert_eq!(of(0.7, 1.1, solid), Fate::Split { children_pruned: false });
        assert_eq!(of(0.7, 0.0, solid), Fate::Prune);
        assert_eq!(of(0.9, 1.1, solid), Fate::Split { children_pruned: true });
        assert_eq!(of(0.01, 0.0, faint), Fate::Prune);
    }
}
