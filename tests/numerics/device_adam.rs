//! The f32 form of deferred Adam that devices compute, by its twin, against dense Adam in f64 over 50,000 steps.

use crate::support::dense_adam::DenseAdam;
use crate::twins::deferred::TableWords;
use crate::twins::gather::{GatherInput, gather};
use crate::twins::page_words::{Table, Words};
use crate::twins::update::{UpdateInput, finish, judge, step};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::kernels::deferred::DeferredTables;
use gsscale::kernels::page_words::{DevicePage, PageResult};
use gsscale::kernels::uniforms_pages::{GatherUniforms, SplitNumbers, UpdateUniforms};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::page_layout::{capacity_bytes, write_page};
use gsscale::scene::state::SceneState;

const STEPS: u32 = 50_000;
/// A row has a gradient once in so many steps.
const PERIODS: [u32; 12] = [1, 1, 2, 3, 7, 40, 199, 201, 399, 401, 3000, 20_000];
const SPLITS: SplitNumbers = SplitNumbers { grow_grad2d: f32::INFINITY, split_scale: f32::INFINITY, reach: 0.0 };

fn camera() -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let (width, height) = (16, 16);
    Camera { viewmat, fx: 8.0, fy: 8.0, cx: 8.0, cy: 8.0, width, height, near_plane: 0.01, far_plane: 1e10 }
}

/// Gradient of an element: rows differ by size, down to where eps matters.
fn gradient(row: usize, draws: &mut Stream) -> f32 {
    let size = [1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15][row % 6];
    (draws.normal() * size) as f32
}

#[test]
fn the_form_of_devices_follows_dense_adam() {
    for eps in [1e-15, 1e-8] {
        let (rates, config) = (Rates::new(1.0, STEPS), AdamConfig { eps, ..AdamConfig::default() });
        let adam = DeferredAdam::new(rates, config, SimdPath::best());
        let numbers = adam.numbers(STEPS).unwrap();
        let tables = DeferredTables::new(&numbers);
        let tables = TableWords::from(&tables);
        let mut state = SceneState::from_columns(Columns::zeros(PERIODS.len(), 0));
        let mut draws = Stream::new(9, Purpose::Test, 0, 0);
        for column in Column::ALL {
            state.columns.column_mut(column).fill_with(|| draws.range(-2.0, 2.0) as f32);
        }
        let exact = |column| state.columns.column(column).iter().map(|x| f64::from(*x)).collect();
        let mut dense = Column::ALL.map(|column| DenseAdam::<f64>::new(config, exact(column)));
        let mut words = vec![0u64; capacity_bytes(PERIODS.len(), 0).div_ceil(8)];
        let layout = write_page(&state, bytemuck::cast_slice_mut(&mut words));
        let mut slab: Vec<u32> = bytemuck::cast_slice(&words).to_vec();
        let pages = [DevicePage::new(layout, 0, 0, 0)];
        let mut updates = [0u32; PERIODS.len()];
        for now in 0..STEPS {
            let rows: Vec<[u32; 2]> =
                (0..PERIODS.len()).filter(|row| now % PERIODS[*row] == 0).map(|row| [0, row as u32]).collect();
            let numbers_now = adam.at(now).numbers();
            let gathers = GatherUniforms::new(&camera(), &numbers, now, &SPLITS, 1);
            let of_step = UpdateUniforms::new(&camera(), &numbers_now, false);
            let mut largest = vec![0; rows.len()];
            let mut parts = Vec::new();
            for column in Column::ALL.into_iter().filter(|c| c.width(0) > 0) {
                let width = column.width(0);
                let uniforms = gathers.of_column(&numbers, column, width, 0);
                let input = GatherInput {
                    uniforms: &uniforms,
                    pages: &pages,
                    slab: &slab,
                    tables,
                    recent: &numbers_now.recent,
                };
                let mut values = vec![0.0; rows.len() * width];
                gather(&input, &rows, &mut values);
                let grads: Vec<f32> = rows
                    .iter()
                    .flat_map(|[_, row]| [*row as usize].repeat(width))
                    .map(|row| gradient(row, &mut draws))
                    .collect();
                let mut all = vec![0.0; PERIODS.len() * width];
                for (i, [_, row]) in rows.iter().enumerate() {
                    let to = &mut all[*row as usize * width..][..width];
                    to.iter_mut().zip(&grads[i * width..]).for_each(|(to, g)| *to = f64::from(*g));
                }
                dense[column as usize].step(&all, rates.at(column, now));
                judge(width, &grads, &mut largest);
                parts.push((column, values, grads));
            }
            for (column, values, grads) in parts {
                let uniforms = of_step.of_column(&numbers_now, column, column.width(0), 0);
                let input = UpdateInput { uniforms: &uniforms, pages: &pages, rows: &rows, tables, largest: &largest };
                step(&input, &values, &grads, &mut slab);
            }
            let input = UpdateInput { uniforms: &of_step, pages: &pages, rows: &rows, tables, largest: &largest };
            let mut results = [<PageResult as bytemuck::Zeroable>::zeroed()];
            finish(&input, &vec![[0.0; 4]; rows.len()], &mut slab, &mut results, &mut []);
            assert_eq!((results[0].updated as usize, results[0].skipped), (rows.len(), 0));
            rows.iter().for_each(|[_, row]| updates[*row as usize] += 1);
            if (now + 1) % 997 == 0 || now + 1 == STEPS {
                check(&adam, tables, (&slab, &pages[0]), &dense, &updates, now + 1);
            }
        }
    }
}

/// Compares the values after `now` steps.
///
/// The limit is 1 unit in the last place of the value and 3e-6 of a rate for a row without updates since. Each update adds a
/// rounding of the value to nearest, half a unit with either sign, and some roundings of its own movement: a random walk, of
/// which six standard deviations are allowed.
fn check(
    adam: &DeferredAdam,
    tables: TableWords<'_>,
    (slab, page): (&[u32], &DevicePage),
    dense: &[DenseAdam<f64>; 6],
    updates: &[u32],
    now: u32,
) {
    let recent = adam.at(now).numbers().recent;
    for column in Column::ALL.into_iter().filter(|c| c.width(0) > 0) {
        let rate = adam.rates().base(column);
        for (row, updates) in updates.iter().enumerate() {
            for e in 0..column.width(0) {
                let of = |table| f32::from_bits(slab[page.row_at(column, table, row) + e]);
                let past = [of(Table::Values), of(Table::ExpAvg), of(Table::ExpAvgSq)];
                let stamp = slab[page.stamp_at(row)];
                let got = tables.evaluate(past, stamp, now, &recent, column == Column::Means, rate as f32);
                let want = dense[column as usize].values[row * column.width(0) + e];
                // Values pass through larger ones on their way: 2 at the start, and what the rates allow later.
                let unit = f64::from(f32::EPSILON) * want.abs().max(2.0);
                let walk = 1.0 + 6.0 * f64::from(*updates).sqrt() * 0.29;
                let limit = (unit + 3e-6 * rate) * walk;
                let error = (f64::from(got) - want).abs();
                assert!(error <= limit, "{column:?} row {row} step {now}: {got} {want}, {error:e} of {limit:e}");
            }
        }
    }
}
