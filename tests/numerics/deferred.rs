//! Deferred Adam follows dense Adam for every value, however long a row sleeps and however often it is read. Reading a
//! row changes no bit.

use crate::support::dense_adam::DenseAdam;
use crate::support::paths;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::densify::ops::reset_opacity_rows;
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::moments::Moments;
use gsscale::optim::rates::Rates;
use gsscale::optim::row_kernels::{evaluate_rows, step_rows, take_step};
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::rows::{BLOCK_LANES, RowsMut, RowsNow, first_lane};
use gsscale::scene::state::SceneState;
use gsscale::train::step::catch_up;

const STEPS: u32 = 5200;

/// Whether row `row` has a gradient at a step: never, every 7th, in bursts, once at the end, always.
fn is_touched(row: usize, step: u32) -> bool {
    match row % 5 {
        0 => false,
        1 => step % 7 == 3,
        2 => step % 900 < 12,
        3 => step == STEPS - 1,
        _ => true,
    }
}

fn random_columns(rows: usize, sh_degree: u8, size: f64, key: u64) -> Columns {
    let mut columns = Columns::zeros(rows, sh_degree);
    let mut draws = Stream::new(5, Purpose::Test, key, 0);
    for column in Column::ALL {
        columns.column_mut(column).iter_mut().for_each(|x| *x = (draws.normal() * size) as f32);
    }
    columns
}

/// Gradients of the listed rows at a step: noise around a mean, size depending on the row.
fn grads_at(rows: &[u32], sh_degree: u8, step: u32) -> Columns {
    let mut grads = Columns::zeros(rows.len(), sh_degree);
    for (i, &row) in rows.iter().enumerate() {
        let mut draws = Stream::new(6, Purpose::Test, u64::from(row), u64::from(step));
        let size = libm::pow(10.0, -f64::from(row % 8));
        for column in Column::ALL {
            grads.row_mut(column, i).iter_mut().for_each(|x| *x = ((draws.normal() + 0.3) * size) as f32);
        }
    }
    grads
}

/// All rows after `now` steps.
pub fn evaluate_all(state: &SceneState, adam: &DeferredAdam, now: u32) -> Columns {
    catch_up::evaluate_all(&[state.view()], state.sh_degree(), adam, now)
}

fn touched_rows(rows: usize, step: u32) -> Vec<u32> {
    (0..rows as u32).filter(|&row| is_touched(row as usize, step)).collect()
}

#[test]
fn values_follow_dense_adam_in_f64() {
    let rows = 10;
    for (means_final_factor, others_final_factor) in [(1.0, 1.0), (0.01, 0.1)] {
        let rates = Rates { means_final_factor, others_final_factor, ..Rates::new(3.0, STEPS) };
        let adam = DeferredAdam::new(rates, AdamConfig::default(), SimdPath::best());
        let start = random_columns(rows, 0, 1.0, 1);
        let mut state = SceneState::from_columns(start.clone());
        let widen = |c: &[f32]| c.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
        let mut dense = Column::ALL.map(|c| DenseAdam::<f64>::new(AdamConfig::default(), widen(start.column(c))));
        let mut narrow = Column::ALL.map(|c| DenseAdam::<f32>::new(AdamConfig::default(), start.column(c).to_vec()));
        // Values written so far, per row: each write rounds the value once.
        let mut writes = vec![0.0f64; rows];
        let (mut sum_deferred, mut sum_dense_f32) = (0.0, 0.0);
        for step in 0..STEPS {
            let listed = touched_rows(rows, step);
            let grads = grads_at(&listed, 0, step);
            take_step(&adam, &mut state, &listed, &grads, step);
            listed.iter().for_each(|&row| writes[row as usize] += 1.0);
            let mut full = Columns::zeros(rows, 0);
            for column in Column::ALL {
                for (i, &row) in listed.iter().enumerate() {
                    full.row_mut(column, row as usize).copy_from_slice(grads.row(column, i));
                }
            }
            for (i, column) in Column::ALL.into_iter().enumerate() {
                dense[i].step(&widen(full.column(column)), rates.at(column, step));
                narrow[i].step(full.column(column), rates.at(column, step));
            }
            if step % 650 != 649 && step + 1 != STEPS {
                continue;
            }
            let now = evaluate_all(&state, &adam, step + 1);
            for (i, column) in Column::ALL.into_iter().enumerate().filter(|(_, c)| *c != Column::ShN) {
                let (width, rate) = (column.width(0), rates.base(column));
                for (j, (&got, &want)) in now.column(column).iter().zip(&dense[i].values).enumerate() {
                    let error = (f64::from(got) - want).abs();
                    // Half an ulp of the value for every write and for this read, and 1e-6 of the learning rate for
                    // every write (moments in f32) and read.
                    let half_ulp = want.abs() * f64::from(f32::EPSILON) / 2.0;
                    let slack = (1.0 + writes[j / width]) * (half_ulp + 1e-6 * rate);
                    assert!(error <= slack, "{column:?} value {j} after step {step}: {error:e} > {slack:e}");
                    sum_deferred += error / rate;
                    sum_dense_f32 += (f64::from(narrow[i].values[j]) - want).abs() / rate;
                }
            }
        }
        assert!(sum_deferred < sum_dense_f32, "deferred {sum_deferred} is further off than f32 {sum_dense_f32}");
    }
}

