//! Orders rows so that neighbours in space are near each other: halves the rows along the longest axis again and again.
//!
//! Invariant: ranges of [`leaves`] are compact in the order that [`order`] gives, because both halve at the same places.

use std::ops::Range;

/// Rows that are not halved further.
pub const BUCKET_ROWS: usize = 16;

/// The numbers of `positions` in order.
pub fn order(positions: &[[f64; 3]]) -> Vec<u32> {
    let mut rows: Vec<u32> = (0..positions.len() as u32).collect();
    halve(positions, &mut rows);
    rows
}

fn halve(positions: &[[f64; 3]], rows: &mut [u32]) {
    if rows.len() <= BUCKET_ROWS {
        rows.sort_unstable();
        return;
    }
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for &row in &*rows {
        for (i, &x) in positions[row as usize].iter().enumerate() {
            low[i] = low[i].min(x);
            high[i] = high[i].max(x);
        }
    }
    let side = |i: usize| high[i] - low[i];
    let axis = (1..3).fold(0, |best, i| if side(i) > side(best) { i } else { best });
    let key = |row: &u32| positions[*row as usize][axis];
    let middle = middle(rows.len());
    rows.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
    let (left, right) = rows.split_at_mut(middle);
    halve(positions, left);
    halve(positions, right);
}

/// Ranges of at most `most` rows that cover `rows` rows in their order.
pub fn leaves(rows: usize, most: usize) -> Vec<Range<usize>> {
    let mut found = Vec::new();
    cut(0..rows, most, &mut found);
    found
}

fn cut(range: Range<usize>, most: usize, found: &mut Vec<Range<usize>>) {
    if range.len() <= most {
        found.push(range);
        return;
    }
    let middle = range.start + middle(range.len());
    cut(range.start..middle, most, found);
    cut(middle..range.end, most, found);
}

fn middle(rows: usize) -> usize {
    rows / 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::mix64;

    #[test]
    fn leaves_are_compact() {
        let positions: Vec<[f64; 3]> =
            (0..5000u64).map(|i| [0, 1, 2].map(|k| (mix64(3 * i + k) >> 40) as f64)).collect();
        let rows = order(&positions);
        let leaves = leaves(rows.len(), 700);
        assert_eq!((leaves.len(), leaves[0].start, leaves[7].end), (8, 0, 5000));
        let mut all = rows.clone();
        all.sort_unstable();
        assert!(all.iter().enumerate().all(|(i, &row)| i == row as usize));
        let whole = (1u64 << 24) as f64;
        for leaf in leaves {
            // A cube is halved once along every axis.
            for axis in 0..3 {
                let at = rows[leaf.clone()].iter().map(|&row| positions[row as usize][axis]);
                let (low, high) = at.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
                assert!(high - low < 0.55 * whole, "{}", (high - low) / whole);
            }
        }
    }
}
