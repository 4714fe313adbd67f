//! The palette of SH coefficients: k-means on two levels, because one level would compare every row with thousands of centres.
//!
//! The first level clusters all rows into as many groups as the square root of the number of centres. Each group then gets a share of
//! the centres that is proportional to its squared error, and the second level clusters the rows of the group around these centres.
//!
//! Invariants: 1. the palette depends on the rows and their order alone: assignments are independent, sums go in the order of the
//! rows; 2. a label names a centre.

use rayon::prelude::*;

/// Rounds of Lloyd's algorithm on each level.
const ROUNDS: usize = 6;
/// Rows whose nearest centres one task finds.
const TASK_ROWS: usize = 256;

/// Centres, and the label of each row: the number of the centre that replaces its coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct Palette {
    /// The centres, one after another, `width` values each.
    pub centres: Vec<f32>,
    pub labels: Vec<u16>,
}

impl Palette {
    /// A palette of at most `centres` (1 to 65,536) centres for rows of `width` finite values each.
    pub fn of(rows: &[f32], width: usize, centres: usize) -> Palette {
        let count = rows.len() / width;
        let wanted = centres.clamp(1, count.max(1));
        let coarse = (libm::sqrt(wanted as f64) as usize).max(1);
        let (groups, members) = lloyd(rows, width, coarse, |centres, labels| {
            let tasks = labels.par_chunks_mut(TASK_ROWS).zip(rows.par_chunks(TASK_ROWS * width));
            tasks.for_each(|(labels, rows)| assign(rows, centres, labels));
        });
        // The rows of each group, ascending.
        let mut by_group = vec![Vec::new(); groups.len() / width];
        members.iter().enumerate().for_each(|(row, &group)| by_group[group as usize].push(row as u32));
        let gathered: Vec<Vec<f32>> = by_group
            .par_iter()
            .map(|group| group.iter().flat_map(|&row| &rows[row as usize * width..][..width]).copied().collect())
            .collect();
        let errors = gathered.iter().zip(groups.chunks_exact(width));
        let errors: Vec<f64> = errors.map(|(rows, centre)| squared_error(rows, centre)).collect();
        let sizes: Vec<usize> = by_group.iter().map(Vec::len).collect();
        let shares = shares(&errors, &sizes, wanted);
        // Groups divide the threads among each other; within a group, rows are assigned one by one.
        let divided = gathered.par_iter().zip(&shares);
        let divided: Vec<_> = divided
            .map(|(rows, &share)| lloyd(rows, width, share, |centres, labels| assign(rows, centres, labels)))
            .collect();
        let mut palette = Palette { centres: Vec::new(), labels: vec![0; count] };
        for (group, (centres, labels)) in by_group.iter().zip(divided) {
            let first = palette.centres.len() / width;
            for (&row, label) in group.iter().zip(labels) {
                palette.labels[row as usize] = (first + label as usize) as u16;
            }
            palette.centres.extend(centres);
        }
        palette
    }
}

/// Number of centres of each group: one for every group with rows, and the others by squared error. No group gets more centres than
/// it has rows.
fn shares(errors: &[f64], sizes: &[usize], wanted: usize) -> Vec<usize> {
    let total: f64 = errors.iter().sum();
    let used = sizes.iter().filter(|&&n| n > 0).count();
    let spare = wanted.saturating_sub(used) as f64;
    let share = |(&error, &size): (&f64, &usize)| {
        let more = if total > 0.0 { (error / total * spare) as usize } else { 0 };
        size.min(1 + more)
    };
    errors.iter().zip(sizes).map(share).collect()
}

fn squared_error(rows: &[f32], centre: &[f32]) -> f64 {
    let off = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    rows.chunks_exact(centre.len()).map(|row| row.iter().zip(centre).map(off).sum::<f64>()).sum()
}