/// A long run: each step sees a random fiftieth of the rows, and opacities are reset every 3,000 steps. Two values of a
/// row have gradients: a position, whose learning rate decays, and the opacity.
#[test]
fn thousands_of_rows_follow_dense_adam_over_a_long_run_with_resets() {
    const RUN: u32 = 50_000;
    let (rows, resets) = (4_000, 3_000);
    let cap = (0.02f32 / 0.98).ln();
    let rates = Rates::new(3.0, RUN);
    let adam = DeferredAdam::new(rates, AdamConfig::default(), SimdPath::best());
    let mut start = Columns::zeros(rows, 0);
    let mut draws = Stream::new(21, Purpose::Test, 0, 0);
    (0..rows).for_each(|row| start.means[3 * row] = draws.normal() as f32);
    start.opacities.iter_mut().for_each(|x| *x = draws.normal() as f32);
    let mut state = SceneState::from_columns(start.clone());
    let first: Vec<f64> = start.means.iter().step_by(3).map(|&x| f64::from(x)).collect();
    let mut means = DenseAdam::<f64>::new(AdamConfig::default(), first);
    let logits = start.opacities.iter().map(|&x| f64::from(x)).collect();
    let mut opacities = DenseAdam::<f64>::new(AdamConfig::default(), logits);
    let mut writes = vec![0.0f64; rows];
    for step in 0..RUN {
        let mut listed: Vec<u32> = (0..rows / 50).map(|_| draws.below(rows as u64) as u32).collect();
        listed.sort_unstable();
        listed.dedup();
        let mut grads = Columns::zeros(listed.len(), 0);
        let mut dense = [vec![0.0f64; rows], vec![0.0f64; rows]];
        for (i, &row) in listed.iter().enumerate() {
            let row = row as usize;
            let size = libm::pow(10.0, -((row % 8) as f64));
            let [a, b] = [0.3, -0.1].map(|mean| ((draws.normal() + mean) * size) as f32);
            (grads.means[3 * i], grads.opacities[i]) = (a, b);
            (dense[0][row], dense[1][row]) = (f64::from(a), f64::from(b));
            writes[row] += 1.0;
        }
        take_step(&adam, &mut state, &listed, &grads, step);
        means.step(&dense[0], rates.at(Column::Means, step));
        opacities.step(&dense[1], rates.at(Column::Opacities, step));
        if (step + 1) % resets == 0 {
            reset_opacity_rows(&adam.at(step + 1), &mut state.view_mut(), 0.02);
            opacities.values.iter_mut().for_each(|x| *x = x.min(f64::from(cap)));
            opacities.exp_avg.fill(0.0);
            opacities.exp_avg_sq.fill(0.0);
            // The reset settles all rows: one more rounding of each value.
            writes.iter_mut().for_each(|w| *w += 1.0);
        }
        if (step + 1) % 5_000 != 0 {
            continue;
        }
        let now = evaluate_all(&state, &adam, step + 1);
        let base = |column| rates.base(column);
        let mut mean_squares = [0.0f64; 2];
        for row in 0..rows {
            let values = [
                (now.means[3 * row], means.values[row], base(Column::Means)),
                (now.opacities[row], opacities.values[row], base(Column::Opacities)),
            ];
            for ((got, want, rate), mean_square) in values.into_iter().zip(&mut mean_squares) {
                // Roundings of the value, one for every write and this read, go to either side: six standard deviations
                // of as many uniform draws within half an ulp. Roundings of the moments may all go to one side: a
                // millionth of the learning rate each.
                let half_ulp = want.abs().max(1.0) * f64::from(f32::EPSILON) / 2.0;
                let count = 1.0 + writes[row];
                let slack = 6.0 * (count / 3.0).sqrt() * half_ulp + 1e-6 * count * rate;
                let error = (f64::from(got) - want).abs();
                assert!(error <= slack, "row {row} after step {step}: {error:e} > {slack:e}");
                *mean_square += error * error / rows as f64;
            }
        }
        // Values are of the order of one; a thousand uniform draws within half an ulp of one sum to 1.1e-6.
        assert!(mean_squares.iter().all(|x| x.sqrt() < 4e-6), "after step {step}: {mean_squares:?}");
    }
}

