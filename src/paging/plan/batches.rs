//! How a step walks the pages of a view that is larger than the frames: in batches, forwards and then backwards.
//!
//! A step needs every page of its view twice: once for the values of its rows, once for their update. One batch serves a view
//! that fits, and stays pinned for the second use. A larger view is cut into consecutive batches. The pass in walks the
//! batches in order; the pass out walks them in reverse order, because a cache that is smaller than the view holds only the
//! pages of the last batches when the pass in ends. The last batch stays pinned between the two passes.
//!
//! Invariants: 1. runs, the bound on reads and simulations use the same walk; 2. the cut changes no bit of the rows.

use crate::base::ids::PageNo;

/// The most pages of one batch of a view of `pages` pages in a cache of `frames` frames: all if they fit; otherwise half of
/// the frames, so that the other half receives the next batch meanwhile, and the parts of pages that split.
pub fn pages_per_batch(pages: usize, frames: usize) -> usize {
    if pages <= frames { pages.max(1) } else { (frames / 2).max(1) }
}

/// The batches of a step in the order in which the step pins them, each as a slice of `pages`.
pub fn walk(pages: &[PageNo], frames: usize) -> impl Iterator<Item = &[PageNo]> {
    let per_batch = pages_per_batch(pages.len(), frames);
    // The last batch is pinned once.
    pages.chunks(per_batch).chain(pages.chunks(per_batch).rev().skip(1))
}

/// For views with these numbers of pages: the number of views that need several batches, and the most batches of a view
/// (at least 1).
pub fn cut_views(pages: impl Iterator<Item = usize>, frames: usize, pages_most: usize) -> (usize, usize) {
    pages.fold((0, 1), |(views, most), pages| {
        let batches = pages.div_ceil(pages_per_batch(pages, frames).min(pages_most).max(1));
        (views + usize::from(batches > 1), most.max(batches))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_that_fits_is_one_batch_and_a_larger_one_goes_forwards_and_back() {
        let pages: Vec<PageNo> = (0..7).map(PageNo).collect();
        for frames in [7, 8, usize::MAX] {
            assert_eq!(walk(&pages, frames).collect::<Vec<_>>(), [&pages[..]]);
        }
        let numbers = |frames| walk(&pages, frames).map(|batch| batch[0].0).collect::<Vec<_>>();
        assert_eq!(numbers(6), [0, 3, 6, 3, 0]);
        assert_eq!(numbers(2), [0, 1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0]);
        assert_eq!(numbers(1), numbers(2));
        assert_eq!(walk(&[], 1).count(), 0);
    }
}
