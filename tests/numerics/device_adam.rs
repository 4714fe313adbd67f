//! The f32 form of deferred Adam that devices compute, by its twin and on a device, against dense Adam in f64 over 50,000 steps.

use crate::support::begin_view;
use crate::support::dense_adam::DenseAdam;
use crate::support::gpu::open;
use crate::twins::deferred::TableWords;
use crate::twins::gather::{GatherInput, gather};
use crate::twins::page_words::{Table, row_at, stamp_at};
use crate::twins::update::{UpdateInput, finish, judge, records, step};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::gpu::{Buffer, Gpu, GpuOptions};
use gsscale::kernels::deferred::DeferredTables;
use gsscale::kernels::uniforms::{DevicePage, GatherUniforms, PageResult, UpdateUniforms};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::render::gpu_pages::{DevicePages, PageBatch, PageTable, UpdateBuffers};
use gsscale::render::gpu_rows::{DeviceColumns, RowGradients, RowSource, SplatRows};
use gsscale::render::pages::{DeviceSlot, PageRules, SlotPage};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::init::SH_C0;
use gsscale::scene::optimizer_numbers::SplitLimits;
use gsscale::scene::page_layout::{PageLayout, capacity_bytes, write_page};
use gsscale::scene::state::SceneState;

const STEPS: u32 = 50_000;
/// A row has a gradient once in so many steps.
const PERIODS: [u32; 12] = [1, 1, 2, 3, 7, 40, 199, 201, 399, 401, 3000, 20_000];
const ROWS: usize = PERIODS.len();
/// Values are compared once in so many steps: a prime, so that every row is met at many ages.
const CHECKED: u32 = 997;
const SPLITS: SplitLimits = SplitLimits { grow_grad2d: f32::INFINITY, split_scale: f32::INFINITY, reach: 0.0 };

/// Sees all rows, which move some units at most.
fn camera() -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1000.0]];
    Camera::pinhole(viewmat, [8.0; 4], [16, 16])
}

/// Gradient of an element: rows differ by size, down to where eps matters.
fn gradient(row: usize, draws: &mut Stream) -> f32 {
    let size = [1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15][row % 6];
    (draws.normal() * size) as f32
}

/// The columns of rows without colour bands.
fn columns() -> impl Iterator<Item = Column> {
    Column::ALL.into_iter().filter(|column| column.width(0) > 0)
}

/// Dense Adam in f64, with the gradients of every step.
struct Dense {
    adam: DeferredAdam,
    columns: [DenseAdam<f64>; 6],
    draws: Stream,
    /// By row.
    updates: [u32; ROWS],
}

impl Dense {
    /// Before the first of `steps` steps, and the rows as a page has them.
    fn new(eps: f64, steps: u32) -> (Dense, Vec<u64>, PageLayout) {
        let rates = Rates { others_final_factor: 0.1, ..Rates::new(1.0, steps) };
        let config = AdamConfig { eps, ..AdamConfig::default() };
        let adam = DeferredAdam::new(rates, config, SimdPath::best());
        let mut state = SceneState::from_columns(Columns::zeros(ROWS, 0));
        let mut draws = Stream::new(9, Purpose::Test, 0, 0);
        for column in Column::ALL {
            state.columns.column_mut(column).fill_with(|| draws.range(-2.0, 2.0) as f32);
        }
        let exact = |column| state.columns.column(column).iter().map(|x| f64::from(*x)).collect();
        let columns = Column::ALL.map(|column| DenseAdam::<f64>::new(config, exact(column)));
        let mut words = vec![0u64; capacity_bytes(ROWS, 0).div_ceil(8)];
        let layout = write_page(&state, bytemuck::cast_slice_mut(&mut words));
        (Dense { adam, columns, draws, updates: [0; ROWS] }, words, layout)
    }

    /// Takes step `now`. Returns the rows that have a gradient, by column the gradients of all rows, and those of their colours, from which
    /// those of sh0 follow.
    fn step(&mut self, now: u32) -> (Vec<usize>, Vec<Vec<f32>>, Vec<[f32; 3]>) {
        let rows: Vec<usize> = (0..ROWS).filter(|row| now.is_multiple_of(PERIODS[*row])).collect();
        let (mut of_columns, mut of_colors) = (Vec::new(), Vec::new());
        for column in columns() {
            let width = column.width(0);
            let mut grads = vec![0.0; ROWS * width];
            for row in &rows {
                grads[row * width..][..width].fill_with(|| gradient(*row, &mut self.draws));
            }
            if column == Column::Sh0 {
                of_colors = grads.as_chunks::<3>().0.to_vec();
                grads.iter_mut().for_each(|g| *g *= SH_C0 as f32);
            }
            let exact: Vec<f64> = grads.iter().map(|g| f64::from(*g)).collect();
            self.columns[column as usize].step(&exact, self.adam.rates().at(column, now));
            of_columns.push(grads);
        }
        rows.iter().for_each(|row| self.updates[*row] += 1);
        (rows, of_columns, of_colors)
    }

