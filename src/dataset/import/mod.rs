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
mod spool;

pub use cloud::{Cloud, LocalCloud};
pub use divide::{Grown, PageSpace, TakePage, paginate};
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
    /// Errors: the points cannot be read, or `take` failed.
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()>;
}

/// Points in memory, with colours; grey if a colour is missing.
impl PointSource for (&[[f32; 3]], &[[u8; 3]]) {
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        let colors = self.1.iter().copied().chain(std::iter::repeat([128; 3]));
        self.0.iter().zip(colors).try_for_each(|(&point, color)| take(point, color))
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Budget<'a> {
    /// An existing folder for data larger than memory.
    pub folder: &'a Path,
    pub bytes: usize,
}

impl<'a> Budget<'a> {
    /// The memory of one list: at most four lists are alive that are not halves of halves, and those add up to one
    /// more. The rest of the budget is for working memory.
    pub fn space(&self) -> SpoolSpace<'a> {
        SpoolSpace { folder: self.folder, memory: self.bytes / 10 }
    }

    /// Most records processed at a time.
    fn records(&self, bytes_each: usize) -> usize {
        (self.bytes / 2 / bytes_each).max(16)
    }
}

#[derive(Debug, Clone, Copy)]
pub struct ImportOptions<'a> {
    pub init: &'a InitOptions,
    /// Most rows of a first page ([`crate::scene::partition::first_fill`]).
    pub fill: usize,
    pub budget: Budget<'a>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct FirstPage {
    pub id: PageId,
    /// Numbers of its rows among all first rows, ascending: their uids.
    pub rows: Vec<u32>,
    pub columns: Columns,
}

impl FirstPage {
    pub fn into_state(self) -> SceneState {
        let mut state = SceneState::from_columns(self.columns);
        state.uid.iter_mut().zip(&self.rows).for_each(|(uid, &row)| *uid = u64::from(row));
        state
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ImportSummary {
    pub rows: u64,
    /// Including those of giants.
    pub pages: u64,
    pub points: u64,
}

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
    point: CloudPoint,
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
        self.point.point
    }
    fn row(&self) -> u32 {
        self.point.row
    }
}

impl Grown for SizedPoint {
    fn log_size(&self) -> f32 {
        self.log_scale
    }
}

/// Makes the first Gaussians of all points and passes them on page by page, in the order of the pages' ids.
/// Errors: the points cannot be read, the folder cannot be written, there are 2^32 points or more, or `take` failed.
pub fn import_points(
    source: &dyn PointSource,
    options: &ImportOptions<'_>,
    take: &mut dyn FnMut(FirstPage) -> InputResult<()>,
) -> InputResult<ImportSummary> {
    let budget = &options.budget;
    let (points, read) = spool_points(source, options)?;
    let rows = points.len();
    let (points, distances) = distances::measure(points, budget)?;
    let sized = size_points(points, distances, options)?;
    let space = PageSpace { list: budget.space(), records: budget.records(2 * size_of::<SizedPoint>()) };
    let pages = paginate(sized, options.fill, space, &mut |id, entries: &[SizedPoint]| {
        let point = |i: usize| {
            let SizedPoint { point: CloudPoint { point, row, color: [r, g, b, _] }, log_scale } = entries[i];
            FirstPoint { point, row, color: [r, g, b], log_scale }
        };
        let rows = entries.iter().map(|e| e.row()).collect();
        take(FirstPage { id, rows, columns: first_gaussians(entries.len(), point, options.init) })
    })?;
    Ok(ImportSummary { rows: rows as u64, pages: pages as u64, points: read })
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
            row = row.checked_add(1).ok_or_else(|| {
                let remedy = "thin it out, or set --max-gaussians";
                InputError::new("the point cloud", "has 2^32 points or more", remedy)
            })?;
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

/// Gives the points their first scales. Takes both lists, which end here, before the pages need their space.
fn size_points(
    points: Spool<CloudPoint>,
    distances: Spool<f64>,
    options: &ImportOptions<'_>,
) -> InputResult<Spool<SizedPoint>> {
    let mut positive = 0;
    distances.for_each(|&d| {
        positive += usize::from(d > 0.0);
        Ok(())
    })?;
    let mut typical = None;
    // The median is needed only by points without a distance.
    if positive < distances.len() {
        let search = RankSearch::new(middle_rank(positive) as u64, positive as u64);
        // Positive numbers are ordered like their bits.
        let search = distances.search(search, |&d| (d > 0.0).then(|| d.to_bits()))?;
        typical = search.key().map(f64::from_bits);
    }
    let rule = ScaleRule::new(options.init, typical);
    let mut sized = SpoolWriter::new(options.budget.space());
    let step = options.budget.records(size_of::<CloudPoint>() + size_of::<f64>());
    for first in (0..points.len()).step_by(step) {
        let range = first..points.len().min(first + step);
        for (p, distance) in points.range(range.clone())?.iter().zip(distances.range(range)?) {
            sized.push(SizedPoint { point: *p, log_scale: rule.log_scale(distance) })?;
        }
    }
    sized.finish()
}
