//! Statistics of rows since the last round: sums of the gradient norms of projected means, and their histogram.
//!
//! Invariants: 1. only drawn rows change; 2. sums are in NDC units, so thresholds do not depend on the image size; 3.
//! the histogram counts every row with statistics exactly once, in the bin of its mean, with integer counters, so the
//! order of updates does not matter; 4. no counter wraps: removing a row from an empty bin, which happens only for
//! statistics of another histogram, adds to [`GradHistogram::uncounted`].

pub use crate::scene::rows::mean_grad2d;
use crate::scene::rows::{Rows, RowsMut};

/// Bins: one per value of the upper 16 bits of a non-negative f32, so 128 per doubling.
const BINS: usize = 1 << 15;

/// Number of rows by mean gradient norm. 128 KiB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GradHistogram {
    bins: Vec<u32>,
    uncounted: u64,
}

impl Default for GradHistogram {
    fn default() -> Self {
        GradHistogram { bins: vec![0; BINS], uncounted: 0 }
    }
}

impl GradHistogram {
    /// The non-empty bins with their row counts, ascending, for a checkpoint.
    pub fn filled(&self) -> Vec<(u16, u32)> {
        self.bins.iter().zip(0..).filter(|(rows, _)| **rows > 0).map(|(&rows, bin)| (bin, rows)).collect()
    }

    /// The histogram with these bins of [`GradHistogram::filled`]; `None` if a bin number is out of range.
    pub fn from_filled(filled: &[(u16, u32)]) -> Option<GradHistogram> {
        let mut histogram = GradHistogram::default();
        for &(bin, rows) in filled {
            *histogram.bins.get_mut(usize::from(bin))? = rows;
        }
        Some(histogram)
    }

    /// Counts a row with this mean.
    pub fn add(&mut self, mean: f32) {
        self.bins[bin(mean)] += 1;
    }

    /// Adds the rows of a view that have statistics.
    pub fn add_rows(&mut self, rows: &Rows<'_>) {
        for (&grad2d, &count) in rows.grad2d.iter().zip(rows.count).filter(|(_, count)| **count > 0) {
            self.add(mean_grad2d(grad2d, count));
        }
    }

    /// Removes a row with this mean.
    pub fn remove(&mut self, mean: f32) {
        let rows = &mut self.bins[bin(mean)];
        match rows.checked_sub(1) {
            Some(left) => *rows = left,
            None => self.uncounted += 1,
        }
    }

    /// Removals from empty bins: 0, unless the rows have statistics that were never added to this histogram.
    pub fn uncounted(&self) -> u64 {
        self.uncounted
    }

    /// Removes all rows, after a round.
    pub fn clear(&mut self) {
        self.bins.fill(0);
    }

    /// Number of rows.
    pub fn rows(&self) -> u64 {
        self.bins.iter().map(|&n| u64::from(n)).sum()
    }

    /// The smallest threshold of at least `least` that at most `room` rows exceed, in whole bins: `least` itself, just
    /// below the edge of a bin, or infinity.
    pub fn threshold(&self, least: f32, room: u64) -> f32 {
        let first = bin(least);
        let mut above = 0u64;
        for b in (first..BINS).rev() {
            above += u64::from(self.bins[b]);
            if above > room {
                // Bin b exceeds the room, so growth starts with bin b + 1.
                let edge = f32::from_bits((b as u32 + 1) << 16);
                return if edge.is_finite() { edge.next_down() } else { f32::INFINITY };
            }
        }
        least
    }

    /// Upper bound of the rows above a threshold from [`GradHistogram::threshold`]: whole bins. Equals the sum of
    /// [`promised_growth`] over all pages.
    pub fn promised(&self, threshold: f32) -> u64 {
        self.bins[bin(threshold.next_up())..].iter().map(|&n| u64::from(n)).sum()
    }
}

/// The rows of a view that [`GradHistogram::promised`] counted, if their statistics are unchanged since the round.
pub fn promised_growth(rows: &Rows<'_>, threshold: f32) -> u64 {
    let first = bin(threshold.next_up());
    let is_counted = |&(&grad2d, &count): &(&f32, &u32)| count > 0 && bin(mean_grad2d(grad2d, count)) >= first;
    rows.grad2d.iter().zip(rows.count).filter(is_counted).count() as u64
}