#[test]
fn reading_any_number_of_times_changes_no_bit_and_late_equals_on_time() {
    let (rows, degree) = (300, 2);
    let adam = DeferredAdam::new(Rates::new(1.0, 900), AdamConfig::default(), SimdPath::best());
    let start = random_columns(rows, degree, 1.0, 2);
    let (mut quiet, mut read) = (SceneState::from_columns(start.clone()), SceneState::from_columns(start));
    for step in 0..1000 {
        let listed = touched_rows(rows, step);
        let grads = grads_at(&listed, degree, step);
        take_step(&adam, &mut quiet, &listed, &grads, step);
        if step % 3 == 0 {
            let before = read.clone();
            let mut out = Columns::zeros(0, degree);
            catch_up::gather(&[read.view()], degree, &adam, step, &listed, &mut out);
            evaluate_all(&read, &adam, step + 500);
            assert_eq!(before, read);
        }
        take_step(&adam, &mut read, &listed, &grads, step);
    }
    assert_eq!(quiet, read);
    assert_eq!(evaluate_all(&quiet, &adam, 3000), evaluate_all(&read, &adam, 3000));
}

fn bits_of(state: &SceneState) -> Vec<u32> {
    let tables = [&state.columns, &state.exp_avg, &state.exp_avg_sq];
    let floats = tables.iter().flat_map(|t| Column::ALL.into_iter().flat_map(|c| t.column(c)));
    floats.map(|x| x.to_bits()).chain(state.stamp.iter().copied()).collect()
}

/// Rows with denormal values or with log-scales beyond their limits.
fn eventful_start(degree: u8) -> SceneState {
    let mut state = SceneState::from_columns(random_columns(2100, degree, 1.0, 3));
    for column in Column::ALL {
        state.columns.column_mut(column).iter_mut().step_by(37).for_each(|x| *x = 1e-40);
    }
    state.columns.scales.iter_mut().step_by(41).for_each(|x| *x = if *x < 0.0 { -80.0 } else { 80.0 });
    state
}

/// Gradients that decide whether a row is updated: the value for all entries, if any, then a column, a place in its row
/// (0 the first, 1 the last value) and the value there.
const ODD_GRADS: [(Option<f32>, Column, f64, f32); 16] = [
    (Some(0.0), Column::Means, 0.0, 0.0),
    (Some(-0.0), Column::Means, 0.0, 0.0),
    (Some(0.0), Column::ShN, 1.0, 1e-3),
    (Some(0.0), Column::ShN, 0.0, 1e-3),
    (Some(0.0), Column::Scales, 1.0, 1e-3),
    (Some(0.0), Column::Sh0, 1.0, 1e-3),
    (Some(0.0), Column::Opacities, 0.0, -1e-3),
    (Some(0.0), Column::Quats, 1.0, 1e-45),
    (None, Column::Means, 0.5, 0.0),
    (None, Column::Sh0, 1.0, f32::NAN),
    (None, Column::ShN, 0.0, f32::NAN),
    (None, Column::ShN, 1.0, -f32::NAN),
    (None, Column::Quats, 0.0, f32::INFINITY),
    (None, Column::Scales, 0.0, f32::NEG_INFINITY),
    (None, Column::Means, 1.0, 1e18),
    (None, Column::Means, 1.0, -1.0000001e18),
];

