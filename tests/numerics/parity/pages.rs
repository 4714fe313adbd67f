//! gather and update: the stages on pages, on the device and by their twins, with dense arithmetic in f64 as the judge.
//!
//! Source of the tolerances: a movement is some ten roundings of 6e-8, or devices' divisions of 2.5 units in the last
//! place, so 3e-6 of the movement; a value has one rounding of its own.

use super::rows::camera;
use crate::support::begin_view;
use crate::support::gpu::open;
use crate::twins::gather::{self, GatherInput};
use crate::twins::page_words::{Table, count_at, row_at, stamp_at};
use crate::twins::update::{self, UpdateInput};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::densify::stats::{GradHistogram, WEIGHED_VIEWS};
use gsscale::gpu::{Buffer, Gpu, GpuOptions, Source, groups_1d};
use gsscale::kernels::deferred::DeferredTables;
use gsscale::kernels::sh_bwd::sh_bwd;
use gsscale::kernels::uniforms::{DevicePage, GatherUniforms, PageResult, PageSurvey, UpdateUniforms};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::drift::DriftTables;
use gsscale::optim::rates::Rates;
use gsscale::render::gpu_pages::{DevicePages, PageBatch, PageTable, PagesView, UpdateBuffers};
use gsscale::render::gpu_rows::{DeviceColumns, RowGradients, RowSource, SplatRows};
use gsscale::render::pages::{DeviceSlot, PageRules, SlotPage};
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::optimizer_numbers::{RunNumbers, SplitLimits};
use gsscale::scene::page_layout::{PageLayout, capacity_bytes, write_page};
use gsscale::scene::rows::{RowsNow, mean_grad2d};
use gsscale::scene::sightings::{mean_weight, views, with_view};
use gsscale::scene::state::SceneState;

const STEPS: u32 = 900;
/// Rows of the pages: one, below, at and above a workgroup, several workgroups.
const PAGES: [usize; 5] = [1, 255, 256, 600, 64];
const SPLITS: SplitLimits = SplitLimits { grow_grad2d: 0.3, split_scale: 0.01, reach: 3.33 };

fn adam() -> DeferredAdam {
    DeferredAdam::new(Rates::new(1.0, STEPS), AdamConfig::default(), SimdPath::best())
}

/// A page after at most `now` steps; half of its rows have weights, if any have. Some second moments are so small that eps matters, some rows never had a gradient.
fn random_page(rows: usize, sh_degree: u8, seed: u64, (now, are_weighed): (u32, bool)) -> SceneState {
    let mut draws = Stream::new(seed, Purpose::Test, rows as u64, 2);
    let mut state = SceneState::from_columns(Columns::zeros(rows, sh_degree));
    for row in 0..rows {
        let least = if row % 16 == 3 { 16.0 } else { 7.0 };
        for column in Column::ALL {
            let range = if column == Column::Scales { (-6.0, -1.0) } else { (-3.0, 3.0) };
            let width = column.width(sh_degree);
            for at in row * width..(row + 1) * width {
                state.columns.column_mut(column)[at] = draws.range(range.0, range.1) as f32;
                if row % 8 != 5 {
                    let root = libm::pow(10.0, -draws.range(0.0, least));
                    state.exp_avg.column_mut(column)[at] = (draws.normal() * root) as f32;
                    state.exp_avg_sq.column_mut(column)[at] = (root * root) as f32;
                }
            }
        }
        let missed = if row % 4 == 0 { 0 } else { draws.below(u64::from(now)) as u32 };
        state.stamp[row] = now - missed;
        let is_weighed = are_weighed && draws.below(2) == 0;
        for _ in 0..draws.below(6) {
            let weight = libm::exp(draws.range(-20.0, 10.0)) as f32;
            state.count[row] = with_view(state.count[row], is_weighed.then_some(weight));
        }
        state.grad2d[row] = if state.count[row] > 0 { draws.uniform() as f32 } else { 0.0 };
    }
    state
}

/// Pages with their payloads, in a slab each for the twin.
struct World {
    now: u32,
    adam: DeferredAdam,
    states: Vec<SceneState>,
    layouts: Vec<PageLayout>,
    payloads: Vec<Vec<u64>>,
}

impl World {
    fn new(sh_degree: u8, now: u32, are_weighed: bool) -> World {
        World::of(&PAGES, sh_degree, now, are_weighed)
    }

    fn of(pages: &[usize], sh_degree: u8, now: u32, are_weighed: bool) -> World {
        let states: Vec<SceneState> = pages
            .iter()
            .enumerate()
            .map(|(i, rows)| random_page(*rows, sh_degree, i as u64, (now, are_weighed)))
            .collect();
        let mut payloads = Vec::new();
        let layouts = states.iter().map(|state| {
            let mut words = vec![0u64; capacity_bytes(state.rows(), sh_degree).div_ceil(8)];
            let layout = write_page(state, bytemuck::cast_slice_mut(&mut words));
            payloads.push(words);
            layout
        });
        World { now, adam: adam(), layouts: layouts.collect(), payloads, states }
    }

