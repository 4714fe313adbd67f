//! Median splits of records larger than memory: halves are written to lists of their own until they fit; and pages of first
//! Gaussians, giants separately.
//!
//! Invariant: the pages are those of [`Pages::divide`] and [`crate::scene::partition::partition`], in their order, for any memory
//! budget.

use super::spool::{Spool, SpoolSpace, SpoolWriter};
use crate::base::error::InputResult;
use crate::base::ids::PageId;
use crate::scene::partition::{GiantCut, Pages, Placed, axis_key, giants};
use crate::scene::point_box::PointBox;
use crate::scene::select::RankSearch;
use bytemuck::Pod;
use std::ops::Range;

pub(super) struct Division<'a> {
    /// Space for halves that exceed memory.
    pub space: SpoolSpace<'a>,
    pub pages: Pages,
    /// Most records divided in memory; one page always may be.
    pub records_in_memory: usize,
}

/// Receives the records of some consecutive pages, sorted as by [`Pages::divide`].
pub(super) type TakePages<'a, E> = dyn FnMut(Range<usize>, Vec<E>) -> InputResult<()> + 'a;

impl Division<'_> {
    /// Divides `records` and passes the pages on in order, as many at a time as fit in memory.
    pub fn run<E: Placed + Pod>(&self, records: Spool<E>, take: &mut TakePages<'_, E>) -> InputResult<()> {
        assert_eq!(records.len(), self.pages.rows);
        if self.pages.pages == 0 {
            return Ok(());
        }
        let mut all = PointBox::EMPTY;
        if records.len() > self.records_in_memory {
            records.for_each(|e| {
                all.add(e.point());
                Ok(())
            })?;
        }
        self.run_range(records, all, 0..self.pages.pages, take)
    }

    fn run_range<E: Placed + Pod>(
        &self,
        records: Spool<E>,
        all: PointBox,
        range: Range<usize>,
        take: &mut TakePages<'_, E>,
    ) -> InputResult<()> {
        if range.len() == 1 || records.len() <= self.records_in_memory {
            let mut entries = records.into_vec()?;
            self.pages.divide_range(&mut entries, range.clone());
            return take(range, entries);
        }
        let middle = Pages::middle(&range);
        let (low, high) =
            self.cut(records, all.longest_axis(), self.pages.start(middle) - self.pages.start(range.start))?;
        self.run_range(low.0, low.1, range.start..middle, take)?;
        self.run_range(high.0, high.1, middle..range.end, take)
    }

    /// The `count` lowest records along an axis, and the others, each with its bounding box.
    #[allow(clippy::type_complexity)] // two lists with their boxes
    fn cut<E: Placed + Pod>(
        &self,
        records: Spool<E>,
        axis: usize,
        count: usize,
    ) -> InputResult<((Spool<E>, PointBox), (Spool<E>, PointBox))> {
        let search = RankSearch::new(count as u64, records.len() as u64);
        let first_high = records.search(search, |e| Some(axis_key(e, axis)))?.key().unwrap_or(u64::MAX);
        let (mut low, mut high) = (SpoolWriter::new(self.space), SpoolWriter::new(self.space));
        let (mut low_box, mut high_box) = (PointBox::EMPTY, PointBox::EMPTY);
        records.for_each(|e| {
            if axis_key(e, axis) < first_high {
                low_box.add(e.point());
                low.push(*e)
            } else {
                high_box.add(e.point());
                high.push(*e)
            }
        })?;
        Ok(((low.finish()?, low_box), (high.finish()?, high_box)))
    }
}

/// A record with a size.
pub trait Grown: Placed + Pod {
    /// Logarithm of the largest standard deviation, which determines the giants.
    fn log_size(&self) -> f32;
}

/// Memory and folder for the division.
#[derive(Debug, Clone, Copy)]
pub struct PageSpace<'a> {
    pub list: SpoolSpace<'a>,
    /// Most records divided in memory; one page always may be.
    pub records: usize,
}

/// Receives the records of a page.
pub type TakePage<'a, E> = dyn FnMut(PageId, &[E]) -> InputResult<()> + 'a;

/// Divides records into pages, giants separately, of at most `fill` and passes them on in the order of their ids. Returns the number of
/// pages.
/// Errors: the folder cannot be written, or `take` failed.
pub fn paginate<E: Grown>(
    records: Spool<E>,
    fill: usize,
    space: PageSpace<'_>,
    take: &mut TakePage<'_, E>,
) -> InputResult<usize> {
    let search = GiantCut::search(records.len());
    let cut = GiantCut::found(&records.search(search, |e| Some(GiantCut::key(e.log_size(), e.row())))?);
    let (mut small, mut large) = (SpoolWriter::new(space.list), SpoolWriter::new(space.list));
    records.for_each(|e| if cut.is_giant(e.log_size(), e.row()) { large.push(*e) } else { small.push(*e) })?;
    debug_assert_eq!(large.len(), giants(records.len()));
    let (small, large) = (small.finish()?, large.finish()?);
    let mut pages_before = 0;
    for part in [small, large] {
        let pages = Pages::of(part.len(), fill);
        let division = Division { space: space.list, pages, records_in_memory: space.records };
        division.run(part, &mut |range, entries| {
            let first = pages.start(range.start);
            for page in range {
                let entries = &entries[pages.start(page) - first..pages.start(page + 1) - first];
                take(PageId::initial((pages_before + page) as u32), entries)?;
            }
            Ok(())
        })?;
        pages_before += pages.pages;
    }
    Ok(pages_before)
}