    /// Compares the values after `now` steps, `got(column, row, element)`.
    ///
    /// The limit is 1 unit in the last place of the value and 3e-6 of a rate for a row without updates since. Each update adds a
    /// rounding of the value to nearest, half a unit with either sign, and some roundings of its own movement: a random walk, of
    /// which six standard deviations are allowed.
    fn check(&self, now: u32, mut got: impl FnMut(Column, usize, usize) -> f32) {
        for column in columns() {
            let rate = self.adam.rates().base(column);
            for (row, updates) in self.updates.iter().enumerate() {
                for e in 0..column.width(0) {
                    let (got, want) =
                        (got(column, row, e), self.columns[column as usize].values[row * column.width(0) + e]);
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
}

#[test]
fn gpu_adam_matches_dense_adam() {
    for eps in [1e-15, 1e-8] {
        let (mut dense, words, layout) = Dense::new(eps, STEPS);
        let adam = dense.adam.clone();
        let numbers = adam.numbers(STEPS).unwrap();
        let tables = DeferredTables::new(&numbers);
        let tables = TableWords::from(&tables);
        let mut slab: Vec<u32> = bytemuck::cast_slice(&words).to_vec();
        let pages = [DevicePage::new(layout, 0, 0, 0)];
        for now in 0..STEPS {
            let (with_gradient, of_columns, _) = dense.step(now);
            let rows: Vec<[u32; 2]> = with_gradient.iter().map(|row| [0, *row as u32]).collect();
            let numbers_now = adam.at(now).numbers();
            let gathers = GatherUniforms::new(&camera(), &numbers, now, &SPLITS, 1);
            let of_step = UpdateUniforms::new(&camera(), &numbers_now, false, false);
            let mut largest = vec![0; rows.len()];
            let mut parts = Vec::new();
            for (column, of_column) in columns().zip(of_columns) {
                let width = column.width(0);
                let input =
                    GatherInput { uniforms: &gathers, pages: &pages, slab: &slab, tables, recent: &numbers_now.recent };
                let mut values = vec![0.0; rows.len() * width];
                gather(&input, (column, width), &rows, &mut values);
                let grads: Vec<f32> =
                    with_gradient.iter().flat_map(|row| &of_column[row * width..][..width]).copied().collect();
                judge(width, &grads, &mut largest);
                parts.push((column, values, grads));
            }
            for (column, values, grads) in parts {
                let input = UpdateInput { uniforms: &of_step, pages: &pages, rows: &rows, tables, largest: &largest };
                step(&input, (column, column.width(0)), &values, &grads, &mut slab);
            }
            let input = UpdateInput { uniforms: &of_step, pages: &pages, rows: &rows, tables, largest: &largest };
            let mut results = [<PageResult as bytemuck::Zeroable>::zeroed()];
            finish(&input, &vec![[0.0; 4]; rows.len()], &mut slab, &mut results, &mut []);
            assert_eq!((results[0].updated as usize, results[0].skipped), (rows.len(), 0));
            if (now + 1) % CHECKED == 0 || now + 1 == STEPS {
                let recent = adam.at(now + 1).numbers().recent;
                dense.check(now + 1, |column, row, e| {
                    let of = |table| f32::from_bits(slab[row_at(&pages[0], column, table, row) + e]);
                    let past = [of(Table::Values), of(Table::ExpAvg), of(Table::ExpAvgSq)];
                    let (stamp, rate) = (slab[stamp_at(&pages[0], row)], adam.rates().base(column) as f32);
                    tables.evaluate(past, stamp, now + 1, &recent, column == Column::Means, rate)
                });
            }
        }
    }
}

/// A page in a slot of a device, all of whose rows are listed at every step.
struct OnDevice {
    gpu: Gpu,
    pages: DevicePages,
    slot: SlotPage,
    listed: (PageBatch, PageTable),
    values: DeviceColumns,
    /// Of rows that are not drawn.
    grads: RowGradients,
    splats: [Buffer; 2],
}

impl OnDevice {
    fn new(gpu: Gpu, dense: &Dense, words: &[u64], layout: PageLayout, steps: u32) -> OnDevice {
        let numbers = dense.adam.numbers(steps).unwrap();
        let rules = PageRules { largest: layout, numbers, splits: SPLITS, weighs: false };
        let mut pages = DevicePages::new(&gpu, &rules).unwrap();
        pages.slots.add(&gpu, 1).unwrap();
        let slot = SlotPage { slot: DeviceSlot(0), layout };
        pages.slots.write(&gpu, &[(slot, &bytemuck::cast_slice(words)[..layout.bytes()])]).unwrap();
        let view = begin_view(&gpu, &pages, &camera(), &dense.adam.at(0).numbers());
        let listed = pages.list(&gpu, &view, &[slot]).unwrap();
        assert_eq!(listed.0.rows as usize, ROWS, "a row is out of view");
        let values = DeviceColumns::new(&gpu, ROWS as u32, 0).unwrap();
        let grads = RowGradients::for_update(&gpu, ROWS as u32, false).unwrap();
        let mut recorder = gpu.begin("adam");
        recorder.clear(&grads.footprints.view()).unwrap();
        let splats = recorder.buffer_with("splats", &[[1.0f32; 12]; ROWS]).unwrap();
        gpu.submit(recorder).unwrap();
        let v_splats = gpu.buffer("v_splats", splats.size()).unwrap();
        OnDevice { pages, slot, listed, values, grads, splats: [splats, v_splats], gpu }
    }

    /// Takes a step; with `is_checked` returns what it did to the page.
    fn step(
        &self,
        adam: &DeferredAdam,
        now: u32,
        (of_columns, of_colors): (&[Vec<f32>], &[[f32; 3]]),
        is_checked: bool,
    ) -> Option<PageResult> {
        let OnDevice { gpu, pages, values, grads, splats, .. } = self;
        let view = begin_view(gpu, pages, &camera(), &adam.at(now).numbers());
        let mut source = pages.source(&view, &self.listed.0, &self.listed.1);
        let mut recorder = gpu.begin("adam");
        source.geometry(gpu, &mut recorder, values, &(0..ROWS)).unwrap();
        let mut largest = vec![0; ROWS];
        for (column, of_column) in columns().zip(of_columns) {
            judge(column.width(0), of_column, &mut largest);
        }
        for ((_, buffer, _), of_column) in grads.columns.columns().zip(of_columns) {
            recorder.upload(&buffer.view(), of_column).unwrap();
        }
        recorder.upload(&splats[1].view(), &records(of_colors, &largest)).unwrap();
        let results = recorder.buffer_zeroed("results", size_of::<PageResult>() as u64).unwrap();
        let splats = splats.each_ref().map(SplatRows::from);
        let buffers = UpdateBuffers { values, grads, splats, results: &results, collects: false };
        pages.update(gpu, &mut recorder, &source, &(0..ROWS), &buffers).unwrap();
        gpu.submit(recorder).unwrap();
        is_checked.then(|| pages.begin_results(gpu, &source, &results).unwrap().to_vec::<PageResult>().unwrap()[0])
    }

    /// The values after `now` steps, by column, as the device evaluates them.
    fn values(&self, adam: &DeferredAdam, now: u32) -> Vec<Vec<f32>> {
        let OnDevice { gpu, pages, values, .. } = self;
        let view = begin_view(gpu, pages, &camera(), &adam.at(now).numbers());
        let mut recorder = gpu.begin("adam");
        let mut source = pages.source(&view, &self.listed.0, &self.listed.1);
        source.geometry(gpu, &mut recorder, values, &(0..ROWS)).unwrap();
        let reads: Vec<_> =
            values.columns().map(|(_, buffer, _)| recorder.read_back("adam", &buffer.view()).unwrap()).collect();
        gpu.submit(recorder).unwrap();
        reads.into_iter().map(|read| read.to_vec().unwrap()).collect()
    }
}

fn follows_on_a_device(eps: f64, steps: u32) {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let (mut dense, words, layout) = Dense::new(eps, steps);
    let on = OnDevice::new(gpu, &dense, &words, layout, steps);
    for now in 0..steps {
        let (rows, of_columns, of_colors) = dense.step(now);
        let is_checked = (now + 1) % CHECKED == 0 || now + 1 == steps;
        if let Some(result) = on.step(&dense.adam, now, (&of_columns, &of_colors), is_checked) {
            assert_eq!((result.updated as usize, result.skipped), (rows.len(), 0));
            let values = on.values(&dense.adam, now + 1);
            let of = |column| columns().position(|other| other == column).unwrap();
            dense.check(now + 1, |column, row, e| values[of(column)][row * column.width(0) + e]);
        }
    }
    // The device has written the page, and nothing but the page.
    let mut payload = vec![0u64; layout.bytes().div_ceil(8)];
    let bytes = &mut bytemuck::cast_slice_mut(&mut payload)[..layout.bytes()];
    on.pages.slots.read(&on.gpu, &mut [(on.slot, bytes)]).unwrap();
    assert!(payload != words, "no row was written");
}

/// The tables of the run and all their ways: rows that sleep longer than the sum of recent steps reaches, and small second moments.
#[test]
fn a_device_follows_dense_adam() {
    follows_on_a_device(1e-15, 2_000);
}

/// As long as a run. `cargo nextest run --test numerics --run-ignored only -E 'test(a_device_follows_dense_adam_over_a_run)'`
#[test]
#[ignore = "takes minutes on a software driver"]
fn a_device_follows_dense_adam_over_a_run() {
    [1e-15, 1e-8].into_iter().for_each(|eps| follows_on_a_device(eps, STEPS));
}
