//! The config of a new run. Flags override the config file, which overrides the defaults. The length of the run sets some
//! of the keys that neither gives ([`super::schedule`]), and `poor-points` some more.
//!
//! Invariants: 1. a given key is never changed, unless photos are few and it has the value that the length of the run gives; 2. the
//! result is written to the config of the run as if every key had been given, so a resumed run keeps its values whatever its new
//! length.

use super::file::{TrainConfig, TrainOverrides};
use super::schedule::{Lengths, Schedule};
use crate::base::error::InputResult;
use crate::densify::long_axis::GrowthScore;
use crate::densify::strategy::StrategyName;
use std::collections::BTreeSet;
use std::path::Path;

/// A key of the schedule: its field, its place in a config, and its value in lengths.
type LengthKey<T> = (&'static str, fn(&mut TrainConfig) -> &mut T, fn(&Lengths) -> T);

/// The keys of the schedule that count steps.
const STEP_KEYS: [LengthKey<u32>; 4] = [
    ("sh_every", |config| &mut config.sh_every, |lengths| lengths.sh_every),
    ("refine_start", |config| &mut config.refine_start, |lengths| lengths.refine_start),
    ("refine_every", |config| &mut config.refine_every, |lengths| lengths.refine_every),
    ("refine_stop", |config| &mut config.refine_stop, |lengths| lengths.refine_stop),
];
/// The keys of the schedule that are rates.
const RATE_KEYS: [LengthKey<f64>; 5] = [
    ("means_lr", |config| &mut config.means_lr, |lengths| lengths.means_lr),
    ("scales_lr", |config| &mut config.scales_lr, |lengths| lengths.scales_lr),
    ("quats_lr", |config| &mut config.quats_lr, |lengths| lengths.quats_lr),
    ("shn_lr", |config| &mut config.shn_lr, |lengths| lengths.shn_lr),
    ("others_lr_final", |config| &mut config.others_lr_final, |lengths| lengths.others_lr_final),
];
/// Most steps of a schedule for each training photo. Held-out photos of a small scene are best after 100 to 200 steps a photo
/// (`benches/RESULTS.md`, "Long runs on a small scene").
const PHOTO_STEPS_MOST: u64 = 150;
/// The value of `others-lr-final` where a schedule ends before the run: the steps behind it shall hardly move anything.
const STILL: f64 = 0.01;

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
        let (mut config, given) = TrainConfig::with_given(file, keys)?;
        config.set_open_keys(&given);
        Ok(config)
    }

    /// As [`TrainConfig::of_new_run`], of the given keys.
    ///
    /// # Errors
    /// A key or a word is unknown.
    pub fn of_given(keys: toml::Table) -> Result<TrainConfig, String> {
        let given = keys.keys().map(|key| key.replace('-', "_")).collect();
        let mut config: TrainConfig = keys.try_into().map_err(|e: toml::de::Error| e.to_string())?;
        config.set_open_keys(&given);
        Ok(config)
    }

    /// The keys that a config file and flags give.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn given(file: Option<&Path>, keys: &TrainOverrides) -> InputResult<toml::Table> {
        let (config, given) = TrainConfig::with_given(file, keys)?;
        let all = toml::Table::try_from(&config).unwrap_or_default();
        Ok(all.into_iter().filter(|(key, _)| given.contains(&key.replace('-', "_"))).collect())
    }

    /// The keys of a config file and flags over the defaults, and the names of their fields.
    fn with_given(file: Option<&Path>, keys: &TrainOverrides) -> InputResult<(TrainConfig, BTreeSet<String>)> {
        let (mut config, mut given) = match file {
            Some(path) => TrainConfig::read_with_keys(path)?,
            None => (TrainConfig::default(), BTreeSet::new()),
        };
        given.extend(keys.given().into_iter().map(str::to_string));
        keys.clone().apply(&mut config);
        Ok((config, given))
    }

    /// Sets the keys that the length of the run and `poor-points` decide, but for those in `given` (names of fields).
    fn set_open_keys(&mut self, given: &BTreeSet<String>) {
        self.follow_length(given);
        if self.poor_points {
            self.adapt_to_poor_points(|field| !given.contains(field));
        }
    }

    /// Sets the fields of `poor-points` that are open. The values were chosen by the PSNR of held-out photos of two scenes with a tenth
    /// of their points and with random ones, see "Few or random points" in `benches/RESULTS.md`.
    pub fn adapt_to_poor_points(&mut self, is_open: impl Fn(&str) -> bool) {
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
        self.set_lengths(&lengths, |field| !given.contains(field));
    }

    /// Ends the schedule of a run with the strategy `long-axis` after 150 steps for each of its training photos, unless
    /// `schedule-steps` is given or `schedule` is classic: further steps at full rates would fit the noise of few photos. A key
    /// that has its value by the length of the run gets the one by the length of the schedule. Returns the steps of the schedule
    /// if it ends before the run.
    pub fn adapt_schedule(&mut self, photos: usize) -> Option<u32> {
        let steps = (photos as u64).saturating_mul(PHOTO_STEPS_MOST).max(1);
        let follows_length = self.schedule == Schedule::RunLength && self.strategy == StrategyName::LongAxis;
        if !follows_length || self.schedule_steps != 0 || steps >= u64::from(self.steps) {
            return None;
        }
        self.schedule_steps = steps as u32;
        let mut of_run = self.of_length(self.steps);
        let mut of_schedule = TrainConfig { others_lr_final: STILL, ..self.of_length(self.schedule_steps) };
        self.exchange(&STEP_KEYS, &mut of_run, &mut of_schedule);
        self.exchange(&RATE_KEYS, &mut of_run, &mut of_schedule);
        Some(self.schedule_steps)
    }

    /// Gives the keys that have their values as in `old` those of `new`.
    fn exchange<T: PartialEq + Copy>(&mut self, keys: &[LengthKey<T>], old: &mut TrainConfig, new: &mut TrainConfig) {
        for (_, place, _) in keys {
            if *place(self) == *place(old) {
                *place(self) = *place(new);
            }
        }
    }

    /// A config of this strategy and this many steps in which no key of the schedule is given.
    fn of_length(&self, steps: u32) -> TrainConfig {
        let mut config = TrainConfig { steps, ..self.clone() };
        config.follow_length(&BTreeSet::new());
        if config.poor_points {
            config.adapt_to_poor_points(|_| true);
        }
        config
    }

    /// Sets the keys of the schedule whose fields are open.
    fn set_lengths(&mut self, lengths: &Lengths, is_open: impl Fn(&str) -> bool) {
        for (_, place, value) in STEP_KEYS.iter().filter(|(field, ..)| is_open(field)) {
            *place(self) = value(lengths);
        }
        for (_, place, value) in RATE_KEYS.iter().filter(|(field, ..)| is_open(field)) {
            *place(self) = value(lengths);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let settled = TrainConfig { others_lr_final: 0.1, ..TrainConfig::default() };
        assert_eq!(of_flags(&TrainOverrides::default()), settled, "30,000 steps are the default");
    }

    #[test]
    fn the_strategy_long_axis_has_faster_rates_in_short_runs_that_settle() {
        let long =
            TrainOverrides { steps: Some(3000), strategy: Some(StrategyName::LongAxis), ..TrainOverrides::default() };
        let rates = |keys: &TrainOverrides| {
            let TrainConfig { scales_lr, quats_lr, shn_lr, others_lr_final, .. } = of_flags(keys);
            [scales_lr, quats_lr, shn_lr, others_lr_final]
        };
        let TrainConfig { scales_lr, quats_lr, shn_lr, others_lr_final, .. } = TrainConfig::default();
        assert_eq!(rates(&long), [3.0 * scales_lr, 3.0 * quats_lr, 3.0 * shn_lr, 0.1]);
        let given = TrainOverrides { scales_lr: Some(1e-3), others_lr_final: Some(0.5), ..long.clone() };
        assert_eq!(rates(&given), [1e-3, 3.0 * quats_lr, 3.0 * shn_lr, 0.5]);
        let same = [scales_lr, quats_lr, shn_lr, others_lr_final];
        assert_eq!(rates(&TrainOverrides { schedule: Some(Schedule::Classic), ..long.clone() }), same);
        assert_eq!(rates(&TrainOverrides { strategy: Some(StrategyName::Default), ..long }), same);
    }

    #[test]
    fn few_photos_end_the_schedule_before_the_run() {
        let keys = TrainOverrides { means_lr: Some(1e-4), refine_every: Some(50), ..TrainOverrides::default() };
        let (before, mut config) = (of_flags(&keys), of_flags(&keys));
        assert_eq!(
            (config.adapt_schedule(200), config.adapt_schedule(usize::MAX)),
            (None, None),
            "150 steps a photo or fewer"
        );
        assert_eq!(config, before);
        assert_eq!(config.adapt_schedule(28), Some(4200));
        let short = Lengths::of_run(4200, StrategyName::LongAxis);
        assert_eq!((config.steps, config.schedule_steps, config.refine_stop), (30_000, 4200, short.refine_stop));
        assert_eq!((config.scales_lr, config.means_lr, config.refine_every), (short.scales_lr, 1e-4, 50));
        assert_eq!(config.others_lr_final, 0.01);
        // Few photos and poor points: both factors of the rate of positions hold.
        let poor = TrainOverrides { poor_points: Some(true), ..TrainOverrides::default() };
        let mut of_both = of_flags(&poor);
        assert_eq!(of_both.adapt_schedule(28), Some(4200));
        assert!((of_both.means_lr / (short.means_lr * POOR_MEANS_LR) - 1.0).abs() < 1e-12, "{}", of_both.means_lr);
        assert!(config.adapt_schedule(5).is_none() && config.check().is_ok(), "its schedule is given now");
        for keys in [
            TrainOverrides { schedule_steps: Some(30_000), ..keys.clone() },
            TrainOverrides { schedule: Some(Schedule::Classic), ..keys.clone() },
            TrainOverrides { strategy: Some(StrategyName::Default), ..keys },
        ] {
            let mut config = of_flags(&keys);
            assert_eq!((config.adapt_schedule(28), config == of_flags(&keys)), (None, true));
        }
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
