//! The number of Gaussians, where the run decides it: growth in stages, as long as more Gaussians pay.
//!
//! A few training views are held out while the scene may grow. Before a round, each of them is drawn with all Gaussians, and
//! without the quarter of the drawn ones that have the least blending weight in it. Where Gaussians are scarce even the
//! faintest carry detail, and the view loses decibels; where they abound, neighbours hide what a removed one leaves. The more
//! decibels the held-out views lose, the more the next doubling brings.
//!
//! What counts as a loss that pays grows with the steps, since an untrained scene loses little whatever its count. The last check
//! comes soon after the first, because Gaussians that come later bring less. A stage of growth is mostly whole doublings: where only
//! the rows of the largest scores were split, the faintest rows of a view would be the children of the most important ones.
//! `benches/RESULTS.md` has the measurements, `benches/TRIED.md` what failed.
//!
//! A loss below the price can mean two things: in a scene of few points, or of few steps a photo, every doubling pays; in others
//! growth only fits noise, and training views come out much better than held-out ones. A scene without that gap doubles on
//! trial, unless `--quality draft` is set. Each further check doubles it again, if the gap is still small or the held-out views gained.
//! Otherwise it undoes the last doubling: the rows of least weight go ([`super::long_axis`]). The last check begins no trial,
//! since no check would judge it.
//!
//! Not here: how the loss is measured (`train::state::growth_checks`), which views are held out (`train::state::turns`).
//!
//! Invariants: 1. a decision is a function of the step, the loss and the earlier decisions, which are part of commits; 2.
//! the allowed number falls only by a doubling that was on trial, and never below the first number.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The value of `--quality`: how much a doubling of the Gaussians must bring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// Few Gaussians.
    Draft,
    Normal,
    /// Many Gaussians.
    Archive,
}

impl Quality {
    /// The loss from which growth pays in a run of up to [`UNIT_MOST`] steps, as a multiple of that in [`CHECKS`]. A scene with
    /// twice the Gaussians loses about half as much.
    ///
    /// Normal is chosen for at most 12 % of the Gaussians that gsplat's rule makes without a cap, with at least its PSNR, and draft
    /// for 8 %. With normal, scenes stop where the next doubling brings about .7 dB, or less (`benches/RESULTS.md`).
    fn price(self) -> f64 {
        match self {
            Quality::Draft => 6.0,
            Quality::Normal => 4.0,
            Quality::Archive => 0.4,
        }
    }
}

/// The checks: at which share of [`GrowthRule::unit`] a check is due, and a loss in decibels. Scenes of small photos have these
/// losses where the next doubling brings one to two tenths of a decibel.
const CHECKS: [[f64; 2]; 4] = [[1.0 / 3.0, 0.07], [0.4, 0.16], [1.4 / 3.0, 0.24], [1.6 / 3.0, 0.30]];
/// Longest unit, steps. In a longer run the losses of a scene tell its count after as many steps as in a run of this
/// length.
const UNIT_MOST: u32 = 3000;
/// Most by which the price of a run longer than [`UNIT_MOST`] falls. A run of twice the steps trains more Gaussians, and its rates are
/// lower, so that the scene loses less at a check: sheffield_cross .34 dB in a run of 7,000 steps, about .5 dB in one of 3,000.
const LONGER_MOST: f64 = 2.5;
/// Most doublings of one stage, which is the number of rounds between two checks.
const DOUBLINGS_MOST: f64 = 2.0;

/// Decibels by which training views may be better than held-out ones for a trial. Measured: .2 to 1.2 in scenes where doublings pay, 2.3
/// to 5.9 where they fit noise.
const TRIAL_GAP: f64 = 1.7;
/// Decibels that the held-out views must gain from a trial to the next check where the gap is larger, or the trial is undone. Measured:
/// .7 to 1.2 where doublings pay, -.2 where they fit noise.
const TRIAL_GAIN: f64 = 0.15;

/// The rule of a run that decides its count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrowthRule {
    /// How much a doubling must bring.
    quality: Quality,
    /// The loss from which growth pays, as a multiple of that in [`CHECKS`].
    price: f64,
    /// Steps to which the shares of the checks refer.
    unit: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GrowthCheck {
    /// Steps done.
    pub step: u32,
    /// Upper bound of the Gaussians then.
    pub gaussians: u64,
    /// PSNR of the held-out views, dB: the mean over the views.
    pub psnr: f64,
    /// PSNR of as many views that are trained on, likewise.
    pub trained_psnr: f64,
    /// Decibels that a held-out view loses without its faintest quarter: the mean over the views.
    pub lost: f64,
    pub pays_from: f64,
    /// Whether the scene doubles on trial, although the loss does not pay.
    pub is_trial: bool,
    pub allowed: u64,
}

