//! The number of Gaussians, where the run decides it: doublings, as long as photos that the run does not train on gain by them.
//!
//! A few training views are held out while the scene may grow. Each check draws the held-out views, and as many trained views. A
//! gain of the trained views since the last check may come from the scene or from noise; a gain of the held-out views can only come
//! from the scene. The first check doubles. Later ones do as long as the held-out views gain a good share of what the trained views
//! gain, and are not far behind in PSNR. If the SSIM of the held-out views gains nothing, more Gaussians only fit noise, and the last
//! doubling is undone: the rows of least weight are removed ([`super::long_axis`]). PSNR cannot say that: where photos do not match to
//! the pixel, it prefers a blurred picture. `benches/RESULTS.md` has the measurements, `benches/TRIED.md` what failed.
//!
//! Photos bound the count, too: a Gaussian beyond one for each two dozen of their pixels costs time and brings next to nothing
//! ([`GrowthRule::most`]).
//!
//! A doubling takes two rounds, so checks come every two rounds. A scene waits while it has fewer Gaussians than allowed, and
//! while its views gain little: new Gaussians need some steps. The last check begins no doubling, since no check would judge it.
//!
//! Not here: the measurement (`train::state::growth_checks`), which views are held out (`train::state::turns`).
//!
//! Invariants: 1. a decision is a function of the step, what was measured and the earlier decisions, which are part of commits; 2.
//! the allowed number falls only by a doubling that is undone, and never below the first number.

use crate::base::units::format_grouped;
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

/// What a doubling must have brought for another one.
struct DoublingDemand {
    /// Least gain of the held-out views, dB, since the last check and since the check that decided the last doubling.
    /// Both count, since a doubling first lowers the PSNR. Training alone gains some tenths.
    gain: f64,
    /// Least gain of the held-out views, as a share of the gain of the trained views. Measured: .4 to 1.1 where
    /// doublings pay, less than .1 where they fit noise.
    share: f64,
    /// Fewest pixels of training photos for a Gaussian.
    pixels: u64,
}

impl Quality {
    fn demand(self) -> DoublingDemand {
        match self {
            Quality::Draft => DoublingDemand { gain: 0.8, share: 0.5, pixels: 128 },
            Quality::Normal => DoublingDemand { gain: 0.3, share: 0.4, pixels: 24 },
            Quality::Archive => DoublingDemand { gain: 0.1, share: 0.25, pixels: 8 },
        }
    }
}

/// Decibels by which held-out views must gain less than trained views for a lag; smaller differences are noise.
const LAG_LEAST: f64 = 0.3;
/// Decibels by which trained views may be better than held-out ones for a doubling. Measured at doublings that pay: -.3 to 1.5; on seneca
/// at 395 pixels, whose second doubling costs .3 dB (and still raises SSIM): 2.3 to 2.6.
const GAP_MOST: f64 = 2.2;
/// Held-out views may be farther behind if they gain at least this share of what trained views gain since the last doubling: .79 in a city
/// whose photos overlap little, where more Gaussians pay; .25 to .53 where they do not.
const SHARE_ACROSS_A_GAP: f64 = 0.7;
/// Decibels by which trained views must be better than held-out ones for a lag to count: a check soon after a doubling may find either
/// better by some tenths. Measured: -.3 to 1.5 where more Gaussians pay, 2.3 and more where they do not.
const GAP_OF_A_LAG: f64 = 1.6;
/// Checks after which a doubling is judged. Earlier is too soon: a doubling disturbs all views.
const PATIENCE: usize = 3;
/// The first allowed number is at least this part of the most Gaussians. Below the second part, one check allows two doublings.
const FIRST_PART_OF_MOST: u64 = 16;
const SMALL_PART_OF_MOST: u64 = 11;
/// The least factor of a stage of growth.
const LEAST_STAGE: f64 = 1.2;
/// A scene has grown when it has this share of the Gaussians that it was allowed.
const GROWN: f64 = 0.8;

