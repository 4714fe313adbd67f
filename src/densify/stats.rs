//! Statistics of rows since the last round, and their histogram: sums of growth scores (for the strategy `default`, of the
//! gradient norms of projected means) and, for strategies that remove rows by it, mean blending weights.
//!
//! Invariants: 1. only drawn rows change; 2. gradients are in NDC units, so thresholds do not depend on the image size;
//! 3. the histogram counts every row with statistics exactly once in the bin of its mean score, and every row that
//! enough views weighed exactly once in the bin of its mean weight, with integer counters, so the order of updates does
//! not matter; 4. no counter wraps: removing a row from an empty bin, which happens only if the row was never
//! added to this histogram, adds to [`GradHistogram::uncounted`].

use crate::scene::columns::Gradients;
use crate::scene::rows::{Rows, RowsMut, mean_grad2d};
use crate::scene::sightings::{is_full, mean_weight, views, with_view};

/// Bins: one per value of the upper 16 bits of a non-negative f32, so 128 per doubling.
const BINS: usize = 1 << 15;
/// A row is removed by its weight only if at least this many views drew it since the last round: a weight in one view
/// says little about the others.
pub const WEIGHED_VIEWS: u32 = 3;

/// Number of rows by mean growth score, and by mean blending weight. 256 KiB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GradHistogram {
    /// The bins of scores, then those of weights.
    bins: Vec<u32>,
    uncounted: u64,
}

impl Default for GradHistogram {
    fn default() -> Self {
        GradHistogram { bins: vec![0; 2 * BINS], uncounted: 0 }
    }
}

impl GradHistogram {
    /// The non-empty bins with their row counts, ascending, for a checkpoint. The bins of weights follow those of scores.
    pub fn filled(&self) -> Vec<(u16, u32)> {
        self.bins.iter().zip(0..=u16::MAX).filter(|(rows, _)| **rows > 0).map(|(&rows, bin)| (bin, rows)).collect()
    }

    /// The histogram with these bins of [`GradHistogram::filled`]. Every u16 is the number of a bin.
    pub fn from_filled(filled: &[(u16, u32)]) -> GradHistogram {
        let mut histogram = GradHistogram::default();
        filled.iter().for_each(|&(bin, rows)| histogram.bins[usize::from(bin)] = rows);
        histogram
    }

    pub fn add_rows(&mut self, rows: &Rows<'_>) {
        rows.grad2d.iter().zip(rows.count).for_each(|(&grad2d, &count)| self.add_row(grad2d, count));
    }

    fn add_row(&mut self, grad2d: f32, count: u32) {
        bins_of(grad2d, count).for_each(|bin| self.bins[bin] += 1);
    }

    fn remove_row(&mut self, grad2d: f32, count: u32) {
        for bin in bins_of(grad2d, count) {
            match self.bins[bin].checked_sub(1) {
                Some(left) => self.bins[bin] = left,
                None => self.uncounted += 1,
            }
        }
    }

