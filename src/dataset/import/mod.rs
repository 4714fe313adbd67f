//! Import: converts any number of points to the first pages of Gaussians, within a memory budget.
//!
//! Through files in the spill folder, the points are sorted into blocks, measured against their neighbours block by
//! block, and divided into pages, which are passed on one by one.
//!
//! Not here: reading formats (a [`PointSource`] provides positions in the local frame), storing pages.
//!
//! Invariants: 1. rows, values and pages are those of [`crate::scene::init::gaussians_from_points`] and
//! [`crate::scene::partition::partition`], bit for bit, for any budget; 2. memory is bounded by the budget plus one
//! page of Gaussians; 3. the import's files are removed when it ends.

mod cloud;
mod distances;
mod divide;
mod paginate;
mod spool;

pub use cloud::{Cloud, LocalCloud};
pub use paginate::{Grown, PageSpace, TakePage, paginate};
pub use spool::{Spool, SpoolSpace, SpoolWriter};

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::scene::columns::Columns;
use crate::scene::init::{FirstPoint, InitOptions, ScaleRule, first_gaussians, middle_rank, subsample_key};
use crate::scene::partition::Placed;
use crate::scene::select::RankSearch;
use crate::scene::state::SceneState;
use std::path::Path;

/// Points that can be read repeatedly, in the same order.
pub trait PointSource {
    /// Passes every point to `take`: position in the local frame, sRGB.
    ///
    /// # Errors
    /// The points cannot be read, or `take` failed.
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()>;
}

/// Points in memory, with colours; grey if a colour is missing.
impl PointSource for (&[[f32; 3]], &[[u8; 3]]) {
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        let colors = self.1.iter().copied().chain(std::iter::repeat([128; 3]));
        self.0.iter().zip(colors).try_for_each(|(&point, color)| take(point, color))
    }
}

/// The budget of an import.
#[derive(Debug, Clone, Copy)]
pub struct Budget<'a> {
    /// An existing folder for data larger than memory.
    pub folder: &'a Path,
    /// Bytes of memory.
    pub bytes: usize,
}

impl<'a> Budget<'a> {
    /// The memory of one list: at most four lists are alive that are not halves of halves, and those add up to one
    /// more. The rest of the budget is for working memory.
    fn space(&self) -> SpoolSpace<'a> {
        SpoolSpace { folder: self.folder, memory: self.bytes / 10 }
    }

    /// Most records processed at a time.
    fn records(&self, bytes_each: usize) -> usize {
        (self.bytes / 2 / bytes_each).max(16)
    }
}

/// Options of an import.
#[derive(Debug, Clone, Copy)]
pub struct ImportOptions<'a> {
    /// Options of the first Gaussians.
    pub init: &'a InitOptions,
    /// Most rows of a first page ([`crate::scene::partition::first_fill`]).
    pub fill: usize,
    /// The budget.
    pub budget: Budget<'a>,
}

/// A first page.
#[derive(Debug, Clone, PartialEq)]
pub struct FirstPage {
    /// Its id.
    pub id: PageId,
    /// Numbers of its rows among all first rows, ascending: their uids.
    pub rows: Vec<u32>,
    /// Its Gaussians.
    pub columns: Columns,
}

impl FirstPage {
    /// Converts to rows of a scene, with their uids.
    pub fn into_state(self) -> SceneState {
        let mut state = SceneState::from_columns(self.columns);
        state.uid.iter_mut().zip(&self.rows).for_each(|(uid, &row)| *uid = u64::from(row));
        state
    }
}

/// Counts of an import.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ImportSummary {
    /// Number of Gaussians.
    pub rows: u64,
    /// Number of pages, including those of giants.
    pub pages: u64,
    /// Number of points read.
    pub points: u64,
}

/// A point with its row.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct CloudPoint {
    point: [f32; 3],
    row: u32,
    color: [u8; 4],
}

/// A point with its row and its first scale.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct SizedPoint {
    point: [f32; 3],
    row: u32,
    color: [u8; 4],
    log_scale: f32,
}

impl Placed for CloudPoint {
    fn point(&self) -> [f32; 3] {
        self.point
    }
    fn row(&self) -> u32 {
        self.row
    }
}

