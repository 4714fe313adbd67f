//! The config of a new run. Flags override the config file, which overrides the defaults. The length of the run sets some
//! of the keys that neither gives, and `poor-points` some more.
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
//! Invariants: 1. a given key is never changed, unless photos are few and it has the value that the length of the run gives; 2. the
//! result is written to the config of the run as if every key had been given, so a resumed run keeps its values whatever its new
//! length; 3. at 30,000 steps and more every value but `others-lr-final` is the default; 4. no value jumps between lengths.

use super::file::{TrainConfig, TrainOverrides};
use crate::base::error::InputResult;
use crate::config::values::{Chosen, Schedule};
use crate::densify::long_axis::GrowthScore;
use crate::densify::strategy::StrategyName;
use crate::optim::method::OptimizerPlace;
use crate::photos::diagnosis::Remedies;
use std::collections::BTreeSet;
use std::path::Path;

/// A key of the schedule: its field, and its place in a config.
type LengthKey<T> = (&'static str, fn(&mut TrainConfig) -> &mut T);

/// The keys of the schedule that count steps.
const STEP_KEYS: [LengthKey<u32>; 4] = [
    ("sh_every", |config| &mut config.sh_every),
    ("refine_start", |config| &mut config.refine_start),
    ("refine_every", |config| &mut config.refine_every),
    ("refine_stop", |config| &mut config.refine_stop),
];
const RATE_KEYS: [LengthKey<f64>; 5] = [
    ("means_lr", |config| &mut config.means_lr),
    ("scales_lr", |config| &mut config.scales_lr),
    ("quats_lr", |config| &mut config.quats_lr),
    ("shn_lr", |config| &mut config.shn_lr),
    ("others_lr_final", |config| &mut config.others_lr_final),
];
/// Steps for which the defaults were made.
const CLASSIC_STEPS: u32 = 30_000;
/// Largest factor of a learning rate.
const RATE_FACTOR_MOST: f64 = 3.0;
/// Fraction of the rates that is left at the end of a run of the strategy `long-axis`.
const SETTLED: f64 = 0.1;
/// Fewest steps between rounds that follow from the number of steps.
const REFINE_EVERY_LEAST: u32 = 10;
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

/// The config of a new run, not checked yet. Errors: the file cannot be read.
pub fn of_new_run(file: Option<&Path>, keys: &TrainOverrides) -> InputResult<TrainConfig> {
    let (mut config, given) = with_given(file, keys)?;
    set_open_keys(&mut config, &given);
    Ok(config)
}

/// As [`of_new_run`], of the given keys. Errors: a key or a word is unknown.
pub fn of_given(keys: toml::Table) -> Result<TrainConfig, String> {
    let given = keys.keys().map(|key| key.replace('-', "_")).collect();
    let mut config = TrainConfig::from_table(keys, |_| String::new())?;
    set_open_keys(&mut config, &given);
    Ok(config)
}

/// The keys that a config file and flags give. Errors: the file cannot be read.
pub fn given_keys(file: Option<&Path>, keys: &TrainOverrides) -> InputResult<toml::Table> {
    let (config, given) = with_given(file, keys)?;
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

/// Sets the keys that the length of the run and `poor-points` decide, but for those in `given` (names of fields). The values of
/// `poor-points` were chosen by the PSNR of held-out photos of two scenes with a tenth of their points and with random ones, see
/// "Few or random points" in `benches/RESULTS.md`.
fn set_open_keys(config: &mut TrainConfig, given: &BTreeSet<String>) {
    let mut of_length = with_lengths(config, config.steps);
    set_keys(&STEP_KEYS, config, &mut of_length, |(field, _), _| !given.contains(*field));
    set_keys(&RATE_KEYS, config, &mut of_length, |(field, _), _| !given.contains(*field));
    if config.poor_points.is_on() {
        set_poor_keys(config, |field| !given.contains(field));
    }
}

/// Sets those of the keys of `poor-points` that are open, by the names of their fields.
fn set_poor_keys(config: &mut TrainConfig, is_open: impl Fn(&str) -> bool) {
    if is_open("means_lr") {
        config.means_lr *= POOR_MEANS_LR;
    }
    if is_open("init_scale") {
        config.init_scale = POOR_INIT_SCALE;
    }
    if is_open("recycle") {
        config.recycle = POOR_RECYCLE;
    }
    if is_open("growth_score") {
        config.growth_score = GrowthScore::Mixed;
    }
}

/// Gives the open ones of these keys their values in `from`.
fn set_keys<T: Copy>(
    keys: &[LengthKey<T>],
    config: &mut TrainConfig,
    from: &mut TrainConfig,
    mut is_open: impl FnMut(&LengthKey<T>, &mut TrainConfig) -> bool,
) {
    for key in keys {
        if is_open(key, config) {
            *key.1(config) = *key.1(from);
        }
    }
}

/// The config with the values that the keys of the schedule have in a run of this many steps.
fn with_lengths(config: &TrainConfig, steps: u32) -> TrainConfig {
    let classic = TrainConfig::default();
    let follows = config.schedule == Schedule::RunLength;
    let (share, factor) = match follows {
        true => (steps, (f64::from(CLASSIC_STEPS) / f64::from(steps.max(1))).sqrt().clamp(1.0, RATE_FACTOR_MOST)),
        false => (u32::MAX, 1.0),
    };
    let (of_strategy, others_lr_final) = match follows && config.strategy == StrategyName::LongAxis {
        true => (factor, SETTLED),
        false => (1.0, classic.others_lr_final),
    };
    TrainConfig {
        steps,
        sh_every: (share / 10).clamp(1, classic.sh_every),
        refine_start: (share / 6).min(classic.refine_start),
        refine_every: (share / 30).clamp(REFINE_EVERY_LEAST, classic.refine_every),
        refine_stop: (u64::from(share) * 4 / 5).min(u64::from(classic.refine_stop)) as u32,
        means_lr: classic.means_lr * factor,
        scales_lr: classic.scales_lr * of_strategy,
        quats_lr: classic.quats_lr * of_strategy,
        shn_lr: classic.shn_lr * of_strategy,
        others_lr_final,
        ..config.clone()
    }
}

/// Ends the schedule of a run with the strategy `long-axis` after 150 steps for each of its training photos, unless
/// `schedule-steps` is given or `schedule` is classic: further steps at full rates would fit the noise of few photos. A key
/// that has its value by the length of the run gets the one by the length of the schedule. Returns the steps of the schedule
/// if it ends before the run.
pub fn adapt_schedule(config: &mut TrainConfig, photos: usize) -> Option<u32> {
    let steps = (photos as u64).saturating_mul(PHOTO_STEPS_MOST).max(1);
    let follows_length = config.schedule == Schedule::RunLength && config.strategy == StrategyName::LongAxis;
    if !follows_length || config.schedule_steps != 0 || steps >= u64::from(config.steps) {
        return None;
    }
    config.schedule_steps = steps as u32;
    // As if no key was given.
    let of_length = |steps: u32| {
        let mut all = TrainConfig { steps, ..config.clone() };
        set_open_keys(&mut all, &BTreeSet::new());
        all
    };
    let (mut of_run, mut of_schedule) = (of_length(config.steps), of_length(config.schedule_steps));
    of_schedule.others_lr_final = STILL;
    set_keys(&STEP_KEYS, config, &mut of_schedule, |(_, place), config| *place(config) == *place(&mut of_run));
    set_keys(&RATE_KEYS, config, &mut of_schedule, |(_, place), config| *place(config) == *place(&mut of_run));
    Some(config.schedule_steps)
}

/// Switches on what the photos ask for and the config leaves open, and switches the rest of what it leaves open off.
pub fn adapt_to_photos(config: &mut TrainConfig, asked: &Remedies) {
    let is_on_host = config.optimizer_on != Chosen(Some(OptimizerPlace::Device));
    let grows_by_score = config.strategy == StrategyName::LongAxis && is_on_host;
    // Without a cap, a run grows to the count that its photos need, and these keys cost decibels.
    let is_capped = config.max_gaussians > 0;
    if config.poor_points.0.is_none() && asked.poor_points && grows_by_score && is_capped {
        // As if no key was given.
        let mut usual = config.clone();
        set_open_keys(&mut usual, &BTreeSet::new());
        let given = config.clone();
        set_poor_keys(config, |field| match field {
            "means_lr" => given.means_lr == usual.means_lr,
            "init_scale" => given.init_scale == usual.init_scale,
            "recycle" => given.recycle == usual.recycle,
            _ => given.growth_score == usual.growth_score,
        });
        config.poor_points = Chosen::ON;
    }
    config.poor_points.0.get_or_insert(false);
    config.sweep_points.0.get_or_insert(asked.sweep_points);
    config.appearance.0.get_or_insert(asked.appearance);
    config.robust_views.0.get_or_insert(asked.robust_views);
    if !asked.judge_pixels {
        config.robust_pixels.0.get_or_insert(false);
    }
    config.refine_poses.0.get_or_insert(asked.refine_poses && is_on_host);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::limits::RunOptions;

    fn of_flags(keys: &TrainOverrides) -> TrainConfig {
        of_new_run(None, keys).unwrap_or_default()
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
            (adapt_schedule(&mut config, 200), adapt_schedule(&mut config, usize::MAX)),
            (None, None),
            "150 steps a photo or fewer"
        );
        assert_eq!(config, before);
        assert_eq!(adapt_schedule(&mut config, 28), Some(4200));
        let short = with_lengths(&TrainConfig::default(), 4200);
        assert_eq!((config.steps, config.schedule_steps, config.refine_stop), (30_000, 4200, short.refine_stop));
        assert_eq!((config.scales_lr, config.means_lr, config.refine_every), (short.scales_lr, 1e-4, 50));
        assert_eq!(RunOptions::new(&config, 1.0).photos.steps, 4200, "what is known of photos keeps its phases, too");
        let leg = TrainConfig { steps: 2000, ..config.clone() };
        assert_eq!(RunOptions::new(&leg, 1.0).photos.steps, 4200, "in a run of fewer steps, too");
        assert_eq!(config.others_lr_final, 0.01);
        // Few photos and poor points: both factors of the rate of positions hold.
        let poor = TrainOverrides { poor_points: Some(Chosen::ON), ..TrainOverrides::default() };
        let mut of_both = of_flags(&poor);
        assert_eq!(adapt_schedule(&mut of_both, 28), Some(4200));
        assert!((of_both.means_lr / (short.means_lr * POOR_MEANS_LR) - 1.0).abs() < 1e-12, "{}", of_both.means_lr);
        assert!(adapt_schedule(&mut config, 5).is_none() && config.check().is_ok(), "its schedule is given now");
        for keys in [
            TrainOverrides { schedule_steps: Some(30_000), ..keys.clone() },
            TrainOverrides { schedule: Some(Schedule::Classic), ..keys.clone() },
            TrainOverrides { strategy: Some(StrategyName::Default), ..keys },
        ] {
            let mut config = of_flags(&keys);
            assert_eq!((adapt_schedule(&mut config, 28), config == of_flags(&keys)), (None, true));
        }
    }

    #[test]
    fn poor_points_set_what_is_not_given() {
        let poor = TrainOverrides { steps: Some(3000), poor_points: Some(Chosen::ON), ..TrainOverrides::default() };
        let config = of_flags(&poor);
        assert!((config.means_lr - 3.2e-3).abs() < 1e-9, "{}", config.means_lr);
        assert_eq!((config.init_scale, config.recycle, config.growth_score), (2.0, 0.05, GrowthScore::Mixed));
        let given = TrainOverrides { means_lr: Some(1e-4), recycle: Some(0.0), ..poor };
        let config = of_flags(&given);
        assert_eq!((config.means_lr, config.init_scale, config.recycle), (1e-4, 2.0, 0.0));
    }

    #[test]
    fn poor_points_get_their_keys_by_themselves_where_the_count_is_capped() {
        let asked = Remedies { poor_points: true, ..Remedies::default() };
        for (max_gaussians, scale) in [(0, 1.0), (1000, POOR_INIT_SCALE)] {
            let mut config = TrainConfig { max_gaussians, ..TrainConfig::default() };
            adapt_to_photos(&mut config, &asked);
            assert_eq!((config.poor_points.is_on(), config.init_scale), (max_gaussians > 0, scale));
        }
    }

    #[test]
    fn keys_of_a_file_are_given() {
        let parsed = TrainConfig::parse_with_keys("steps = 3000\nmeans-lr = 1.6e-4\n[resolved]\nrefine-stop = 1\n");
        let (mut config, given) = parsed.unwrap_or_default();
        set_open_keys(&mut config, &given);
        assert_eq!((config.means_lr, config.sh_every, config.refine_stop), (1.6e-4, 300, 2400));
    }

    #[test]
    fn long_runs_keep_the_classic_values_and_short_runs_follow_their_length() {
        let of_run = |steps: u32, strategy| with_lengths(&TrainConfig { strategy, ..TrainConfig::default() }, steps);
        for steps in [30_000, 30_001, 200_000, u32::MAX] {
            for strategy in [StrategyName::Default, StrategyName::Mcmc, StrategyName::None] {
                assert_eq!(of_run(steps, strategy), TrainConfig { steps, strategy, ..TrainConfig::default() });
            }
            let settled = TrainConfig { steps, others_lr_final: 0.1, ..TrainConfig::default() };
            assert_eq!(of_run(steps, StrategyName::LongAxis), settled);
        }
        let TrainConfig { sh_every, refine_start, refine_every, refine_stop, means_lr, .. } =
            of_run(300, StrategyName::Default);
        assert_eq!((sh_every, refine_start, refine_every, refine_stop, means_lr), (30, 50, 10, 240, 3.0 * 1.6e-4));
    }

    #[test]
    fn nothing_jumps_between_lengths() {
        let mut last = with_lengths(&TrainConfig::default(), 1);
        for steps in (2..32_000).step_by(37) {
            let now = with_lengths(&TrainConfig::default(), steps);
            // 37 steps more move no length by more than that, and no rate by more than 1 %.
            let rates = |of: &TrainConfig| [of.means_lr, of.scales_lr, of.quats_lr, of.shn_lr];
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
