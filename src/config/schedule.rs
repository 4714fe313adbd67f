//! Lengths and rates that follow from the number of steps: what the keys of a new run become that neither its config
//! file nor a flag gives.
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
//!
//! The factor of the rate has a reason: a value whose gradients have changing signs moves like a random walk under
//! Adam, as far as its rate times the square root of the steps. The factor keeps this distance. The limit of 3 is the
//! factor that was measured at 3,000 steps. `reset-every` stays as it is, because opacities take a number of steps to
//! recover, not a share; `refine-stop` ends resets too.
//!
//! Invariants: 1. a given key is never changed; 2. at 30,000 steps and more every key keeps its classic value; 3. the
//! result is written to the config of the run, so a resumed run keeps its values whatever its new length.

use super::file::{TrainConfig, TrainOverrides};
use crate::base::error::InputResult;
use std::collections::BTreeSet;
use std::path::Path;

/// Steps for which the classic values were made.
const CLASSIC_STEPS: u32 = 30_000;
/// Largest factor of the learning rate of positions.
const RATE_FACTOR_MOST: f64 = 3.0;
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

impl TrainConfig {
    /// The config of a new run: flags over the config file over the defaults, and the keys that neither gives by
    /// `--schedule`. Not checked yet.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of_new_run(file: Option<&Path>, keys: &TrainOverrides) -> InputResult<TrainConfig> {
        let (mut config, mut given) = match file {
            Some(path) => TrainConfig::read_with_keys(path)?,
            None => (TrainConfig::default(), BTreeSet::new()),
        };
        given.extend(keys.given().into_iter().map(str::to_string));
        keys.clone().apply(&mut config);
        config.follow_length(&given);
        Ok(config)
    }

    /// Sets the keys of the schedule that are not in `given` (names of fields) by `--schedule` and `--steps`.
    fn follow_length(&mut self, given: &BTreeSet<String>) {
        if self.schedule == Schedule::Classic {
            return;
        }
        let (steps, classic) = (self.steps, TrainConfig::default());
        let is_open = |field: &str| !given.contains(field);
        if is_open("sh_every") {
            self.sh_every = (steps / 10).clamp(1, classic.sh_every);
        }
        if is_open("refine_start") {
            self.refine_start = (steps / 6).min(classic.refine_start);
        }
        if is_open("refine_every") {
            self.refine_every = (steps / 30).clamp(REFINE_EVERY_LEAST, classic.refine_every);
        }
        if is_open("refine_stop") {
            self.refine_stop = (u64::from(steps) * 4 / 5).min(u64::from(classic.refine_stop)) as u32;
        }
        if is_open("means_lr") {
            self.means_lr = classic.means_lr * rate_factor(steps);
        }
    }
}

/// Factor of the learning rate of positions in a run of this many steps.
fn rate_factor(steps: u32) -> f64 {
    (f64::from(CLASSIC_STEPS) / f64::from(steps.max(1))).sqrt().clamp(1.0, RATE_FACTOR_MOST)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_steps(steps: u32) -> TrainConfig {
        let mut config = TrainConfig { steps, ..TrainConfig::default() };
        config.follow_length(&BTreeSet::new());
        config
    }

    #[test]
    fn long_runs_keep_the_classic_values_and_short_runs_follow_their_length() {
        for steps in [30_000, 30_001, 200_000] {
            assert_eq!(of_steps(steps), TrainConfig { steps, ..TrainConfig::default() });
        }
        let lengths = |c: &TrainConfig| (c.sh_every, c.refine_start, c.refine_every, c.refine_stop);
        let short = of_steps(3000);
        assert_eq!(lengths(&short), (300, 500, 100, 2400));
        assert_eq!((short.means_lr, short.reset_every), (3.0 * 1.6e-4, 3000));
        assert_eq!(lengths(&of_steps(300)), (30, 50, 10, 240));
        assert!(of_steps(1).check().is_ok());
    }

    #[test]
    fn nothing_jumps_between_lengths() {
        let mut last = of_steps(1);
        for steps in (2..32_000).step_by(37) {
            let now = of_steps(steps);
            // 37 steps more move no length by more than that, and no rate by more than 1 %.
            assert!(now.means_lr <= last.means_lr && now.means_lr > 0.99 * last.means_lr, "{steps}");
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

    #[test]
    fn given_keys_and_the_classic_schedule_are_left_alone() {
        let keys = TrainOverrides { steps: Some(3000), sh_every: Some(1000), ..TrainOverrides::default() };
        let config = TrainConfig::of_new_run(None, &keys).unwrap_or_default();
        assert_eq!((config.sh_every, config.refine_stop), (1000, 2400));
        let keys = TrainOverrides { schedule: Some(Schedule::Classic), ..keys };
        let config = TrainConfig::of_new_run(None, &keys).unwrap_or_default();
        let want = TrainConfig { steps: 3000, schedule: Schedule::Classic, ..TrainConfig::default() };
        assert_eq!(config, want);
    }

    #[test]
    fn keys_of_a_file_are_given() {
        let parsed = TrainConfig::parse_with_keys("steps = 3000\nmeans-lr = 1.6e-4\n[resolved]\nrefine-stop = 1\n");
        let (mut config, given) = parsed.unwrap_or_default();
        config.follow_length(&given);
        assert_eq!((config.means_lr, config.sh_every, config.refine_stop), (1.6e-4, 300, 2400));
    }
}
