//! The pages of a cell: those that reach into its ground and those of a margin around it are trained; what its views show beyond is the
//! ring, which is frozen.
//!
//! Invariant: every row whose place lies in the ground of a cell is in a page that the cell trains.

use super::plan::GroundRect;
use super::views::Seen;

/// The places of the pages that a cell trains, and of those of its ring, each in the order of ids.
pub(crate) fn pages_of_cell<'v>(
    seen: &Seen,
    leaves: &[GroundRect],
    owner: &[usize],
    cell: usize,
    views: impl Iterator<Item = &'v usize>,
    margin: f64,
) -> (Vec<usize>, Vec<usize>) {
    let own: Vec<GroundRect> = leaves.iter().filter(|leaf| leaf.cell == cell).copied().collect();
    let by = margin * width(seen, owner, cell);
    let grown: Vec<GroundRect> = own.iter().map(|leaf| leaf.grown(by)).collect();
    let mut is_seen = vec![false; seen.pages.len()];
    views.flat_map(|&view| &seen.views[view].weights).for_each(|&(page, _)| is_seen[page] = true);
    let is_trained = |page: &usize| {
        let at = &seen.pages[*page];
        own.iter().any(|leaf| leaf.meets(at.low, at.high)) || grown.iter().any(|leaf| leaf.holds(at.middle))
    };
    let (trained, others): (Vec<usize>, Vec<usize>) = (0..seen.pages.len()).partition(is_trained);
    (trained, others.into_iter().filter(|&page| is_seen[page]).collect())
}

/// The width of a cell: the root of the area that the middles of its pages span.
fn width(seen: &Seen, owner: &[usize], cell: usize) -> f64 {
    let side = |axis: usize| {
        let along = (0..owner.len()).filter(|&page| owner[page] == cell).map(|page| seen.pages[page].middle[axis]);
        let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        (high - low).max(0.0)
    };
    (side(0) * side(1)).sqrt()
}
