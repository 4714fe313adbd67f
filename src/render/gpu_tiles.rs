//! Records the tile stages of the forward pass on a device: depth sort, intersections, tile lists, blending.
//!
//! Not here: the backward half (`gpu_tiles_bwd`); projection, colours and loss (`gpu_rows`, `gpu_loss`). Splats come in
//! as a buffer (`shaders/shared/splat.wgsl`). The CPU twin is the second half of [`super::cpu`].
//!
//! Invariants: 1. no stage writes beyond a buffer: stages clamp the number of intersections to the capacity of the
//! buffers, [`Demand`] reports the true number, and a frame that exceeded its capacity is recorded again with more; 2.
//! an invocation runs fewer than 65,535 loop iterations: long lists are blended in segments, whose number follows from
//! the longest list so far, and a frame with a longer list is recorded again; 3. the order of every sum is fixed, so
//! the same input gives the same bits on one device.

use super::gpu_frame::{
    Blend, Demand, DemandReadback, Frame, FrameRoom, ListPart, Pairs, Pixels, Ranks, raster_uniforms, words,
};
use super::gpu_tiles_bwd::BackStages;
use crate::gpu::{BufferView, Gpu, GpuError, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::{
    DIGIT_BITS, DIGITS, IsectUniforms, OffsetsUniforms, RasterUniforms, SCAN_BLOCK, SCAN_SUMS, SEGMENT_BWD,
    SEGMENT_FIRST, SEGMENT_FWD, SEGMENT_LAST, SORT_BLOCK, ScanUniforms, SortUniforms, grid_words, range_words,
};
use std::sync::Arc;

/// Invocations per workgroup of the stages on rows and intersections.
const WORKGROUP: u32 = crate::gpu::WORKGROUP;
/// Capacity of the first frame, intersections.
const CAPACITY_MIN: u32 = 1 << 16;
/// Most intersections of a view: sums saturate at 2^32 - 1, and the index of a folded dispatch may exceed the count.
const CAPACITY_MAX: u64 = (1 << 32) - (1 << 25);

/// Length of the longest list before a frame has shown it, entries.
const FIRST_LIST: u32 = 2048;

/// Capacities of frames whose demand nobody waits for are multiples of this: few sizes of buffers.
const LIST_STEP: u32 = 1 << 10;

/// The compiled tile stages of the forward pass.
#[derive(Debug)]
struct Pipelines {
    scan_reduce: Arc<Pipeline>,
    scan: Arc<Pipeline>,
    radix_histogram: Arc<Pipeline>,
    radix_sort: Arc<Pipeline>,
    depth_keys: Arc<Pipeline>,
    isect_count: Arc<Pipeline>,
    isect_emit: Arc<Pipeline>,
    isect_offsets: Arc<Pipeline>,
    rasterize_fwd: Arc<Pipeline>,
}

/// The tile stages of one device, and the buffer sizes for the next frame.
#[derive(Debug)]
pub struct TileStages {
    pipelines: Pipelines,
    /// The backward pass.
    pub back: BackStages,
    /// [`SCAN_SUMS`]; tests lower it. It changes no result.
    pub scan_sums: u32,
    /// Sizes of the next frame.
    room: FrameRoom,
    /// The most that a frame has needed so far; `None` before the first.
    seen: Option<Demand>,
    /// Size of the largest binding, 32-bit words.
    binding_words: u32,
}

impl TileStages {
    pub fn new(gpu: &Gpu) -> GpuResult<TileStages> {
        let get = |stage: &str, entry: &str| gpu.pipeline(&format!("{stage}.wgsl"), entry, &[]);
        let pipelines = Pipelines {
            scan_reduce: get("scan", "scan_reduce")?,
            scan: get("scan", "scan")?,
            radix_histogram: get("radix_sort", "radix_histogram")?,
            radix_sort: get("radix_sort", "radix_sort")?,
            depth_keys: get("radix_sort", "depth_keys")?,
            isect_count: get("isect_emit", "isect_count")?,
            isect_emit: get("isect_emit", "isect_emit")?,
            isect_offsets: get("isect_offsets", "isect_offsets")?,
            rasterize_fwd: get("rasterize_fwd", "rasterize_fwd")?,
        };
        let binding_words = u32::try_from(gpu.max_binding_bytes() / 4).unwrap_or(u32::MAX);
        Ok(TileStages {
            pipelines,
            back: BackStages::new(gpu)?,
            scan_sums: SCAN_SUMS,
            room: FrameRoom { capacity: CAPACITY_MIN, list_max: SEGMENT_FWD },
            seen: None,
            binding_words,
        })
    }

    /// Sizes of the next frame of a whole view, as earlier frames needed them.
    pub fn room(&self) -> FrameRoom {
        self.room
    }

    /// Notes what a frame needed.
    pub(super) fn note(&mut self, demand: Demand) {
        let Demand { isects, list_max } = self.seen.unwrap_or(demand);
        self.seen = Some(Demand { isects: isects.max(demand.isects), list_max: list_max.max(demand.list_max) });
    }

    /// Sizes of a frame whose demand nobody waits for: a quarter more than any frame has needed, and no more than the next frame
    /// would have; `None` before the first frame.
    pub(super) fn room_by_demand(&self) -> Option<FrameRoom> {
        let more = |seen: u32, step: u32| seen.saturating_add(seen / 4).max(1).checked_next_multiple_of(step);
        self.seen.map(|Demand { isects, list_max }| FrameRoom {
            capacity: more(isects, LIST_STEP).unwrap_or(u32::MAX).min(self.room.capacity),
            list_max: more(list_max, SEGMENT_BWD).unwrap_or(u32::MAX).min(self.room.list_max),
        })
    }

    /// Sets the capacity of the next frame. The capacity grows on demand.
    pub fn set_capacity(&mut self, isects: u32) {
        self.room.capacity = isects.max(1);
    }

    /// Halves the capacity of the next frame, after a frame that device memory could not hold.
    pub(super) fn halve_capacity(&mut self) {
        self.room.capacity = (self.room.capacity / 2).max(1);
    }

    /// Records the exclusive prefix sum of `count` words into `offsets` (`count` + 1 words; the last is the total).
    /// Sums saturate: a total of 2^32 - 1 means 2^32 - 1 or more.
    pub fn scan(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        values: &BufferView,
        count: u32,
        offsets: &BufferView,
    ) -> GpuResult<()> {
        let blocks = count.div_ceil(SCAN_BLOCK);
        if blocks <= 1 {
            return self.scan_summed(gpu, recorder, (values, values, SCAN_BLOCK), count, offsets);
        }
        let level =
            recorder.uniform(&ScanUniforms { count, values_of_sum: SCAN_BLOCK, are_sums_scanned: 0, pad: 0 })?;
        let sums = gpu.buffer("sums of scan blocks", words(blocks))?;
        let views = [level, values.clone(), sums.view()];
        recorder.dispatch("scan", &self.pipelines.scan_reduce, &views, groups_1d(count, SCAN_BLOCK))?;
        self.scan_summed(gpu, recorder, (values, &sums.view(), SCAN_BLOCK), count, offsets)
    }

    /// As [`TileStages::scan`], with given `sums` of groups of `values_of_sum` values. If a block would read more than [`SCAN_SUMS`] of
    /// the sums, the values are summed by blocks instead. If a block would read too many sums of blocks, these sums are scanned first.
    fn scan_summed(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        (values, sums, values_of_sum): (&BufferView, &BufferView, u32),
        count: u32,
        offsets: &BufferView,
    ) -> GpuResult<()> {
        let blocks = count.div_ceil(SCAN_BLOCK);
        // Most values before a block that lie in the same group as the block's first value.
        let shared = if SCAN_BLOCK.is_multiple_of(values_of_sum) { 0 } else { values_of_sum.min(count) };
        let is_too_much = blocks > 1 && count / values_of_sum.max(1) + shared > self.scan_sums;
        if is_too_much && values_of_sum != SCAN_BLOCK {
            return self.scan(gpu, recorder, values, count, offsets);
        }
        let scanned = is_too_much.then(|| gpu.buffer("scanned sums of blocks", words(blocks + 1))).transpose()?;
        if let Some(scanned) = &scanned {
            self.scan(gpu, recorder, sums, blocks, &scanned.view())?;
        }
        let are_sums_scanned = u32::from(is_too_much);
        let level = recorder.uniform(&ScanUniforms { count, values_of_sum, are_sums_scanned, pad: 0 })?;
        let sums = scanned.map_or_else(|| sums.clone(), |scanned| scanned.view());
        let views = [level, values.clone(), sums, offsets.clone()];
        recorder.dispatch("scan", &self.pipelines.scan, &views, groups_1d(count.max(1), SCAN_BLOCK))
    }

    /// Records a stable radix sort of `pairs` by the low `bits` bits of the keys. Word `live_at` of the buffer `live`
    /// holds the number of pairs, at most `capacity`. Returns the sorted pairs.
    pub fn sort(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        live: &BufferView,
        live_at: u32,
        capacity: u32,
        bits: u32,
        pairs: Pairs,
    ) -> GpuResult<Pairs> {
        let blocks = capacity.div_ceil(SORT_BLOCK);
        let groups = groups_1d(capacity, SORT_BLOCK);
        let entries = DIGITS * blocks;
        let histogram = gpu.buffer("digits of sort blocks", words(entries))?;
        let places = gpu.buffer("places of sort blocks", words(entries + 1))?;
        let totals = recorder.buffer_zeroed("digits", words(DIGITS * bits.div_ceil(DIGIT_BITS)))?;
        let mut from = pairs;
        let mut to = Pairs::new(gpu, capacity)?;
        for (pass, shift) in (0..bits).step_by(DIGIT_BITS as usize).enumerate() {
            let totals = totals.slice(words(DIGITS) * pass as u64, words(DIGITS));
            let pass = recorder.uniform(&SortUniforms { capacity, live_at, blocks, shift })?;
            let views = [pass.clone(), live.clone(), from.keys.view(), histogram.view(), totals.clone()];
            recorder.dispatch("radix_sort", &self.pipelines.radix_histogram, &views, groups)?;
            self.scan_summed(gpu, recorder, (&histogram.view(), &totals, blocks), entries, &places.view())?;
            let views = [
                pass,
                live.clone(),
                from.keys.view(),
                from.values.view(),
                places.view(),
                to.keys.view(),
                to.values.view(),
            ];
            recorder.dispatch("radix_sort", &self.pipelines.radix_sort, &views, groups)?;
            std::mem::swap(&mut from, &mut to);
        }
        Ok(from)
    }

    /// Records the depth sort of the rows and the offsets of their intersections with the tiles of `range`. `splats` holds
    /// `rows` records. `keys` are those that the projection wrote; `None` if it wrote none.
    pub fn order(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        rows: u32,
        grid: Grid,
        range: TileRange,
        keys: Option<Pairs>,
    ) -> GpuResult<Ranks> {
        let groups = groups_1d(rows, WORKGROUP);
        let pairs = match keys {
            Some(pairs) => pairs,
            None => {
                let pairs = Pairs::new(gpu, rows)?;
                let depth = recorder.uniform(&SortUniforms { capacity: rows, live_at: 0, blocks: 0, shift: 0 })?;
                let views = [depth, pairs.keys.view(), pairs.values.view(), splats.clone()];
                recorder.dispatch("radix_sort", &self.pipelines.depth_keys, &views, groups)?;
                pairs
            }
        };
        let live = recorder.buffer_with("rows of the view", &[rows])?;
        let sorted = self.sort(gpu, recorder, &live.view(), 0, rows, 32, pairs)?;
        let counts = gpu.buffer("intersections of rows", words(rows))?;
        let view = recorder.uniform(&IsectUniforms {
            grid: grid_words(grid),
            row_count: rows,
            capacity: 0,
            pad: [0; 2],
            range: range_words(range),
        })?;
        let sums = gpu.buffer("intersections of workgroups", words(rows.div_ceil(WORKGROUP)))?;
        let views = [view, splats.clone(), sorted.values.view(), counts.view(), sums.view()];
        recorder.dispatch("isect_emit", &self.pipelines.isect_count, &views, groups)?;
        let offsets = gpu.buffer("intersection offsets", words(rows + 1))?;
        let summed = (&counts.view(), &sums.view(), WORKGROUP);
        self.scan_summed(gpu, recorder, summed, rows, &offsets.view())?;
        Ok(Ranks { rows, order: sorted.values, offsets })
    }

    /// Records the lists of the tiles of `range`, with buffers of the sizes `room`. The lists are complete if the demand of
    /// the frame is within `room`.
    pub fn lists(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        blend: Blend,
        range: TileRange,
        room: FrameRoom,
    ) -> GpuResult<Frame> {
        let (grid, capacity) = (blend.grid, room.capacity);
        let tiles = grid.tiles_x * grid.tiles_y;
        let pairs = Pairs::new(gpu, capacity)?;
        let row_from_isect = gpu.buffer("rows of intersections", words(capacity))?;
        let view = recorder.uniform(&IsectUniforms {
            grid: grid_words(grid),
            row_count: ranks.rows,
            capacity,
            pad: [0; 2],
            range: range_words(range),
        })?;
        let views = [
            view,
            splats.clone(),
            ranks.order.view(),
            ranks.offsets.view(),
            pairs.keys.view(),
            pairs.values.view(),
            row_from_isect.view(),
        ];
        recorder.dispatch("isect_emit", &self.pipelines.isect_emit, &views, groups_1d(capacity, WORKGROUP))?;
        // The key `tiles`, one beyond the last tile, marks entries without an intersection.
        let bits = 32 - tiles.leading_zeros();
        let live = ranks.offsets.view();
        let sorted = self.sort(gpu, recorder, &live, ranks.rows, capacity, bits, pairs)?;

        let tile_offsets = gpu.buffer("tile offsets", words(tiles + 1))?;
        let longest = recorder.buffer_zeroed("longest list", 4)?;
        let lists = recorder.uniform(&OffsetsUniforms { tile_count: tiles, capacity, live_at: ranks.rows, pad: 0 })?;
        let views = [lists, live, sorted.keys.view(), tile_offsets.view(), longest.view()];
        let groups = groups_1d(tiles + 1, WORKGROUP);
        recorder.dispatch("isect_offsets", &self.pipelines.isect_offsets, &views, groups)?;
        let part = ListPart::ALL;
        Ok(Frame { blend, range, part, room, row_from_isect, isects: sorted.values, tile_offsets, longest })
    }

    /// Records the tile lists and the blending of a whole view, with buffers as large as earlier frames needed. The picture
    /// is valid if [`TileStages::fits`] is true for the demand that the readback returns.
    pub fn frame(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        blend: Blend,
        pixels: &Pixels,
    ) -> GpuResult<(Frame, DemandReadback)> {
        let frame = self.frame_of(gpu, recorder, splats, ranks, (blend, self.room), pixels)?;
        let last = words(ranks.rows);
        let total = recorder.read_back("scan", &ranks.offsets.slice(last, 4))?;
        let longest = recorder.read_back("isect_offsets", &frame.longest.slice(0, 4))?;
        Ok((frame, DemandReadback { total, longest }))
    }

    /// As [`TileStages::frame`], with buffers of the sizes `room`, and without reading the demand.
    pub(super) fn frame_of(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        (blend, room): (Blend, FrameRoom),
        pixels: &Pixels,
    ) -> GpuResult<Frame> {
        let frame = self.lists(gpu, recorder, splats, ranks, blend, TileRange::all(blend.grid), room)?;
        let entries = self.seen.map_or(FIRST_LIST, |seen| seen.list_max);
        self.blend(recorder, splats, &frame, pixels, entries)?;
        Ok(frame)
    }

    /// Records the blending of the tiles of a frame, in dispatches for lists of some `entries` entries.
    pub fn blend(
        &self,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        frame: &Frame,
        pixels: &Pixels,
        entries: u32,
    ) -> GpuResult<()> {
        let segments = frame.room.list_max.div_ceil(SEGMENT_FWD).max(1);
        let bands: Vec<TileRange> = self.back.bands(frame.range, entries.min(SEGMENT_FWD));
        for (segment, &band) in (0..segments).flat_map(|segment| bands.iter().map(move |band| (segment, band))) {
            let mut flags = 0;
            flags |= if segment == 0 && frame.part.is_nearest { SEGMENT_FIRST } else { 0 };
            flags |= if segment + 1 == segments && frame.part.is_farthest { SEGMENT_LAST } else { 0 };
            let uniforms = raster_uniforms(&frame.blend, band, segment, SEGMENT_FWD, flags);
            let view = recorder.uniform(&RasterUniforms { list_base: frame.part.base, ..uniforms })?;
            let views = [
                view,
                splats.clone(),
                frame.row_from_isect.view(),
                frame.isects.view(),
                frame.tile_offsets.view(),
                pixels.rgb.view(),
                pixels.t_final.view(),
                pixels.stops.view(),
            ];
            let groups = groups_1d(band.tiles(), 1);
            recorder.dispatch("rasterize_fwd", &self.pipelines.rasterize_fwd, &views, groups)?;
            if bands.len() > 1 {
                recorder.submit_so_far()?;
            }
        }
        Ok(())
    }

    /// Whether the buffers of a frame were large enough. If not, the sizes for the next frame grow to `demand`, and the
    /// caller records [`TileStages::frame`] again.
    /// Errors: the view has more intersections than any device can hold.
    pub fn fits(&mut self, frame: &Frame, demand: Demand) -> GpuResult<bool> {
        if u64::from(demand.isects) >= CAPACITY_MAX {
            let need = words(demand.isects);
            return Err(GpuError::BufferTooLarge {
                what: "intersections of this view".into(),
                need,
                limit: words(CAPACITY_MAX as u32),
            });
        }
        let room = demand.isects <= frame.room.capacity;
        if !room {
            // A quarter more than needed, so that slightly larger views need no second recording. The limit is the
            // largest binding; if this view alone exceeds it, the dispatch reports the error.
            let more = (demand.isects.saturating_add(demand.isects / 4)).min(self.binding_words);
            self.room.capacity = self.room.capacity.max(more).max(demand.isects);
        }
        let reached = demand.list_max <= frame.room.list_max;
        if !reached {
            self.room.list_max = self.room.list_max.max(demand.list_max.next_multiple_of(SEGMENT_FWD));
        }
        Ok(room && reached)
    }
}
