//! The strategy `mcmc`: 3DGS-MCMC (Kheradmand et al. 2024, arXiv 2404.09591) after gsplat's `MCMCStrategy`, for scenes in pages.
//!
//! A round removes dead rows, which are those of opacity [`McmcStrategy::dead_opacity`] or less. It draws other rows with a
//! probability that grows with their opacity, and two rows replace each of them at its place ([`Fate::SplitInPlace`]). Each update
//! adds noise to the means of the rows that it rewrote. Each view adds the gradients of two regularisers to the rows that it drew.
//!
//! Where it differs from gsplat, which reads all rows in every step:
//! - The draw is one without replacement, so a row gets one copy in a round. Its key is opacity / E, with E from the exponential
//!   distribution: the rows with the greatest keys are such a draw (Efraimidis and Spirakis 2006). The histogram of keys gives the least
//!   key that still fits, in whole bins. The opacity is the mean over the views that drew the row since the last round; other rows get
//!   no copy.
//! - A round gives away places for 5 % of the rows drawn since the last round, as far as the cap has room. The place of
//!   a dead row becomes room when its page has applied the removal.
//! - Noise and regularisers act on rows that the view drew only. The means of the regularisers are over the rows of the view.
//! - Lengths are in units of the scene scale, which gsplat has by making it about 1 on loading.
//! - Both rows of a place start with zero moments and new uids.
//!
//! Invariants: 1. a round never leaves more rows than the cap, unless there were more before; 2. keys and noise are functions
//! of (seed, round or step, uid) and the row; 3. an update ends with the noise, so bounds of pages, which are taken
//! afterwards, contain it; 4. a split in place moves no mean and enlarges no row, so no bounds need room for a round.

use super::ops::rotation;
use super::stats::{DrawnRows, GradHistogram, accumulate_scores, reaches_bin};
use super::strategy::{Extremes, Fate, Round, RoundSteps, RowCount, RowFacts, Strategy, ViewGradients};
use crate::base::math::sigmoid;
use crate::base::rng::{Purpose, Stream};
use crate::optim::bounds::SplitLimits;
use crate::optim::rates::Rates;
use crate::scene::columns::{Column, Gradients};
use crate::scene::events::{EventKind, RelocationRound};
use crate::scene::rows::{Rows, RowsMut};

/// Share of the rows drawn since the last round that a round adds.
pub const GROWTH: f64 = 0.05;
/// Factor of the noise on the rate of the means.
const NOISE: f64 = 5e5;
/// Steepness of the fall of the noise with the opacity, and the opacity at which it is at half.
const NOISE_STEEPNESS: f64 = 100.0;
const NOISE_OPACITY: f64 = 0.005;
/// Above this opacity the noise is under 1e-12 of its whole size, less than the rounding of a mean.
const QUIET_OPACITY: f64 = 0.3;
/// Weights of the mean opacity and of the mean standard deviation in the loss.
const OPACITY_WEIGHT: f64 = 0.01;
const SCALE_WEIGHT: f64 = 0.01;
/// Least value of an exponential draw, so that no key is infinite.
const DRAW_LEAST: f64 = 1e-20;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct McmcStrategy {
    /// Rows of this opacity or less are dead.
    pub dead_opacity: f32,
    pub rounds: RoundSteps,
    /// Most rows of the scene.
    pub max_gaussians: u64,
    /// Seed of keys and noise.
    pub seed: u64,
    /// Scene scale, local units.
    pub scene_scale: f64,
    /// Learning rates: the noise follows that of the means.
    pub rates: Rates,
}

impl McmcStrategy {
    /// The round that follows a step with this number of rows.
    pub fn round(&self, count: RowCount, histogram: &GradHistogram) -> RelocationRound {
        let room = self.max_gaussians.min(count.allowed).saturating_sub(count.rows);
        let births = (GROWTH * histogram.rows() as f64).round() as u64;
        RelocationRound { copy_from_bin: histogram.split_bin(births.min(room)), dead_opacity: self.dead_opacity }
    }

    /// The key of a row in the rounds of `step`'s interval; 0 for a dead row, which gets no copy.
    fn key(&self, opacity: f32, uid: u64, step: u32) -> f32 {
        if opacity <= self.dead_opacity {
            return 0.0;
        }
        // A round follows the last step of its interval.
        let round = u64::from(step.div_ceil(self.rounds.every));
        let uniform = Stream::new(self.seed, Purpose::Relocation, uid, round).uniform();
        (f64::from(opacity) / (-libm::log1p(-uniform)).max(DRAW_LEAST)) as f32
    }