    /// Adds what a device counted: `changes[bin]`, a signed number in a u32, is the change of the rows of that bin of mean scores; bins of
    /// mean weights follow where the device weighs rows.
    pub fn add_changes(&mut self, changes: &[u32]) {
        for (rows, change) in self.bins.iter_mut().zip(changes) {
            let counted = i64::from(*rows) + i64::from(*change as i32);
            self.uncounted += u64::try_from(-counted).unwrap_or(0);
            *rows = u32::try_from(counted).unwrap_or(0);
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

    pub fn rows(&self) -> u64 {
        self.bins[..BINS].iter().map(|&n| u64::from(n)).sum()
    }

    /// Number of rows that at least [`WEIGHED_VIEWS`] views weighed.
    pub fn weighed_rows(&self) -> u64 {
        self.bins[BINS..].iter().map(|&n| u64::from(n)).sum()
    }

    /// The lowest bin of scores, at least 1, from which on there are at most `room` rows; the number of bins if the last
    /// bin has more. Bin 0 holds scores of zero.
    pub fn split_bin(&self, room: u64) -> u32 {
        let (mut first, mut above) = (BINS, 0u64);
        while first > 1 {
            above += u64::from(self.bins[first - 1]);
            if above > room {
                break;
            }
            first -= 1;
        }
        first as u32
    }

    /// Number of rows in this bin of scores and above. Equals the sum of [`rows_from_bin`] over all pages.
    pub fn rows_from_bin(&self, bin: u32) -> u64 {
        self.bins[(bin as usize).min(BINS)..BINS].iter().map(|&n| u64::from(n)).sum()
    }

    /// The highest bin of weights below which there are at most `most` rows.
    pub fn remove_bin(&self, most: u64) -> u32 {
        let mut below = 0u64;
        let fits = |rows: &&u32| {
            below += u64::from(**rows);
            below <= most
        };
        self.bins[BINS..].iter().take_while(fits).count() as u32
    }

    /// The lowest threshold, at least `least`, above which at most `room` rows lie: `least` itself, just below the edge of
    /// a bin, or infinity.
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
}

/// The first bin whose rows may all lie above a threshold of [`GradHistogram::threshold`].
pub fn bin_above(threshold: f32) -> u32 {
    bin(threshold.next_up()) as u32
}

/// The rows of a view that [`GradHistogram::rows_from_bin`] counted, if their statistics are unchanged since the round.
pub fn rows_from_bin(rows: &Rows<'_>, bin: u32) -> u64 {
    let is_counted = |&(&grad2d, &count): &(&f32, &u32)| reaches_bin(grad2d, count, bin);
    rows.grad2d.iter().zip(rows.count).filter(is_counted).count() as u64
}

/// Whether a view drew a row with these statistics, and its mean score lies in this bin or above.
#[inline(always)]
pub fn reaches_bin(grad2d: f32, count: u32, bin: u32) -> bool {
    count > 0 && self::bin(mean_grad2d(grad2d, count)) as u32 >= bin
}

/// Bin of the mean weight of a row; `None` if fewer than [`WEIGHED_VIEWS`] views drew it or none weighed it.
#[inline(always)]
pub fn weight_bin(count: u32) -> Option<u32> {
    let mean = mean_weight(count).filter(|_| views(count) >= WEIGHED_VIEWS)?;
    Some(bin(mean) as u32)
}

/// The bins that count a row with these statistics: of its score if a view drew it, and of its weight if enough views weighed it.
#[inline(always)]
fn bins_of(grad2d: f32, count: u32) -> impl Iterator<Item = usize> {
    let of_score = (count > 0).then(|| bin(mean_grad2d(grad2d, count)));
    of_score.into_iter().chain(weight_bin(count).map(|bin| BINS + bin as usize))
}

#[inline(always)]
fn bin(mean: f32) -> usize {
    // Sums of norms are never -0, negative or NaN; such values would count as 0.
    if mean > 0.0 { (mean.to_bits() >> 16) as usize } else { 0 }
}

/// Rows of a step's working set, with their gradients and radii.
#[derive(Debug, Clone, Copy)]
pub struct DrawnRows<'a> {
    /// 0-based step.
    pub step: u32,
    /// Row numbers in the table of the view, ascending.
    pub rows: &'a [u32],
    /// Gradients of the working set. Weights are empty unless [`super::strategy::Strategy::needs_weights`].
    pub gradients: &'a Gradients,
    /// Place of the first of `rows` in `gradients`.
    pub first: usize,
    /// Width and height of the picture, pixels.
    pub image_size: [u32; 2],
}

impl DrawnRows<'_> {
    /// Norm of the gradient of the projected mean at a place in the gradients, NDC units.
    #[inline(always)]
    pub fn gradient_norm(&self, place: usize) -> f32 {
        let (v, half) = (self.gradients.means2d[place], self.image_size.map(|n| n as f32 * 0.5));
        let (x, y) = (v[0] * half[0], v[1] * half[1]);
        (x * x + y * y).sqrt()
    }
}

/// Adds the gradient norms of one view, as [`accumulate_scores`] does.
pub fn accumulate(view: &mut RowsMut<'_>, drawn: &DrawnRows<'_>, histogram: &mut GradHistogram) -> usize {
    accumulate_scores(view, drawn, histogram, |place| (drawn.gradient_norm(place), None))
}

