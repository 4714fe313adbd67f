//! Downscaling by exact area average.
//!
//! Every target pixel is the mean of the source rectangle that it covers, with fractional coverage at the edges. All
//! sums are integers in units of 1 / (source size x target size), so the only rounding is the last one (to nearest,
//! halves up) and the result cannot depend on order or instruction set.
//!
//! Invariants: 1. a constant picture stays constant; 2. equal sizes return the source unchanged; 3. rows are pushed one
//! by one, so a source that is made row by row never has to exist as a whole. Enlarging is possible (each target pixel
//! averages less than one source pixel), but has no use.

/// Largest side for which the integer sums are proven not to overflow.
pub const LARGEST_SIDE: u32 = 65_535;

/// Tolerated difference between the scales of width and height for sizes of one shape.
const SHAPE_TOLERANCE: f64 = 0.01;

/// Width and height, pixels.
pub type Size = (u32, u32);

/// Size of a photo after division by `factor`, each side rounded to nearest and at least 1.
pub fn divided_size(full: Size, factor: f64) -> Size {
    let side = |n: u32| (f64::from(n) / factor).round().clamp(1.0, f64::from(LARGEST_SIDE)) as u32;
    (side(full.0), side(full.1))
}

/// Whether the sizes are equal up to scale: aspect ratios within 1 %, or a side within rounding (1.5 pixels).
pub fn same_shape(size: Size, stated: Size) -> bool {
    let [w, h, sw, sh] = [size.0, size.1, stated.0, stated.1].map(f64::from);
    let (x, y) = (w / sw, h / sh);
    (x / y - 1.0).abs() <= SHAPE_TOLERANCE || (w - sw * y).abs() <= 1.5 && (h - sh * x).abs() <= 1.5
}

/// Whether the sizes are equal up to scale and to the rounding of either.
pub fn is_rounded_shape(size: Size, stated: Size) -> bool {
    let [w, h, sw, sh] = [size.0, size.1, stated.0, stated.1].map(f64::from);
    let (x, y) = (w / sw, h / sh);
    let rounding = 1.5 * x.max(y).max(1.0);
    (w - sw * y).abs() <= rounding && (h - sh * x).abs() <= rounding
}

/// The range of a source row that one target pixel covers.
#[derive(Debug, Clone, Copy)]
struct SourceSpan {
    start: u32,
    end: u32,
    first_weight: u32,
    last_weight: u32,
}

/// Averages source rows into a smaller picture.
#[derive(Debug)]
pub struct AreaResizer {
    channels: usize,
    source: Size,
    target: Size,
    unit: u32,
    spans: Vec<SourceSpan>,
    reduced: Vec<u32>,
    sums: Vec<u64>,
    rows_taken: u32,
    out: Vec<u8>,
}

impl AreaResizer {
    /// For interleaved rows of `channels` samples. A sample of `255 * unit` is full white: `unit` is 1 for 8-bit
    /// rows and 256 for rows with 8 fractional bits. Sides are 1 to [`LARGEST_SIDE`].
    pub fn new(channels: usize, source: Size, target: Size, unit: u32) -> Self {
        for side in [source.0, source.1, target.0, target.1] {
            assert!((1..=LARGEST_SIDE).contains(&side), "side {side} of a picture is out of range");
        }
        assert!((1..=256).contains(&unit), "unit {unit} would overflow the sums");
        let row = target.0 as usize * channels;
        AreaResizer {
            channels,
            source,
            target,
            unit,
            spans: (0..target.0).map(|j| span(j, source.0, target.0)).collect(),
            reduced: vec![0; row],
            sums: vec![0; row],
            rows_taken: 0,
            out: Vec::with_capacity(row * target.1 as usize),
        }
    }