/// Lloyd's algorithm from rows at even distances. `assign` writes the number of the nearest centre of each row.
fn lloyd(rows: &[f32], width: usize, centres: usize, assign: impl Fn(&Transposed, &mut [u32])) -> (Vec<f32>, Vec<u32>) {
    let count = rows.len() / width;
    let centres = centres.min(count);
    let seed = |i: usize| &rows[i * count / centres.max(1) * width..][..width];
    let mut values: Vec<f32> = (0..centres).flat_map(seed).copied().collect();
    let mut labels = vec![0; count];
    if centres == 0 {
        return (values, labels);
    }
    for _ in 0..ROUNDS {
        assign(&Transposed::of(&values, width), &mut labels);
        let mut sums = vec![0.0f64; centres * width];
        let mut counts = vec![0u32; centres];
        for (row, &label) in rows.chunks_exact(width).zip(&labels) {
            counts[label as usize] += 1;
            let sum = &mut sums[label as usize * width..][..width];
            sum.iter_mut().zip(row).for_each(|(sum, &v)| *sum += f64::from(v));
        }
        // A centre without rows stays.
        for (i, &n) in counts.iter().enumerate().filter(|&(_, &n)| n > 0) {
            let sum = &sums[i * width..][..width];
            values[i * width..][..width].iter_mut().zip(sum).for_each(|(v, sum)| *v = (sum / f64::from(n)) as f32);
        }
    }
    assign(&Transposed::of(&values, width), &mut labels);
    (values, labels)
}

/// Centres, transposed so that loops over centres vectorise (one row for each coefficient), and half of their squared lengths.
struct Transposed {
    width: usize,
    coefficients: Vec<f32>,
    halves: Vec<f32>,
}

impl Transposed {
    fn of(centres: &[f32], width: usize) -> Transposed {
        let count = centres.len() / width;
        let mut coefficients = vec![0.0; centres.len()];
        for (i, centre) in centres.chunks_exact(width).enumerate() {
            centre.iter().enumerate().for_each(|(k, &v)| coefficients[k * count + i] = v);
        }
        let half = |centre: &[f32]| (centre.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>() / 2.0) as f32;
        let halves = centres.chunks_exact(width).map(half).collect();
        Transposed { width, coefficients, halves }
    }
}

/// The nearest centre of each row: that with the least |c|^2 / 2 - x c; the first of equals.
fn assign(rows: &[f32], centres: &Transposed, labels: &mut [u32]) {
    let count = centres.halves.len();
    let mut scores = vec![0.0; count];
    for (row, label) in rows.chunks_exact(centres.width).zip(labels) {
        scores.copy_from_slice(&centres.halves);
        for (&x, coefficients) in row.iter().zip(centres.coefficients.chunks_exact(count)) {
            scores.iter_mut().zip(coefficients).for_each(|(score, &c)| *score -= x * c);
        }
        let nearest = (1..count).fold(0, |best, i| if scores[i] < scores[best] { i } else { best });
        *label = nearest as u32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::mix64;

    fn random(count: usize) -> Vec<f32> {
        (0..count as u64).map(|i| (mix64(i) >> 40) as f32 / (1 << 24) as f32 - 0.5).collect()
    }

    #[test]
    fn a_palette_is_better_than_one_centre_and_the_same_for_any_number_of_threads() {
        let width = 24;
        let rows = random(3000 * width);
        let of = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.map(|pool| pool.install(|| Palette::of(&rows, width, 256))).map_err(|e| e.to_string())
        };
        let palette = of(1);
        assert_eq!(palette, of(3));
        let error = palette.map(|palette| {
            let of_row = |(row, &label): (&[f32], &u16)| {
                squared_error(row, &palette.centres[usize::from(label) * width..][..width])
            };
            rows.chunks_exact(width).zip(&palette.labels).map(of_row).sum::<f64>() / rows.len() as f64
        });
        // The variance of these values is 1/12; 256 centres in 24 dimensions leave some three quarters of it.
        assert!(error.as_ref().is_ok_and(|e| *e < 0.8 / 12.0), "{error:?}");
    }
}