/// Longest unit, steps: longer runs decide their count as early as one of this length.
const UNIT_MOST: u32 = 3000;
/// Shortest unit whose checks recognise a scene that does not gain by growth. Checks of shorter runs see little but the
/// gain of training. Measured on brighton: 500 steps grow to the most.
const UNIT_MEASURED: u32 = 1000;
/// Parts of a unit, and the parts at which checks are due.
const PARTS: u32 = 15;
const FIRST_PART: u32 = 4;
const LAST_PART: u32 = 11;

/// Pixels of the largest photos that the bound was measured with.
const MEASURED_PIXELS: u64 = 120_000;

/// The pixels of a photo that count for [`GrowthRule::most`]. All pixels count up to the size of the photos that the bound was
/// measured with. For larger photos, detail is assumed to grow with the side of the photo, not with its area; this was not measured.
pub fn counted_pixels(pixels: u64) -> u64 {
    match pixels <= MEASURED_PIXELS {
        true => pixels,
        false => (pixels as f64 * MEASURED_PIXELS as f64).sqrt() as u64,
    }
}

/// The rule of a run that decides its count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrowthRule {
    /// How much a doubling must bring.
    quality: Quality,
    /// Steps to which the parts of the checks refer.
    unit: u32,
}

/// What a check decides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GrowthDecision {
    /// Twice as many Gaussians, or as many as the pixels allow.
    Doubles,
    /// No more for now: the gain is small yet, trained views are far better, or the scene still grows.
    Waits,
    /// The number stays as it is.
    Ends,
    /// As many Gaussians as before the last doubling, for good.
    Undoes,
}

/// Metrics of drawn views against their photos: means over the views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewMetrics {
    /// dB.
    pub psnr: f64,
    /// 0 to 1.
    pub ssim: f64,
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
    /// SSIM of the held-out and of the trained views, likewise.
    pub ssim: f64,
    pub trained_ssim: f64,
    pub decision: GrowthDecision,
    pub allowed: u64,
}

impl GrowthCheck {
    /// Whether no check follows.
    pub fn is_final(&self) -> bool {
        matches!(self.decision, GrowthDecision::Ends | GrowthDecision::Undoes)
    }
}

/// The state of the decision about the count.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GrowthState {
    /// Gaussians that are allowed before the first check ([`GrowthRule::first`]); 0 before the first round, and in runs that do not decide.
    pub first: u64,
    /// The checks so far, in order.
    pub checks: Vec<GrowthCheck>,
}

impl GrowthState {
    pub fn allowed(&self) -> u64 {
        self.checks.last().map_or(self.first, |last| last.allowed)
    }

    /// Whether the count is decided for good.
    pub fn is_decided(&self) -> bool {
        self.checks.last().is_some_and(GrowthCheck::is_final)
    }

    /// The checks from the one that decided the last doubling on, and what was allowed before, if no check has judged the doubling.
    fn open_doubling(&self) -> Option<(&[GrowthCheck], u64)> {
        let at = self.checks.iter().rposition(|check| check.decision != GrowthDecision::Waits)?;
        let before = at.checked_sub(1).map_or(self.first, |before| self.checks[before].allowed);
        (self.checks[at].decision == GrowthDecision::Doubles).then_some((&self.checks[at..], before))
    }

    /// What a commit cannot hold.
    /// Errors: the checks are out of order, lie beyond `steps_done`, or hold a value that is not finite.
    pub fn check(&self, steps_done: u32) -> Result<(), &'static str> {
        let is_sound = |c: &GrowthCheck| {
            [c.psnr, c.trained_psnr, c.ssim, c.trained_ssim].iter().all(|value| value.is_finite())
                && c.step <= steps_done
        };
        let follows = |pair: &[GrowthCheck]| {
            pair[0].step < pair[1].step
                && (pair[0].allowed <= pair[1].allowed || pair[1].decision == GrowthDecision::Undoes)
        };
        let is_enough = self.checks.iter().all(|check| check.allowed >= self.first);
        if is_enough && self.checks.iter().all(is_sound) && self.checks.windows(2).all(follows) {
            return Ok(());
        }
        Err("the checks of its growth are invalid")
    }
}

