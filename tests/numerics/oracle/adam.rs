//! Dense and deferred Adam against torch.optim.Adam: 17 rows of 8 columns, touch schedules from "every step" to
//! "never", gradients from 1 to 1e-14, two values of eps, two learning-rate schedules.

use super::torch32::Torch32;
use crate::support::dense_adam::{DenseAdam, Real};
use crate::support::fixture::Fixture;
use gsscale::base::simd::SimdPath;
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::drift::DriftTables;
use gsscale::optim::rates::Rates;
use gsscale::optim::row_kernels::take_step;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::state::SceneState;

const FILES: [&str; 4] =
    ["adam_const_eps1e-15", "adam_const_eps1e-8", "adam_expdecay_eps1e-15", "adam_expdecay_eps1e-8"];

/// One file, its gradients made dense per step.
struct Case {
    file: Fixture,
    values: usize,
    columns: usize,
    lrs: Vec<f64>,
    config: AdamConfig,
    snaps: Vec<usize>,
}

impl Case {
    fn open(name: &str) -> Option<Case> {
        let file = Fixture::open(name)?;
        let shape = file.shape("param0").to_vec();
        let betas = file.f64("betas_eps");
        let config = AdamConfig { beta1: betas[0], beta2: betas[1], eps: betas[2] };
        let snaps = file.f64("snap_steps").iter().map(|&s| s as usize).collect();
        let lrs = file.f64("lrs").to_vec();
        Some(Case { values: shape[0] * shape[1], columns: shape[1], lrs, config, snaps, file })
    }

    /// Gradients of the 1-based step, `[values]`.
    fn grads(&self, step: usize) -> Vec<f64> {
        let mut grads = vec![0.0; self.values];
        let (steps, rows, values) = (self.file.f64("ev_step"), self.file.f64("ev_row"), self.file.f64("ev_grad"));
        let first = steps.partition_point(|&s| s < step as f64);
        let end = steps.partition_point(|&s| s <= step as f64);
        for event in first..end {
            let row = rows[event] as usize;
            grads[row * self.columns..(row + 1) * self.columns]
                .copy_from_slice(&values[event * self.columns..(event + 1) * self.columns]);
        }
        grads
    }

    /// The expected `[values]` of snapshot number `snap`.
    fn snapshot(&self, tensor: &str, snap: usize) -> &[f64] {
        &self.file.f64(tensor)[snap * self.values..(snap + 1) * self.values]
    }
}

