//! Splits pages that outgrew their capacity: in two along the longest axis of their means, at the median, repeatedly.
//! When to split and where to store the parts is decided elsewhere.
//!
//! Invariants: 1. the parts are a function of the rows in their order and of the given positions; 2. rows keep their
//! relative order; 3. the ids of the parts follow lineage, and the parts are ordered by id.

use super::partition::{PointRow, axis_key, box_of};
use super::state::SceneState;
use crate::base::ids::PageId;

/// A page was split 31 times in a row and must be split again: in one spot, growth round after growth round, everything
/// else was pruned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "page {page} cannot be split any further\n  remedy: use larger pages (--page-rows) or fewer Gaussians (--max-gaussians)"
)]
pub struct SplitTooDeep {
    pub page: PageId,
}

/// Splits the rows of page `id` into pages of at most `page_rows` rows (at least 1). `means` (`[rows][3]`) are the
/// positions to cut by: the current ones, not the stored ones.
/// Errors: the lineage has no more ids.
pub fn split_page(
    id: PageId,
    state: SceneState,
    means: &[f32],
    page_rows: usize,
) -> Result<Vec<(PageId, SceneState)>, SplitTooDeep> {
    assert_eq!(means.len(), state.rows() * 3, "one position per row");
    if state.rows() <= page_rows.max(1) {
        return Ok(vec![(id, state)]);
    }
    let entry = |row: usize| PointRow { point: std::array::from_fn(|i| means[row * 3 + i]), row: row as u32 };
    let mut parts = Vec::new();
    cut(id, (0..state.rows()).map(entry).collect(), page_rows.max(1), &mut |id, rows| parts.push((id, rows)))?;
    Ok(parts.into_iter().map(|(id, rows)| (id, state.select(&rows))).collect())
}

fn cut(
    id: PageId,
    mut entries: Vec<PointRow>,
    page_rows: usize,
    part: &mut impl FnMut(PageId, Vec<u32>),
) -> Result<(), SplitTooDeep> {
    if entries.len() <= page_rows {
        entries.sort_unstable_by_key(|e| e.row);
        part(id, entries.iter().map(|e| e.row).collect());
        return Ok(());
    }
    let [low_id, high_id] = id.children().ok_or(SplitTooDeep { page: id })?;
    let axis = box_of(&entries).longest_axis();
    let middle = entries.len() / 2;
    entries.select_nth_unstable_by_key(middle, |e| axis_key(e, axis));
    let high = entries.split_off(middle);
    cut(low_id, entries, page_rows, part)?;
    cut(high_id, high, page_rows, part)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::scene::columns::Columns;

    fn page(rows: usize) -> (SceneState, Vec<f32>) {
        let mut draws = Stream::new(8, Purpose::Test, rows as u64, 0);
        let mut state = SceneState::from_columns(Columns::zeros(rows, 1));
        // Lattice positions: equal coordinates everywhere.
        state.columns.means.iter_mut().for_each(|x| *x = draws.below(6) as f32);
        state.columns.sh_n.iter_mut().for_each(|x| *x = draws.uniform() as f32);
        let means = state.columns.means.iter().map(|x| x * 2.0).collect();
        (state, means)
    }

    fn parts_of(rows: usize, page_rows: usize) -> usize {
        if rows <= page_rows { 1 } else { parts_of(rows / 2, page_rows) + parts_of(rows - rows / 2, page_rows) }
    }

    #[test]
    fn parts_hold_all_rows_in_order_and_are_halves() {
        for (rows, page_rows) in [(9, 8), (16, 8), (17, 8), (40, 8), (1, 1), (5, 1), (8, 8), (0, 4)] {
            let (state, means) = page(rows);
            let parts = split_page(PageId::initial(3), state.clone(), &means, page_rows).unwrap_or_default();
            assert!(parts.windows(2).all(|pair| pair[0].0 < pair[1].0));
            let mut seen = Vec::new();
            for (id, part) in &parts {
                assert!(part.rows() <= page_rows && (part.rows() * 2 >= page_rows || rows < page_rows), "{id}");
                assert!(part.uid.windows(2).all(|pair| pair[0] < pair[1]));
                let rows: Vec<u32> = part.uid.iter().map(|&uid| uid as u32).collect();
                assert_eq!(*part, state.select(&rows));
                seen.extend(rows);
            }
            seen.sort_unstable();
            assert_eq!(seen, (0..rows as u32).collect::<Vec<_>>());
            assert_eq!(parts.len() == 1, rows <= page_rows);
            assert_eq!(parts.len(), parts_of(rows, page_rows), "{rows} rows in pages of {page_rows}");
        }
    }

    #[test]
    fn the_cut_is_the_median_of_the_longest_axis_with_ties_by_row() {
        let (state, mut means) = page(10);
        (0..10).for_each(|row| means[row * 3 + 1] = [10.0, -30.0, 10.0, 10.0, 50.0, 10.0, 10.0, 10.0, 10.0, -9.0][row]);
        let parts = split_page(PageId::initial(0), state, &means, 5).unwrap_or_default();
        assert_eq!(parts.iter().map(|(id, _)| id.to_string()).collect::<Vec<_>>(), ["0.0", "0.1"]);
        assert_eq!(parts[0].1.uid, [0, 1, 2, 3, 9]);
        assert_eq!(parts[1].1.uid, [4, 5, 6, 7, 8]);
    }

    #[test]
    fn running_out_of_ids_is_an_error() {
        let mut id = PageId::initial(1);
        while let Some([low, _]) = id.children() {
            id = low;
        }
        let (state, means) = page(4);
        assert_eq!(split_page(id, state, &means, 3), Err(SplitTooDeep { page: id }));
    }
}