    /// The same with moments of 16 bits.
    fn with_halves(mut self) -> World {
        for (state, payload) in self.states.iter_mut().zip(&mut self.payloads) {
            for table in [&mut state.exp_avg, &mut state.exp_avg_sq] {
                for column in Column::ALL {
                    let values = table.column_mut(column).iter_mut();
                    values.for_each(|x| *x = f32::from_bits(x.to_bits() & 0xffff_0000));
                }
            }
            write_page(state, bytemuck::cast_slice_mut(payload));
        }
        self
    }

    /// The payloads behind each other, as one slab, and the pages in it.
    fn slab(&self) -> (Vec<u32>, Vec<DevicePage>) {
        let (mut slab, mut pages, mut first_row) = (Vec::new(), Vec::new(), 0);
        for (layout, payload) in self.layouts.iter().zip(&self.payloads) {
            pages.push(DevicePage::new(*layout, 0, slab.len() as u32, first_row));
            first_row += layout.rows as u32;
            slab.extend_from_slice(&bytemuck::cast_slice::<u64, u32>(payload)[..layout.bytes() / 4]);
        }
        (slab, pages)
    }
}

/// The columns on a device with their floats per row.
fn columns_of(sh_degree: u8) -> Vec<(Column, usize)> {
    let columns = Column::ALL.map(|column| (column, column.width(sh_degree)));
    columns.into_iter().filter(|(_, width)| *width > 0).collect()
}

pub fn read<T: bytemuck::Pod>(gpu: &Gpu, buffer: &Buffer, count: usize) -> Vec<T> {
    let mut recorder = gpu.begin("parity");
    let bytes = recorder.read_back("parity", &buffer.view()).unwrap();
    gpu.submit(recorder).unwrap();
    let mut values: Vec<T> = bytes.to_vec().unwrap();
    values.truncate(count);
    values
}

/// The listed rows of a batch on a device: number of the page, number of the row in it.
fn listed_rows(gpu: &Gpu, batch: &PageBatch, slots: &[SlotPage]) -> Vec<[u32; 2]> {
    let rows: usize = slots.iter().map(|page| page.layout.rows).sum();
    let found: Vec<u32> = read(gpu, &batch.found, rows);
    let (mut listed, mut first_row) = (Vec::new(), 0);
    for (p, (page, &count)) in slots.iter().zip(&batch.listed).enumerate() {
        listed.extend(found[first_row..][..count as usize].iter().map(|row| [p as u32, *row]));
        first_row += page.layout.rows;
    }
    assert_eq!(listed.len(), batch.rows as usize);
    listed
}

fn gathered_by_twin(world: &World) -> (Vec<[u32; 2]>, Vec<Vec<f32>>) {
    let numbers = world.adam.numbers(STEPS).unwrap();
    let (tables, step) = (DeferredTables::new(&numbers), world.adam.at(world.now).numbers());
    let (slab, mut pages) = world.slab();
    let uniforms = GatherUniforms::new(&camera(), &numbers, world.now, &SPLITS, pages.len() as u32);
    let rows: usize = PAGES.iter().sum();
    let (mut counts, mut found) = (vec![0; pages.len()], vec![0; rows]);
    let (tables, recent) = ((&tables).into(), &step.recent[..]);
    let input = GatherInput { uniforms: &uniforms, pages: &pages, slab: &slab, tables, recent };
    gather::cull(&input, &mut counts, &mut found);
    let listed = gather::place(&mut pages, &counts);
    let mut list = vec![[0; 2]; listed as usize];
    gather::list(&pages, &counts, &found, &mut list);
    let mut values = Vec::new();
    for (column, width) in columns_of(world.layouts[0].sh_degree) {
        let mut out = vec![f32::NAN; listed as usize * width];
        let input = GatherInput { uniforms: &uniforms, pages: &pages, slab: &slab, tables, recent };
        gather::gather(&input, (column, width), &list, &mut out);
        values.push(out);
    }
    (list, values)
}

/// What a test needs of the pages on a device.
struct OnDevice<'g> {
    gpu: &'g Gpu,
    pages: DevicePages,
    slots: Vec<SlotPage>,
}

