//! The plan of a picture in ranges of tiles: which tiles are blended together, and what their buffers take.
//!
//! A tile whose list is too long is cut front to back: a part holds the splats of the tile between two depths, and the pixels
//! carry their state from part to part.
//!
//! Not here: counting on the device and blending (`gpu_ranges`), the cut by tiles (`crate::kernels::tile_range`).
//!
//! Invariants: 1. the parts of a tile cover all depths, nearest first; splats of one depth are in one part; 2. a range or part of
//! at most [`PART_ISECTS`] intersections is not cut.

use super::gpu_frame::{Demand, FrameRoom, ListPart, splat_bytes};
use crate::gpu::GpuResult;
use crate::kernels::splats::Grid;
use crate::kernels::tile_range::TileRange;
use crate::kernels::uniforms::{DEPTH_BINS, WEIGHED_SUMS};

/// Device memory of a range, bytes a splat: the splat and its gradient, two pairs of keys and values of the depth sort, and
/// counts, offsets and order.
pub(super) const BYTES_OF_SPLAT: u64 = 2 * 48 + 16 + 12;
/// Bytes an intersection: the row, the sorted list, and the sums of the backward pass, which take more than the sort. The
/// weights, which not every run collects, are included.
pub(super) const BYTES_OF_ISECT: u64 = 8 + BYTES_OF_SUMS + 2;
const BYTES_OF_SUMS: u64 = 4 * WEIGHED_SUMS as u64;
/// Intersections of a range or part that is small enough.
pub(super) const PART_ISECTS: u64 = 256;
/// Depth keys of all splats, first and one past the last.
pub(super) const ALL_DEPTHS: [u32; 2] = [0, u32::MAX];

/// A range of tiles or a part of one tile's list, with the sizes of its buffers, and what it needed of them.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlannedRange {
    pub range: TileRange,
    /// First depth key of the splats, and one past the last.
    pub depths: [u32; 2],
    pub part: ListPart,
    /// Room for splats.
    pub rows: u32,
    pub room: FrameRoom,
    /// Whether less memory would make smaller ranges or parts of it.
    pub can_be_cut: bool,
    /// Known after the range was blended.
    pub demand: Demand,
}

impl PlannedRange {
    /// Whether this is a part of one tile's list.
    pub fn is_part(&self) -> bool {
        self.part != ListPart::ALL
    }
}

/// Limits of a range, bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct RangeLimits {
    /// Device memory.
    pub bytes: u64,
    /// Largest binding.
    pub binding: u64,
}

/// The splats of one tile between two depths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct DepthSpan {
    /// First key, and one past the last.
    keys: [u32; 2],
    splats: u64,
}

/// The number of splats that reach each tile, and that begin and end in each tile column.
#[derive(Debug)]
pub(super) struct Tally {
    pub grid: Grid,
    /// `[tiles_x][tiles_y]`.
    pub isects: Vec<u64>,
    /// `[tiles_x + 1]`: splats that begin in a column before this one.
    pub begun: Vec<u64>,
    /// `[tiles_x + 1]`: splats that ended in a column before this one.
    pub ended: Vec<u64>,
    /// Added to every size: the stages may round the reach of a splat differently from the tally.
    pub slack: u64,
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

    /// Device memory of the whole picture as one range, bytes.
    pub fn bytes_of_all(&self) -> u64 {
        let isects = self.isects.iter().sum();
        self.bytes(self.rows(&TileRange::all(self.grid), isects), isects)
    }

    /// Device memory, bytes; size classes of the pool add up to a quarter.
    fn bytes(&self, rows: u64, isects: u64) -> u64 {
        (BYTES_OF_SPLAT * (rows + self.slack) + BYTES_OF_ISECT * (isects + self.slack)) / 4 * 5
    }

    /// Whether splats and lists fit into the memory, and each of them into a binding.
    fn fits(&self, rows: u64, isects: u64, limits: RangeLimits) -> bool {
        isects <= PART_ISECTS
            || (self.bytes(rows, isects) <= limits.bytes
                && splat_bytes(1) * (rows + self.slack) <= limits.binding
                && 4 * (isects + self.slack) <= limits.binding.min(u64::from(u32::MAX)))
    }

    /// Cuts the picture into ranges and parts of tiles within the limits. `bins_of(range, keys, bits)` counts the splats that reach
    /// the range by depth: entry k counts the keys from `keys[0] + (k << bits)` on.
    pub fn plan(
        &self,
        limits: RangeLimits,
        mut bins_of: impl FnMut(TileRange, [u32; 2], u32) -> GpuResult<Vec<u32>>,
    ) -> GpuResult<Vec<PlannedRange>> {
        let fits = |range: &TileRange, isects: u64| self.fits(self.rows(range, isects), isects, limits);
        let mut planned = Vec::new();
        for range in TileRange::cut(self.grid, |x, y| self.of_tile(x, y), fits) {
            let whole = self.whole(range);
            if range.tiles() > 1 || fits(&range, self.of_tile(range.columns[0].into(), range.rows[0].into())) {
                planned.push(whole);
                continue;
            }
            // The sums of a part are one buffer, so they must fit one binding.
            let of_part = |splats: u64| {
                self.fits(splats, splats, limits) && BYTES_OF_SUMS * (splats + self.slack) <= limits.binding
            };
            let mut spans = Vec::new();
            cut_depths(ALL_DEPTHS, &of_part, &mut |keys, bits| bins_of(range, keys, bits), &mut spans)?;
            self.add_parts(whole, &without_empty(&spans), &mut planned);
        }
        Ok(planned)
    }