impl Placed for SizedPoint {
    fn point(&self) -> [f32; 3] {
        self.point
    }
    fn row(&self) -> u32 {
        self.row
    }
}

impl Grown for SizedPoint {
    fn log_size(&self) -> f32 {
        self.log_scale
    }
}

/// Makes the first Gaussians of all points and passes them on page by page, in the order of the pages' ids.
///
/// # Errors
/// The points cannot be read, the folder cannot be written, there are 2^32 points or more, or `take` failed.
pub fn import_points(
    source: &dyn PointSource,
    options: &ImportOptions<'_>,
    take: &mut dyn FnMut(FirstPage) -> InputResult<()>,
) -> InputResult<ImportSummary> {
    let budget = &options.budget;
    let (points, read) = spool_points(source, options)?;
    let rows = points.len();
    let measured = distances::measure(points, budget)?;
    let sized = size_points(measured, options)?;
    let space = PageSpace { list: budget.space(), records: budget.records(2 * size_of::<SizedPoint>()) };
    let pages = paginate(sized, options.fill, space, &mut |id, entries| take(first_page(id, entries, options.init)))?;
    Ok(ImportSummary { rows: rows as u64, pages: pages as u64, points: read })
}

fn first_page(id: PageId, entries: &[SizedPoint], init: &InitOptions) -> FirstPage {
    let point = |i: usize| {
        let SizedPoint { point, row, color: [r, g, b, _], log_scale } = entries[i];
        FirstPoint { point, row, color: [r, g, b], log_scale }
    };
    FirstPage {
        id,
        rows: entries.iter().map(|e| e.row).collect(),
        columns: first_gaussians(entries.len(), point, init),
    }
}

/// The points that get a row, numbered; and the number of points read.
fn spool_points(source: &dyn PointSource, options: &ImportOptions<'_>) -> InputResult<(Spool<CloudPoint>, u64)> {
    let first_gone = match options.init.max_gaussians {
        None => None,
        Some(most) => first_excluded_key(source, most as u64, options.init.seed)?,
    };
    let mut points = SpoolWriter::new(options.budget.space());
    let (mut index, mut row) = (0, 0u32);
    source.read(&mut |point, [r, g, b]| {
        if is_finite(point) && first_gone.is_none_or(|key| subsample_key(options.init.seed, index) < key) {
            points.push(CloudPoint { point, row, color: [r, g, b, 0] })?;
            row = row.checked_add(1).ok_or_else(too_many)?;
        }
        index += 1;
        Ok(())
    })?;
    Ok((points.finish()?, index))
}

fn is_finite(point: [f32; 3]) -> bool {
    point.iter().all(|x| x.is_finite())
}

/// At most `most` points stay, those with the smallest keys. Returns the smallest key of the others, if any.
fn first_excluded_key(source: &dyn PointSource, most: u64, seed: u64) -> InputResult<Option<u64>> {
    let mut finite = 0;
    source.read(&mut |point, _| {
        finite += u64::from(is_finite(point));
        Ok(())
    })?;
    if finite <= most {
        return Ok(None);
    }
    let mut search = RankSearch::new(most, finite);
    while !search.is_done() {
        let mut index = 0;
        source.read(&mut |point, _| {
            if is_finite(point) {
                search.count(subsample_key(seed, index));
            }
            index += 1;
            Ok(())
        })?;
        search.next_pass();
    }
    Ok(search.key())
}

fn too_many() -> InputError {
    InputError::new("the point cloud", "has 2^32 points or more", "thin it out, or set --max-gaussians")
}