/// Adds a growth score and, where a strategy weighs rows, a blending weight (pixels) of one view to the statistics of
/// the drawn rows of the table that contains `view`. `of_row` gives both for a place in the gradients. Rows with a zero
/// radius, with a score that is not finite, or with as many views as a row can count are ignored. Returns the number of
/// rows that changed.
pub fn accumulate_scores(
    view: &mut RowsMut<'_>,
    drawn: &DrawnRows<'_>,
    histogram: &mut GradHistogram,
    of_row: impl Fn(usize) -> (f32, Option<f32>),
) -> usize {
    let mut changed = 0;
    for (place, &row) in (drawn.first..).zip(drawn.rows) {
        if drawn.gradients.radii[place].contains(&0) {
            continue;
        }
        let (score, weight) = of_row(place);
        let row = row as usize - view.first_row;
        let (grad2d, count) = (&mut view.grad2d[row], &mut view.count[row]);
        if !score.is_finite() || is_full(*count) {
            continue;
        }
        histogram.remove_row(*grad2d, *count);
        *grad2d = (*grad2d + score).min(f32::MAX);
        *count = with_view(*count, weight);
        histogram.add_row(*grad2d, *count);
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
        let means2d = vec![[3e-4, 4e-4], [1.0, 1.0], [f32::NAN, 0.0]];
        let gradients = Gradients { means2d, radii: vec![[2, 1], [0, 3], [1, 1]], ..Gradients::default() };
        let drawn = DrawnRows { step: 0, rows: &[0, 2, 3], gradients: &gradients, first: 0, image_size: [20, 20] };
        for _ in 0..2 {
            accumulate(&mut state.view_mut(), &drawn, &mut histogram);
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
    fn weights_have_bins_of_their_own_that_a_checkpoint_holds() {
        let mut state = SceneState::from_columns(Columns::zeros(100, 0));
        let mut histogram = GradHistogram::default();
        let rows: Vec<u32> = (0..100).collect();
        let gradients = Gradients { radii: vec![[1, 1]; 100], ..Gradients::default() };
        let drawn = DrawnRows { step: 0, rows: &rows, gradients: &gradients, first: 0, image_size: [1, 1] };
        for view in 1..=WEIGHED_VIEWS {
            let of_row = |row: usize| (row as f32, Some(row as f32 + 1.0));
            accumulate_scores(&mut state.view_mut(), &drawn, &mut histogram, of_row);
            assert_eq!(histogram.weighed_rows(), if view < WEIGHED_VIEWS { 0 } else { 100 });
        }
        assert_eq!((histogram.rows(), histogram.uncounted()), (100, 0));
        // Means are whole numbers, and the bins below 128 tell whole numbers apart.
        let removed = |most: u64| {
            let below = histogram.remove_bin(most);
            state.count.iter().filter(|&&count| weight_bin(count).is_some_and(|bin| bin < below)).count()
        };
        assert_eq!([0, 1, 7, 99].map(removed), [0, 1, 7, 99]);
        let grown = |room: u64| rows_from_bin(&state.view(), histogram.split_bin(room));
        // Row 0 has score 0, which never grows.
        assert_eq!([0, 1, 7, 99, 100].map(grown), [0, 1, 7, 99, 99]);
        assert_eq!(GradHistogram::from_filled(&histogram.filled()), histogram);
        let mut recounted = GradHistogram::default();
        recounted.add_rows(&state.view());
        assert_eq!(recounted, histogram);
    }

    #[test]
    fn what_a_device_counted_is_added_and_never_wraps() {
        let mut histogram = GradHistogram::default();
        [0.5, 0.5, 2.0].into_iter().for_each(|score| histogram.add_row(score, 1));
        let mut changes = vec![0; BINS];
        (changes[bin(0.5)], changes[bin(2.0)], changes[bin(8.0)]) = (u32::MAX, u32::MAX, 1);
        histogram.add_changes(&changes);
        assert_eq!(histogram.filled(), [(bin(0.5) as u16, 1), (bin(8.0) as u16, 1)]);
        assert_eq!(histogram.uncounted(), 0);
        histogram.add_changes(&changes);
        assert_eq!((histogram.filled(), histogram.uncounted()), (vec![(bin(8.0) as u16, 2)], 1));
    }

    #[test]
    fn rows_that_were_never_counted_are_noticed_and_no_counter_wraps() {
        let mut state = SceneState::from_columns(Columns::zeros(2, 0));
        (state.grad2d[1], state.count[1]) = (3.0, 2);
        let mut histogram = GradHistogram::default();
        let gradients = Gradients { means2d: vec![[1.0, 0.0]; 2], radii: vec![[1, 1]; 2], ..Gradients::default() };
        let drawn = DrawnRows { step: 0, rows: &[0, 1], gradients: &gradients, first: 0, image_size: [2, 2] };
        accumulate(&mut state.view_mut(), &drawn, &mut histogram);
        assert_eq!((histogram.uncounted(), histogram.rows()), (1, 2));
        let mut counted = GradHistogram::default();
        counted.add_rows(&state.view());
        assert_eq!((counted.filled(), counted.uncounted()), (histogram.filled(), 0));
    }
}
