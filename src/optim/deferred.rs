//! Deferred Adam: dense Adam, with the steps without a gradient computed only when the row is read. Here: the optimizer of a
//! run and its state at one step (tables, rates, single values). [`super::row_kernels`] applies it to rows.
//!
//! A row's stored state is the state after its last gradient, with the number of steps that it contains. Its current
//! value is a pure function of that state ([`super::drift`]), and reading stores nothing. So it does not matter how
//! often, when and by whom rows are read, evicted or loaded.
//!
//! Invariants: 1. one function evaluates a value, for every caller; 2. nothing here depends on rows.

use super::adam::AdamConfig;
use super::decay::Decay;
use super::drift::{
    Drift, DriftTables, EpsFloor, RECENT, drifted, flush, has_infinite_ratio, needs_direct_sum, of_column,
};
use super::moments::Moments;
use super::rates::Rates;
use crate::base::simd::{LANES, SimdPath};
use crate::scene::columns::Column;
use crate::scene::log_scales::LogScaleRange;
use crate::scene::optimizer_numbers::{RunNumbers, StepNumbers};
use crate::scene::rows::first_lane;

/// A value per lane of a row; all lanes of `sh_n` share one.
#[derive(Debug, Clone)]
pub(super) struct OfLanes {
    pub narrow: [f32; LANES],
    pub sh_n: f32,
}

impl OfLanes {
    /// From a value per column.
    pub fn new(of: impl Fn(Column) -> f32) -> Self {
        let mut narrow = [0.0; LANES];
        for column in Column::ALL.into_iter().filter(|&c| c != Column::ShN) {
            narrow[first_lane(column)..][..column.width(0)].fill(of(column));
        }
        OfLanes { narrow, sh_n: of(Column::ShN) }
    }

    #[inline(always)]
    pub fn of(&self, column: Column) -> f32 {
        if column == Column::ShN { self.sh_n } else { self.narrow[first_lane(column)] }
    }
}

/// Gaps whose decay is tabulated; longer ones are computed.
const TABLED_GAPS: usize = 4096;

/// The optimizer of a run: rates, tables, instruction path. Holds no row state.
#[derive(Debug, Clone)]
pub struct DeferredAdam {
    pub(super) tables: DriftTables,
    /// Base rates.
    pub(super) lane_rates: OfLanes,
    pub(super) eps: EpsFloor,
    /// `[k]`: decay of the moments over k steps.
    decays: Vec<Decay>,
    pub(crate) simd: SimdPath,
    pub(super) moments: Moments,
    /// The range to which updates clamp log-scales.
    pub(super) log_scales: LogScaleRange,
}

/// The optimizer at one step: everything that evaluation at this step needs, so that the work per row is a look-up.
#[derive(Debug, Clone)]
pub struct AdamNow<'a> {
    pub adam: &'a DeferredAdam,
    /// Number of steps taken.
    pub(super) now: u32,
    /// `[k]`: drift of a row that missed k steps.
    recent: [Drift; RECENT],
}

impl DeferredAdam {
    /// Builds the tables for these rates; panics as [`DriftTables::new`] does.
    pub fn new(rates: Rates, config: AdamConfig, simd: SimdPath) -> Self {
        let lane_rates = OfLanes::new(|column| rates.base(column) as f32);
        DeferredAdam {
            tables: DriftTables::new(rates, config),
            lane_rates,
            eps: EpsFloor::new(config.eps),
            decays: (0..TABLED_GAPS as u32).map(|k| Decay::new(config, k)).collect(),
            simd,
            moments: Moments::F32,
            log_scales: LogScaleRange::ANY_SCENE,
        }
    }

    /// The same optimizer with the range of log-scales of a scene.
    #[must_use]
    pub fn with_log_scales(self, log_scales: LogScaleRange) -> Self {
        DeferredAdam { log_scales, ..self }
    }

    /// The same optimizer with another storage format of moments.
    #[must_use]
    pub fn with_moments(self, moments: Moments) -> Self {
        DeferredAdam { moments, ..self }
    }

    /// The same optimizer without catching up: rows without a gradient keep their values and moments
    /// ([`super::method::Method::Sparse`]).
    #[must_use]
    pub fn without_catch_up(self) -> Self {
        DeferredAdam { tables: self.tables.still(), ..self }
    }

    pub fn rates(&self) -> &Rates {
        self.tables.rates()
    }

    pub fn bytes(&self) -> usize {
        self.tables.bytes() + self.decays.len() * size_of::<Decay>()
    }