/// One line of a terminal.
impl fmt::Display for GrowthCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let GrowthCheck { step, psnr, trained_psnr, ssim, trained_ssim, decision, allowed, .. } = self;
        let what = match decision {
            GrowthDecision::Doubles => "up to",
            GrowthDecision::Waits => "for now stay at",
            GrowthDecision::Ends => "stay at",
            GrowthDecision::Undoes => "back to",
        };
        let allowed = format_grouped(*allowed);
        write!(f, "step {step}: Gaussians {what} {allowed}: ")?;
        // A doubling is undone for its SSIM.
        match decision {
            GrowthDecision::Undoes => write!(f, "SSIM {ssim:.3} of held-out photos, {trained_ssim:.3} of others"),
            _ => write!(f, "PSNR {psnr:.2} dB of held-out photos, {trained_psnr:.2} of others"),
        }
    }
}

impl GrowthRule {
    /// The rule of a run that is planned for this many steps.
    pub fn new(quality: Quality, steps: u32) -> GrowthRule {
        GrowthRule { quality, unit: steps.clamp(1, UNIT_MOST) }
    }

    /// The most Gaussians that such a run allows for training photos of so many [`counted_pixels`].
    pub fn most(&self, pixels: u64) -> u64 {
        pixels / self.quality.demand().pixels
    }

    /// The Gaussians that are allowed before the first check, in a scene that begins with `rows`: few first points say nothing about what
    /// the scene needs.
    pub fn first(&self, rows: u64, pixels: u64) -> u64 {
        rows.max(self.most(pixels) / FIRST_PART_OF_MOST)
    }

    /// The final number of Gaussians if every check after `last` doubles what is allowed, for a scene of `rows` and training photos
    /// of `pixels` [`counted_pixels`]. Each round of `rounds` at most doubles the scene, up to what is allowed then.
    pub fn reachable(
        &self,
        rows: u64,
        pixels: u64,
        last: Option<&GrowthCheck>,
        rounds: impl Iterator<Item = u32>,
    ) -> u64 {
        let mut now = rows;
        let mut allowed = last.map_or_else(|| self.first(rows, pixels), |check| check.allowed);
        let (mut before, mut is_first) = (last.map(|check| check.step.saturating_sub(1)), last.is_none());
        for step in rounds {
            if self.is_due(before, step) && !self.is_past(LAST_PART, step) {
                // The first check doubles whatever the scene has.
                if is_first || now as f64 >= GROWN * allowed as f64 {
                    allowed = self.more(allowed, pixels).max(allowed);
                }
                is_first = false;
            }
            now = now.saturating_mul(2).min(allowed).max(now);
            before = Some(step);
        }
        now
    }

    /// What the first check of a scene that begins with `rows` allows.
    pub fn after_first_check(&self, rows: u64, pixels: u64) -> u64 {
        let first = self.first(rows, pixels);
        self.more(first, pixels).max(first)
    }

    /// What the next doubling allows. Where little is allowed yet, two doublings at once: judging the first of them would cost steps that
    /// the scene needs later.
    fn more(&self, allowed: u64, pixels: u64) -> u64 {
        let is_small = allowed < self.most(pixels) / SMALL_PART_OF_MOST;
        allowed.saturating_mul(if is_small { 4 } else { 2 }).min(self.most(pixels))
    }

    /// Whether photos of `pixels` [`counted_pixels`] allow a stage of growth beyond `allowed` Gaussians.
    pub fn has_room(&self, allowed: u64, pixels: u64) -> bool {
        self.more(allowed, pixels) as f64 >= LEAST_STAGE * allowed as f64
    }

