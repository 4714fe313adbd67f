//! Ranges of tiles on a device: a picture whose splats or lists are too large to be bound or held at once is blended in parts,
//! and its gradients come back in the same parts.
//!
//! A tally counts the splats that reach each tile. The host plans ranges of tiles whose lists fit, and parts of one tile's list
//! where that list alone is too long. For each of them the splats that reach it are copied into one buffer, in row order, and
//! go through the stages of a whole view. On the way back the copy and the lists are made again.
//!
//! Not here: the stages of a view (`gpu_tiles`, `gpu_tiles_bwd`), the plan (`gpu_range_plan`).
//!
//! Invariants: 1. pictures and gradients have the same bits for any plan: a tile's list has the same splats in the same order,
//! a row's sums are carried from range to range in column order, and pixels carry their state from part to part; 2. a range
//! that lacks memory is cut again, down to a few splats of one tile; 3. the picture is complete when [`Ranges::draw`] returns:
//! it waits.

use super::gpu_frame::{Blend, Demand, Frame, Pixels, Ranks, splat_bytes, words};
use super::gpu_range_plan::{ALL_DEPTHS, PlannedRange, RangeLimits, Tally};
use super::gpu_segments::{Segment, gradients_of, zero_gradients};
use super::gpu_tiles::TileStages;
use super::gpu_tiles_bwd::{Fold, PictureGradientBuffers, carry_bytes};
use crate::gpu::{Buffer, Gpu, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::{DEPTH_BINS, RangeUniforms, grid_words, range_words};
use bytemuck::Zeroable;
use std::sync::Arc;

/// Invocations per workgroup of the stages on rows.
const WORKGROUP: u32 = crate::gpu::WORKGROUP;
/// Bytes a row of the view: whether the splat reaches the range, and its place among those that do.
pub(super) const PLACE_BYTES: u64 = 8;
/// Words of the demand of one range: intersections, longest list, splats.
const DEMAND_WORDS: u32 = 3;

#[derive(Debug)]
pub(super) struct RangeStages {
    tally: Arc<Pipeline>,
    select: Arc<Pipeline>,
    depths: Arc<Pipeline>,
    gather: Arc<Pipeline>,
    scatter: Arc<Pipeline>,
}

impl RangeStages {
    /// Compiles the stages.
    pub fn new(gpu: &Gpu) -> GpuResult<Self> {
        let entry = |name: &str| gpu.pipeline("tile_range.wgsl", name, &[]);
        Ok(RangeStages {
            tally: entry("range_tally")?,
            select: entry("range_select")?,
            depths: entry("range_depths")?,
            gather: entry("range_gather")?,
            scatter: entry("range_scatter")?,
        })
    }
}

/// The splats that reach a range, in row order, and where each row of the view lies among them.
struct Copied {
    splats: Buffer,
    places: Places,
    ranks: Ranks,
}

/// Where the rows of the segments lie in a copy.
struct Places {
    /// For each segment `[rows + 1]` u32: the place of each row among the copied rows of the segment.
    in_segment: Vec<Buffer>,
    /// `[segments + 1]` u32: copied rows before each segment; the last entry is their number.
    bases: Buffer,
}

/// What the parts of a view have in common.
pub(super) struct Ranges<'a> {
    pub gpu: &'a Gpu,
    pub tiles: &'a TileStages,
    pub stages: &'a RangeStages,
    pub blend: Blend,
    pub pixels: &'a Pixels,
}