/// An eps at which some rows (gradients down to 1e-7) take the direct sum.
fn eventful_config() -> AdamConfig {
    AdamConfig { eps: 1e-8, ..AdamConfig::default() }
}

/// 60 steps that reach every branch of each loop: rows without a gradient, rows with a skipped gradient, first moments
/// of zero, second moments near eps.
fn eventful_steps(simd: SimdPath, degree: u8, moments: Moments) -> (DeferredAdam, SceneState, [usize; 2]) {
    let adam = DeferredAdam::new(Rates::new(1.0, 100), eventful_config(), simd).with_moments(moments);
    let mut state = eventful_start(degree);
    let rows = state.rows();
    let mut counts = [0, 0];
    for step in 0..60 {
        let listed: Vec<u32> = (0..rows as u32).filter(|r| (r * 7 + step) % 11 < 3).collect();
        let mut grads = grads_at(&listed, degree, step);
        for (k, i) in (step as usize % 3..listed.len()).step_by(5).enumerate() {
            let (others, column, of_row, value) = ODD_GRADS[k % ODD_GRADS.len()];
            if let Some(others) = others {
                Column::ALL.into_iter().for_each(|column| grads.row_mut(column, i).fill(others));
            }
            let row = grads.row_mut(column, i);
            let at = ((row.len() as f64 - 1.0) * of_row) as usize;
            if let Some(x) = row.get_mut(at) {
                *x = value;
            }
        }
        let of_step = take_step(&adam, &mut state, &listed, &grads, step);
        counts = [counts[0] + of_step.updated, counts[1] + of_step.skipped_non_finite];
    }
    (adam, state, counts)
}

/// Evaluates a list of rows in any order, with duplicates, after `now` steps.
fn evaluate_listed(state: &SceneState, adam: &DeferredAdam, now: u32) -> Columns {
    let rows = state.rows();
    let mut out = Columns::zeros(rows + 130, state.sh_degree());
    evaluate_rows(&adam.at(now), state.view(), |i| (rows - 1 - i % rows) * 11 % rows, out.view_mut());
    out
}

#[test]
fn the_same_bits_on_every_instruction_path_whatever_happens_to_rows() {
    for (degree, moments) in [(0, Moments::F32), (1, Moments::F32), (2, Moments::Bf16), (3, Moments::F32)] {
        let (plain, state, counts) = eventful_steps(SimdPath::Baseline, degree, moments);
        assert!(counts[0] > 10_000 && counts[1] > 1000, "{counts:?}");
        for simd in paths() {
            let (adam, same, same_counts) = eventful_steps(simd, degree, moments);
            assert!(bits_of(&same) == bits_of(&state), "{} at degree {degree}", simd.name());
            assert_eq!(same_counts, counts);
            let start = eventful_start(degree);
            for now in [0, 58, 59, 60, 61, 77, 459, 460, 5000] {
                let state = if now == 0 { &start } else { &state };
                let (want, got) = (evaluate_listed(state, &plain, now), evaluate_listed(state, &adam, now));
                for column in Column::ALL {
                    let bits = |c: &Columns| -> Vec<u32> { c.column(column).iter().map(|x| x.to_bits()).collect() };
                    assert!(bits(&got) == bits(&want), "{} at degree {degree}: {column:?} at {now}", simd.name());
                }
            }
        }
    }
}

