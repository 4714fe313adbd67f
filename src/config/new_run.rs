//! The config of a new run. Flags override the config file, which overrides the defaults. The length of the run sets some
//! of the keys that neither gives ([`super::schedule`]), and `poor-points` some more.
//!
//! Invariants: 1. a given key is never changed; 2. the result is written to the config of the run as if every key had
//! been given, so a resumed run keeps its values whatever its new length.

use super::file::{TrainConfig, TrainOverrides};
use super::schedule::{Lengths, Schedule};
use crate::base::error::InputResult;
use crate::densify::long_axis::GrowthScore;
use std::collections::BTreeSet;
use std::path::Path;

/// With `poor-points`: the factor of the learning rate of positions. Points that lie at a wrong place have a long way to go.
const POOR_MEANS_LR: f64 = 20.0 / 3.0;
/// With `poor-points`: the factor of first sizes, so that few points cover the scene.
const POOR_INIT_SCALE: f64 = 2.0;
/// With `poor-points`: the share of Gaussians that a round at the cap moves to a better place.
const POOR_RECYCLE: f64 = 0.05;

impl TrainConfig {
    /// The config of a new run, not checked yet.
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
        if config.poor_points {
            config.suit_poor_points(|field| !given.contains(field));
        }
        Ok(config)
    }

    /// Sets the fields of `poor-points` that are open. The values were chosen by the PSNR of held-out photos of two scenes with a tenth
    /// of their points and with random ones, see "Few or random points" in `benches/RESULTS.md`.
    pub fn suit_poor_points(&mut self, is_open: impl Fn(&str) -> bool) {
        if is_open("means_lr") {
            self.means_lr *= POOR_MEANS_LR;
        }
        if is_open("init_scale") {
            self.init_scale = POOR_INIT_SCALE;
        }
        if is_open("recycle") {
            self.recycle = POOR_RECYCLE;
        }
        if is_open("growth_score") {
            self.growth_score = GrowthScore::Mixed;
        }
    }

    /// Sets the keys of the schedule that are not in `given` (names of fields) by `--schedule` and `--steps`.
    fn follow_length(&mut self, given: &BTreeSet<String>) {
        let lengths = match self.schedule {
            Schedule::RunLength => Lengths::of_run(self.steps, self.strategy),
            Schedule::Classic => Lengths::CLASSIC,
        };
        let is_open = |field: &str| !given.contains(field);
        if is_open("sh_every") {
            self.sh_every = lengths.sh_every;
        }
        if is_open("refine_start") {
            self.refine_start = lengths.refine_start;
        }
        if is_open("refine_every") {
            self.refine_every = lengths.refine_every;
        }
        if is_open("refine_stop") {
            self.refine_stop = lengths.refine_stop;
        }
        if is_open("means_lr") {
            self.means_lr = lengths.means_lr;
        }
        if is_open("scales_lr") {
            self.scales_lr = lengths.scales_lr;
        }
        if is_open("shn_lr") {
            self.shn_lr = lengths.shn_lr;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densify::strategy::StrategyName;

    fn of_flags(keys: &TrainOverrides) -> TrainConfig {
        TrainConfig::of_new_run(None, keys).unwrap_or_default()
    }

    #[test]
    fn the_classic_values_are_the_defaults() {
        let classic = TrainOverrides { schedule: Some(Schedule::Classic), ..TrainOverrides::default() };
        let want = TrainConfig { schedule: Schedule::Classic, ..TrainConfig::default() };
        assert_eq!(of_flags(&classic), want);
        let short = TrainOverrides { steps: Some(3000), ..classic };
        assert_eq!(of_flags(&short), TrainConfig { steps: 3000, ..want });
        assert_eq!(of_flags(&TrainOverrides::default()), TrainConfig::default(), "30,000 steps are the default");
    }

    #[test]
    fn the_strategy_long_axis_has_faster_rates_in_short_runs() {
        let long =
            TrainOverrides { steps: Some(3000), strategy: Some(StrategyName::LongAxis), ..TrainOverrides::default() };
        let rates = |keys: &TrainOverrides| {
            let TrainConfig { scales_lr, shn_lr, .. } = of_flags(keys);
            [scales_lr, shn_lr]
        };
        let TrainConfig { scales_lr, shn_lr, .. } = TrainConfig::default();
        assert_eq!(rates(&long), [3.0 * scales_lr, 3.0 * shn_lr]);
        assert_eq!(rates(&TrainOverrides { scales_lr: Some(1e-3), ..long.clone() }), [1e-3, 3.0 * shn_lr]);
        let same = [scales_lr, shn_lr];
        assert_eq!(rates(&TrainOverrides { schedule: Some(Schedule::Classic), ..long.clone() }), same);
        assert_eq!(rates(&TrainOverrides { strategy: Some(StrategyName::Default), ..long }), same);
    }

    #[test]
    fn poor_points_set_what_is_not_given() {
        let poor = TrainOverrides { steps: Some(3000), poor_points: Some(true), ..TrainOverrides::default() };
        let config = of_flags(&poor);
        assert!((config.means_lr - 3.2e-3).abs() < 1e-9, "{}", config.means_lr);
        assert_eq!((config.init_scale, config.recycle, config.growth_score), (2.0, 0.05, GrowthScore::Mixed));
        let given = TrainOverrides { means_lr: Some(1e-4), recycle: Some(0.0), ..poor };
        let config = of_flags(&given);
        assert_eq!((config.means_lr, config.init_scale, config.recycle), (1e-4, 2.0, 0.0));
    }

    #[test]
    fn flags_are_left_alone() {
        let keys = TrainOverrides { steps: Some(3000), sh_every: Some(1000), ..TrainOverrides::default() };
        let config = of_flags(&keys);
        assert_eq!((config.sh_every, config.refine_stop, config.reset_every), (1000, 2400, 3000));
        let shortest = TrainOverrides { steps: Some(1), ..TrainOverrides::default() };
        assert!(of_flags(&shortest).check().is_ok());
    }

    #[test]
    fn keys_of_a_file_are_given() {
        let parsed = TrainConfig::parse_with_keys("steps = 3000\nmeans-lr = 1.6e-4\n[resolved]\nrefine-stop = 1\n");
        let (mut config, given) = parsed.unwrap_or_default();
        config.follow_length(&given);
        assert_eq!((config.means_lr, config.sh_every, config.refine_stop), (1.6e-4, 300, 2400));
    }
}