    /// A range in one part.
    fn whole(&self, range: TileRange) -> PlannedRange {
        let [columns, rows] = [range.columns, range.rows].map(|[first, end]| u32::from(first)..u32::from(end));
        let tiles = columns.flat_map(|x| rows.clone().map(move |y| (x, y)));
        let (mut isects, mut longest) = (0, 0);
        for (x, y) in tiles {
            isects += self.of_tile(x, y);
            longest = longest.max(self.of_tile(x, y));
        }
        PlannedRange {
            range,
            depths: ALL_DEPTHS,
            part: ListPart::ALL,
            rows: self.size(self.rows(&range, isects)),
            room: FrameRoom { capacity: self.size(isects).max(1), list_max: self.size(longest) },
            can_be_cut: isects > PART_ISECTS,
            demand: Demand { isects: 0, list_max: 0 },
        }
    }

    fn add_parts(&self, tile: PlannedRange, spans: &[DepthSpan], planned: &mut Vec<PlannedRange>) {
        let mut base = 0u32;
        for (i, span) in spans.iter().enumerate() {
            let size = self.size(span.splats);
            planned.push(PlannedRange {
                depths: span.keys,
                part: ListPart { base, is_nearest: i == 0, is_farthest: i + 1 == spans.len() },
                rows: size,
                room: FrameRoom { capacity: size.max(1), list_max: size },
                can_be_cut: span.splats > PART_ISECTS && span.keys[1] - span.keys[0] > 1,
                ..tile
            });
            base = base.saturating_add(size);
        }
    }

    fn size(&self, count: u64) -> u32 {
        u32::try_from(count + self.slack).unwrap_or(u32::MAX)
    }
}

/// Cuts the splats with these depth keys into spans that fit, or of one depth.
fn cut_depths(
    keys: [u32; 2],
    fits: &dyn Fn(u64) -> bool,
    bins_of: &mut dyn FnMut([u32; 2], u32) -> GpuResult<Vec<u32>>,
    spans: &mut Vec<DepthSpan>,
) -> GpuResult<()> {
    let bits = (keys[1] - keys[0]).div_ceil(DEPTH_BINS).next_power_of_two().ilog2();
    let (mut begun, mut held) = (keys[0], 0u64);
    for (i, splats) in bins_of(keys, bits)?.into_iter().map(u64::from).enumerate() {
        let first = u64::from(keys[0]) + ((i as u64) << bits);
        if first >= u64::from(keys[1]) {
            break;
        }
        let end = (first + (1 << bits)).min(u64::from(keys[1])) as u32;
        let first = first as u32;
        if fits(held + splats) {
            held += splats;
            continue;
        }
        if begun < first {
            spans.push(DepthSpan { keys: [begun, first], splats: held });
        }
        (begun, held) = (first, splats);
        if bits > 0 && !fits(splats) {
            cut_depths([first, end], fits, bins_of, spans)?;
            (begun, held) = (end, 0);
        }
    }
    if begun < keys[1] {
        spans.push(DepthSpan { keys: [begun, keys[1]], splats: held });
    }
    Ok(())
}

/// Joins spans without splats to a neighbour. At least one span is left.
fn without_empty(spans: &[DepthSpan]) -> Vec<DepthSpan> {
    let mut joined: Vec<DepthSpan> = Vec::new();
    for span in spans {
        match joined.last_mut() {
            Some(last) if last.splats == 0 || span.splats == 0 => {
                (last.keys[1], last.splats) = (span.keys[1], last.splats + span.splats);
            }
            _ => joined.push(*span),
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Spans of splats with these keys.
    fn spans_of(sorted: &[u32], most: u64) -> (Vec<DepthSpan>, usize) {
        let (mut spans, mut counts) = (Vec::new(), 0);
        let mut bins_of = |keys: [u32; 2], bits: u32| {
            counts += 1;
            let mut bins = vec![0u32; DEPTH_BINS as usize];
            for key in sorted.iter().filter(|&&key| key >= keys[0] && key < keys[1]) {
                bins[((key - keys[0]) >> bits) as usize] += 1;
            }
            Ok(bins)
        };
        assert_eq!(cut_depths(ALL_DEPTHS, &|splats| splats <= most, &mut bins_of, &mut spans), Ok(()));
        (without_empty(&spans), counts)
    }

    #[test]
    fn spans_cover_all_depths_and_hold_what_fits() {
        let near = 2.0f32.to_bits();
        let even: Vec<u32> = (0..5000).map(|i| (1.0 + i as f32 * 0.001).to_bits()).collect();
        let close: Vec<u32> = (0..5000).map(|i| near + i / 3).collect();
        let equal = vec![near; 5000];
        for (keys, most, counts_most) in [(even, 300, 60), (close, 70, 9), (equal, 300, 4)] {
            let (spans, counts) = spans_of(&keys, most);
            assert_eq!((spans[0].keys[0], spans[spans.len() - 1].keys[1]), (0, u32::MAX));
            assert!(spans.windows(2).all(|pair| pair[0].keys[1] == pair[1].keys[0]));
            for span in &spans {
                let mut of_span: Vec<u32> =
                    keys.iter().copied().filter(|&key| key >= span.keys[0] && key < span.keys[1]).collect();
                assert_eq!(of_span.len() as u64, span.splats);
                of_span.dedup();
                assert!(span.splats > 0 && (span.splats <= most || of_span.len() == 1), "{span:?}");
            }
            assert!(spans.len() as u64 <= 3 * (5000 / most + 1), "{} spans", spans.len());
            assert!(counts <= counts_most, "{counts} counts");
        }
        assert_eq!(spans_of(&[], 10).0, [DepthSpan { keys: ALL_DEPTHS, splats: 0 }]);
    }
}
