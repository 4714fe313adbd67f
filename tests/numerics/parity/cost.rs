//! What a training step costs a device: dispatches, and bytes of their storage bindings, as functions of rows, intersections and
//! pixels. The recorder counts the same for steps of both forms.

use super::frame::{photo, renderer, results_with, scene};
use gsscale::base::simd::SimdPath;
use gsscale::gpu::{GpuOptions, Work};
use gsscale::kernels::deferred::DeferredTables;
use gsscale::kernels::uniforms::{SCAN_BLOCK, SCAN_SUMS};
use gsscale::optim::adam::AdamConfig;
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::rates::Rates;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::pages::{DeviceSlot, PageRenderer, PageRules, RecordedUpdate, SlotPage, StepJob};
use gsscale::render::{LossOptions, RenderOptions, Renderer};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use gsscale::scene::optimizer_numbers::SplitLimits;
use gsscale::scene::page_layout::{capacity_bytes, write_page};
use gsscale::scene::state::SceneState;

/// Values of a block of the scan, and the most sums that one reads.
const BLOCK: u64 = SCAN_BLOCK as u64;
const MOST: u64 = SCAN_SUMS as u64;

/// A step on all rows with all colour bands, whose lists fit one dispatch of each rasterizer.
#[derive(Clone, Copy)]
struct Step {
    rows: u64,
    /// Room of the lists; in the device form also of the sums of intersections.
    room: u64,
    isects: u64,
    size: [u64; 2],
    /// In the device form: number of pages, bytes of their slab, and of the optimizer's tables and sums of the step.
    pages: Option<[u64; 4]>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cost {
    pub dispatches: u64,
    bytes: u64,
}

impl Cost {
    fn add(&mut self, dispatches: u64, bytes_each: u64) {
        self.dispatches += dispatches;
        self.bytes += dispatches * bytes_each;
    }

    /// A scan of values without sums. Returns the sums and values that blocks read besides their own values, `most` each.
    pub fn scan(&mut self, count: u64, most: u64) -> u64 {
        let blocks = count.div_ceil(BLOCK);
        if blocks <= 1 {
            return self.scan_summed(count, [count, BLOCK], most);
        }
        self.add(1, 4 * (count + blocks)); // scan_reduce
        count + self.scan_summed(count, [blocks, BLOCK], most)
    }

    /// As [`Cost::scan`], with so many sums of so many values each.
    fn scan_summed(&mut self, count: u64, [sums, of_sum]: [u64; 2], most: u64) -> u64 {
        let blocks = count.div_ceil(BLOCK);
        let of_block = |block: u64| (block * BLOCK / of_sum, block * BLOCK % of_sum);
        let shared = if BLOCK.is_multiple_of(of_sum) { 0 } else { of_sum.min(count) };
        let is_too_much = blocks > 1 && count / of_sum + shared > most;
        if is_too_much && of_sum != BLOCK {
            return self.scan(count, most);
        }
        let (read, sums) = match is_too_much {
            true => (self.scan(blocks, most) + 2 * blocks, blocks + 1),
            false => ((0..blocks).map(of_block).map(|(sums, values)| sums + values).sum(), sums),
        };
        self.add(1, 4 * (count + sums + count + 1));
        read
    }