    /// The optimizer after `now` steps. Costs about a microsecond.
    pub fn at(&self, now: u32) -> AdamNow<'_> {
        let recent = std::array::from_fn(|k| self.tables.drift(now.saturating_sub(k as u32), now));
        AdamNow { adam: self, now, recent }
    }

    /// One value after `now` steps, from its state after `stamp` steps. This defines a single value; [`AdamNow`] gives
    /// the same bits for rows.
    pub fn evaluate(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32, now: u32) -> f32 {
        self.evaluate_with(&self.tables.drift(stamp, now), column, value, m, v, stamp, now)
    }

    /// A value that bounds, together with `value`, all later values without further gradients: the limit to which the
    /// value moves monotonically, or, where eps matters, the limit without eps, which lies farther away.
    pub(crate) fn limit(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32) -> f32 {
        if has_infinite_ratio(m, v) {
            return self.value_by_direct_sum(column, value, m, v, stamp, u32::MAX);
        }
        let sums = of_column(self.tables.limit(stamp), column);
        drifted(value, m, v, sums, self.base_rate(column), self.eps.of_limit(v))
    }

    /// Base rate of a column, as the evaluation uses it.
    #[inline(always)]
    pub(crate) fn base_rate(&self, column: Column) -> f32 {
        self.lane_rates.of(column)
    }

    fn evaluate_with(&self, drift: &Drift, column: Column, value: f32, m: f32, v: f32, stamp: u32, now: u32) -> f32 {
        if stamp >= now {
            return value;
        }
        if needs_direct_sum(m, v, self.eps.floor) {
            return self.value_by_direct_sum(column, value, m, v, stamp, now);
        }
        drifted(value, m, v, of_column(drift, column), self.base_rate(column), self.eps.eps)
    }

    /// A value after its movement by the direct sum.
    fn value_by_direct_sum(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32, now: u32) -> f32 {
        let [sum] = self.tables.direct_sums(&[m], &[v], stamp, now, usize::from(column == Column::Means));
        flush(value - sum * self.base_rate(column))
    }

    /// The decay of the moments over `k` steps.
    #[inline(always)]
    fn decay(&self, k: u32) -> Decay {
        match self.decays.get(k as usize) {
            Some(&decay) => decay,
            None => self.far_decay(k),
        }
    }

    /// The decay over `k` steps beyond the table.
    #[cold]
    #[inline(never)]
    fn far_decay(&self, k: u32) -> Decay {
        Decay::new(self.tables.config(), k)
    }

    /// The numbers of a run of `steps` steps, for backends that update rows themselves; `None` for an optimizer that only the CPU has:
    /// rows that do not catch up. The sums of the series are those of the CPU, to the bit: they are
    /// computed in f64 and rounded once. The factors of the direct sum, which the CPU multiplies in f64, are multiplied in
    /// f32 there: its relative error is some 1e-6 (`tests/numerics/device_adam.rs`).
    pub fn numbers(&self, steps: u32) -> Option<RunNumbers> {
        let tables = &self.tables;
        if tables.is_still() {
            return None;
        }
        let config = tables.config();
        let decays = (0..=steps.saturating_add(1)).map(|k| Decay::new(config, k));
        let LogScaleRange { low, high } = self.log_scales;
        Some(RunNumbers {
            limits: (0..=steps).map(|stamp| *tables.limit(stamp)).collect(),
            bias: tables.bias_until(steps).iter().map(|pair| pair.map(|x| x as f32)).collect(),
            rate_factors: tables.rate_factors().iter().map(|pair| pair.map(|x| x as f32)).collect(),
            decay_powers: tables.decay_powers().iter().map(|pair| pair.map(|x| x as f32)).collect(),
            decays: decays.map(|decay| [decay.first, decay.kept, decay.lost]).collect(),
            eps: self.eps.eps,
            floor: self.eps.floor,
            one_minus_betas: [(1.0 - config.beta1) as f32, (1.0 - config.beta2) as f32],
            base_rates: Column::ALL.map(|column| self.base_rate(column)),
            log_scales: [low, high],
            has_halves: self.moments == Moments::Bf16,
        })
    }
}

impl<'a> AdamNow<'a> {
    /// Number of steps without a gradient over which the moments of a row of this stamp decay.
    #[inline(always)]
    fn missed(&self, stamp: u32) -> u32 {
        if self.adam.tables.is_still() { 0 } else { self.now.saturating_sub(stamp) }
    }

    /// The decay that the current step applies to the moments of a row of this stamp: for the first moment over the
    /// missed steps, for the second moment over the missed steps and this one.
    #[inline(always)]
    pub(super) fn step_decay(&self, stamp: u32) -> Decay {
        let missed = self.missed(stamp);
        Decay { first: self.adam.decay(missed).first, ..self.adam.decay(missed.saturating_add(1)) }
    }

    /// The decay of the moments of a row of this stamp over the steps that it missed.
    #[inline(always)]
    pub(super) fn settled_decay(&self, stamp: u32) -> Decay {
        self.adam.decay(self.missed(stamp))
    }

    /// A value of a row of this stamp, as of now.
    #[inline(always)]
    pub(super) fn evaluate_value(&self, column: Column, value: f32, m: f32, v: f32, stamp: u32) -> f32 {
        self.adam.evaluate_with(self.drift(stamp), column, value, m, v, stamp, self.now)
    }

    /// Series sums for a row of this stamp.
    #[inline(always)]
    pub(crate) fn drift(&self, stamp: u32) -> &Drift {
        let gap = self.now.saturating_sub(stamp) as usize;
        if gap < RECENT { &self.recent[gap] } else { self.adam.tables.limit(stamp) }
    }

    /// The numbers of this step, for backends that update rows themselves.
    pub fn numbers(&self) -> StepNumbers {
        let (tables, now) = (&self.adam.tables, self.now);
        let [inv_bias1, inv_root] = tables.bias(now + 1);
        StepNumbers {
            now,
            recent: (0..RECENT as u32).map(|k| *self.drift(now.saturating_sub(k))).collect(),
            step_sizes: Column::ALL.map(|column| (tables.rates().at(column, now) * inv_bias1) as f32),
            inv_root_correction: inv_root as f32,
        }
    }
}
