//! Records the tile stages on a device: order by depth, intersections, lists by tile, and the rasterizer in both
//! directions. Twin of the second half of [`super::cpu`].
//!
//! Not here: projection, colours and loss, whose splats come in and whose gradients go out as buffers
//! (`shaders/shared/splat.wgsl`).
//!
//! Invariants: 1. nothing is written beyond a buffer: stages clamp the number of intersections to what the buffers
//! hold, and [`Demand`] tells the true one; a frame that fell short is recorded again with more room; 2. an invocation
//! stays below 65,535 loop iterations: long lists are blended in segments, whose number follows from the longest list
//! that was seen, and a frame with a longer one is recorded again; 3. the order of every sum is fixed, so a device
//! gives the same bits whenever it runs the same input again.

use crate::gpu::{Buffer, BufferView, Gpu, GpuError, GpuResult, Pipeline, Readback, Recorder, groups_1d};
use crate::kernels::splats::Grid;
use crate::kernels::uniforms_tiles::{
    DIGIT_BITS, DIGITS, IsectUniforms, OffsetsUniforms, RasterUniforms, SCAN_BLOCK, SEGMENT_FIRST, SEGMENT_FWD,
    SEGMENT_LAST, SORT_BLOCK, SPLAT_WORDS, ScanUniforms, SortUniforms, grid_words,
};
use std::sync::Arc;

/// Invocations of a workgroup of the stages on rows and intersections.
const WORKGROUP: u32 = crate::gpu::WORKGROUP;
/// Fewest intersections that buffers are made for.
const CAPACITY_MIN: u32 = 1 << 16;
/// Most intersections of a view: sums saturate at 2^32 - 1, and indices of folded dispatches need some room.
const CAPACITY_MAX: u64 = (1 << 32) - (1 << 25);

/// Compiled stages.
#[derive(Debug)]
pub(super) struct Pipelines {
    scan_reduce: Arc<Pipeline>,
    scan: Arc<Pipeline>,
    radix_histogram: Arc<Pipeline>,
    radix_sort: Arc<Pipeline>,
    depth_keys: Arc<Pipeline>,
    isect_count: Arc<Pipeline>,
    isect_emit: Arc<Pipeline>,
    isect_offsets: Arc<Pipeline>,
    rasterize_fwd: Arc<Pipeline>,
    pub(super) rasterize_bwd: Arc<Pipeline>,
    pub(super) fold_rows: Arc<Pipeline>,
}

/// What blending depends on besides splats.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blend {
    /// Tiles of the picture.
    pub grid: Grid,
    /// Added behind everything.
    pub background: [f32; 3],
    /// Upper clamp of alpha.
    pub max_alpha: f32,
}

/// Two arrays of 32-bit words that a sort goes to and fro between.
#[derive(Debug)]
pub struct Pairs {
    /// Keys and values.
    pub keys: Buffer,
    /// As long as the keys.
    pub values: Buffer,
}

/// Rows of a view in depth order, with the offsets of their intersections.
#[derive(Debug)]
pub struct Ranks {
    /// Rows of the view.
    pub rows: u32,
    /// `[rows]` u32: rows by rank; rows that are not drawn come last.
    pub order: Buffer,
    /// `[rows + 1]` u32: where each rank's intersections begin; the last is their number.
    pub offsets: Buffer,
}

/// Lists and picture of a view.
#[derive(Debug)]
pub struct Frame {
    /// Tiles, background and clamp.
    pub blend: Blend,
    /// Intersections that the buffers hold.
    pub capacity: u32,
    /// Longest list that the dispatches reached to the end of.
    pub list_max: u32,
    /// u32 by emit index: the row.
    pub row_from_isect: Buffer,
    /// u32, tile by tile: emit indices.
    pub isects: Buffer,
    /// `[tiles + 1]` u32.
    pub tile_offsets: Buffer,
    /// `[3][height][width]` f32.
    pub rgb: Buffer,
    /// `[height][width]` f32: transmittance behind everything; the coverage is 1 less this.
    pub t_final: Buffer,
    /// `[height][width]` u32: list index at which the pixel stopped, or 2^32 - 1.
    pub stops: Buffer,
}