/// Every path gives NaN and infinity for the same values and equal bits for all others: no path hides a broken state.
#[test]
fn nan_stays_nan_on_every_instruction_path() {
    let (plain, mut state, _) = eventful_steps(SimdPath::Baseline, 3, Moments::F32);
    for (table, every) in [(&mut state.columns, 29), (&mut state.exp_avg, 31), (&mut state.exp_avg_sq, 37)] {
        Column::ALL.into_iter().for_each(|c| table.column_mut(c).iter_mut().step_by(every).for_each(|x| *x = f32::NAN));
    }
    // Payloads and signs may differ.
    let bits = |c: &Columns, column| -> Vec<u32> {
        c.column(column).iter().map(|x| if x.is_nan() { u32::MAX } else { x.to_bits() }).collect()
    };
    for (simd, now) in each_path([60, 61, 77, 5000]) {
        let adam = DeferredAdam::new(Rates::new(1.0, 100), eventful_config(), simd);
        let (want, got) = (evaluate_listed(&state, &plain, now), evaluate_listed(&state, &adam, now));
        for column in Column::ALL {
            let want = bits(&want, column);
            let share = want.iter().filter(|&&x| x == u32::MAX).count() as f64 / want.len() as f64;
            assert!((0.03..0.5).contains(&share), "{column:?}: {share}");
            assert!(bits(&got, column) == want, "{}: {column:?} at {now}", simd.name());
        }
    }
}

#[test]
fn every_way_of_reading_gives_the_same_bits() {
    for simd in paths() {
        let (adam, state, _) = eventful_steps(simd, 3, Moments::F32);
        for now in [60, 61, 77, 459, 460, 461, 5000] {
            let all = evaluate_all(&state, &adam, now);
            let listed: Vec<u32> = (0..state.rows() as u32).step_by(13).collect();
            let mut gathered = Columns::default();
            catch_up::gather(&[state.view()], 3, &adam, now, &listed, &mut gathered);
            let at = adam.at(now);
            for (place, row) in (0..state.rows()).step_by(13).enumerate() {
                let mut block = [0.0; BLOCK_LANES];
                at.evaluate_row(&state.view(), row, &mut block);
                for column in Column::ALL {
                    for (i, &x) in all.row(column, row).iter().enumerate() {
                        assert_eq!(x.to_bits(), gathered.row(column, place)[i].to_bits());
                        assert_eq!(x.to_bits(), block[first_lane(column) + i].to_bits());
                        assert_eq!(x.to_bits(), at.evaluate_element(&state.view(), column, row, i).to_bits());
                        let (m, v) = (state.exp_avg.row(column, row)[i], state.exp_avg_sq.row(column, row)[i]);
                        let value = state.columns.row(column, row)[i];
                        let one = adam.evaluate(column, value, m, v, state.stamp[row], now);
                        assert_eq!(x.to_bits(), one.to_bits());
                    }
                }
            }
        }
    }
}

#[test]
fn settling_a_row_keeps_its_later_values() {
    let adam = DeferredAdam::new(Rates::new(1.0, 2000), AdamConfig::default(), SimdPath::best());
    let mut state = SceneState::from_columns(random_columns(20, 1, 1.0, 4));
    let all: Vec<u32> = (0..20).collect();
    for step in 0..40 {
        take_step(&adam, &mut state, &all, &grads_at(&all, 1, step), step);
    }
    let want = evaluate_all(&state, &adam, 300);
    let mut view = state.view_mut();
    (0..20).for_each(|row| adam.at(45).settle_row(&mut view, row));
    assert!(state.stamp.iter().all(|&s| s == 45));
    let got = evaluate_all(&state, &adam, 300);
    for column in Column::ALL {
        for (a, b) in got.column(column).iter().zip(want.column(column)) {
            // One more rounding of the value, and of moments that still move the value by a few learning rates.
            let slack = b.abs() * f32::EPSILON + 1e-6 * adam.rates().base(column) as f32;
            assert!((a - b).abs() <= slack, "{column:?} {a} {b}");
        }
    }
}

