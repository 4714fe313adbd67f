//! Ranges of tiles on a device: a picture whose splats or lists are too large to be bound or held at once is blended in parts,
//! and its gradients come back in the same parts.
//!
//! A tally counts the splats that reach each tile. The host cuts the picture into ranges whose lists fit. For each range the
//! splats that reach it are copied into one buffer, in row order, and go through the stages of a whole view. On the way back
//! the copy and the lists are made again.
//!
//! Not here: the stages of a view (`gpu_tiles`, `gpu_tiles_bwd`), the cut (`crate::kernels::tile_range`).
//!
//! Invariants: 1. pictures and gradients have the same bits for any cut: a tile's list has the same splats in the same order,
//! and a row's sums are carried from range to range in column order; 2. a range that lacks memory is cut again, down to one
//! tile; 3. the picture is complete when [`Ranges::draw`] returns: it waits.

use super::gpu_segments::{Segment, gradients_of, zero_gradients};
use super::gpu_tiles::{Blend, Demand, FrameRoom, Pixels, Ranks, TileStages, splat_bytes, words};
use super::gpu_tiles_bwd::{Fold, PictureGradientBuffers};
use crate::gpu::{Buffer, BufferView, Gpu, GpuResult, Pipeline, Recorder, groups_1d};
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms_tiles::{RangeUniforms, SUMS, grid_words, range_words};
use std::sync::Arc;

/// Invocations per workgroup of the stages on rows.
const WORKGROUP: u32 = crate::gpu::WORKGROUP;
/// Device memory of a range, bytes a splat: the splat and its gradient, two pairs of keys and values of the depth sort, and
/// counts, offsets and order.
pub(super) const BYTES_OF_SPLAT: u64 = 2 * 48 + 16 + 12;
/// Bytes an intersection: the row, the sorted list, and the sums of the backward pass, which take more than the sort.
pub(super) const BYTES_OF_ISECT: u64 = 8 + 4 * SUMS as u64 + 2;
/// Bytes a row of the view: whether the splat reaches the range, and its place among those that do.
pub(super) const PLACE_BYTES: u64 = 8;
/// Words of the demand of one range: intersections, longest list, splats.
const DEMAND_WORDS: u32 = 3;

/// The compiled stages.
#[derive(Debug)]
pub(super) struct RangeStages {
    tally: Arc<Pipeline>,
    select: Arc<Pipeline>,
    gather: Arc<Pipeline>,
    scatter: Arc<Pipeline>,
}

impl RangeStages {
    /// Compiles the stages.
    ///
    /// # Errors
    /// The device rejects the shader.
    pub fn new(gpu: &Gpu) -> GpuResult<Self> {
        let entry = |name: &str| gpu.pipeline("tile_range.wgsl", name, &[]);
        Ok(RangeStages {
            tally: entry("range_tally")?,
            select: entry("range_select")?,
            gather: entry("range_gather")?,
            scatter: entry("range_scatter")?,
        })
    }
}

/// A range with the sizes of its buffers, and what it needed of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlannedRange {
    range: TileRange,
    /// Room for splats.
    rows: u32,
    room: FrameRoom,
    /// Known after the range was blended.
    pub demand: Demand,
}

/// The number of splats that reach each tile, and that begin and end in each tile column.
#[derive(Debug)]
struct Tally {
    grid: Grid,
    /// `[tiles_x][tiles_y]`.
    isects: Vec<u64>,
    /// `[tiles_x + 1]`: splats that begin in a column before this one.
    begun: Vec<u64>,
    /// `[tiles_x + 1]`: splats that ended in a column before this one.
    ended: Vec<u64>,
    /// Added to every size: the stages may round the reach of a splat differently from the tally.
    slack: u64,
}

impl Tally {
    fn of_tile(&self, x: u32, y: u32) -> u64 {
        self.isects[(x * self.grid.tiles_y + y) as usize]
    }

    /// At most so many splats reach a range with this number of intersections.
    fn rows(&self, range: &TileRange, isects: u64) -> u64 {
        let [first, end] = range.columns.map(usize::from);
        (self.begun[end] - self.ended[first]).min(isects)
    }

    /// Device memory of a range, bytes; size classes of the pool add up to a quarter.
    fn bytes(&self, range: &TileRange, isects: u64) -> u64 {
        (BYTES_OF_SPLAT * (self.rows(range, isects) + self.slack) + BYTES_OF_ISECT * (isects + self.slack)) / 4 * 5
    }