    /// Takes the next source row, `source width * channels` samples.
    pub fn push_row<S: Copy + Into<u32>>(&mut self, row: &[S]) {
        assert_eq!(row.len(), self.source.0 as usize * self.channels, "row length");
        assert!(self.rows_taken < self.source.1, "more rows than the source has");
        match self.channels {
            1 => self.reduce::<1, S>(row),
            3 => self.reduce::<3, S>(row),
            4 => self.reduce::<4, S>(row),
            n => panic!("{n} channels"),
        }
        let (source_height, target_height) = (u64::from(self.source.1), u64::from(self.target.1));
        // This row covers [top, bottom), in units in which a source row is target_height high.
        let top = u64::from(self.rows_taken) * target_height;
        let bottom = top + target_height;
        let mut j = top / source_height;
        while j * source_height < bottom {
            let end = (j + 1) * source_height;
            let weight = bottom.min(end) - top.max(j * source_height);
            for (sum, &value) in self.sums.iter_mut().zip(&self.reduced) {
                *sum += weight * u64::from(value);
            }
            if end <= bottom {
                self.flush();
            }
            j += 1;
        }
        self.rows_taken += 1;
    }

    /// The target, interleaved 8-bit. All source rows must have been pushed.
    pub fn finish(self) -> Vec<u8> {
        assert_eq!(self.rows_taken, self.source.1, "rows pushed");
        self.out
    }

    /// Horizontal pass: `reduced[j]` = sum of the covered samples, weighted in 1 / target width of a source pixel.
    fn reduce<const C: usize, S: Copy + Into<u32>>(&mut self, row: &[S]) {
        let inner_weight = self.target.0;
        for (out, span) in self.reduced.chunks_exact_mut(C).zip(&self.spans) {
            let covered = &row[span.start as usize * C..span.end as usize * C];
            let (mut first, mut inner, mut last) = ([0u32; C], [0u32; C], [0u32; C]);
            for c in 0..C {
                first[c] = covered[c].into();
                last[c] = covered[covered.len() - C + c].into();
            }
            if covered.len() > 2 * C {
                for pixel in covered[C..covered.len() - C].chunks_exact(C) {
                    for c in 0..C {
                        inner[c] += pixel[c].into();
                    }
                }
            }
            for c in 0..C {
                out[c] = first[c] * span.first_weight + inner[c] * inner_weight + last[c] * span.last_weight;
            }
        }
    }

    fn flush(&mut self) {
        let total = u64::from(self.source.0) * u64::from(self.source.1) * u64::from(self.unit);
        for sum in &mut self.sums {
            self.out.push(((*sum + total / 2) / total) as u8);
            *sum = 0;
        }
    }
}

/// Target pixel `j` covers [j source, (j + 1) source), in units in which a source pixel is `target` wide.
fn span(j: u32, source: u32, target: u32) -> SourceSpan {
    let (source, target, j) = (u64::from(source), u64::from(target), u64::from(j));
    let (left, right) = (j * source, (j + 1) * source);
    let start = left / target;
    let end = right.div_ceil(target);
    // All weights of a span add up to `source`; a span within a single pixel has its whole weight in the first.
    let first_weight = right.min((start + 1) * target) - left;
    let last_weight = if end - start > 1 { right - (end - 1) * target } else { 0 };
    SourceSpan {
        start: start as u32,
        end: end as u32,
        first_weight: first_weight as u32,
        last_weight: last_weight as u32,
    }
}