fn bin(mean: f32) -> usize {
    // Sums of norms are never -0, negative or NaN; such values would count as 0.
    if mean > 0.0 { (mean.to_bits() >> 16) as usize } else { 0 }
}

/// Adds the gradients of one view. `rows` lists rows of the table that contains `view`, ascending. `v_means2d`
/// (gradient of the loss with respect to the projected mean, pixel units) and `radii` have one entry per listed row.
/// Rows with a zero radius and gradients that are not finite are ignored. Returns the number of rows that changed.
pub fn accumulate(
    view: &mut RowsMut<'_>,
    rows: &[u32],
    v_means2d: &[[f32; 2]],
    radii: &[[u32; 2]],
    image_size: [u32; 2],
    histogram: &mut GradHistogram,
) -> usize {
    let mut changed = 0;
    assert!(rows.len() == v_means2d.len() && rows.len() == radii.len(), "one gradient and radius per listed row");
    let half = image_size.map(|n| n as f32 * 0.5);
    for ((&row, v), radius) in rows.iter().zip(v_means2d).zip(radii) {
        if radius[0] == 0 || radius[1] == 0 {
            continue;
        }
        let (x, y) = (v[0] * half[0], v[1] * half[1]);
        let norm = (x * x + y * y).sqrt();
        if !norm.is_finite() {
            continue;
        }
        let row = row as usize - view.first_row;
        let (grad2d, count) = (&mut view.grad2d[row], &mut view.count[row]);
        if *count > 0 {
            histogram.remove(mean_grad2d(*grad2d, *count));
        }
        *grad2d = (*grad2d + norm).min(f32::MAX);
        *count += 1;
        histogram.add(mean_grad2d(*grad2d, *count));
        changed += 1;
    }
    changed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::columns::Columns;
    use crate::scene::state::SceneState;

    #[test]
    fn only_drawn_rows_count_and_the_histogram_follows() {
        let mut state = SceneState::from_columns(Columns::zeros(4, 0));
        let mut histogram = GradHistogram::default();
        let v = [[3e-4, 4e-4], [1.0, 1.0], [f32::NAN, 0.0]];
        for _ in 0..2 {
            let radii = [[2, 1], [0, 3], [1, 1]];
            accumulate(&mut state.view_mut(), &[0, 2, 3], &v, &radii, [20, 20], &mut histogram);
        }
        assert_eq!(state.count, [2, 0, 0, 0]);
        // |(3e-4, 4e-4)| * 10, twice.
        assert!((state.grad2d[0] - 1e-2).abs() < 1e-8);
        assert_eq!(histogram.rows(), 1);
        assert_eq!(histogram.threshold(2e-4, 1), 2e-4);
        let threshold = histogram.threshold(2e-4, 0);
        assert!(threshold >= mean_grad2d(state.grad2d[0], 2));
    }

    #[test]
    fn rows_that_were_never_counted_are_noticed_and_no_counter_wraps() {
        let mut state = SceneState::from_columns(Columns::zeros(2, 0));
        (state.grad2d[1], state.count[1]) = (3.0, 2);
        let mut histogram = GradHistogram::default();
        let v = [[1.0, 0.0], [1.0, 0.0]];
        accumulate(&mut state.view_mut(), &[0, 1], &v, &[[1, 1]; 2], [2, 2], &mut histogram);
        assert_eq!((histogram.uncounted(), histogram.rows()), (1, 2));
        let mut counted = GradHistogram::default();
        counted.add_rows(&state.view());
        assert_eq!((counted.filled(), counted.uncounted()), (histogram.filled(), 0));
    }

    #[test]
    fn thresholds_admit_at_most_the_room_and_whole_bins() {
        let mut histogram = GradHistogram::default();
        let means: Vec<f32> = (1..1000).map(|i| i as f32 * 1e-5).collect();
        means.iter().for_each(|&m| histogram.add(m));
        let mut last = f32::INFINITY;
        for room in 0..1000u64 {
            let threshold = histogram.threshold(2e-4, room);
            let above = means.iter().filter(|&&m| m > threshold).count() as u64;
            assert!(above <= room);
            // A bin is less than 1 % wide: up to 10 of these means share one bin.
            assert!(above + 10 >= room.min(979), "{above} of {room}");
            assert!(threshold <= last);
            last = threshold;
        }
        assert_eq!(last, 2e-4);
    }
}