    /// The noise on the mean of a row after this step; `None` where it is less than a rounding.
    fn noise(&self, rows: &Rows<'_>, row: usize, step: u32) -> Option<[f64; 3]> {
        let opacity = f64::from(sigmoid(rows.columns.opacities[row]));
        if opacity > QUIET_OPACITY {
            return None;
        }
        let faintness = 1.0 / (1.0 + libm::exp(NOISE_STEEPNESS * (opacity - NOISE_OPACITY)));
        // The rate is a length, and the covariance a squared one: the scale of the scene makes the product a length.
        let size = self.rates.at(Column::Means, step) * NOISE * faintness / (self.scene_scale * self.scene_scale);
        let mut draws = Stream::new(self.seed, Purpose::MeanNoise, rows.uid[row], u64::from(step));
        let z = [draws.normal(), draws.normal(), draws.normal()];
        let r = rotation(std::array::from_fn(|i| f64::from(rows.columns.quats[row * 4 + i])));
        let along: [f64; 3] = std::array::from_fn(|axis| {
            let sigma = libm::exp(f64::from(rows.columns.scales[row * 3 + axis]));
            sigma * sigma * (0..3).map(|i| r[i][axis] * z[i]).sum::<f64>()
        });
        Some(std::array::from_fn(|i| size * (0..3).map(|axis| r[i][axis] * along[axis]).sum::<f64>()))
    }
}

impl Strategy for McmcStrategy {
    fn rounds(&self) -> Option<&RoundSteps> {
        Some(&self.rounds)
    }

    /// The score of a row is its key, so the mean score is the mean opacity over the draw of the row.
    fn collect(&self, view: &mut RowsMut<'_>, drawn: &DrawnRows<'_>, histogram: &mut GradHistogram) -> usize {
        let key = |&row: &u32| {
            let row = row as usize - view.first_row;
            self.key(sigmoid(view.columns.opacities[row]), view.uid[row], drawn.step)
        };
        let keys: Vec<f32> = drawn.rows.iter().map(key).collect();
        accumulate_scores(view, drawn, histogram, |place| (keys[place - drawn.first], None))
    }

    fn add_gradients(&self, view: &mut ViewGradients<'_>) {
        let of_opacity = OPACITY_WEIGHT / view.rows_of_view as f64;
        let of_scale = SCALE_WEIGHT / (3 * view.rows_of_view) as f64 / self.scene_scale;
        let (values, Gradients { columns: gradients, radii, .. }) = (view.columns, &mut *view.gradients);
        for (row, radii) in radii.iter().enumerate() {
            if radii.contains(&0) {
                continue;
            }
            let opacity = f64::from(sigmoid(values.opacities[row]));
            gradients.opacities[row] += (of_opacity * opacity * (1.0 - opacity)) as f32;
            for c in row * 3..row * 3 + 3 {
                gradients.scales[c] += (of_scale * libm::exp(f64::from(values.scales[c]))) as f32;
            }
        }
    }

    fn after_update(&self, view: &mut RowsMut<'_>, listed: &[u32], step: u32) {
        for &row in listed {
            let row = row as usize - view.first_row;
            if view.stamp[row] != step + 1 {
                continue;
            }
            let Some(noise) = self.noise(&view.as_ref(), row, step) else { continue };
            let moved: [f32; 3] =
                std::array::from_fn(|i| (f64::from(view.columns.means[row * 3 + i]) + noise[i]) as f32);
            if moved.iter().all(|x| x.is_finite()) {
                view.columns.means[row * 3..row * 3 + 3].copy_from_slice(&moved);
            }
        }
    }

    fn events_after(&self, step: u32, _: f32, count: RowCount, histogram: &GradHistogram) -> Vec<EventKind> {
        if self.rounds.is_round(step) { vec![EventKind::Relocate(self.round(count, histogram))] } else { Vec::new() }
    }

    /// Children of a split in place lie within their parent.
    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits::NEVER
    }
}

impl RelocationRound {
    fn copies(&self, grad2d: f32, count: u32) -> bool {
        reaches_bin(grad2d, count, self.copy_from_bin)
    }
}