impl Ranges<'_> {
    /// Blends the splats of `segments` in ranges of at most `bytes` bytes of device memory, or less if the device has less.
    /// Returns the ranges.
    pub fn draw(&self, segments: &[Segment], bytes: u64) -> GpuResult<Vec<PlannedRange>> {
        let mut tally = self.tally(segments)?;
        let binding = self.gpu.max_binding_bytes();
        let mut limits = RangeLimits { bytes: bytes.min(tally.bytes_of_all()), binding };
        loop {
            let mut planned =
                tally.plan(limits, |range, keys, bits| self.splats_by_depth(segments, range, keys, bits))?;
            match self.blend_all(segments, &mut planned) {
                Ok(true) => return Ok(planned),
                Ok(false) => tally.slack = 2 * tally.slack + 64,
                Err(error) if error.is_out_of_memory() && planned.iter().any(|range| range.can_be_cut) => {
                    limits.bytes /= 2
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Propagates the gradient of the picture back to the splats of `segments`, which get gradients, and counts in `unusable` as
    /// [`super::gpu_tiles_bwd::BackStages::backward`]. `planned` is what [`Ranges::draw`] returned; ranges that lack memory now are cut again.
    pub fn back(
        &self,
        segments: &mut [Segment],
        planned: &mut Vec<PlannedRange>,
        picture: PictureGradientBuffers<'_>,
        unusable: &Buffer,
    ) -> GpuResult<()> {
        let mut bytes = self.gpu.room();
        loop {
            zero_gradients(self.gpu, segments)?;
            match self.back_all(segments, planned, picture, unusable) {
                Err(error) if error.is_out_of_memory() && planned.iter().any(|range| range.can_be_cut) => {
                    bytes = (bytes / 2).min(self.gpu.room() / 2);
                    *planned = self.draw(segments, bytes)?;
                }
                Err(error) => return Err(error),
                Ok(()) => break,
            }
        }
        let mut recorder = self.gpu.begin("backward");
        for segment in segments.iter() {
            let weighs = picture.errors.is_some();
            self.tiles.back.finish_sums(self.gpu, &mut recorder, segment, unusable, self.blend, weighs)?;
        }
        self.gpu.submit(recorder).map(|_| ())
    }

    /// Propagates the gradient through all ranges in column order, and through the parts of a tile from the farthest on.
    fn back_all(
        &self,
        segments: &[Segment],
        planned: &[PlannedRange],
        picture: PictureGradientBuffers<'_>,
        unusable: &Buffer,
    ) -> GpuResult<()> {
        let carry = planned.iter().any(PlannedRange::is_part).then(|| {
            let bytes = carry_bytes(self.pixels);
            self.gpu.buffer("pixels between parts", bytes)
        });
        let carry = carry.transpose()?;
        for of_range in planned.chunk_by(|a, b| a.range == b.range) {
            for part in of_range.iter().rev() {
                self.back_range(segments, part, picture, (carry.as_ref(), unusable))?;
            }
        }
        Ok(())
    }

    /// Uniforms of a stage on the rows of a segment, without room for a copy.
    fn uniforms(&self, number: usize, segment: &Segment, range: TileRange, depths: [u32; 2]) -> RangeUniforms {
        RangeUniforms {
            grid: grid_words(self.blend.grid),
            range: range_words(range),
            segment: number as u32,
            row_count: segment.rows,
            depths,
            ..RangeUniforms::zeroed()
        }
    }

    fn uniforms_of_copy(&self, number: usize, segment: &Segment, planned: &PlannedRange) -> RangeUniforms {
        let uniforms = self.uniforms(number, segment, planned.range, planned.depths);
        RangeUniforms { capacity: planned.rows, ..uniforms }
    }

    /// Counts the splats that reach the range at these depth keys, in bins of `1 << bits` keys, and waits for the counts.
    fn splats_by_depth(
        &self,
        segments: &[Segment],
        range: TileRange,
        keys: [u32; 2],
        bits: u32,
    ) -> GpuResult<Vec<u32>> {
        let mut recorder = self.gpu.begin("tiles");
        let bins = recorder.buffer_zeroed("splats by depth", words(DEPTH_BINS))?;
        for (i, segment) in segments.iter().enumerate() {
            let uniforms = RangeUniforms { bin_bits: bits, ..self.uniforms(i, segment, range, keys) };
            let views = [recorder.uniform(&uniforms)?, segment.splats.view(), bins.view()];
            recorder.dispatch("tile_range", &self.stages.depths, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        let bins = recorder.read_back("tile_range", &bins.view())?;
        self.gpu.submit(recorder)?;
        bins.to_vec()
    }

    /// Counts the splats of each tile and waits for the counts.
    fn tally(&self, segments: &[Segment]) -> GpuResult<Tally> {
        let grid = self.blend.grid;
        let mut recorder = self.gpu.begin("tiles");
        let changes = recorder.buffer_zeroed("splats of tiles", words(grid.tiles_x * (grid.tiles_y + 1)))?;
        let columns = recorder.buffer_zeroed("splats of tile columns", words(2 * (grid.tiles_x + 1)))?;
        for (i, segment) in segments.iter().enumerate() {
            let uniform = recorder.uniform(&self.uniforms(i, segment, TileRange::all(grid), ALL_DEPTHS))?;
            let views = [uniform, segment.splats.view(), changes.view(), columns.view()];
            recorder.dispatch("tile_range", &self.stages.tally, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        let changes = recorder.read_back("tile_range", &changes.view())?;
        let columns = recorder.read_back("tile_range", &columns.view())?;
        self.gpu.submit(recorder)?;
        let (changes, columns) = (changes.to_vec::<i32>()?, columns.to_vec::<u32>()?);
        let mut isects = Vec::with_capacity((grid.tiles_x * grid.tiles_y) as usize);
        for column in changes.chunks_exact(grid.tiles_y as usize + 1).take(grid.tiles_x as usize) {
            let mut here = 0i64;
            for change in &column[..grid.tiles_y as usize] {
                here += i64::from(*change);
                isects.push(here.max(0) as u64);
            }
        }
        let side = grid.tiles_x as usize + 1;
        let sums = |counts: &[u32], inclusive: bool| {
            let mut sum = 0;
            let each = counts.iter().map(|&count| {
                let before = sum;
                sum += u64::from(count);
                if inclusive { sum } else { before }
            });
            each.collect()
        };
        let (begun, ended) = (sums(&columns[..side], false), sums(&columns[side..2 * side], true));
        Ok(Tally { grid, isects, begun, ended, slack: 0 })
    }

    /// Records the copy of the splats that reach a range, and their depth sort.
    fn copy(&self, recorder: &mut Recorder<'_>, segments: &[Segment], planned: &PlannedRange) -> GpuResult<Copied> {
        let places = self.places(recorder, segments, planned)?;
        // Records beyond the last splat stay zero, as those of a row that is not drawn.
        let splats = recorder.buffer_zeroed("splats of a range", splat_bytes(planned.rows))?;
        self.gather(recorder, segments, planned, &places, |segment| Ok(&segment.splats), &splats)?;
        let grid = self.blend.grid;
        let ranks = self.tiles.order(self.gpu, recorder, &splats.view(), planned.rows, grid, planned.range, None)?;
        Ok(Copied { splats, places, ranks })
    }

    /// Records the places of the splats that reach a range, segment by segment.
    fn places(&self, recorder: &mut Recorder<'_>, segments: &[Segment], planned: &PlannedRange) -> GpuResult<Places> {
        let count = segments.len() as u32;
        let totals = self.gpu.buffer("splats of segments in the range", words(count))?;
        let mut in_segment = Vec::with_capacity(segments.len());
        for (i, segment) in segments.iter().enumerate() {
            let flags = self.gpu.buffer("splats of the range", words(segment.rows))?;
            let uniform = recorder.uniform(&self.uniforms_of_copy(i, segment, planned))?;
            let views = [uniform, segment.splats.view(), flags.view()];
            recorder.dispatch("tile_range", &self.stages.select, &views, groups_1d(segment.rows, WORKGROUP))?;
            let places = self.gpu.buffer("places in the range", words(segment.rows + 1))?;
            self.tiles.scan(self.gpu, recorder, &flags.view(), segment.rows, &places.view())?;
            recorder.copy(&places.slice(words(segment.rows), 4), &totals.slice(words(i as u32), 4))?;
            in_segment.push(places);
        }
        let bases = self.gpu.buffer("splats before segments", words(count + 1))?;
        self.tiles.scan(self.gpu, recorder, &totals.view(), count, &bases.view())?;
        Ok(Places { in_segment, bases })
    }

    /// Records the copy of records of the rows that reach a range.
    fn gather<'s>(
        &self,
        recorder: &mut Recorder<'_>,
        segments: &'s [Segment],
        planned: &PlannedRange,
        places: &Places,
        records: impl Fn(&'s Segment) -> GpuResult<&'s Buffer>,
        to: &Buffer,
    ) -> GpuResult<()> {
        for (i, (segment, in_segment)) in segments.iter().zip(&places.in_segment).enumerate() {
            let uniform = recorder.uniform(&self.uniforms_of_copy(i, segment, planned))?;
            let views = [uniform, in_segment.view(), records(segment)?.view(), to.view(), places.bases.view()];
            recorder.dispatch("tile_range", &self.stages.gather, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        Ok(())
    }

    /// Blends all ranges and waits for their demands, which it stores. Returns whether every range had room.
    fn blend_all(&self, segments: &[Segment], planned: &mut [PlannedRange]) -> GpuResult<bool> {
        let mut recorder = self.gpu.begin("forward");
        let demands = recorder.buffer_zeroed("demands of ranges", words(DEMAND_WORDS * planned.len() as u32))?;
        for (i, range) in planned.iter().enumerate() {
            let copied = self.copy(&mut recorder, segments, range)?;
            let (splats, bases) = (copied.splats.view(), &copied.places.bases);
            let frame = self.lists(&mut recorder, &copied, range)?;
            self.tiles.blend(&mut recorder, &splats, &frame, self.pixels, range.room.list_max)?;
            let total = copied.ranks.offsets.slice(words(copied.ranks.rows), 4);
            let copied_rows = bases.slice(words(segments.len() as u32), 4);
            for (word, view) in [total, frame.longest.slice(0, 4), copied_rows].iter().enumerate() {
                let at = 4 * (u64::from(DEMAND_WORDS) * i as u64 + word as u64);
                recorder.copy(view, &demands.slice(at, 4))?;
            }
            self.gpu.submit(recorder)?;
            recorder = self.gpu.begin("forward");
        }
        let demands = recorder.read_back("tile_range", &demands.view())?;
        self.gpu.submit(recorder)?;
        let demands = demands.to_vec::<u32>()?;
        let mut had_room = true;
        for (range, demand) in planned.iter_mut().zip(demands.chunks_exact(DEMAND_WORDS as usize)) {
            range.demand = Demand { isects: demand[0], list_max: demand[1] };
            had_room &= demand[0] <= range.room.capacity && demand[1] <= range.room.list_max.max(1);
            had_room &= demand[2] <= range.rows;
        }
        Ok(had_room)
    }

    /// Records the lists of a range or part.
    fn lists(&self, recorder: &mut Recorder<'_>, copied: &Copied, planned: &PlannedRange) -> GpuResult<Frame> {
        let (splats, room) = (copied.splats.view(), planned.room);
        let (blend, range) = (self.blend, planned.range);
        let frame = self.tiles.lists(self.gpu, recorder, &splats, &copied.ranks, blend, range, room)?;
        Ok(Frame { part: planned.part, ..frame })
    }

    /// Submits the backward pass of one range: the sums of its rows go on from those that the segments hold.
    fn back_range(
        &self,
        segments: &[Segment],
        planned: &PlannedRange,
        picture: PictureGradientBuffers<'_>,
        (carry, unusable): (Option<&Buffer>, &Buffer),
    ) -> GpuResult<()> {
        let (gpu, mut recorder) = (self.gpu, self.gpu.begin("backward"));
        let copied = self.copy(&mut recorder, segments, planned)?;
        let frame = self.lists(&mut recorder, &copied, planned)?;
        let Copied { splats, places, ranks } = copied;
        let sums = gpu.buffer("sums of a range", splat_bytes(planned.rows))?;
        self.gather(&mut recorder, segments, planned, &places, gradients_of, &sums)?;
        let (into, of_splats, of_sums) = (&mut recorder, splats.view(), sums.view());
        self.tiles.back.backward(
            gpu,
            into,
            &of_splats,
            &ranks,
            &frame,
            self.pixels,
            planned.demand,
            picture,
            (&of_sums, unusable),
            carry.filter(|_| planned.is_part()).map_or(Fold::Range, Fold::Part),
        )?;
        for (i, (segment, in_segment)) in segments.iter().zip(&places.in_segment).enumerate() {
            let uniform = recorder.uniform(&self.uniforms_of_copy(i, segment, planned))?;
            let bases = places.bases.view();
            let views = [uniform, in_segment.view(), gradients_of(segment)?.view(), sums.view(), bases];
            recorder.dispatch("tile_range", &self.stages.scatter, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        gpu.submit(recorder).map(|_| ())
    }
}