/// Area average of a whole interleaved 8-bit picture with 1, 3 or 4 channels.
pub fn resize_area(source: &[u8], channels: usize, from: Size, to: Size) -> Vec<u8> {
    assert_eq!(source.len(), channels * from.0 as usize * from.1 as usize, "picture length");
    let mut resizer = AreaResizer::new(channels, from, to, 1);
    for row in source.chunks_exact(from.0 as usize * channels) {
        resizer.push_row(row);
    }
    resizer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    fn noise(len: usize, key: u64) -> Vec<u8> {
        let mut s = Stream::new(5, Purpose::Test, key, 0);
        (0..len).map(|_| s.next_u64() as u8).collect()
    }

    /// The definition, in f64: overlap of every source pixel with every target pixel.
    fn slow(source: &[u8], channels: usize, from: Size, to: Size) -> Vec<f64> {
        let overlap = |i: u32, j: u32, n: u32, m: u32| {
            let ratio = f64::from(n) / f64::from(m);
            let low = f64::from(i).max(f64::from(j) * ratio);
            let high = f64::from(i + 1).min(f64::from(j + 1) * ratio);
            (high - low).max(0.0)
        };
        let mut out = Vec::new();
        for ty in 0..to.1 {
            for tx in 0..to.0 {
                for c in 0..channels {
                    let (mut sum, mut area) = (0.0, 0.0);
                    for sy in 0..from.1 {
                        for sx in 0..from.0 {
                            let weight = overlap(sx, tx, from.0, to.0) * overlap(sy, ty, from.1, to.1);
                            let i = (sy * from.0 + sx) as usize * channels + c;
                            sum += weight * f64::from(source[i]);
                            area += weight;
                        }
                    }
                    out.push(sum / area);
                }
            }
        }
        out
    }

    #[test]
    fn shapes_agree_up_to_scale_and_rounding() {
        assert!(same_shape((1200, 674), (1200, 674)));
        assert!(same_shape((600, 337), (1200, 674)));
        assert!(same_shape((351, 197), (1200, 674)));
        assert!(same_shape((19, 11), (1200, 674))); // 18.75 x 10.53, rounded
        assert!(!same_shape((674, 1200), (1200, 674)));
        assert!(!same_shape((1200, 800), (1200, 674)));
        assert!(!same_shape((1000, 674), (1200, 674)));
    }

    #[test]
    fn equals_the_definition() {
        let sizes = [((17, 11), (5, 4)), ((24, 16), (6, 4)), ((13, 9), (12, 8)), ((7, 5), (1, 1)), ((4, 3), (9, 7))];
        for (k, (from, to)) in sizes.into_iter().enumerate() {
            for channels in [1, 3, 4] {
                let source = noise(channels * (from.0 * from.1) as usize, k as u64);
                let got = resize_area(&source, channels, from, to);
                let want = slow(&source, channels, from, to);
                assert_eq!(got.len(), want.len());
                for (g, w) in got.iter().zip(&want) {
                    // Rounding to nearest is the only difference; 1e-9 for the f64 sums of the definition.
                    assert!((f64::from(*g) - w).abs() <= 0.5 + 1e-9, "{from:?} -> {to:?}: {g} {w}");
                }
            }
        }
    }

    #[test]
    fn fractional_bits_are_averaged_before_rounding_and_the_largest_sums_fit() {
        let resized = |row: &[u16], to: u32| {
            let mut resizer = AreaResizer::new(1, (row.len() as u32, 1), (to, 1), 256);
            resizer.push_row(row);
            resizer.finish()
        };
        // (100.78 + 101.23) / 2 = 101.008; rounding first would give (101 + 101) / 2.
        assert_eq!(resized(&[100 * 256 + 200, 101 * 256 + 60], 1), [101]);
        for to in [1, LARGEST_SIDE - 1] {
            assert!(resized(&vec![255 * 256; LARGEST_SIDE as usize], to).iter().all(|&x| x == 255));
        }
    }

    #[test]
    fn shapes_are_equal_up_to_the_rounding_of_either_size() {
        for (size, stated) in [((640, 480), (640, 480)), ((187, 140), (640, 480)), ((5472, 3648), (1600, 1066))] {
            assert!(is_rounded_shape(size, stated) && same_shape(size, stated), "{size:?} {stated:?}");
        }
        // Undistorted after the model was made: used, with a warning.
        for (size, stated) in [((640, 476), (640, 480)), ((3968, 2988), (4000, 3000))] {
            assert!(!is_rounded_shape(size, stated) && same_shape(size, stated), "{size:?} {stated:?}");
        }
    }

    #[test]
    fn equal_sizes_change_nothing_and_sizes_round_to_nearest() {
        let source = noise(3 * 10 * 6, 9);
        assert_eq!(resize_area(&source, 3, (10, 6), (10, 6)), source);
        assert_eq!(divided_size((790, 594), 2.0), (395, 297));
        assert_eq!(divided_size((1200, 674), 3.4175), (351, 197)); // 351.13, 197.22
        assert_eq!(divided_size((7, 3), 100.0), (1, 1));
    }
}