/// What a check measures, dB: means over views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrowthValues {
    /// PSNR of the held-out views.
    pub psnr: f64,
    pub trained_psnr: f64,
    /// Loss of the held-out views without their faintest quarter.
    pub lost: f64,
}

/// The state of the decision about the count.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GrowthState {
    /// Gaussians before the first event; 0 before that, and in runs that do not decide.
    pub first: u64,
    /// The checks so far, in order.
    pub checks: Vec<GrowthCheck>,
}

impl GrowthState {
    pub fn allowed(&self) -> u64 {
        self.checks.last().map_or(self.first, |last| last.allowed)
    }

    /// What a commit cannot hold.
    /// Errors: the checks are out of order, lie beyond `steps_done`, or hold a value that is not finite.
    pub fn check(&self, steps_done: u32) -> Result<(), &'static str> {
        let are_finite = |c: &GrowthCheck| [c.psnr, c.trained_psnr, c.lost, c.pays_from].iter().all(|x| x.is_finite());
        let is_sound = |c: &GrowthCheck| are_finite(c) && c.step <= steps_done;
        let follows = |pair: &[GrowthCheck]| {
            pair[0].step < pair[1].step && (pair[0].allowed <= pair[1].allowed || pair[0].is_trial)
        };
        let is_enough = self.checks.iter().all(|check| check.allowed >= self.first);
        if is_enough && self.checks.iter().all(is_sound) && self.checks.windows(2).all(follows) {
            return Ok(());
        }
        Err("the checks of its growth are invalid")
    }
}

impl GrowthCheck {
    pub fn grows(&self) -> bool {
        self.is_trial || self.lost > self.pays_from
    }
}

/// One line of a terminal.
impl fmt::Display for GrowthCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let GrowthCheck { step, psnr, lost, pays_from, is_trial, allowed, .. } = self;
        if *is_trial {
            return write!(f, "step {step}: Gaussians up to {allowed} on trial; held-out photos have {psnr:.2} dB");
        }
        let (what, against) = if self.grows() { ("up to", "more") } else { ("stay at", "less") };
        write!(
            f,
            "step {step}: Gaussians {what} {allowed}: a faint quarter adds {lost:.3} dB, {against} than {pays_from:.3}"
        )
    }
}

impl GrowthRule {
    /// The rule of a run that is planned for this many steps.
    pub fn new(quality: Quality, steps: u32) -> GrowthRule {
        let longer = f64::from(steps) / f64::from(UNIT_MOST);
        let price = quality.price() / longer.clamp(1.0, LONGER_MOST);
        GrowthRule { quality, price, unit: steps.clamp(1, UNIT_MOST) }
    }

    /// The number of the check after `step`: the last one that fell due since the step before at which a check was possible,
    /// `before`.
    pub fn due(&self, before: Option<u32>, step: u32) -> Option<usize> {
        let is_past = |step: u32, share: f64| f64::from(step) >= share * f64::from(self.unit);
        (0..CHECKS.len()).rfind(|&number| {
            let [share, _] = CHECKS[number];
            is_past(step, share) && !before.is_some_and(|before| is_past(before, share))
        })
    }

    pub fn check_steps(&self) -> [u32; 2] {
        [CHECKS[0], CHECKS[CHECKS.len() - 1]].map(|[share, _]| (share * f64::from(self.unit)) as u32)
    }

    /// Whether a check may still come after this step or a later one.
    pub fn is_open(&self, step: u32, refine_every: u32) -> bool {
        let [last, _] = CHECKS[CHECKS.len() - 1];
        f64::from(step) < last * f64::from(self.unit) + f64::from(refine_every)
    }