impl Round for RelocationRound {
    /// Removal first: a row that died since the views drew it gets no copy.
    fn fate(&self, row: &RowFacts) -> Fate {
        if sigmoid(row.opacity) <= self.dead_opacity {
            Fate::Prune
        } else if self.copies(row.grad2d, row.count) {
            Fate::SplitInPlace
        } else {
            Fate::Keep
        }
    }

    fn may_edit(&self, rows: &Rows<'_>) -> bool {
        rows.grad2d.iter().zip(rows.count).any(|(&grad2d, &count)| self.copies(grad2d, count))
    }

    /// The slack of 1e-5 covers the rounding of the sigmoid, some 4e-7.
    fn keeps_all(&self, extremes: &Extremes) -> bool {
        sigmoid(extremes.lowest_opacity) > self.dead_opacity * (1.0 + 1e-5)
    }

    fn grows_from_bin(&self) -> u32 {
        self.copy_from_bin
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::math::logit;
    use crate::scene::columns::Columns;
    use crate::scene::state::SceneState;

    fn strategy(max_gaussians: u64, seed: u64) -> McmcStrategy {
        McmcStrategy {
            dead_opacity: 0.005,
            rounds: RoundSteps { start: 500, stop: 2400, every: 100 },
            max_gaussians,
            seed,
            scene_scale: 2.0,
            rates: Rates::new(2.0, 3000),
        }
    }

    /// Rows with the opacities .1, .2, .4, .8 in turn, the last one dead, after the same view twice.
    fn drawn(strategy: &McmcStrategy, rows: usize, step: u32) -> (SceneState, GradHistogram) {
        let mut state = SceneState::from_columns(Columns::zeros(rows, 0));
        for row in 0..rows {
            state.columns.opacities[row] = logit([0.1, 0.2, 0.4, 0.8][row % 4]);
            state.uid[row] = row as u64;
        }
        state.columns.opacities[rows - 1] = logit(0.004);
        let mut histogram = GradHistogram::default();
        let numbers: Vec<u32> = (0..rows as u32).collect();
        let gradients = Gradients { radii: vec![[1, 1]; rows], ..Gradients::default() };
        for step in [step - 1, step] {
            let drawn = DrawnRows { step, rows: &numbers, gradients: &gradients, first: 0, image_size: [9, 9] };
            strategy.collect(&mut state.view_mut(), &drawn, &mut histogram);
        }
        (state, histogram)
    }

    fn fate(round: &RelocationRound, state: &SceneState, row: usize) -> Fate {
        let opacity = state.columns.opacities[row];
        round.fate(&RowFacts { grad2d: state.grad2d[row], count: state.count[row], log_scale: 0.0, opacity })
    }

    #[test]
    fn copies_go_to_rows_in_proportion_to_their_opacity_and_the_cap_holds() {
        const ROWS: usize = 20_000;
        let mut copies = [0usize; 4];
        for seed in 0..8 {
            let strategy = strategy(u64::MAX, seed);
            let (state, histogram) = drawn(&strategy, ROWS, 700);
            let round = strategy.round(RowCount::unlimited(ROWS as u64), &histogram);
            let chosen: Vec<usize> = (0..ROWS).filter(|&row| fate(&round, &state, row) == Fate::SplitInPlace).collect();
            // A bin is under 1 % wide, and keys spread over several doublings: a bin holds some ten of the 1,000.
            assert!((970..=1000).contains(&chosen.len()), "{}", chosen.len());
            assert_eq!(round.promised(&histogram), chosen.len() as u64);
            assert_eq!(round.promised_rows(&state.view()), chosen.len() as u64);
            assert!(round.may_edit(&state.view()));
            chosen.iter().for_each(|row| copies[row % 4] += 1);
            assert_eq!(fate(&round, &state, ROWS - 1), Fate::Prune);
            // With room for 90 there are at most 90 births.
            let full = McmcStrategy { max_gaussians: ROWS as u64 + 90, ..strategy };
            let births = full.round(RowCount::unlimited(ROWS as u64), &histogram).promised(&histogram);
            assert!((80..=90).contains(&births), "{births}");
        }
        let all = copies.iter().sum::<usize>() as f64;
        for (copies, opacity) in copies.iter().zip([0.1, 0.2, 0.4, 0.8]) {
            // Without replacement a row cannot be chosen again: with rate q a row of opacity o is chosen with 1 - exp(-q o), where
            // the mean over the four is .05. Five standard errors of a count of 500 or more are under a quarter of it.
            let chance = |o: f64| 1.0 - libm::exp(-0.1386 * o);
            let want = all * chance(opacity) / [0.1, 0.2, 0.4, 0.8].map(chance).iter().sum::<f64>();
            assert!((*copies as f64 - want).abs() < 5.0 * want.sqrt(), "{copies} of {want}");
        }
    }

    #[test]
    fn keys_change_between_rounds_only() {
        let strategy = strategy(9, 1);
        let key = |step: u32, uid: u64| strategy.key(0.5, uid, step);
        // The round that follows step 700 counts steps 601 to 700.
        assert_eq!((key(601, 4), key(650, 4)), (key(700, 4), key(700, 4)));
        assert!(key(700, 4) != key(701, 4) && key(700, 4) != key(700, 5));
        assert_eq!(strategy.key(0.005, 4, 700), 0.0);
    }

    #[test]
    fn noise_has_the_covariance_of_the_row_and_fades_with_its_opacity() {
        let strategy = strategy(9, 3);
        let mut state = SceneState::from_columns(Columns::zeros(1, 0));
        // A quarter turn about z takes the long axis x to y.
        let h = std::f32::consts::FRAC_1_SQRT_2;
        state.columns.quats.copy_from_slice(&[h, 0.0, 0.0, h]);
        state.columns.scales.copy_from_slice(&[0.1f32.ln(), 0.05f32.ln(), 0.01f32.ln()]);
        state.columns.opacities[0] = logit(0.005);
        let mut sums = [0.0; 3];
        let draws = 4000;
        for uid in 0..draws {
            state.uid[0] = uid;
            let noise = strategy.noise(&state.view(), 0, 0).unwrap_or([f64::NAN; 3]);
            (0..3).for_each(|i| sums[i] += noise[i] * noise[i]);
        }
        // Rate 1.6e-4 times the scale 2, times 5e5, times a half, over the square of the scale.
        let size = 1.6e-4 * 2.0 * 5e5 * 0.5 / 4.0;
        for (sum, sigma) in sums.iter().zip([0.05, 0.1, 0.01f64]) {
            let want = size * sigma * sigma;
            // Five standard errors of a standard deviation from 4,000 draws, sqrt(1 / 8000) each, are 5.6 %.
            assert!(((sum / draws as f64).sqrt() / want - 1.0).abs() < 0.056, "{sum}");
        }
        state.columns.opacities[0] = logit(0.5);
        assert_eq!(strategy.noise(&state.view(), 0, 0), None);
    }

    #[test]
    fn regularisers_are_the_derivatives_of_the_means_of_opacity_and_size() {
        let strategy = strategy(9, 3);
        let mut values = Columns::zeros(2, 0);
        values.opacities.copy_from_slice(&[0.3, -1.0]);
        values.scales.copy_from_slice(&[-2.0, -3.0, -1.0, 0.0, 0.0, 0.0]);
        let (columns, radii) = (Columns::zeros(2, 0), vec![[1, 1], [0, 0]]);
        let mut gradients = Gradients { columns, radii, ..Gradients::default() };
        let mut view = ViewGradients { columns: &values, gradients: &mut gradients, rows_of_view: 2 };
        strategy.add_gradients(&mut view);
        let gradients = gradients.columns;
        let loss = |change: f64| {
            let opacity = 1.0 / (1.0 + (-(f64::from(values.opacities[0]) + change)).exp());
            let sigma = (f64::from(values.scales[1]) + change).exp() / 2.0;
            [0.01 * opacity / 2.0, 0.01 * sigma / 6.0]
        };
        let (up, down) = (loss(1e-4), loss(-1e-4));
        let got = [gradients.opacities[0], gradients.scales[1]];
        for i in 0..2 {
            let want = (up[i] - down[i]) / 2e-4;
            // The rounding of an f32 gradient and the third order of the differences.
            assert!((f64::from(got[i]) / want - 1.0).abs() < 1e-6, "{got:?}");
        }
        assert_eq!((gradients.opacities[1], gradients.scales[3]), (0.0, 0.0), "a row that was not drawn");
    }
}