    /// Whether runs are long enough for the measurements of which scenes grow (`UNIT_MEASURED`).
    pub fn is_of_measured_length(&self) -> bool {
        self.unit >= UNIT_MEASURED
    }

    /// Whether the check at this part of the unit is due at this step or was before.
    fn is_past(&self, part: u32, step: u32) -> bool {
        u64::from(step) * u64::from(PARTS) >= u64::from(part) * u64::from(self.unit)
    }

    /// Whether a check is due after `step`: one fell due since `before`, the previous step at which a check was possible.
    pub fn is_due(&self, before: Option<u32>, step: u32) -> bool {
        (FIRST_PART..=LAST_PART)
            .any(|part| self.is_past(part, step) && !before.is_some_and(|before| self.is_past(part, before)))
    }

    /// The first and the last step at which a check falls due.
    pub fn check_steps(&self) -> [u32; 2] {
        [FIRST_PART, LAST_PART].map(|part| (u64::from(part) * u64::from(self.unit)).div_ceil(u64::from(PARTS)) as u32)
    }

    /// Whether a check may still come after this step or a later one.
    pub fn is_open(&self, step: u32, refine_every: u32) -> bool {
        !step.checked_sub(refine_every).is_some_and(|before| self.is_past(LAST_PART, before))
    }