/// The first scale of every point.
fn size_points(measured: distances::Measured, options: &ImportOptions<'_>) -> InputResult<Spool<SizedPoint>> {
    let distances::Measured { points, distances } = measured;
    let mut positive = 0;
    distances.for_each(|&d| {
        positive += usize::from(d > 0.0);
        Ok(())
    })?;
    let mut typical = None;
    // The median is needed only by points without a distance.
    if positive < distances.len() {
        let mut search = RankSearch::new(middle_rank(positive) as u64, positive as u64);
        while !search.is_done() {
            distances.for_each(|&d| {
                if d > 0.0 {
                    // Positive numbers are ordered like their bits.
                    search.count(d.to_bits());
                }
                Ok(())
            })?;
            search.next_pass();
        }
        typical = search.key().map(f64::from_bits);
    }
    let rule = ScaleRule::new(options.init, typical);
    let mut sized = SpoolWriter::new(options.budget.space());
    let step = options.budget.records(size_of::<CloudPoint>() + size_of::<f64>());
    for first in (0..points.len()).step_by(step) {
        let range = first..points.len().min(first + step);
        for (p, distance) in points.range(range.clone())?.iter().zip(distances.range(range)?) {
            let log_scale = rule.log_scale(distance);
            sized.push(SizedPoint { point: p.point, row: p.row, color: p.color, log_scale })?;
        }
    }
    sized.finish()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::scene::init::gaussians_from_points;
    use crate::scene::partition::partition;
    use crate::scene::state::SceneState;

    /// Clusters far apart, duplicates, a lattice, lone points, non-finite points.
    fn cloud(count: u64) -> (Vec<[f32; 3]>, Vec<[u8; 3]>) {
        let point = |i: u64| {
            let mut s = Stream::new(6, Purpose::Test, i, count);
            let position: [f32; 3] = match i % 13 {
                0 => std::array::from_fn(|_| s.below(7) as f32),
                1 => std::array::from_fn(|_| (s.normal() * 300.0) as f32),
                2 if i.is_multiple_of(5) => [f32::NAN, 0.0, 1.0],
                k => std::array::from_fn(|axis| (((k * (axis as u64 + 2)) % 5) as f64 * 40.0 + s.normal()) as f32),
            };
            (position, std::array::from_fn(|_| s.below(256) as u8))
        };
        (0..count).map(point).unzip()
    }

    #[test]
    fn pages_equal_those_made_in_memory_for_any_budget() {
        let folder = tempfile::tempdir().unwrap();
        for (count, most) in [(0, None), (1, None), (3, None), (7000, None), (7000, Some(5000)), (2000, Some(0))] {
            let (points, colors) = cloud(count);
            let init = InitOptions { max_gaussians: most, sh_degree: 1, seed: 3, ..InitOptions::default() };
            let columns = gaussians_from_points(&points, &colors, &init);
            let fill = 50;
            let parts = partition(&columns.means, &columns.scales, fill);
            let state = SceneState::from_columns(columns);
            for bytes in [1 << 30, 1 << 20, 300_000, 100_000, 20_000] {
                let mut pages = Vec::new();
                let budget = Budget { folder: folder.path(), bytes };
                let options = ImportOptions { init: &init, fill, budget };
                let source = (points.as_slice(), colors.as_slice());
                let summary = import_points(&source, &options, &mut |page| {
                    pages.push(page);
                    Ok(())
                })
                .unwrap();
                assert_eq!((summary.rows, summary.points), (state.rows() as u64, count));
                assert_eq!(pages.len(), parts.pages());
                for (number, (page, rows)) in pages.iter().zip(parts.iter()).enumerate() {
                    assert_eq!(page.id, PageId::initial(number as u32));
                    assert_eq!(page.rows, rows);
                    assert!(page.columns == state.select(rows).columns, "{count} points, {bytes} bytes, page {number}");
                }
            }
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
    }

    #[test]
    fn errors_of_the_source_and_of_the_receiver_are_returned() {
        struct Broken;
        impl PointSource for Broken {
            fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()> {
                take([0.0; 3], [0; 3])?;
                Err(InputError::new("points", "cut short", "copy it again"))
            }
        }
        let folder = tempfile::tempdir().unwrap();
        let init = InitOptions::default();
        let options = ImportOptions { init: &init, fill: 8, budget: Budget { folder: folder.path(), bytes: 10_000 } };
        assert!(import_points(&Broken, &options, &mut |_| Ok(())).is_err());
        let (points, colors) = cloud(100);
        let source = (points.as_slice(), colors.as_slice());
        let full = || InputError::new("disk", "full", "free some");
        assert!(import_points(&source, &options, &mut |_| Err(full())).is_err());
    }
}
