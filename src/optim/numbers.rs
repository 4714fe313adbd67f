//! The deferred optimizer as plain numbers, for backends that update rows themselves.
//!
//! The sums of the series are those of the CPU, to the bit: they are computed in f64 and rounded once. The direct sum,
//! which the CPU computes in f64, has f32 tables here: its relative error is some 1e-6 (`tests/numerics/device_adam.rs`).

use super::adam_now::{AdamNow, DeferredAdam};
use super::decay::Decay;
use super::drift::RECENT;
use super::moments::Moments;
use crate::scene::columns::Column;
use crate::scene::log_scales::LogScaleRange;
use crate::scene::optimizer_numbers::{RunNumbers, StepNumbers};

impl DeferredAdam {
    /// The numbers of a run of `steps` steps; `None` for optimizers that only the CPU has: moments of 16 bits, and rows
    /// that do not catch up.
    pub fn numbers(&self, steps: u32) -> Option<RunNumbers> {
        let tables = self.tables();
        if tables.is_still() || self.moments() != Moments::F32 {
            return None;
        }
        let config = tables.config();
        let decays = (0..=steps.saturating_add(1)).map(|k| Decay::new(config, k));
        let LogScaleRange { low, high } = self.log_scales();
        let floor = self.eps_floor();
        Some(RunNumbers {
            limits: (0..=steps).map(|stamp| *tables.limit(stamp)).collect(),
            bias: tables.bias_until(steps).iter().map(|pair| pair.map(|x| x as f32)).collect(),
            rate_factors: tables.rate_factors().iter().map(|pair| pair.map(|x| x as f32)).collect(),
            decay_powers: tables.decay_powers().iter().map(|pair| pair.map(|x| x as f32)).collect(),
            decays: decays.map(|decay| [decay.first, decay.kept, decay.lost]).collect(),
            eps: floor.eps,
            floor: floor.floor,
            one_minus_betas: [(1.0 - config.beta1) as f32, (1.0 - config.beta2) as f32],
            base_rates: Column::ALL.map(|column| self.base_rate(column)),
            log_scales: [low, high],
        })
    }
}

impl AdamNow<'_> {
    /// The numbers of this step.
    pub fn numbers(&self) -> StepNumbers {
        let (tables, now) = (self.adam().tables(), self.steps());
        let [inv_bias1, inv_root] = tables.bias(now + 1);
        StepNumbers {
            now,
            recent: (0..RECENT as u32).map(|k| *self.drift(now.saturating_sub(k))).collect(),
            step_sizes: Column::ALL.map(|column| (tables.rates().at(column, now) * inv_bias1) as f32),
            inv_root_correction: inv_root as f32,
        }
    }
}