    /// Cuts the picture into ranges of at most `bytes` bytes whose splats and lists fit one binding each.
    fn cut(&self, bytes: u64, binding: u64) -> Vec<PlannedRange> {
        let fits = |range: &TileRange, isects: u64| {
            let rows = self.rows(range, isects) + self.slack;
            self.bytes(range, isects) <= bytes
                && splat_bytes(1) * rows <= binding
                && 4 * (isects + self.slack) <= binding.min(u64::from(u32::MAX))
        };
        let ranges = TileRange::cut(self.grid, |x, y| self.of_tile(x, y), fits);
        ranges.into_iter().map(|range| self.planned(range)).collect()
    }

    fn planned(&self, range: TileRange) -> PlannedRange {
        let [columns, rows] = [range.columns, range.rows].map(|[first, end]| u32::from(first)..u32::from(end));
        let tiles = columns.flat_map(|x| rows.clone().map(move |y| (x, y)));
        let (mut isects, mut longest) = (0, 0);
        for (x, y) in tiles {
            isects += self.of_tile(x, y);
            longest = longest.max(self.of_tile(x, y));
        }
        let size = |count: u64| u32::try_from(count + self.slack).unwrap_or(u32::MAX);
        let room = FrameRoom { capacity: size(isects).max(1), list_max: size(longest) };
        let demand = Demand { isects: 0, list_max: 0 };
        PlannedRange { range, rows: size(self.rows(&range, isects)), room, demand }
    }
}

/// The splats that reach a range, in row order, and where each row of the view lies among them.
struct Copied {
    splats: Buffer,
    places: Buffer,
    ranks: Ranks,
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
    ///
    /// # Errors
    /// The device failed, or has no memory for one tile.
    pub fn draw(&self, segments: &[Segment], bytes: u64) -> GpuResult<Vec<PlannedRange>> {
        let mut tally = self.tally(segments)?;
        let isects = tally.isects.iter().sum();
        let mut bytes = bytes.min(tally.bytes(&TileRange::all(self.blend.grid), isects));
        loop {
            let mut planned = tally.cut(bytes, self.gpu.max_binding_bytes());
            match self.blend_all(segments, &mut planned) {
                Ok(true) => return Ok(planned),
                Ok(false) => tally.slack = 2 * tally.slack + 64,
                Err(error) if error.lacks_room() && planned.iter().any(|p| p.range.tiles() > 1) => bytes /= 2,
                Err(error) => return Err(error),
            }
        }
    }

    /// Propagates the gradient of the picture back to the splats of `segments`, which get gradients. `planned` is what
    /// [`Ranges::draw`] returned; ranges that lack memory now are cut again.
    ///
    /// # Errors
    /// The device failed, or has no memory for one tile.
    pub fn back(
        &self,
        segments: &mut [Segment],
        planned: &mut Vec<PlannedRange>,
        picture: PictureGradientBuffers<'_>,
    ) -> GpuResult<()> {
        let mut bytes = self.gpu.room();
        loop {
            zero_gradients(self.gpu, segments)?;
            let done = planned.iter().try_for_each(|range| self.back_range(segments, range, picture));
            match done {
                Err(error) if error.lacks_room() && planned.iter().any(|p| p.range.tiles() > 1) => {
                    bytes = (bytes / 2).min(self.gpu.room() / 2);
                    *planned = self.draw(segments, bytes)?;
                }
                Err(error) => return Err(error),
                Ok(()) => break,
            }
        }
        let mut recorder = self.gpu.begin("backward");
        for segment in segments.iter() {
            let (splats, v_splats) = (segment.splats.view(), gradients_of(segment)?.view());
            self.tiles.finish_sums(self.gpu, &mut recorder, &splats, &v_splats, segment.rows, self.blend)?;
        }
        self.gpu.submit(recorder).map(|_| ())
    }

    fn uniform(
        &self,
        recorder: &mut Recorder<'_>,
        segment: &Segment,
        range: TileRange,
        capacity: u32,
    ) -> GpuResult<BufferView> {
        recorder.uniform(&RangeUniforms {
            grid: grid_words(self.blend.grid),
            range: range_words(range),
            first_row: segment.first as u32,
            row_count: segment.rows,
            capacity,
            pad: 0,
        })
    }