#[test]
fn gradients_that_are_not_finite_or_zero_leave_their_row_alone() {
    for simd in paths() {
        let adam = DeferredAdam::new(Rates::new(1.0, 2000), AdamConfig::default(), simd);
        let mut state = SceneState::from_columns(random_columns(6, 3, 1.0, 5));
        state.columns.scales[15] = 80.0;
        let all: Vec<u32> = (0..6).collect();
        let mut grads = grads_at(&all, 3, 0);
        grads.row_mut(Column::ShN, 1)[44] = f32::NAN;
        grads.row_mut(Column::Opacities, 2)[0] = f32::INFINITY;
        grads.row_mut(Column::Means, 3)[1] = 1e30;
        for column in Column::ALL {
            grads.row_mut(column, 4).fill(-0.0);
        }
        let before = state.clone();
        let counts = take_step(&adam, &mut state, &all, &grads, 9);
        assert_eq!((counts.updated, counts.skipped_non_finite), (2, 3));
        assert_eq!(state.stamp, [10, 0, 0, 0, 0, 10]);
        for row in 1..5 {
            for column in Column::ALL {
                assert_eq!(state.columns.row(column, row), before.columns.row(column, row));
                assert_eq!(state.exp_avg_sq.row(column, row), before.exp_avg_sq.row(column, row));
            }
        }
        // A runaway log-scale is clamped to the limit when its row is updated.
        assert_eq!(state.columns.scales[15], 30.0);
        assert!(Column::ALL.into_iter().all(|c| state.columns.column(c).iter().all(|x| x.is_finite())));
    }
}

/// A load of a row also reads a little of the next row, and the last row of a table takes a different code path.
#[test]
fn a_rows_result_does_not_depend_on_its_neighbours() {
    for simd in paths() {
        let bits = |values: &[f32]| -> Vec<u32> { values.iter().map(|x| x.to_bits()).collect() };
        for (degree, moments, eps) in
            [(0, Moments::F32, 1e-15), (1, Moments::F32, 1e-8), (2, Moments::Bf16, 1e-15), (3, Moments::F32, 1e-8)]
        {
            let rows = 23;
            let config = AdamConfig { eps, ..AdamConfig::default() };
            let adam = DeferredAdam::new(Rates::new(1.0, 2000), config, simd).with_moments(moments);
            let mut together = SceneState::from_columns(random_columns(rows, degree, 1.0, 8));
            let mut alone: Vec<SceneState> = (0..rows as u32).map(|row| together.select(&[row])).collect();
            for (step, now) in [3, 4, 40, 900].into_iter().enumerate() {
                let listed: Vec<u32> = (0..rows as u32).filter(|row| !(row + step as u32).is_multiple_of(4)).collect();
                let mut grads = grads_at(&listed, degree, now);
                for i in 0..listed.len() {
                    // Rows without a gradient and skipped rows lie before and after others.
                    let of = [None, Some(0.0), None, Some(f32::NAN), Some(0.0), None, None][(i + step) % 7];
                    if let Some(value) = of {
                        Column::ALL.into_iter().for_each(|column| grads.row_mut(column, i).fill(value));
                    }
                }
                let counts = take_step(&adam, &mut together, &listed, &grads, now);
                let mut counted = (0, 0);
                for (i, &row) in listed.iter().enumerate() {
                    let mut own = Columns::zeros(1, degree);
                    Column::ALL.into_iter().for_each(|c| own.row_mut(c, 0).copy_from_slice(grads.row(c, i)));
                    let of_row = take_step(&adam, &mut alone[row as usize], &[0], &own, now);
                    counted = (counted.0 + of_row.updated, counted.1 + of_row.skipped_non_finite);
                }
                assert_eq!((counts.updated, counts.skipped_non_finite), counted);
                assert!(counted.0 > 0 && counted.1 > 0 && counted.0 + counted.1 < listed.len());
                let values = evaluate_all(&together, &adam, now + 20);
                for (row, own) in alone.iter().enumerate() {
                    let stored = together.select(&[row as u32]);
                    assert_eq!(&stored, own, "row {row} at degree {degree}");
                    let own_values = evaluate_all(own, &adam, now + 20);
                    for column in Column::ALL {
                        for (a, b) in [(&stored.columns, &own.columns), (&stored.exp_avg, &own.exp_avg)] {
                            assert_eq!(bits(a.row(column, 0)), bits(b.row(column, 0)));
                        }
                        assert_eq!(bits(values.row(column, row)), bits(own_values.row(column, 0)));
                    }
                }
            }
        }
    }
}