/// What a recorded frame will turn out to have needed: two words on their way to the host.
#[derive(Debug)]
pub struct DemandReadback {
    total: Readback,
    longest: Readback,
}

/// What a frame needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Demand {
    /// Intersections; 2^32 - 1 stands for this many or more.
    pub isects: u32,
    /// Longest list of a tile, of those intersections that the buffers held.
    pub list_max: u32,
}

impl DemandReadback {
    /// Waits for the device.
    ///
    /// # Errors
    /// The device failed.
    pub fn wait(self) -> GpuResult<Demand> {
        let (mut isects, mut list_max) = ([0u32], [0u32]);
        self.total.copy_to(&mut isects)?;
        self.longest.copy_to(&mut list_max)?;
        Ok(Demand { isects: isects[0], list_max: list_max[0] })
    }
}

/// The tile stages of one device, and how much room the views so far needed.
#[derive(Debug)]
pub struct TileStages {
    pub(super) pipelines: Pipelines,
    capacity: u32,
    /// Words of the largest binding.
    binding_words: u32,
    list_max: u32,
}

pub(super) fn words(count: u32) -> u64 {
    4 * u64::from(count)
}

impl TileStages {
    /// Compiles the stages.
    ///
    /// # Errors
    /// A shader does not compile on this device.
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
            rasterize_bwd: get("rasterize_bwd", "rasterize_bwd")?,
            fold_rows: get("rasterize_bwd", "fold_rows")?,
        };
        let binding_words = u32::try_from(gpu.max_binding_bytes() / 4).unwrap_or(u32::MAX);
        Ok(TileStages { pipelines, capacity: CAPACITY_MIN, binding_words, list_max: SEGMENT_FWD })
    }

    /// Intersections that the next frame has room for.
    pub fn capacity(&self) -> u32 {
        self.capacity
    }

    /// Sets how many intersections the next frame has room for; it grows again on demand.
    pub fn set_capacity(&mut self, isects: u32) {
        self.capacity = isects.max(1);
    }

    /// Records the exclusive prefix sum of `count` words into `offsets` (`count` + 1 words, the last is the total).
    /// Sums saturate: a total of 2^32 - 1 means this much or more.
    ///
    /// # Errors
    /// The device has no room for the sums of blocks.
    pub fn scan(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        values: &BufferView,
        count: u32,
        offsets: &BufferView,
    ) -> GpuResult<()> {
        let groups = groups_1d(count.max(1), SCAN_BLOCK);
        let blocks = count.div_ceil(SCAN_BLOCK);
        if blocks <= 1 {
            let level = recorder.uniform(&ScanUniforms { count, has_bases: 0, pad: [0; 2] })?;
            let views = [level, values.clone(), values.clone(), offsets.clone()];
            return recorder.dispatch("scan", &self.pipelines.scan, &views, groups);
        }
        let level = recorder.uniform(&ScanUniforms { count, has_bases: 1, pad: [0; 2] })?;
        let sums = gpu.buffer("sums of scan blocks", words(blocks))?;
        let bases = gpu.buffer("bases of scan blocks", words(blocks + 1))?;
        let views = [level.clone(), values.clone(), sums.view()];
        recorder.dispatch("scan", &self.pipelines.scan_reduce, &views, groups)?;
        self.scan(gpu, recorder, &sums.view(), blocks, &bases.view())?;
        let views = [level, values.clone(), bases.view(), offsets.clone()];
        recorder.dispatch("scan", &self.pipelines.scan, &views, groups)
    }

    /// Records the stable sort of pairs by the `bits` low bits of their keys. The number of pairs is the word
    /// `live_at` of `live`, at most `capacity`. Returns the sorted pairs.
    ///
    /// # Errors
    /// The device has no room.
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
        let mut from = pairs;
        let mut to = Pairs {
            keys: gpu.buffer("sort keys", words(capacity))?,
            values: gpu.buffer("sort values", words(capacity))?,
        };
        for shift in (0..bits).step_by(DIGIT_BITS as usize) {
            let pass = recorder.uniform(&SortUniforms { capacity, live_at, blocks, shift })?;
            let views = [pass.clone(), live.clone(), from.keys.view(), histogram.view()];
            recorder.dispatch("radix_sort", &self.pipelines.radix_histogram, &views, groups)?;
            self.scan(gpu, recorder, &histogram.view(), entries, &places.view())?;
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

    /// Records the order of the rows by depth and the offsets of their intersections. `splats` holds `rows` records.
    ///
    /// # Errors
    /// The device has no room.
    pub fn order(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        rows: u32,
        grid: Grid,
    ) -> GpuResult<Ranks> {
        let groups = groups_1d(rows, WORKGROUP);
        let pairs =
            Pairs { keys: gpu.buffer("sort keys", words(rows))?, values: gpu.buffer("sort values", words(rows))? };
        let depth = recorder.uniform(&SortUniforms { capacity: rows, live_at: 0, blocks: 0, shift: 0 })?;
        let views = [depth, pairs.keys.view(), pairs.values.view(), splats.clone()];
        recorder.dispatch("radix_sort", &self.pipelines.depth_keys, &views, groups)?;
        let live = recorder.buffer_with("rows of the view", &[rows])?;
        let sorted = self.sort(gpu, recorder, &live.view(), 0, rows, 32, pairs)?;
        let counts = gpu.buffer("intersections of rows", words(rows))?;
        let view = recorder.uniform(&IsectUniforms {
            grid: grid_words(grid),
            row_count: rows,
            capacity: self.capacity,
            pad: [0; 2],
        })?;
        let views = [view, splats.clone(), sorted.values.view(), counts.view()];
        recorder.dispatch("isect_emit", &self.pipelines.isect_count, &views, groups)?;
        let offsets = gpu.buffer("intersection offsets", words(rows + 1))?;
        self.scan(gpu, recorder, &counts.view(), rows, &offsets.view())?;
        Ok(Ranks { rows, order: sorted.values, offsets })
    }

    /// Records the lists of the tiles and the picture, with room as the frames before needed it. The picture is right
    /// if [`TileStages::fits`] says so once the demand has arrived.
    ///
    /// # Errors
    /// The device has no room.
    pub fn frame(
        &self,
        gpu: &Gpu,
        recorder: &mut Recorder<'_>,
        splats: &BufferView,
        ranks: &Ranks,
        blend: Blend,
    ) -> GpuResult<(Frame, DemandReadback)> {
        let (grid, capacity) = (blend.grid, self.capacity);
        let tiles = grid.tiles_x * grid.tiles_y;
        let pairs = Pairs {
            keys: gpu.buffer("tiles of intersections", words(capacity))?,
            values: gpu.buffer("intersections", words(capacity))?,
        };
        let row_from_isect = gpu.buffer("rows of intersections", words(capacity))?;
        let view = recorder.uniform(&IsectUniforms {
            grid: grid_words(grid),
            row_count: ranks.rows,
            capacity,
            pad: [0; 2],
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
        // One value beyond the last tile is for intersections that were not found.
        let bits = 32 - tiles.leading_zeros();
        let live = ranks.offsets.view();
        let sorted = self.sort(gpu, recorder, &live, ranks.rows, capacity, bits, pairs)?;

        let tile_offsets = gpu.buffer("tile offsets", words(tiles + 1))?;
        let longest = recorder.buffer_zeroed("longest list", 4)?;
        let lists = recorder.uniform(&OffsetsUniforms { tile_count: tiles, capacity, live_at: ranks.rows, pad: 0 })?;
        let views = [lists, live, sorted.keys.view(), tile_offsets.view(), longest.view()];
        let groups = groups_1d(tiles + 1, WORKGROUP);
        recorder.dispatch("isect_offsets", &self.pipelines.isect_offsets, &views, groups)?;

        let pixels = u64::from(grid.width) * u64::from(grid.height);
        let frame = Frame {
            blend,
            capacity,
            list_max: self.list_max,
            row_from_isect,
            isects: sorted.values,
            tile_offsets,
            rgb: gpu.buffer("picture", 12 * pixels)?,
            t_final: gpu.buffer("transmittance", 4 * pixels)?,
            stops: gpu.buffer("stops of pixels", 4 * pixels)?,
        };
        self.blend(recorder, splats, &frame)?;
        let last = words(ranks.rows);
        let total = recorder.read_back("scan", &ranks.offsets.slice(last, 4))?;
        let longest = recorder.read_back("isect_offsets", &longest.slice(0, 4))?;
        Ok((frame, DemandReadback { total, longest }))
    }

    fn blend(&self, recorder: &mut Recorder<'_>, splats: &BufferView, frame: &Frame) -> GpuResult<()> {
        let tiles = frame.blend.grid.tiles_x * frame.blend.grid.tiles_y;
        let segments = frame.list_max.div_ceil(SEGMENT_FWD).max(1);
        for segment in 0..segments {
            let mut flags = 0;
            flags |= if segment == 0 { SEGMENT_FIRST } else { 0 };
            flags |= if segment + 1 == segments { SEGMENT_LAST } else { 0 };
            let view = recorder.uniform(&raster_uniforms(&frame.blend, segment, SEGMENT_FWD, flags))?;
            let views = [
                view,
                splats.clone(),
                frame.row_from_isect.view(),
                frame.isects.view(),
                frame.tile_offsets.view(),
                frame.rgb.view(),
                frame.t_final.view(),
                frame.stops.view(),
            ];
            recorder.dispatch("rasterize_fwd", &self.pipelines.rasterize_fwd, &views, groups_1d(tiles, 1))?;
        }
        Ok(())
    }

    /// Whether a frame had room for what it needed. If not, the next one will: record [`TileStages::frame`] again.
    ///
    /// # Errors
    /// No device could hold this view.
    pub fn fits(&mut self, frame: &Frame, demand: Demand) -> GpuResult<bool> {
        if u64::from(demand.isects) >= CAPACITY_MAX {
            let need = words(demand.isects);
            return Err(GpuError::BufferTooLarge {
                what: "intersections of this view".into(),
                need,
                limit: words(CAPACITY_MAX as u32),
            });
        }
        let room = demand.isects <= frame.capacity;
        if !room {
            // A quarter more, so that views that need a little more do not come here again; but not more than a binding
            // holds, unless this view alone is beyond it, which the dispatch then reports.
            let more = (demand.isects.saturating_add(demand.isects / 4)).min(self.binding_words);
            self.capacity = self.capacity.max(more).max(demand.isects);
        }
        let reached = demand.list_max <= frame.list_max;
        if !reached {
            self.list_max = self.list_max.max(demand.list_max.next_multiple_of(SEGMENT_FWD));
        }
        Ok(room && reached)
    }

    /// Orders, lists and blends, as often as the demand takes, and waits for it. `splats` holds `rows` records.
    ///
    /// # Errors
    /// The device has no room, or failed.
    pub fn forward(
        &mut self,
        gpu: &Gpu,
        splats: &BufferView,
        rows: u32,
        blend: Blend,
    ) -> GpuResult<(Ranks, Frame, Demand)> {
        let mut recorder = gpu.begin("tiles");
        let ranks = self.order(gpu, &mut recorder, splats, rows, blend.grid)?;
        loop {
            let (frame, demand) = self.frame(gpu, &mut recorder, splats, &ranks, blend)?;
            gpu.submit(recorder)?;
            let demand = demand.wait()?;
            if self.fits(&frame, demand)? {
                return Ok((ranks, frame, demand));
            }
            drop(frame);
            recorder = gpu.begin("tiles again");
        }
    }
}

/// Bytes of the splats, or of their gradients, of `rows` rows.
pub fn splat_bytes(rows: u32) -> u64 {
    u64::from(SPLAT_WORDS) * words(rows)
}

/// Uniforms of one dispatch of a rasterizer: list entries from `length` times `segment` on.
pub(super) fn raster_uniforms(blend: &Blend, segment: u32, length: u32, flags: u32) -> RasterUniforms {
    RasterUniforms {
        grid: grid_words(blend.grid),
        background: blend.background,
        max_alpha: blend.max_alpha,
        log2_max_alpha: libm::log2f(blend.max_alpha),
        first: segment.saturating_mul(length),
        end: segment.saturating_add(1).saturating_mul(length),
        flags,
        row_count: 0,
        isect_count: 0,
        window_first: 0,
        window_end: 0,
    }
}
