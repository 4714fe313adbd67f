//! Lengths and rates that follow from the number of steps: the values of keys that neither the config file nor a flag of a
//! new run gives.
//!
//! The defaults of the 3D Gaussian Splatting code are for 30,000 steps. A run of 3,000 steps would raise its SH degree
//! to 3 only at its end, and its Gaussians would not get far. [`Schedule::RunLength`] makes these lengths shares of
//! `--steps`:
//!
//! | key | value | from the classic value on, at |
//! | --- | --- | --- |
//! | `sh-every` | a tenth of the steps | 10,000 steps |
//! | `refine-start` | a sixth of the steps | 3,000 steps |
//! | `refine-every` | a thirtieth of the steps, at least 10 | 3,000 steps |
//! | `refine-stop` | four fifths of the steps | 18,750 steps |
//! | `means-lr` | times the square root of 30,000 / steps, at most times 3 | 30,000 steps |
//! | `scales-lr`, `quats-lr` and `shn-lr`, with the strategy `long-axis` | times the same factor | 30,000 steps |
//! | `others-lr-final`, with the strategy `long-axis` | a tenth | never |
//!
//! The factor of the rates has a reason: a value whose gradients have changing signs moves like a random walk under
//! Adam, as far as its rate times the square root of the steps. The factor keeps this distance. The limit of 3 is the
//! largest factor that was measured (`benches/RESULTS.md`). `reset-every` stays as it is, because opacities take a number
//! of steps to recover, not a share; `refine-stop` ends resets too, and none comes shortly before the end of a run
//! ([`crate::densify::default`]).
//!
//! Not here: which keys are given ([`super::new_run`]).
//!
//! Invariants: 1. at 30,000 steps and more every value but `others-lr-final` is the classic one; 2. no value jumps between
//! lengths.

use crate::densify::strategy::StrategyName;

/// Steps for which the classic values were made.
const CLASSIC_STEPS: u32 = 30_000;
/// Largest factor of a learning rate.
const RATE_FACTOR_MOST: f64 = 3.0;
/// Fraction of the rates that is left at the end of a run of the strategy `long-axis`.
const SETTLED: f64 = 0.1;
/// Fewest steps between rounds that follow from the number of steps.
const REFINE_EVERY_LEAST: u32 = 10;

/// The value of `--schedule`: what keys become that are not given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Schedule {
    /// Shares of the steps.
    RunLength,
    /// The values for 30,000 steps, whatever the number of steps.
    Classic,
}

/// The values of the keys that follow the length of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lengths {
    /// Steps between raises of the SH degree.
    pub sh_every: u32,
    /// Step after which rounds begin.
    pub refine_start: u32,
    /// Steps between rounds.
    pub refine_every: u32,
    /// Step at which rounds end.
    pub refine_stop: u32,
    /// Learning rate of positions, times the scene scale.
    pub means_lr: f64,
    /// Learning rate of log-scales.
    pub scales_lr: f64,
    /// Learning rate of quaternions.
    pub quats_lr: f64,
    /// Learning rate of the higher SH bands.
    pub shn_lr: f64,
    /// Fraction of the rates of all but positions that is left at the last step.
    pub others_lr_final: f64,
}

impl Lengths {
    /// The values for 30,000 steps.
    pub const CLASSIC: Lengths = Lengths {
        sh_every: 1000,
        refine_start: 500,
        refine_every: 100,
        refine_stop: 15_000,
        means_lr: 1.6e-4,
        scales_lr: 5e-3,
        quats_lr: 1e-3,
        shn_lr: 2.5e-3 / 20.0,
        others_lr_final: 1.0,
    };

    /// The values of a run of this many steps with this strategy.
    pub fn of_run(steps: u32, strategy: StrategyName) -> Lengths {
        let classic = Lengths::CLASSIC;
        let factor = (f64::from(CLASSIC_STEPS) / f64::from(steps.max(1))).sqrt().clamp(1.0, RATE_FACTOR_MOST);
        let (of_strategy, others_lr_final) =
            if strategy == StrategyName::LongAxis { (factor, SETTLED) } else { (1.0, classic.others_lr_final) };
        Lengths {
            sh_every: (steps / 10).clamp(1, classic.sh_every),
            refine_start: (steps / 6).min(classic.refine_start),
            refine_every: (steps / 30).clamp(REFINE_EVERY_LEAST, classic.refine_every),
            refine_stop: (u64::from(steps) * 4 / 5).min(u64::from(classic.refine_stop)) as u32,
            means_lr: classic.means_lr * factor,
            scales_lr: classic.scales_lr * of_strategy,
            quats_lr: classic.quats_lr * of_strategy,
            shn_lr: classic.shn_lr * of_strategy,
            others_lr_final,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_runs_keep_the_classic_values_and_short_runs_follow_their_length() {
        for steps in [30_000, 30_001, 200_000, u32::MAX] {
            for strategy in [StrategyName::Default, StrategyName::Mcmc, StrategyName::None] {
                assert_eq!(Lengths::of_run(steps, strategy), Lengths::CLASSIC);
            }
            let settled = Lengths { others_lr_final: 0.1, ..Lengths::CLASSIC };
            assert_eq!(Lengths::of_run(steps, StrategyName::LongAxis), settled);
        }
        let of = |sh_every, refine_start, refine_every, refine_stop| Lengths {
            sh_every,
            refine_start,
            refine_every,
            refine_stop,
            means_lr: 3.0 * 1.6e-4,
            ..Lengths::CLASSIC
        };
        for (steps, want) in [(3000, of(300, 500, 100, 2400)), (300, of(30, 50, 10, 240))] {
            assert_eq!(Lengths::of_run(steps, StrategyName::Default), want);
            let faster = Lengths {
                scales_lr: 3.0 * want.scales_lr,
                quats_lr: 3.0 * want.quats_lr,
                shn_lr: 3.0 * want.shn_lr,
                others_lr_final: 0.1,
                ..want
            };
            assert_eq!(Lengths::of_run(steps, StrategyName::LongAxis), faster);
        }
    }

    #[test]
    fn nothing_jumps_between_lengths() {
        let mut last = Lengths::of_run(1, StrategyName::LongAxis);
        for steps in (2..32_000).step_by(37) {
            let now = Lengths::of_run(steps, StrategyName::LongAxis);
            // 37 steps more move no length by more than that, and no rate by more than 1 %.
            let rates = |of: &Lengths| [of.means_lr, of.scales_lr, of.quats_lr, of.shn_lr];
            for (now, last) in rates(&now).into_iter().zip(rates(&last)) {
                assert!(now <= last && now > 0.99 * last, "{steps}");
            }
            for (now, last) in [
                (now.sh_every, last.sh_every),
                (now.refine_start, last.refine_start),
                (now.refine_every, last.refine_every),
                (now.refine_stop, last.refine_stop),
            ] {
                assert!(now >= last && now - last <= 37, "{steps}: {last} to {now}");
            }
            last = now;
        }
    }
}