impl<'g> OnDevice<'g> {
    fn new(gpu: &'g Gpu, world: &World) -> OnDevice<'g> {
        OnDevice::with_moments(gpu, world, false)
    }

    fn with_moments(gpu: &'g Gpu, world: &World, has_halves: bool) -> OnDevice<'g> {
        let layout = world.layouts[0];
        let rows = world.layouts.iter().map(|layout| layout.rows).max().unwrap();
        let largest = PageLayout { rows, sh_degree: layout.sh_degree };
        let numbers = RunNumbers { has_halves, ..world.adam.numbers(STEPS).unwrap() };
        let rules = PageRules { largest, numbers, splits: SPLITS, weighs: true };
        let mut pages = DevicePages::new(gpu, &rules).unwrap();
        // Not in order, so that slabs and batch differ in theirs.
        let count = world.layouts.len().next_multiple_of(8) as u32;
        assert_eq!(pages.slots.add(gpu, count as usize).unwrap(), count as usize);
        let slots = (0..).map(|page| DeviceSlot((3 * page + 2) % count)).zip(&world.layouts);
        let slots: Vec<SlotPage> = slots.map(|(slot, layout)| SlotPage { slot, layout: *layout }).collect();
        let payloads = slots.iter().zip(&world.payloads);
        let payloads: Vec<(SlotPage, &[u8])> = payloads
            .map(|(page, words)| (*page, &bytemuck::cast_slice::<u64, u8>(words)[..page.layout.bytes()]))
            .collect();
        pages.slots.write(gpu, &payloads).unwrap();
        OnDevice { gpu, pages, slots }
    }

    /// The geometry of the listed rows.
    fn geometry(&self, view: &PagesView, (batch, table): &(PageBatch, PageTable)) -> DeviceColumns {
        let columns = DeviceColumns::new(self.gpu, batch.rows, self.slots[0].layout.sh_degree).unwrap();
        let mut recorder = self.gpu.begin("parity");
        let all = 0..batch.rows as usize;
        self.pages.source(view, batch, table).geometry(self.gpu, &mut recorder, &columns, &all).unwrap();
        self.gpu.submit(recorder).unwrap();
        columns
    }

    fn payloads(&self) -> Vec<Vec<u32>> {
        let mut payloads: Vec<Vec<u32>> = self.slots.iter().map(|page| vec![0; page.layout.bytes() / 4]).collect();
        let mut copies: Vec<(SlotPage, &mut [u8])> =
            self.slots.iter().copied().zip(payloads.iter_mut().map(|words| bytemuck::cast_slice_mut(words))).collect();
        self.pages.slots.read(self.gpu, &mut copies).unwrap();
        payloads
    }
}

/// A device with two slots to a slab, so that a batch has pages in several slabs.
fn device(world: &World) -> Option<Gpu> {
    let slot = capacity_bytes(PAGES.into_iter().max().unwrap(), world.layouts[0].sh_degree) as u64;
    // The tables of 900 steps take some 80 KB.
    let binding = (2 * slot.next_multiple_of(256)).max(160 << 10);
    open(&GpuOptions { max_binding_bytes: Some(binding), ..GpuOptions::default() })
}

/// The value of an element after `now` steps, in f64, and how far it has moved.
fn exact(world: &World, tables: &DriftTables, page: usize, column: Column, row: usize, e: usize) -> [f64; 2] {
    let state = &world.states[page];
    let [value, m, v] = [&state.columns, &state.exp_avg, &state.exp_avg_sq].map(|of| f64::from(of.row(column, row)[e]));
    let rate = tables.rates().base(column);
    let moved = rate * tables.movement([m, v], state.stamp[row], world.now, column == Column::Means);
    [value - moved, moved.abs() + rate]
}

fn assert_gathered(world: &World, list: &[[u32; 2]], values: &[Vec<f32>], by: &str) {
    let tables = DriftTables::new(Rates::new(1.0, STEPS), AdamConfig::default());
    for ((column, width), values) in columns_of(world.layouts[0].sh_degree).into_iter().zip(values) {
        for (i, got) in values.iter().enumerate() {
            let [page, row] = list[i / width].map(|x| x as usize);
            let [want, moved] = exact(world, &tables, page, column, row, i % width);
            let slack = f64::from(f32::EPSILON) * want.abs() + 3e-6 * moved;
            assert!((f64::from(*got) - want).abs() <= slack, "{by}: {column:?} page {page} row {row}: {got} {want}");
        }
    }
}

#[test]
fn rows_of_pages_are_listed_and_gathered_as_dense_adam_has_them() {
    for (sh_degree, now) in [(0, 40), (1, 899), (3, 700)] {
        let world = World::new(sh_degree, now, true);
        let (list, values) = gathered_by_twin(&world);
        assert_gathered(&world, &list, &values, "twin");
        let rows: usize = PAGES.iter().sum();
        assert!(list.len() > rows / 10 && list.len() < rows, "{} of {rows} rows in view", list.len());
        let Some(gpu) = device(&world) else { return };
        let on = OnDevice::new(&gpu, &world);
        let view = begin_view(&gpu, &on.pages, &camera(), &world.adam.at(now).numbers());
        let list_of_device = on.pages.list(&gpu, &view, &on.slots).unwrap();
        let batch = &list_of_device.0;
        let listed = listed_rows(&gpu, batch, &on.slots);
        assert!(listed.is_sorted(), "lists are in the order of pages and rows");
        // A row at the edge of the cull's slack may be listed on one side alone.
        let differ = listed.iter().filter(|row| !list.contains(row)).count()
            + list.iter().filter(|row| !listed.contains(row)).count();
        assert!(differ <= 2, "{differ} rows of {} differ", list.len());
        let columns = on.geometry(&view, &list_of_device);
        let of_device: Vec<Vec<f32>> =
            columns.columns().map(|(_, buffer, width)| read(&gpu, buffer, width * batch.rows as usize)).collect();
        assert_gathered(&world, &listed, &of_device, "device");
    }
}

/// A dispatch for each slab in which a batch has pages, of workgroups for these pages alone: in four slabs they are no more than in one.
#[test]
fn dispatches_work_on_the_pages_of_their_slab() {
    let world = World::new(1, 40, false);
    let devices = [open(&GpuOptions::default()), device(&world)];
    let [Some(one), Some(four)] = &devices else { return };
    let workgroups = [one, four].map(|gpu| {
        let on = OnDevice::new(gpu, &world);
        let view = begin_view(gpu, &on.pages, &camera(), &world.adam.at(40).numbers());
        let listed = on.pages.list(gpu, &view, &on.slots).unwrap();
        let before = gpu.traffic().work;
        on.geometry(&view, &listed);
        let after = gpu.traffic().work;
        [after.dispatches - before.dispatches, after.workgroups - before.workgroups]
    });
    let [[in_one, of_one], [in_four, of_four]] = workgroups;
    assert_eq!([in_one, in_four], [2, 8], "two stages in one and in four slabs");
    assert!(of_four <= of_one, "{of_four} workgroups in four slabs, {of_one} in one");
}

/// Gradients of listed rows.
struct Drawn {
    /// By column.
    grads: Vec<Vec<f32>>,
    /// Those of colours, from which the columns of colours follow, and splats, of which a ninth of the channels is clamped at 0.
    v_colors: Vec<[f32; 3]>,
    splats: Vec<[f32; 12]>,
    footprints: Vec<[f32; 4]>,
}

/// Gradients of listed rows with these means: a tenth of the rows have none, and `poison` of them are not finite or too large in one
/// element. With weights every footprint is followed by a second one, some of which are extreme.
fn random_gradients(means: &[f32], sh_degree: u8, (poison, weighs): (f64, bool)) -> Drawn {
    let rows = means.len() / 3;
    let mut draws = Stream::new(5, Purpose::Test, rows as u64, 3);
    let kinds: Vec<[f64; 2]> = (0..rows).map(|_| [draws.uniform(), draws.uniform()]).collect();
    let bad = [f32::NAN, f32::INFINITY, -2e19];
    let widths = [3, 4, 3, 1, 3]; // of the geometry, and of the gradients of colours
    let mut grads = Vec::new();
    for (p, width) in widths.into_iter().enumerate() {
        let mut of_column = Vec::new();
        for (row, kind) in kinds.iter().enumerate() {
            let is_zero = kind[0] > 0.9;
            let size = libm::pow(10.0, -draws.range(0.0, 9.0));
            of_column.extend((0..width).map(|_| if is_zero { 0.0 } else { (draws.normal() * size) as f32 }));
            if kind[1] < poison && row % widths.len() == p {
                of_column[row * width + row % width] = bad[row % 3];
            }
        }
        grads.push(of_column);
    }
    let v_colors = grads.pop().unwrap().as_chunks::<3>().0.to_vec();
    let clamped = |i: usize| if i % 9 == 5 { 0.0 } else { 0.5 };
    let colors: Vec<[f32; 3]> = (0..rows).map(|row| [0, 1, 2].map(|c| clamped(3 * row + c))).collect();
    let splats = colors.iter().map(|[r, g, b]| [0.0, 0.0, 1.0, 0.5, 1.0, 0.0, 1.0, 4.0, *r, *g, *b, 4.0]).collect();
    let (mut of_rows, mut of_colors) = (Columns::zeros(rows, sh_degree), Columns::default());
    of_rows.means.copy_from_slice(means);
    let radii = vec![[4; 2]; rows];
    sh_bwd(&of_rows, &camera(), sh_degree, &radii, &colors, &v_colors, SimdPath::best(), &mut of_colors);
    grads.extend([of_colors.sh0, of_colors.sh_n]);
    let mut footprints = Vec::new();
    for kind in &kinds {
        let radius = if kind[0] > 0.95 { 0.0 } else { 4.0 };
        footprints.push([draws.normal() as f32 * 1e-3, draws.normal() as f32 * 1e-3, radius, radius]);
        if weighs {
            let weight = libm::exp(draws.range(-20.0, 10.0)) as f32;
            let extreme = [0.0, f32::NAN, f32::INFINITY, 1e-38, 1e31];
            let weight = if kind[1] < 0.2 { extreme[footprints.len() % 5] } else { weight };
            footprints.push([weight, 7.0, 7.0, 7.0]);
        }
    }
    Drawn { grads, v_colors, splats, footprints }
}

/// Columns beyond a binding: several windows of rows, which begin and end within pages, in as many slabs as pages. No bit differs.
#[test]
fn windows_of_rows_change_no_bit_of_pages() {
    let world = World::of(&[256; 29], 3, 700, false);
    // The limit holds one slot, and the bins just fit.
    let limit = 256 << 10;
    assert!((capacity_bytes(256, 3) as u64..2 * capacity_bytes(256, 3) as u64).contains(&limit));
    let cut = GpuOptions { max_binding_bytes: Some(limit), ..GpuOptions::default() };
    let devices = [open(&GpuOptions::default()), open(&cut)];
    let [Some(whole), Some(cut)] = &devices else { return };
    let stepped = |gpu: &Gpu| {
        let before = gpu.traffic().work.dispatches;
        let ((payloads, ..), list, values) = updated_by_device(&OnDevice::new(gpu, &world), &world, (0.01, false));
        (gpu.traffic().work.dispatches - before, list.len(), (payloads, list, values))
    };
    let ((one, rows, want), (many, _, got)) = (stepped(whole), stepped(cut));
    assert!(180 * rows as u64 > 2 * limit && many > 10 * one, "{rows} rows fit a binding: {many} and {one} dispatches");
    assert!(want == got);
}

/// What an update leaves: payloads, results of pages, change of the bins.
type Updated = (Vec<Vec<u32>>, Vec<PageResult>, Vec<u32>);

fn updated_by_twin(
    world: &World,
    list: &[[u32; 2]],
    values: &[Vec<f32>],
    Drawn { grads, footprints, .. }: &Drawn,
) -> Updated {
    let numbers = world.adam.numbers(STEPS).unwrap();
    let (tables, step) = (DeferredTables::new(&numbers), world.adam.at(world.now).numbers());
    let (mut slab, pages) = world.slab();
    let weighs = footprints.len() > list.len();
    let uniforms = UpdateUniforms::new(&camera(), &step, true, weighs);
    let mut largest = vec![0; list.len()];
    let columns = columns_of(world.layouts[0].sh_degree);
    columns.iter().zip(grads).for_each(|((_, width), grads)| update::judge(*width, grads, &mut largest));
    let (pages, rows, tables, largest) = (&pages[..], list, (&tables).into(), &largest[..]);
    for (((column, width), values), grads) in columns.into_iter().zip(values).zip(grads) {
        let input = UpdateInput { uniforms: &uniforms, pages, rows, tables, largest };
        update::step(&input, (column, width), values, grads, &mut slab);
    }
    let mut results = vec![<PageResult as bytemuck::Zeroable>::zeroed(); pages.len()];
    let mut bins = vec![0; 2 << 15];
    let input = UpdateInput { uniforms: &uniforms, pages, rows, tables, largest };
    update::finish(&input, footprints, &mut slab, &mut results, &mut bins);
    let of_bounds = GatherUniforms::new(&camera(), &numbers, world.now, &SPLITS, pages.len() as u32);
    let input = GatherInput { uniforms: &of_bounds, pages, slab: &slab, tables, recent: &step.recent };
    gather::bounds(&input, &mut results);
    let payload =
        |(page, layout): (&DevicePage, &PageLayout)| slab[page.base as usize..][..layout.bytes() / 4].to_vec();
    (pages.iter().zip(&world.layouts).map(payload).collect(), results, bins)
}

/// The same on a device, on rows that it has listed and gathered; and these.
fn updated_by_device(
    on: &OnDevice<'_>,
    world: &World,
    (poison, weighs): (f64, bool),
) -> (Updated, Vec<[u32; 2]>, Vec<Vec<f32>>) {
    let (gpu, sh_degree) = (on.gpu, world.layouts[0].sh_degree);
    let view = begin_view(gpu, &on.pages, &camera(), &world.adam.at(world.now).numbers());
    let (batch, table) = on.pages.list(gpu, &view, &on.slots).unwrap();
    let rows = batch.rows as usize;
    let values = DeviceColumns::new(gpu, batch.rows, sh_degree).unwrap();
    let grads = RowGradients::for_update(gpu, batch.rows, weighs).unwrap();
    let mut source = on.pages.source(&view, &batch, &table);
    let mut recorder = gpu.begin("parity");
    source.geometry(gpu, &mut recorder, &values, &(0..rows)).unwrap();
    gpu.submit(recorder).unwrap();
    let drawn = random_gradients(&read::<f32>(gpu, &values.means, 3 * rows), sh_degree, (poison, weighs));
    let mut recorder = gpu.begin("parity");
    let mut largest = vec![0; rows];
    for ((_, width), of_rows) in columns_of(sh_degree).into_iter().zip(&drawn.grads) {
        update::judge(width, of_rows, &mut largest);
    }
    for ((_, buffer, _), of_rows) in grads.columns.columns().zip(&drawn.grads) {
        recorder.upload(&buffer.view(), of_rows).unwrap();
    }
    recorder.upload(&grads.footprints.view(), &drawn.footprints).unwrap();
    let splats = recorder.buffer_with("splats", &drawn.splats).unwrap();
    let v_splats = recorder.buffer_with("v_splats", &update::records(&drawn.v_colors, &largest)).unwrap();
    let results = recorder.buffer_zeroed("results", (size_of::<PageResult>() * on.slots.len()) as u64).unwrap();
    let splats = [&splats, &v_splats].map(SplatRows::from);
    let buffers = UpdateBuffers { values: &values, grads: &grads, splats, results: &results, collects: true };
    on.pages.update(gpu, &mut recorder, &source, &(0..rows), &buffers).unwrap();
    gpu.submit(recorder).unwrap();
    let results = on.pages.begin_results(gpu, &source, &results).unwrap().to_vec::<PageResult>().unwrap();
    let gathered = values.columns().map(|(_, buffer, width)| read(gpu, buffer, width * rows)).collect();
    let bins = on.pages.take_bins(gpu).unwrap();
    ((on.payloads(), results, bins), listed_rows(gpu, &batch, &on.slots), gathered)
}

/// Whether two floats, by their bits, agree within three units in the last place and `slack`.
fn agree(a: u32, b: u32, slack: f32) -> bool {
    let (x, y) = (f32::from_bits(a), f32::from_bits(b));
    a == b || (x - y).abs() <= 3.0 * f32::EPSILON * x.abs().max(y.abs()) + slack
}

#[test]
fn updates_of_pages_agree_and_unusable_gradients_leave_their_rows() {
    for (poison, sh_degree, weighs) in [(0.0, 3, true), (0.01, 1, false), (0.1, 3, true)] {
        let world = World::new(sh_degree, 700, weighs);
        let Some(gpu) = device(&world) else { return };
        let on = OnDevice::new(&gpu, &world);
        let ((payloads, results, bins), list, values) = updated_by_device(&on, &world, (poison, weighs));
        let drawn = random_gradients(&values[0], sh_degree, (poison, weighs));
        let twin = updated_by_twin(&world, &list, &values, &drawn);
        let (_, of_slab) = world.slab();
        let counts = |of: &[PageResult]| -> Vec<[u32; 4]> {
            of.iter().map(|r| [r.updated, r.skipped, r.drawn, r.collected]).collect()
        };
        assert_eq!(counts(&results), counts(&twin.1), "poison {poison}");
        let skipped: u32 = results.iter().map(|r| r.skipped).sum();
        assert_eq!(skipped > 0, poison > 0.0, "{skipped} rows were skipped");
        assert_eq!(bins, twin.2);
        let (mut histogram, mut after) = (GradHistogram::default(), GradHistogram::default());
        for (p, layout) in world.layouts.iter().enumerate() {
            let before: &[u32] = bytemuck::cast_slice(&world.payloads[p]);
            histogram.add_rows(&layout.rows(bytemuck::cast_slice(&world.payloads[p]), 0));
            let mut aligned = vec![0u64; layout.bytes() / 8];
            bytemuck::cast_slice_mut::<u64, u32>(&mut aligned).copy_from_slice(&payloads[p]);
            after.add_rows(&layout.rows(bytemuck::cast_slice(&aligned), 0));
            let page = &of_slab[p];
            let words_of_views =
                count_at(page, 0) - page.base as usize..count_at(page, layout.rows) - page.base as usize;
            // Steps of Adam are at most 32 rates long, and 1e-6 of that is the slack of the slowest arithmetic.
            for (i, (device, twin)) in payloads[p].iter().zip(&twin.0[p]).enumerate() {
                let is_untouched = *twin == before[i];
                let is_exact = is_untouched || words_of_views.contains(&i);
                let is_same = if is_exact { device == twin } else { agree(*device, *twin, 2e-6) };
                assert!(is_same, "page {p} word {i}: {device:#x} {twin:#x}");
                let float = f32::from_bits(*device);
                assert!(float.is_finite() || is_exact, "page {p} word {i} became {float}");
            }
        }
        histogram.add_changes(&bins);
        assert_eq!((histogram.uncounted(), histogram == after), (0, true), "bins of the device are those of the CPU");
        assert_bounds(&world, &payloads, &results, &twin.1);
        assert_bounds_of_device(&on, &world, &results);
    }
}

/// Moments of 16 bits: values as with 32, and each moment of an updated row is that of the twin, rounded by the same draw.
#[test]
fn moments_of_16_bits_are_rounded_as_by_the_twin_and_packed_in_slots() {
    let world = World::new(3, 700, false).with_halves();
    let Some(gpu) = device(&world) else { return };
    let on = OnDevice::with_moments(&gpu, &world, true);
    let before = on.payloads();
    assert!(
        before
            .iter()
            .zip(&world.payloads)
            .all(|(got, want)| got[..] == bytemuck::cast_slice::<u64, u32>(want)[..got.len()])
    );
    let ((payloads, results, _), list, values) = updated_by_device(&on, &world, (0.0, false));
    let drawn = random_gradients(&values[0], 3, (0.0, false));
    let twin = updated_by_twin(&world, &list, &values, &drawn);
    let (_, pages) = world.slab();
    let [mut exact, mut near] = [0; 2];
    for (p, page) in pages.iter().enumerate() {
        assert_eq!(results[p].updated, twin.1[p].updated);
        let page = DevicePage { base: 0, ..*page };
        let stamped = |row: usize| twin.0[p][stamp_at(&page, row)] == 701;
        for (column, row) in Column::ALL.into_iter().flat_map(|c| (0..page.rows as usize).map(move |row| (c, row))) {
            for e in 0..column.width(3) {
                let at = |table| row_at(&page, column, table, row) + e;
                let of = |words: &[u32]| [Table::Values, Table::ExpAvg, Table::ExpAvgSq].map(|table| words[at(table)]);
                let ([value, m, v], [of_twin, m_twin, v_twin]) = (of(&payloads[p]), of(&twin.0[p]));
                assert!(agree(value, of_twin, 2e-6), "page {p} row {row} {column:?} {e}: {value:#x} {of_twin:#x}");
                let moments = [m_twin, v_twin].map(f32::from_bits);
                let uid = world.states[p].uid[row];
                let rounded = if stamped(row) { update::rounded(moments, uid, 701, (column, e)) } else { moments };
                for (got, want) in [m, v].into_iter().zip(rounded.map(f32::to_bits)) {
                    // A last bit of 32 moves a draw over its limit for one moment in thousands. Devices may flush terms below 2^-126 to zero.
                    let is_near = got.abs_diff(want) <= 1 << 16
                        || (f32::from_bits(got) - f32::from_bits(want)).abs() <= 4.0 * f32::MIN_POSITIVE;
                    assert!(got & 0xffff == 0 && is_near, "page {p} row {row} {column:?} {e}: {got:#x} {want:#x}");
                    if got == want { exact += 1 } else { near += 1 }
                }
            }
        }
        let Some(bounds) = results[p].bounds() else { continue };
        let of_twin = twin.1[p].bounds().unwrap();
        // Wider, for what roundings of later steps move.
        assert!(
            (0..3).all(|c| bounds.lo[c] <= of_twin.lo[c] && bounds.hi[c] >= of_twin.hi[c]),
            "{bounds:?} {of_twin:?}"
        );
    }
    assert!(near * 500 < exact, "{near} of {exact} moments are others");
}

/// The same for positions and scales as the device evaluates them, of the rows that the camera sees at later steps.
fn assert_bounds_of_device(on: &OnDevice<'_>, world: &World, results: &[PageResult]) {
    for later in [1, 3, 50, 199] {
        let view = begin_view(on.gpu, &on.pages, &camera(), &world.adam.at(world.now + later).numbers());
        let list = on.pages.list(on.gpu, &view, &on.slots).unwrap();
        let (listed, columns) = (listed_rows(on.gpu, &list.0, &on.slots), on.geometry(&view, &list));
        let mut outside = 0;
        for (column, buffer, width) in columns.columns() {
            let values: Vec<f32> = read(on.gpu, buffer, width * listed.len());
            for ([page, _], row) in listed.iter().zip(values.chunks(width)) {
                let Some(bounds) = results[*page as usize].bounds() else { continue };
                outside += match column {
                    Column::Means => (0..3).filter(|&c| !(bounds.lo[c]..=bounds.hi[c]).contains(&row[c])).count(),
                    Column::Scales => row.iter().filter(|scale| scale.exp() > bounds.sigma_max).count(),
                    _ => 0,
                };
            }
        }
        assert_eq!(outside, 0, "{later} steps later, of {} rows", listed.len());
        assert!(listed.len() > 50, "{} rows are seen", listed.len());
    }
}

/// Bounds of the device hold the positions of all rows at later steps, and are those of the twin but for roundings.
fn assert_bounds(world: &World, payloads: &[Vec<u32>], results: &[PageResult], twin: &[PageResult]) {
    for (p, layout) in world.layouts.iter().enumerate() {
        let (Some(bounds), Some(of_twin)) = (results[p].bounds(), twin[p].bounds()) else { continue };
        let mut aligned = vec![0u64; layout.bytes() / 8];
        bytemuck::cast_slice_mut::<u64, u32>(&mut aligned).copy_from_slice(&payloads[p]);
        let rows = layout.rows(bytemuck::cast_slice(&aligned), 0);
        for later in [1, 3, 50, 199] {
            let at = world.adam.at(world.now + later);
            for row in 0..layout.rows {
                for c in 0..3 {
                    let mean = at.evaluate_element(&rows, Column::Means, row, c);
                    assert!((bounds.lo[c]..=bounds.hi[c]).contains(&mean), "page {p} row {row}: {mean} {bounds:?}");
                    let scale = at.evaluate_element(&rows, Column::Scales, row, c);
                    assert!(scale.exp() <= bounds.sigma_max, "page {p} row {row}");
                }
            }
        }
        for c in 0..3 {
            let slack = 1e-5 * (1.0 + of_twin.hi[c].abs() + of_twin.lo[c].abs());
            assert!((bounds.lo[c] - of_twin.lo[c]).abs() <= slack && (bounds.hi[c] - of_twin.hi[c]).abs() <= slack);
        }
        assert!((bounds.sigma_max / of_twin.sigma_max - 1.0).abs() < 1e-5);
    }
}

/// What a round needs to know of pages, and statistics that it clears: the survey bounds all rows, and is that of the twin.
#[test]
fn surveys_hold_all_rows_and_only_statistics_are_cleared() {
    let world = World::new(3, 700, true);
    let numbers = world.adam.numbers(STEPS).unwrap();
    let tables = DeferredTables::new(&numbers);
    let (mut slab, pages) = world.slab();
    let uniforms = GatherUniforms::new(&camera(), &numbers, 700, &SPLITS, pages.len() as u32);
    let input = GatherInput { uniforms: &uniforms, pages: &pages, slab: &slab, tables: (&tables).into(), recent: &[] };
    let mut twin = vec![<PageSurvey as bytemuck::Zeroable>::zeroed(); pages.len()];
    gather::survey(&input, &mut twin);
    for (state, survey) in world.states.iter().zip(&twin) {
        let (rows, lowest) = (state.view(), f32::from_bits(survey.lowest_opacity));
        for later in [0, 1, 50, 199] {
            let at = world.adam.at(700 + later);
            let opacity = |row: usize| at.evaluate_element(&rows, Column::Opacities, row, 0);
            assert!((0..state.rows()).all(|row| opacity(row) >= lowest), "{later} steps later, {lowest}");
        }
        let means = state.grad2d.iter().zip(&state.count).map(|(&grad2d, &count)| mean_grad2d(grad2d, count));
        assert_eq!(survey.largest_mean, means.fold(0.0f32, f32::max).to_bits());
        let judged = state.count.iter().filter(|&&word| views(word) >= WEIGHED_VIEWS);
        let least = judged.filter_map(|&word| mean_weight(word)).fold(3.4e38, f32::min);
        assert_eq!(survey.least_weight, least.to_bits());
    }
    update::clear_statistics(&pages, 0, &mut slab);
    let Some(gpu) = device(&world) else { return };
    let on = OnDevice::new(&gpu, &world);
    for (of_device, twin) in on.pages.survey(&gpu, &on.slots).unwrap().iter().zip(&twin) {
        assert_eq!((of_device.largest_mean, of_device.least_weight), (twin.largest_mean, twin.least_weight));
        assert!(agree(of_device.lowest_opacity, twin.lowest_opacity, 2e-6), "{of_device:?} {twin:?}");
    }
    let before = on.payloads();
    // All but the second page.
    let cleared: Vec<SlotPage> = on.slots.iter().enumerate().filter(|(p, _)| *p != 1).map(|(_, page)| *page).collect();
    on.pages.clear_statistics(&gpu, &cleared).unwrap();
    for (p, (payload, page)) in on.payloads().into_iter().zip(&pages).enumerate() {
        let words = &slab[page.base as usize..][..payload.len()];
        assert!(payload == if p == 1 { &before[p][..] } else { words }, "page {p}");
    }
}

const DIVISIONS: &str = r#"
#import "shared/dispatch.wgsl"
#import "shared/quotient.wgsl"
@group(0) @binding(0) var<storage, read> sums: array<f32>;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> quotients: array<f32>;
@compute @workgroup_size(256)
fn divide(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i < arrayLength(&sums) {
        quotients[i] = quotient(sums[i], counts[i]);
    }
}
"#;

/// Means of growth scores decide on both sides, so they must be equal to the bit.
#[test]
fn devices_divide_growth_scores_exactly() {
    let Some(gpu) = open(&GpuOptions::default()) else { return };
    let mut draws = Stream::new(6, Purpose::Test, 0, 4);
    let (mut sums, mut counts) = (Vec::new(), Vec::new());
    for i in 0..1 << 20u32 {
        let exponent = draws.range(-75.0, 120.0).floor();
        let mantissa = if i % 7 == 0 { 1.0 } else { draws.range(1.0, 2.0) };
        sums.push(if i % 1001 == 0 { 0.0 } else { (mantissa * libm::exp2(exponent)) as f32 });
        counts.push(1 + if i % 3 == 0 { draws.below(40) } else { draws.below(4095) } as u32);
    }
    (sums[5], counts[5]) = (f32::MAX, 3);
    let divide = gpu.pipeline_from(&Source { name: "divisions", text: DIVISIONS }, "divide", &[]).unwrap();
    let mut recorder = gpu.begin("divisions");
    let inputs = [recorder.buffer_with("sums", &sums).unwrap(), recorder.buffer_with("counts", &counts).unwrap()];
    let out = gpu.buffer("quotients", 4 * sums.len() as u64).unwrap();
    let views = [inputs[0].view(), inputs[1].view(), out.view()];
    recorder.dispatch("divisions", &divide, &views, groups_1d(sums.len() as u32, 256)).unwrap();
    gpu.submit(recorder).unwrap();
    let quotients: Vec<f32> = read(&gpu, &out, sums.len());
    for ((sum, count), got) in sums.iter().zip(&counts).zip(quotients) {
        assert_eq!(got.to_bits(), (sum / *count as f32).to_bits(), "{sum} / {count} = {got}");
    }
}
