//! The optimizer of a run as plain numbers, for backends that evaluate and update rows themselves. `optim` fills them,
//! and documents the formulas.
//!
//! Invariant: the numbers depend on the run's configuration ([`RunNumbers`]) and the step ([`StepNumbers`]) alone.

use super::columns::Column;

/// Series sums of one gap at unit base rate: three for the schedule of the means, 0, then the same for that
/// of the other columns.
pub type SeriesSums = [f32; 8];

#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunNumbers {
    /// `[stamp]`: sums of the movement to the limit; beyond the end as the last.
    pub limits: Vec<SeriesSums>,
    /// `[t]`, t from 1: 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t); beyond the end as the last.
    pub bias: Vec<[f32; 2]>,
    /// `[step]`, 0-based: factors on the rate of the means and on the other rates; beyond the end as the last.
    pub rate_factors: Vec<[f32; 2]>,
    /// `[j]`: beta1^j, sqrt(beta2^j). Its length less one is the number of terms of the direct sum.
    pub decay_powers: Vec<[f32; 2]>,
    /// `[k]`: decay of the moments over k steps: factor of the first, factor of the second, share that the second loses.
    pub decays: Vec<[f32; 3]>,
    pub eps: f32,
    /// The series holds for second moments above this.
    pub floor: f32,
    /// 1 - beta1, 1 - beta2.
    pub one_minus_betas: [f32; 2],
    /// Base rate of each column, in the order of [`Column::ALL`].
    pub base_rates: [f32; Column::ALL.len()],
    /// Least and greatest log-scale that an update leaves.
    pub log_scales: [f32; 2],
    /// Whether moments have 16 bits between updates.
    pub has_halves: bool,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepNumbers {
    pub now: u32,
    /// `[k]`: sums of a row that missed k steps; a row that missed more has those of its limit.
    pub recent: Vec<SeriesSums>,
    /// Rate of each column over the bias of the first moment, in the order of [`Column::ALL`].
    pub step_sizes: [f32; Column::ALL.len()],
    /// 1 / sqrt(1 - beta2^t).
    pub inv_root_correction: f32,
}

/// The lowest thresholds for splitting that any round of the run can have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplitLimits {
    /// Rows grow only above this mean gradient norm.
    pub grow_grad2d: f32,
    /// Growing rows split only above this largest standard deviation.
    pub split_scale: f32,
    /// Largest distance of a child's mean from its parent's, in the parent's largest standard deviation.
    pub reach: f32,
}

impl SplitLimits {
    /// For a run without rounds.
    pub const NEVER: SplitLimits = SplitLimits { grow_grad2d: f32::INFINITY, split_scale: f32::INFINITY, reach: 0.0 };
}