    /// The check after this step of a scene of at most `gaussians` Gaussians and training photos of `pixels` pixels, by how the held-out
    /// views are drawn, and as many trained ones. `before` has the checks so far, of which none has decided for good.
    pub fn check(
        &self,
        step: u32,
        [gaussians, pixels]: [u64; 2],
        [held_out, trained]: [ViewMetrics; 2],
        before: &GrowthState,
    ) -> GrowthCheck {
        let (ViewMetrics { psnr, ssim }, ViewMetrics { psnr: trained_psnr, ssim: trained_ssim }) = (held_out, trained);
        let DoublingDemand { gain: gain_least, share: share_least, .. } = self.quality.demand();
        let more = self.more(before.allowed(), pixels);
        let has_room = self.has_room(before.allowed(), pixels);
        let is_last = self.is_past(LAST_PART, step);
        let gap = trained_psnr - psnr;
        let has_grown = gaussians as f64 >= GROWN * before.allowed() as f64;
        let (decision, allowed) = match before.open_doubling() {
            None if is_last || !has_room => (GrowthDecision::Ends, before.allowed()),
            None => (GrowthDecision::Doubles, more),
            Some((checks, allowed_before)) => {
                // Gains count from the doubling that the check judges, since noise may be fitted slowly.
                let (since, last) = (&checks[0], &checks[checks.len() - 1]);
                let (gain, trained_gain) = (psnr - since.psnr, trained_psnr - since.trained_psnr);
                let lags = gap >= GAP_OF_A_LAG
                    && trained_gain - gain >= LAG_LEAST
                    && gain < share_least * trained_gain.max(0.0);
                let fits_noise = ssim <= since.ssim && trained_ssim > since.trained_ssim;
                let is_close = gap < GAP_MOST || gain >= SHARE_ACROSS_A_GAP * trained_gain;
                let is_judged = checks.len() >= PATIENCE;
                if is_judged && fits_noise {
                    (GrowthDecision::Undoes, allowed_before)
                } else if is_last || !has_room || (is_judged && lags) {
                    (GrowthDecision::Ends, before.allowed())
                } else if is_close && has_grown && !lags && (psnr - last.psnr).min(gain) >= gain_least {
                    (GrowthDecision::Doubles, more)
                } else {
                    (GrowthDecision::Waits, before.allowed())
                }
            }
        };
        GrowthCheck { step: step + 1, gaussians, psnr, trained_psnr, ssim, trained_ssim, decision, allowed }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The steps after which a run with rounds every `every` steps from `start` on has checks.
    fn checks(rule: &GrowthRule, start: u32, every: u32) -> Vec<u32> {
        let rounds: Vec<u32> = (start..40_000).filter(|step| step.is_multiple_of(every)).collect();
        let due = |(i, &step): (usize, &u32)| {
            rule.is_due(i.checked_sub(1).map(|before| rounds[before]), step).then_some(step)
        };
        rounds.iter().enumerate().filter_map(due).collect()
    }

    #[test]
    fn checks_come_every_two_rounds_and_end() {
        for (steps, unit) in [(1500, 1500), (3000, 3000), (30_000, 3000), (200_000, 3000)] {
            let rule = GrowthRule::new(Quality::Normal, steps);
            let every = unit / 30;
            let due: Vec<u32> = (4..=11).map(|part| part * 2 * every).collect();
            assert_eq!((checks(&rule, 6 * every, every), rule.check_steps()), (due.clone(), [due[0], due[7]]));
            assert!(rule.is_open(due[7], every) && !rule.is_open(due[7] + every, every));
        }
        // A run whose rounds begin late has its only check with the first round; one with few rounds skips checks.
        let rule = GrowthRule::new(Quality::Normal, 3000);
        assert_eq!(checks(&rule, 2300, 100), [2300]);
        assert_eq!(checks(&rule, 600, 500), [1000, 1500, 2000, 2500]);
    }

    /// What the checks of a run of 3,000 steps allow and decide: of PSNR of held-out and of trained views, in a scene that has grown to
    /// `grown` of what it was allowed. SSIM rises and falls with PSNR.
    fn decisions(quality: Quality, first: u64, grown: f64, of_checks: &[[f64; 2]]) -> Vec<(u64, GrowthDecision)> {
        let with_ssim = |psnrs: &[f64; 2]| psnrs.map(|psnr| ViewMetrics { psnr, ssim: psnr / 40.0 });
        decisions_of(quality, first, grown, &of_checks.iter().map(with_ssim).collect::<Vec<_>>())
    }

    /// As [`decisions`], of PSNR and SSIM.
    fn decisions_of(
        quality: Quality,
        first: u64,
        grown: f64,
        of_checks: &[[ViewMetrics; 2]],
    ) -> Vec<(u64, GrowthDecision)> {
        let rule = GrowthRule::new(quality, 3000);
        let mut state = GrowthState { first, checks: Vec::new() };
        for (number, &values) in of_checks.iter().enumerate() {
            if state.is_decided() {
                break;
            }
            let gaussians = (grown * state.allowed() as f64) as u64;
            state.checks.push(rule.check(800 + 200 * number as u32, [gaussians, PIXELS], values, &state));
            assert_eq!(state.check(2201), Ok(()));
        }
        state.checks.iter().map(|check| (check.allowed, check.decision)).collect()
    }

    const PIXELS: u64 = 6_528_000;

    #[test]
    fn every_check_may_double_what_is_allowed() {
        let reach = |steps: u32, every: u32, rows: u64| {
            let rule = GrowthRule::new(Quality::Normal, steps);
            rule.reachable(
                rows,
                PIXELS,
                None,
                (1..).map(|round| steps / 6 + round * every).take_while(|&step| step < steps * 4 / 5),
            )
        };
        let most = PIXELS / 24;
        // Checks of short runs allow as many doublings; rounds that are rare leave no time for them.
        assert_eq!([reach(500, 16, 6750), reach(3000, 100, 6750), reach(3000, 100, 2 * most)], [most, most, 2 * most]);
        assert_eq!(reach(3000, 900, 100), 400);
    }

    #[test]
    fn a_scene_doubles_while_held_out_views_gain_their_share() {
        use GrowthDecision::{Doubles, Ends, Undoes, Waits};
        // As measured: a city with few points, seneca, brighton.
        let few = [
            [20.24, 20.29],
            [20.96, 20.85],
            [22.13, 22.24],
            [22.99, 23.43],
            [24.11, 24.46],
            [24.75, 25.42],
            [25.52, 26.59],
            [26.1, 27.4],
        ];
        assert_eq!([0, 117_315, 469_260, 1_920_000].map(counted_pixels), [0, 117_315, 237_299, 480_000]);
        let most = PIXELS / 24;
        let first = GrowthRule::new(Quality::Normal, 3000).first(3000, PIXELS);
        assert_eq!(first, most / 16, "more than 3,000 points");
        let doubled = [(4 * first, Doubles), (8 * first, Doubles), (most, Doubles), (most, Ends)];
        assert_eq!(decisions(Quality::Normal, first, 0.97, &few), doubled);
        let of_archive = decisions(Quality::Archive, 3000, 0.97, &few);
        assert_eq!(of_archive[..4], [12_000, 48_000, 192_000, 384_000].map(|allowed| (allowed, Doubles)));
        let of_draft = decisions(Quality::Draft, 10_000, 0.97, &few);
        assert_eq!(of_draft[..3], [(20_000, Doubles), (20_000, Waits), (40_000, Doubles)]);
        // As many as the pixels allow, and no stage of a few more.
        assert_eq!(decisions(Quality::Normal, 200_000, 0.97, &few[..3]), [(most, Doubles), (most, Ends)]);
        assert_eq!(decisions(Quality::Normal, 250_000, 0.97, &few[..3]), [(250_000, Ends)]);
        // Scenes whose photos do not match to the pixel, as measured: SSIM gains by the first doubling, and PSNR goes apart.
        let drawn = |values: &[[f64; 4]]| -> Vec<[ViewMetrics; 2]> {
            let of = |&[psnr, trained_psnr, ssim, trained_ssim]: &[f64; 4]| {
                [ViewMetrics { psnr, ssim }, ViewMetrics { psnr: trained_psnr, ssim: trained_ssim }]
            };
            values.iter().map(of).collect()
        };
        let seneca = [
            [22.30, 24.70, 0.707, 0.714],
            [21.04, 23.29, 0.683, 0.689],
            [21.38, 24.33, 0.694, 0.716],
            [21.93, 25.87, 0.719, 0.749],
        ];
        let of_seneca = [(119_854, Doubles), (119_854, Waits), (119_854, Waits), (119_854, Ends)];
        assert_eq!(decisions_of(Quality::Normal, 59_927, 0.97, &drawn(&seneca)), of_seneca);
        let brighton = [
            [18.34, 19.91, 0.427, 0.479],
            [18.30, 20.61, 0.442, 0.515],
            [18.33, 21.79, 0.450, 0.557],
            [18.09, 22.49, 0.452, 0.593],
        ];
        let of_brighton = [(80_000, Doubles), (80_000, Waits), (80_000, Waits), (80_000, Ends)];
        assert_eq!(decisions_of(Quality::Normal, 40_000, 0.97, &drawn(&brighton)), of_brighton);
        // A city whose photos overlap little: held-out views are far behind, and gain nearly what the others gain.
        let sparse = [
            [20.73, 22.32, 0.587, 0.654],
            [20.79, 22.30, 0.592, 0.669],
            [21.61, 23.49, 0.651, 0.729],
            [21.59, 23.40, 0.667, 0.746],
            [23.00, 25.25, 0.729, 0.815],
        ];
        let of_sparse = [(80_000, Doubles), (80_000, Waits), (160_000, Doubles), (160_000, Waits), (most, Doubles)];
        assert_eq!(decisions_of(Quality::Normal, 40_000, 0.97, &drawn(&sparse)), of_sparse);
        // SSIM of held-out views that falls while that of trained views rises.
        let only_fits =
            brighton.map(|[psnr, trained, _, trained_ssim]| [psnr, trained, 0.6 - 0.2 * trained_ssim, trained_ssim]);
        let of_fits = [(80_000, Doubles), (80_000, Waits), (80_000, Waits), (40_000, Undoes)];
        assert_eq!(decisions_of(Quality::Normal, 40_000, 0.97, &drawn(&only_fits)), of_fits);
        // Noise that even trained views hardly fit: nothing lags, and nothing is gained.
        let noise = [[11.0, 11.04], [10.99, 11.04], [10.99, 11.10], [10.89, 11.09]];
        let of_noise = [(2000, Doubles), (2000, Waits), (2000, Waits), (1000, Undoes)];
        assert_eq!(
            decisions(Quality::Normal, 100_000, 0.97, &noise),
            of_noise.map(|(n, decision)| (100 * n, decision))
        );
        // A lag ends growth, though not at once after a doubling.
        let lags = [[20.0, 21.0], [20.3, 22.0], [20.3, 22.0], [20.3, 22.2], [21.0, 22.0]];
        let of_lags = [(200_000, Doubles), (200_000, Waits), (200_000, Waits), (200_000, Ends)];
        assert_eq!(decisions(Quality::Normal, 100_000, 0.97, &lags), of_lags);
        // Nor does one soon after a doubling, while trained views are hardly better: sheffield_cross, seed 3.
        let early = [[26.97, 26.67], [27.92, 27.70], [27.87, 28.15]];
        let of_early = [(82_642, Doubles), (165_284, Doubles), (165_284, Waits)];
        assert_eq!(decisions(Quality::Normal, 41_321, 0.97, &early), of_early);
        // sheffield_cross: the gain comes after some steps.
        let late = [[27.24, 27.16], [27.29, 27.24], [28.41, 28.33]];
        let of_late = [(82_642, Doubles), (82_642, Waits), (165_284, Doubles)];
        assert_eq!(decisions(Quality::Normal, 41_321, 0.97, &late), of_late);
        // Views that recover from a doubling have gained nothing by it.
        let recovers = [[21.60, 22.79], [20.68, 21.97], [21.33, 22.70]];
        let of_recovers = [(80_000, Doubles), (80_000, Waits), (80_000, Waits)];
        assert_eq!(decisions(Quality::Normal, 40_000, 0.97, &recovers), of_recovers);
        // Where rounds are rare, a scene that has not grown yet waits, and the doubling is still judged.
        let waits = [few[0], few[1], few[2], [20.2, 23.0]];
        let of_waits = [(200_000, Doubles), (200_000, Waits), (200_000, Waits), (100_000, Undoes)];
        assert_eq!(decisions(Quality::Normal, 100_000, 0.5, &waits), of_waits);
    }

    #[test]
    fn what_no_run_has_is_refused() {
        let check = |step, allowed, decision| GrowthCheck {
            step,
            gaussians: 7,
            psnr: 20.0,
            trained_psnr: 20.0,
            ssim: 0.5,
            trained_ssim: 0.5,
            decision,
            allowed,
        };
        let of = |first, checks: &[GrowthCheck]| GrowthState { first, checks: checks.to_vec() };
        let (first, second) = (check(1001, 2000, GrowthDecision::Doubles), check(1201, 1000, GrowthDecision::Undoes));
        assert!(of(1000, &[first, second]).check(1201).is_ok() && of(1000, &[first, second]).check(1200).is_err());
        for wrong in [
            of(1500, &[first, second]),
            of(1000, &[second, first]),
            of(1000, &[first, GrowthCheck { decision: GrowthDecision::Ends, ..second }]),
            of(1000, &[GrowthCheck { psnr: f64::NAN, ..first }, second]),
            of(1000, &[GrowthCheck { trained_ssim: f64::INFINITY, ..first }, second]),
        ] {
            assert!(wrong.check(1201).is_err(), "{wrong:?}");
        }
        assert_eq!(GrowthState { first: 7, ..GrowthState::default() }.allowed(), 7);
    }
}