    /// The check `number` after this step of a scene of at most `gaussians` Gaussians. `before` has the checks so far.
    pub fn check(
        &self,
        (number, step): (usize, u32),
        gaussians: u64,
        GrowthValues { psnr, trained_psnr, lost }: GrowthValues,
        before: &GrowthState,
    ) -> GrowthCheck {
        let pays_from = self.price * CHECKS[number][1];
        let trial = before.checks.last().filter(|last| last.is_trial);
        let may_pay = trained_psnr - psnr < TRIAL_GAP || trial.is_some_and(|trial| psnr > trial.psnr + TRIAL_GAIN);
        let pays = lost > pays_from;
        let is_open = self.quality != Quality::Draft && (before.checks.is_empty() || trial.is_some());
        let is_trial = !pays && may_pay && is_open && number + 1 < CHECKS.len();
        let allowed = if pays {
            let doublings = libm::log2(lost / pays_from).min(DOUBLINGS_MOST);
            (before.allowed() as f64 * libm::exp2(doublings)) as u64
        } else if is_trial {
            before.allowed().saturating_mul(2)
        } else if trial.is_some() && !may_pay {
            // What was allowed before the trial.
            before.checks.iter().rev().nth(1).map_or(before.first, |check| check.allowed)
        } else {
            before.allowed()
        };
        GrowthCheck { step: step + 1, gaussians, psnr, trained_psnr, lost, pays_from, is_trial, allowed }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// PSNR and loss of held-out views, where training views are far better.
    fn values([psnr, lost]: [f64; 2]) -> GrowthValues {
        GrowthValues { psnr, trained_psnr: psnr + 2.0 * TRIAL_GAP, lost }
    }

    /// The steps and numbers of the checks of a run with rounds every `every` steps from `start` on.
    fn checks(rule: &GrowthRule, start: u32, every: u32) -> Vec<(u32, usize)> {
        let rounds: Vec<u32> = (start..40_000).filter(|step| step.is_multiple_of(every)).collect();
        let due = |(i, &step): (usize, &u32)| {
            rule.due(i.checked_sub(1).map(|before| rounds[before]), step).map(|n| (step, n))
        };
        rounds.iter().enumerate().filter_map(due).collect()
    }

    #[test]
    fn checks_come_with_the_rounds_and_end_soon() {
        for (steps, unit) in [(1500, 1500), (3000, 3000), (30_000, 3000), (200_000, 3000)] {
            let rule = GrowthRule::new(Quality::Normal, steps);
            let every = unit / 30;
            let due = [10, 12, 14, 16].map(|rounds| rounds * every);
            assert_eq!(checks(&rule, 6 * every, every), due.into_iter().zip(0..).collect::<Vec<_>>());
            assert!(rule.is_open(due[3], every) && !rule.is_open(due[3] + every, every));
        }
        // A run whose rounds begin late has the last check with the first round; one with few rounds skips checks.
        let rule = GrowthRule::new(Quality::Normal, 3000);
        assert_eq!(checks(&rule, 2000, 100), [(2000, 3)]);
        assert_eq!(checks(&rule, 600, 500), [(1000, 0), (1500, 2), (2000, 3)]);
    }

    #[test]
    fn a_scene_grows_by_stages_while_it_loses_more_than_pays() {
        let rule = GrowthRule::new(Quality::Normal, 3000);
        let pays = Quality::Normal.price() * CHECKS[1][1];
        let of = |first, checks: &[GrowthCheck]| GrowthState { first, checks: checks.to_vec() };
        let first = |lost: f64| rule.check((1, 1200), 990, values([20.0, lost]), &of(1000, &[]));
        assert_eq!(
            (first(0.9 * pays).allowed, first(-1.0).allowed, first(f64::NEG_INFINITY).allowed),
            (1000, 1000, 1000)
        );
        assert!(!first(0.9 * pays).grows() && first(1.5 * pays).grows() && !first(1.5 * pays).is_trial);
        // Twice the loss that pays: one doubling.
        assert_eq!((first(2.0 * pays).allowed, first(100.0 * pays).allowed), (2000, 4000));
        assert!((1499..=1500).contains(&first(1.5 * pays).allowed));
        let second = rule.check((2, 1400), 3900, values([30.0, 0.0]), &of(1000, &[first(4.0 * pays)]));
        assert_eq!((second.step, second.gaussians, second.allowed), (1401, 3900, 4000));
        let sound = of(1000, &[first(4.0 * pays), second]);
        assert_eq!((sound.allowed(), GrowthState { first: 7, ..GrowthState::default() }.allowed()), (4000, 7));
        assert!(sound.check(1401).is_ok() && sound.check(1400).is_err());
        for wrong in [
            of(5000, &[first(4.0 * pays), second]),
            of(1000, &[second, first(0.0)]),
            of(1000, &[first(4.0 * pays), GrowthCheck { allowed: 2000, ..second }]),
            of(1000, &[first(0.5 * pays), GrowthCheck { allowed: 999, ..second }]),
            of(1000, &[first(f64::NAN), second]),
        ] {
            assert!(wrong.check(1401).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn the_price_says_how_far_a_scene_grows() {
        let state = GrowthState { first: 41_321, checks: Vec::new() };
        let of = |quality, lost| {
            GrowthRule::new(quality, 3000).check((0, 1000), 41_321, values([25.0, lost]), &state).allowed
        };
        let each = |lost| [Quality::Draft, Quality::Normal, Quality::Archive].map(|quality| of(quality, lost));
        // The losses of sheffield_cross, brighton and seneca, with photos of about 395 pixels, after 1,000 steps.
        let [draft, normal, archive] = each(0.4387);
        assert!((41_321..45_000).contains(&draft) && (64_000..66_000).contains(&normal), "{draft}, {normal}");
        assert!((165_283..=165_284).contains(&archive), "four times as many at most: {archive}");
        // Below the price, brighton and seneca keep their number; archive has a lower one.
        assert_eq!((each(0.0684)[..2].to_vec(), each(0.0146)), (vec![41_321; 2], [41_321; 3]));
    }

    #[test]
    fn the_price_falls_with_the_steps_of_long_runs() {
        let state = GrowthState { first: 41_321, checks: Vec::new() };
        let of = |steps, lost| {
            GrowthRule::new(Quality::Normal, steps).check((0, 1000), 41_321, values([25.0, lost]), &state).pays_from
        };
        let pays = Quality::Normal.price() * CHECKS[0][1];
        for (steps, want) in [(300, pays), (3000, pays), (6000, pays / 2.0), (7500, pays / 2.5), (30_000, pays / 2.5)] {
            assert!((of(steps, 0.3) / want - 1.0).abs() < 1e-12, "{steps} steps");
        }
        // The loss of brighton, whose doublings fit noise, is below the price at any length.
        assert!(of(u32::MAX, 0.0) > 0.0684);
    }

    /// What each of four checks allows, and whether it begins a trial: of PSNR of held-out and of trained views, and losses.
    fn decisions(first: u64, of_checks: [[f64; 3]; 4]) -> Vec<(u64, bool)> {
        let rule = GrowthRule::new(Quality::Normal, 3000);
        let mut state = GrowthState { first, checks: Vec::new() };
        for (number, [psnr, trained_psnr, lost]) in of_checks.into_iter().enumerate() {
            let measured = GrowthValues { psnr, trained_psnr, lost };
            let check = rule.check((number, 1000 + 200 * number as u32), state.allowed(), measured, &state);
            state.checks.push(check);
            assert_eq!(state.check(2000), Ok(()));
        }
        state.checks.iter().map(|check| (check.allowed, check.is_trial)).collect()
    }

    #[test]
    fn doublings_on_trial_go_on_while_held_out_views_keep_up_and_are_undone_otherwise() {
        // As measured: the demo city, two cities of 100 photos with few points and of 600 with few steps each, brighton, seneca.
        let demo = [[22.71, 22.96, 0.111], [23.43, 23.56, 0.033], [24.15, 24.36, 0.002], [25.34, 25.97, -0.004]];
        let few_points = [[20.04, 21.19, 0.024], [20.44, 22.03, 0.024], [21.55, 23.41, 0.009], [22.39, 24.43, 0.003]];
        let few_steps = [[18.93, 19.08, 0.002], [18.41, 18.70, 0.0], [18.73, 18.88, 0.0], [18.75, 19.00, 0.0]];
        for of_scene in [demo, few_points, few_steps] {
            // No check would judge a trial that the last one begins.
            let doubled = [(40_000, true), (80_000, true), (160_000, true), (160_000, false)];
            assert_eq!(decisions(20_000, of_scene), doubled);
        }
        let brighton = [[18.39, 20.74, 0.064], [18.28, 21.05, 0.081], [18.29, 21.28, 0.096], [18.22, 21.40, 0.101]];
        let seneca = [[22.98, 25.57, 0.020], [23.81, 26.78, 0.012], [24.06, 27.58, 0.031], [24.35, 28.49, 0.052]];
        assert_eq!(
            [decisions(7395, brighton), decisions(7395, seneca)],
            [vec![(7395, false); 4], vec![(7395, false); 4]]
        );
        // A doubling that fits noise is undone, the first one and a later one.
        let fits_noise = [few_points[0], brighton[1], brighton[2], brighton[3]];
        assert_eq!(decisions(7395, fits_noise), [(14_790, true), (7395, false), (7395, false), (7395, false)]);
        let stalls = [demo[0], demo[1], [23.5, 26.0, 0.002], [25.0, 28.0, 0.0]];
        assert_eq!(decisions(20_000, stalls), [(40_000, true), (80_000, true), (40_000, false), (40_000, false)]);
        // A loss that pays decides alone, then and afterwards, and ends a trial with growth.
        let cross = [[25.0, 25.5, 0.439], [26.0, 26.5, 0.250], [27.0, 28.0, 0.448], [28.0, 29.5, 0.580]];
        let [first, .., last] = decisions(41_321, cross)[..] else { panic!("four checks") };
        assert!(!first.1 && first == last && first.0 > 64_000, "{first:?}, {last:?}");
        let pays_later = decisions(1000, [[20.0, 20.0, 0.1], [19.0, 19.0, 1.0], [19.0, 19.0, 0.0], [19.0, 19.0, 0.0]]);
        assert_eq!(pays_later[0], (2000, true));
        let draft = GrowthRule::new(Quality::Draft, 3000);
        let near = GrowthValues { psnr: 20.0, trained_psnr: 19.5, lost: 0.001 };
        assert!(!draft.check((0, 1000), 1000, near, &GrowthState { first: 1000, checks: Vec::new() }).is_trial);
        assert!(!pays_later[1].1 && pays_later[1].0 > 2000 && pays_later[3] == pays_later[1], "{pays_later:?}");
    }
}