fn each_path<T: Clone, const N: usize>(cases: [T; N]) -> impl Iterator<Item = (SimdPath, T)> {
    let paths = paths();
    paths.flat_map(move |simd| cases.clone().map(|case| (simd, case)))
}

#[test]
fn a_list_that_does_not_ascend_is_refused_before_any_row_is_changed() {
    for (simd, list) in each_path([vec![3, 1, 2], vec![1, 1], vec![0, 5, 4]]) {
        let adam = DeferredAdam::new(Rates::new(1.0, 2000), AdamConfig::default(), simd);
        let mut state = SceneState::from_columns(random_columns(6, 3, 1.0, 5));
        let (before, grads) = (state.clone(), grads_at(&list, 3, 0));
        let step = std::panic::AssertUnwindSafe(|| take_step(&adam, &mut state, &list, &grads, 9));
        assert!(std::panic::catch_unwind(step).is_err(), "{list:?}");
        assert_eq!(state, before, "{list:?}");
    }
}

/// Rows 3000 to 5200 of a table, processed in pieces.
#[test]
fn a_list_that_does_not_fit_the_view_is_refused_before_any_row_is_changed() {
    for simd in paths() {
        let adam = DeferredAdam::new(Rates::new(1.0, 2000), AdamConfig::default(), simd);
        let all: Vec<u32> = (3000..5200).collect();
        let (grads, values) = (grads_at(&all, 3, 0), random_columns(all.len(), 3, 1.0, 5));
        let start = SceneState::from_columns(values.clone());
        // All rows but the odd one have valid gradients, so that an error beside the odd row would show.
        let last = all.len() - 1;
        for (at, row) in [(0, 3000), (0, 2999), (last, 5200), (last, 5198), (10, 3011)] {
            let (mut list, is_right) = (all.clone(), all[at] == row);
            list[at] = row;
            let mut state = start.clone();
            let step = std::panic::AssertUnwindSafe(|| {
                let view = RowsMut { first_row: 3000, ..state.view_mut() };
                step_rows(&adam.at(9), view, &list, values.view(), grads.view())
            });
            let counts = std::panic::catch_unwind(step).ok().map(|counts| counts.updated);
            assert_eq!(counts, is_right.then_some(all.len()), "{} {at} {row}", simd.name());
            assert_eq!(bits_of(&state) == bits_of(&start), !is_right, "{} {at} {row}", simd.name());
        }
    }
}

#[test]
fn without_catch_up_rows_keep_their_values_without_a_gradient() {
    let (rows, degree) = (40, 1);
    let adam = DeferredAdam::new(Rates::new(1.0, 2000), AdamConfig::default(), SimdPath::best());
    let sparse = adam.clone().without_catch_up();
    let start = random_columns(rows, degree, 1.0, 8);
    let all: Vec<u32> = (0..rows as u32).collect();
    let (mut still, mut exact) = (SceneState::from_columns(start.clone()), SceneState::from_columns(start));
    for step in 0..5 {
        let grads = grads_at(&all, degree, step);
        take_step(&sparse, &mut still, &all, &grads, step);
        take_step(&adam, &mut exact, &all, &grads, step);
    }
    assert!(still == exact, "with a gradient at every step there is nothing to catch up with");
    // Many steps later.
    assert!(evaluate_all(&still, &sparse, 1500) == still.columns);
    assert!(evaluate_all(&exact, &adam, 1500) != exact.columns);
    let before = still.clone();
    let at = sparse.at(1500);
    (0..rows).for_each(|row| at.settle_row(&mut still.view_mut(), row));
    assert!(
        still.columns == before.columns && still.exp_avg == before.exp_avg && still.exp_avg_sq == before.exp_avg_sq
    );
    // The next gradient finds the moments as the last gradient left them.
    let grads = grads_at(&all, degree, 1500);
    take_step(&sparse, &mut still, &all, &grads, 1500);
    let (m, g) = (before.exp_avg.means[0], grads.means[0]);
    assert!((still.exp_avg.means[0] - (0.9 * m + 0.1 * g)).abs() <= 1e-6 * (m.abs() + g.abs()));
}