fn max_abs(got: impl Iterator<Item = f64>, want: &[f64]) -> f64 {
    got.zip(want).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Largest relative error over entries that f32 can hold with full precision.
fn max_rel(got: impl Iterator<Item = f64>, want: &[f64]) -> f64 {
    got.zip(want).filter(|(_, w)| w.abs() > 1e-37).map(|(g, w)| ((g - w) / w).abs()).fold(0.0, f64::max)
}

fn run_dense<F: Real + Into<f64>>(case: &Case, mut check: impl FnMut(usize, &DenseAdam<F>)) {
    let start = case.file.f64("param0").iter().map(|&x| F::from_f64(x)).collect();
    let mut adam = DenseAdam::new(case.config, start);
    for (i, &lr) in case.lrs.iter().enumerate() {
        let grads: Vec<F> = case.grads(i + 1).into_iter().map(F::from_f64).collect();
        adam.step(&grads, lr);
        if let Some(snap) = case.snaps.iter().position(|&s| s == i + 1) {
            check(snap, &adam);
        }
    }
}

#[test]
fn adam_dense_f64_equals_torch() {
    for name in FILES {
        let Some(case) = Case::open(name) else { return };
        run_dense::<f64>(&case, |snap, adam| {
            let error = max_abs(adam.values.iter().copied(), case.snapshot("param_f64", snap));
            // 1600 steps of a few f64 roundings of values near 1.
            assert!(error < 1e-12, "{name} snapshot {snap}: value {error:e}");
            let m = max_rel(adam.exp_avg.iter().copied(), case.snapshot("m_f64", snap));
            let v = max_rel(adam.exp_avg_sq.iter().copied(), case.snapshot("v_f64", snap));
            // Cancelling gradients cost digits of m.
            assert!(m < 1e-9 && v < 1e-11, "{name} snapshot {snap}: moments {m:e} {v:e}");
        });
    }
}

#[test]
fn adam_dense_f32_equals_torch() {
    for name in FILES {
        let Some(case) = Case::open(name) else { return };
        run_dense::<f32>(&case, |snap, adam| {
            let error = max_abs(adam.values.iter().map(|&x| f64::from(x)), case.snapshot("param_f64", snap));
            // The fixtures' README: torch in f32 is off by 4e-5, limit 2e-4 (0.02 of the rate).
            assert!(error < 2e-4, "{name} snapshot {snap}: {error:e}");
        });
    }
}

/// [`Torch32`] imitates torch in f32: nearly every value has torch's own bits. (Which operations torch's compiler fused
/// is a guess, and wrong for some tails of its loops; with no fused operation, or other ones, more than 8 % differ in
/// every file.)
#[test]
fn torch_in_f32_is_imitated() {
    for name in FILES {
        let Some(case) = Case::open(name) else { return };
        let mut torch = Torch32::new(case.config, case.file.f32("param0"));
        let (mut same, mut all) = (0, 0);
        for (i, &lr) in case.lrs.iter().enumerate() {
            let grads: Vec<f32> = case.grads(i + 1).into_iter().map(|g| g as f32).collect();
            torch.step(&grads, lr);
            if let Some(snap) = case.snaps.iter().position(|&s| s == i + 1) {
                let want = case.snapshot("param_f32", snap);
                same += torch.values.iter().zip(want).filter(|&(&a, &b)| f64::from(a) == b).count();
                all += want.len();
            }
        }
        // Measured: 91 to 98 %.
        assert!(same * 10 >= all * 9, "{name}: {same} of {all}");
    }
}

/// The fixture's values as means, one to a row, so that each follows its own touch schedule and both rate schedules
/// take the trainer's own path.
fn state_of(case: &Case) -> SceneState {
    let mut columns = Columns::zeros(case.values, 0);
    for (row, x) in case.file.f32("param0").into_iter().enumerate() {
        columns.means[3 * row] = x;
    }
    SceneState::from_columns(columns)
}

/// A rate schedule equal to the file's: constant, or exponential between its first and last rate.
fn rates_of(case: &Case) -> Rates {
    let (first, last) = (case.lrs[0], *case.lrs.last().unwrap());
    let steps = case.lrs.len() as u32 - 1;
    let rates = Rates { means: first, means_final_factor: last / first, ..Rates::new(1.0, steps) };
    for (step, &lr) in case.lrs.iter().enumerate() {
        assert!((rates.at(Column::Means, step as u32) / lr - 1.0).abs() < 1e-12);
    }
    rates
}

/// Deferred Adam with its state in f64: the remaining error is that of the formula.
#[test]
fn adam_deferred_in_f64_is_within_a_millionth_of_a_rate() {
    for name in FILES {
        let Some(case) = Case::open(name) else { return };
        let tables = DriftTables::new(rates_of(&case), case.config);
        let AdamConfig { beta1, beta2, eps } = case.config;
        let rate = case.lrs[0];
        let mut values = case.file.f64("param0").to_vec();
        let mut moments = vec![[0.0f64; 2]; case.values];
        // A row takes a step when one of its columns has a gradient.
        let mut stamps = vec![0u32; case.values / case.columns];
        let value_at = |values: &[f64], moments: &[[f64; 2]], stamps: &[u32], i: usize, now: u32| {
            values[i] - rate * tables.movement(moments[i], stamps[i / case.columns], now, true)
        };
        for step in 1..=case.lrs.len() {
            let (now, grads) = (step as u32 - 1, case.grads(step));
            for (row, grads) in grads.chunks(case.columns).enumerate().filter(|(_, g)| g.iter().any(|&g| g != 0.0)) {
                let missed = f64::from(now - stamps[row]);
                for (i, g) in grads.iter().enumerate().map(|(column, g)| (row * case.columns + column, g)) {
                    values[i] = value_at(&values, &moments, &stamps, i, now);
                    let [m, v] = [moments[i][0] * beta1.powf(missed), moments[i][1] * beta2.powf(missed)];
                    let [m, v] = [m + (1.0 - beta1) * (g - m), v + (1.0 - beta2) * (g * g - v)];
                    let [correction1, correction2] = [beta1, beta2].map(|b| 1.0 - b.powf(step as f64));
                    values[i] -= case.lrs[step - 1] / correction1 * m / ((v / correction2).sqrt() + eps);
                    moments[i] = [m, v];
                }
                stamps[row] = step as u32;
            }
            let Some(snap) = case.snaps.iter().position(|&s| s == step) else { continue };
            let now = (0..case.values).map(|i| value_at(&values, &moments, &stamps, i, step as u32));
            let error = max_abs(now, case.snapshot("param_f64", snap)) / rate;
            // The truncation error of the series near its floor; each later step adds its own.
            assert!(error < 1e-6, "{name} after step {step}: {error:e} of a rate");
        }
    }
}

#[test]
fn adam_deferred_equals_torch_at_every_snapshot() {
    let (mut unlucky, mut values) = (0, 0);
    for name in FILES {
        let Some(case) = Case::open(name) else { return };
        let adam = DeferredAdam::new(rates_of(&case), case.config, SimdPath::best());
        let mut state = state_of(&case);
        let all: Vec<u32> = (0..state.rows() as u32).collect();
        let mut grads = Columns::zeros(state.rows(), 0);
        // Largest errors of a value over all snapshots, ours and those of torch in f32.
        let mut largest = vec![[0.0f64; 2]; case.values];
        for step in 1..=case.lrs.len() {
            for (i, g) in case.grads(step).into_iter().enumerate() {
                grads.means[3 * i] = g as f32;
            }
            let counts = take_step(&adam, &mut state, &all, &grads, step as u32 - 1);
            let touched = all.iter().filter(|&&r| grads.row(Column::Means, r as usize).iter().any(|&g| g != 0.0));
            assert_eq!(counts.updated, touched.count());
            let Some(snap) = case.snaps.iter().position(|&s| s == step) else { continue };
            let stored = state.clone();
            let value = |i: usize| {
                let first = |table: &Columns| table.means[3 * i];
                let (value, m, v) = (first(&state.columns), first(&state.exp_avg), first(&state.exp_avg_sq));
                f64::from(adam.evaluate(Column::Means, value, m, v, state.stamp[i], step as u32))
            };
            let error = max_abs((0..case.values).map(value), case.snapshot("param_f64", snap));
            // The README's limit for f32 is 2e-4; a deferred value takes fewer roundings than a dense one.
            assert!(error < 4e-5, "{name} after step {step}: {error:e}");
            assert_eq!(stored, state);
            let (want, torch) = (case.snapshot("param_f64", snap), case.snapshot("param_f32", snap));
            for (i, largest) in largest.iter_mut().enumerate() {
                let errors = [value(i), torch[i]].map(|x| (x - want[i]).abs());
                *largest = std::array::from_fn(|k| largest[k].max(errors[k]));
            }
        }
        unlucky += compare_with_torch_in_f32(&case, name, &largest);
        values += case.values;
    }
    // Likewise less than one in a hundred of the values of other seeds (`adam_seeds`).
    assert!(unlucky * 67 <= values, "{unlucky} of {values} values");
}

/// At most twice the errors of torch in f32: for every touch schedule and every gradient size (largest over the others),
/// and for single values but for a few. Of one value both errors are a matter of which way the roundings of its second
/// moment happen to fall, in torch as here: where its own were lucky, twice of it is less than they are expected to be.
/// Returns how many of them there are.
fn compare_with_torch_in_f32(case: &Case, name: &str, largest: &[[f64; 2]]) -> usize {
    let over = |of: &dyn Fn(usize) -> bool| {
        let chosen = largest.iter().enumerate().filter(|&(i, _)| of(i));
        chosen.fold([0.0f64; 2], |a, (_, b)| [a[0].max(b[0]), a[1].max(b[1])])
    };
    for row in 0..case.values / case.columns {
        let [ours, torch] = over(&|i| i / case.columns == row);
        assert!(ours <= 2.0 * torch, "{name} schedule {row}: {ours:e}, torch in f32 {torch:e}");
    }
    for column in 0..case.columns {
        let [ours, torch] = over(&|i| i % case.columns == column);
        assert!(ours <= 2.0 * torch, "{name} gradient size {column}: {ours:e}, torch in f32 {torch:e}");
    }
    let unlucky: Vec<_> = largest.iter().copied().filter(|[ours, torch]| *ours > 2.0 * torch).collect();
    assert!(unlucky.iter().all(|[ours, torch]| *ours <= 10.0 * torch), "{name}: {unlucky:?}");
    unlucky.len()
}