    /// Returns what [`Cost::scan`] returns, of a pass.
    fn sort(&mut self, live: u64, capacity: u64, bits: u32) -> u64 {
        let (passes, blocks) = (u64::from(bits.div_ceil(8)), capacity.div_ceil(1024));
        self.add(passes, live + 4 * capacity + 4 * 256 * blocks + 1024); // radix_histogram
        self.add(passes, live + 16 * capacity + 4 * (256 * blocks + 1)); // radix_sort
        (0..passes).map(|_| self.scan_summed(256 * blocks, [256, blocks], MOST)).max().unwrap_or(0)
    }
}

fn cost(&Step { rows: n, room, isects, size, pages }: &Step) -> Cost {
    let (pixels, tiles) = (size[0] * size[1], size[0].div_ceil(16) * size[1].div_ceil(16));
    let (geometry, colors, splats, offsets) = (44 * n, 192 * n, 48 * n, 4 * (n + 1));
    let (summed, v_colors) = if pages.is_some() { (room, 0) } else { (isects, colors) };
    let mut cost = Cost::default();
    if let Some([count, slab, tables, recent]) = pages {
        let (table, counts, found, results) = (32 * count, 4 * (count + 1), 4 * n, 48 * count);
        cost.add(1, table + slab + tables + recent + counts + found); // cull
        cost.add(1, counts + table); // place
        cost.add(2, table + slab + tables + recent + found); // gather_geometry, gather_colors
        cost.add(3, table + slab + tables + found + splats + 4); // step_geometry twice, step_colors
        cost.bytes += (geometry + colors) + 2 * geometry + (splats + 12 * n + colors);
        cost.add(1, table + slab + found + splats + 16 * n + results + (4 << 15) + 4); // finish
        cost.add(1, table + slab + tables + recent + results); // bounds
        cost.add(1, counts + offsets + 4 + 4 + 16 + 4 + 48); // gate
    }
    cost.add(1, geometry + splats + 8 * n); // project_fwd
    cost.sort(4, n, 32);
    cost.add(1, splats + 8 * n + 4 * n.div_ceil(256)); // isect_count
    cost.scan_summed(n, [n.div_ceil(256), 256], MOST);
    cost.add(1, splats + 12 * n + colors); // sh_fwd
    cost.add(1, splats + 4 * n + offsets + 12 * room); // isect_emit
    cost.sort(offsets, room, 64 - tiles.leading_zeros());
    cost.add(1, offsets + 4 * room + 4 * (tiles + 1) + 4); // isect_offsets
    cost.add(1, splats + 8 * room + 4 * (tiles + 1) + 20 * pixels); // rasterize_fwd
    cost.add(1, (12 + 4 + 36) * pixels + 48 * tiles); // ssim_map
    cost.add(1, (12 + 4 + 36 + 12) * pixels + 48 * tiles); // gradient
    let mut sums = 3 * tiles;
    while sums > 1 {
        cost.add(1, 16 * (sums + sums.div_ceil(4096))); // sum_partials
        sums = sums.div_ceil(4096);
    }
    cost.add(1, splats + 8 * room + 4 * (tiles + 1) + 20 * pixels + 36 * summed + 8); // rasterize_bwd
    cost.add(1, splats + 4 * room + 36 * summed + 4 * n + offsets + splats + 4); // fold_rows
    cost.add(1, 2 * splats + (16 + 12) * n + colors + v_colors); // sh_bwd
    cost.add(1, 2 * geometry + 2 * splats); // project_bwd
    cost
}

fn counted(renderer: &mut GpuRenderer, step: impl FnOnce(&mut GpuRenderer)) -> Cost {
    let Work { dispatches, bytes_bound, .. } = renderer.traffic().work;
    step(renderer);
    let work = renderer.traffic().work;
    Cost { dispatches: work.dispatches - dispatches, bytes: work.bytes_bound - bytes_bound }
}

/// One step on the device form, recorded without waiting: all rows in one page.
fn on_pages(gpu: &mut GpuRenderer, (rows, camera): &(Columns, Camera), host: Step) -> (Cost, Step) {
    let mut words = vec![0u64; capacity_bytes(rows.rows(), 3).div_ceil(8)];
    let layout = write_page(&SceneState::from_columns(rows.clone()), bytemuck::cast_slice_mut(&mut words));
    let adam = DeferredAdam::new(Rates::new(1.0, 100), AdamConfig::default(), SimdPath::best());
    let (numbers, of_step) = (adam.numbers(100).unwrap(), adam.at(0).numbers());
    let (tables, recent) = (DeferredTables::new(&numbers).words().len(), of_step.recent.as_flattened().len());
    let splits = SplitLimits { grow_grad2d: 0.3, split_scale: 0.01, reach: 3.33 };
    gpu.prepare_page_storage(&PageRules { largest: layout, numbers, splits, weighs: false }).unwrap();
    assert_eq!(gpu.add_slots(1).unwrap(), 1);
    let page = SlotPage { slot: DeviceSlot(0), layout };
    gpu.write_slots(&[(page, &bytemuck::cast_slice(&words)[..layout.bytes()])]).unwrap();
    let (options, loss) = (RenderOptions::default(), LossOptions::default());
    let (pages, rows_room, isects_most) = (&[page][..], rows.rows() as u32, u32::MAX);
    let job = StepJob { pages, numbers: &of_step, camera, options: &options, rows_room, isects_most };
    let (target, rows_per_unusable) = (photo(camera.width, camera.height, false), 1000);
    let update = RecordedUpdate { target: &target, loss: &loss, collects: true, rows_per_unusable, closes: false };
    let cost = counted(gpu, |gpu| {
        assert!(gpu.record_picture(&job).unwrap() && gpu.record_update(&update).unwrap());
        assert_eq!(gpu.finish_step().unwrap().closed, 0);
    });
    let room = (host.isects + host.isects / 4).next_multiple_of(1024);
    (cost, Step { room, pages: Some([1, gpu.slot_bytes(), 4 * tables as u64, 4 * recent as u64]), ..host })
}

/// Bytes of a row's page that a step moves, with so many bytes of moments a value: values and moments of means and scales in the cull, of
/// all in the gather; the update reads moments and writes all.
fn page_bytes_of_row(moments: u64) -> u64 {
    (6 + 59) * (4 + moments) + 59 * (moments + 4 + moments)
}

/// Few and many rows, few and many tiles: scans of one and of several blocks, sorts of one and of two digits.
#[test]
fn a_step_costs_what_the_model_says() {
    for (rows, width, height) in [(900, 64, 48), (9000, 336, 304)] {
        let options = GpuOptions { uniform_blocks: Some(true), ..GpuOptions::default() };
        let Some(mut gpu) = renderer(&options) else { return };
        let (mut view, target) = (scene(rows, width, height), photo(width, height, false));
        view.0.scales.iter_mut().for_each(|scale| *scale -= 1.0);
        gpu.set_capacity(1 << 20);
        let of_host = counted(&mut gpu, |gpu| {
            results_with(gpu, &view, &RenderOptions::default(), &target, &LossOptions::default()).unwrap();
        });
        let (isects, size) = (u64::from(gpu.isects()), [width, height].map(u64::from));
        let step = Step { rows: rows as u64, room: 1 << 20, isects, size, pages: None };
        assert_eq!(of_host, cost(&step), "the host form of {rows} rows");
        let (of_device, step) = on_pages(&mut gpu, &view, step);
        assert_eq!(of_device, cost(&step), "the device form of {rows} rows");
    }
    // Without the slab, of which a stage reads what the view needs.
    let large = Step { rows: 1 << 20, room: 5 << 20, isects: 5 << 20, size: [1024; 2], pages: None };
    let costs = [large, Step { pages: Some([500, 0, 100 << 10, 6400]), ..large }].map(|step| cost(&step));
    println!("1 M rows, 5 M intersections, 1 M pixels, on the host and on the device: {costs:?}");
    for (bits, moments) in [(32, 8), (16, 4)] {
        let bytes = costs[1].bytes + large.rows * page_bytes_of_row(moments);
        // Bytes a second, arithmetic of 116 GFLOP of rasterizing a second, 4 microseconds a launch.
        let ms =
            |rate: f64, flops: f64| 1e3 * (bytes as f64 / rate + 116e9 / flops + 4e-6 * costs[1].dispatches as f64);
        let [laptop, h100] = [ms(256e9, 15e12), ms(2.8e12, 45e12)];
        println!(
            "moments of {bits} bits: {bytes} bytes with the pages; RTX 4070 Laptop {laptop:.1} ms, H100 {h100:.1} ms"
        );
    }
    assert!(costs.iter().all(|cost| cost.dispatches <= 45));
}

/// A block reads all sums before it where these are few; where they are many, sums of sums. So much reading is linear.
#[test]
fn scans_read_at_most_three_sums_for_each_value() {
    for keys in (10..30).flat_map(|bits| [1u64 << bits, 3 << (bits - 1)]) {
        let counts = 256 * keys.div_ceil(1024);
        let mut cost = Cost::default();
        let of_sort = cost.sort(4, keys, 8);
        let of_offsets = cost.scan_summed(keys, [keys.div_ceil(256), 256], MOST);
        assert!(of_sort <= 3 * counts, "{of_sort} for {counts} counts of {keys} keys");
        assert!(of_offsets <= 3 * keys, "{of_offsets} for {keys} offsets");
        assert!(cost.dispatches <= 10);
    }
}