    /// Counts the splats of each tile and waits for the counts.
    fn tally(&self, segments: &[Segment]) -> GpuResult<Tally> {
        let grid = self.blend.grid;
        let mut recorder = self.gpu.begin("tiles");
        let changes = recorder.buffer_zeroed("splats of tiles", words(grid.tiles_x * (grid.tiles_y + 1)))?;
        let columns = recorder.buffer_zeroed("splats of tile columns", words(2 * (grid.tiles_x + 1)))?;
        for segment in segments {
            let uniform = self.uniform(&mut recorder, segment, TileRange::all(grid), 0)?;
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
        let rows = segments.last().map_or(0, |last| last.place().end) as u32;
        let flags = self.gpu.buffer("splats of the range", words(rows))?;
        for segment in segments {
            let uniform = self.uniform(recorder, segment, planned.range, planned.rows)?;
            let views = [uniform, segment.splats.view(), flags.view()];
            recorder.dispatch("tile_range", &self.stages.select, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        let places = self.gpu.buffer("places in the range", words(rows + 1))?;
        self.tiles.scan(self.gpu, recorder, &flags.view(), rows, &places.view())?;
        drop(flags);
        // Records beyond the last splat stay zero, as those of a row that is not drawn.
        let splats = recorder.buffer_zeroed("splats of a range", splat_bytes(planned.rows))?;
        self.gather(recorder, segments, planned, &places, |segment| Ok(&segment.splats), &splats)?;
        let grid = self.blend.grid;
        let ranks = self.tiles.order(self.gpu, recorder, &splats.view(), planned.rows, grid, planned.range)?;
        Ok(Copied { splats, places, ranks })
    }

    /// Records the copy of records of the rows that reach a range.
    fn gather<'s>(
        &self,
        recorder: &mut Recorder<'_>,
        segments: &'s [Segment],
        planned: &PlannedRange,
        places: &Buffer,
        records: impl Fn(&'s Segment) -> GpuResult<&'s Buffer>,
        to: &Buffer,
    ) -> GpuResult<()> {
        for segment in segments {
            let uniform = self.uniform(recorder, segment, planned.range, planned.rows)?;
            let views = [uniform, places.view(), records(segment)?.view(), to.view()];
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
            let (splats, rows) = (copied.splats.view(), copied.places.size() - 4);
            let frame = self.tiles.lists(
                self.gpu,
                &mut recorder,
                &splats,
                &copied.ranks,
                self.blend,
                range.range,
                range.room,
            )?;
            self.tiles.blend(&mut recorder, &splats, &frame, self.pixels)?;
            let total = copied.ranks.offsets.slice(words(copied.ranks.rows), 4);
            for (word, view) in [total, frame.longest.slice(0, 4), copied.places.slice(rows, 4)].iter().enumerate() {
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

    /// Submits the backward pass of one range: the sums of its rows go on from those that the segments hold.
    fn back_range(
        &self,
        segments: &[Segment],
        planned: &PlannedRange,
        picture: PictureGradientBuffers<'_>,
    ) -> GpuResult<()> {
        let (gpu, mut recorder) = (self.gpu, self.gpu.begin("backward"));
        let Copied { splats, places, ranks } = self.copy(&mut recorder, segments, planned)?;
        let (range, room, demand) = (planned.range, planned.room, planned.demand);
        let frame = self.tiles.lists(gpu, &mut recorder, &splats.view(), &ranks, self.blend, range, room)?;
        let sums = gpu.buffer("sums of a range", splat_bytes(planned.rows))?;
        self.gather(&mut recorder, segments, planned, &places, gradients_of, &sums)?;
        let (into, of_splats, of_sums) = (&mut recorder, splats.view(), sums.view());
        self.tiles.backward(
            gpu,
            into,
            &of_splats,
            &ranks,
            &frame,
            self.pixels,
            demand,
            picture,
            &of_sums,
            Fold::Range,
        )?;
        for segment in segments {
            let uniform = self.uniform(&mut recorder, segment, range, planned.rows)?;
            let views = [uniform, places.view(), gradients_of(segment)?.view(), sums.view()];
            recorder.dispatch("tile_range", &self.stages.scatter, &views, groups_1d(segment.rows, WORKGROUP))?;
        }
        gpu.submit(recorder).map(|_| ())
    }
}
