//! Divides records of first Gaussians into pages: giants separately, each part by median splits.
//!
//! Invariant: the pages are those of [`crate::scene::partition::partition`], in its order, for any memory budget.

use super::divide::Division;
use super::spool::{Spool, SpoolSpace, SpoolWriter};
use crate::base::error::InputResult;
use crate::base::ids::PageId;
use crate::scene::partition::{GiantCut, Pages, Placed, giants};
use bytemuck::Pod;

/// A record with a size.
pub trait Grown: Placed + Pod {
    /// Logarithm of the largest standard deviation, which determines the giants.
    fn log_size(&self) -> f32;
}

/// Memory and folder for the division.
#[derive(Debug, Clone, Copy)]
pub struct PageSpace<'a> {
    /// Space of each list.
    pub list: SpoolSpace<'a>,
    /// Most records divided in memory; one page always may be.
    pub records: usize,
}

/// Receives the records of a page.
pub type TakePage<'a, E> = dyn FnMut(PageId, &[E]) -> InputResult<()> + 'a;

/// Divides records into pages of at most `fill` and passes them on in the order of their ids. Returns the number of
/// pages.
///
/// # Errors
/// The folder cannot be written, or `take` failed.
pub fn paginate<E: Grown>(
    records: Spool<E>,
    fill: usize,
    space: PageSpace<'_>,
    take: &mut TakePage<'_, E>,
) -> InputResult<usize> {
    let (small, large) = split_giants(records, space.list)?;
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

/// Separates the ordinary records from the giants.
fn split_giants<E: Grown>(records: Spool<E>, space: SpoolSpace<'_>) -> InputResult<(Spool<E>, Spool<E>)> {
    let search = GiantCut::search(records.len());
    let cut = GiantCut::found(&records.search(search, |e| Some(GiantCut::key(e.log_size(), e.row())))?);
    let (mut small, mut large) = (SpoolWriter::new(space), SpoolWriter::new(space));
    records.for_each(|e| if cut.is_giant(e.log_size(), e.row()) { large.push(*e) } else { small.push(*e) })?;
    debug_assert_eq!(large.len(), giants(records.len()));
    Ok((small.finish()?, large.finish()?))
}
