//! An evenly spaced sample of a stream of unknown length: every value, or every second, fourth and so on.
//!
//! Invariant: the sample is a function of the values in their order, and never larger than the limit.

#[derive(Debug, Clone)]
pub struct EvenSample<T> {
    pub kept: Vec<T>,
    /// Values that were offered.
    pub seen: u64,
    /// One value in so many is kept: a power of two.
    pub stride: u64,
    most: usize,
}

impl<T> EvenSample<T> {
    /// An empty sample that will keep at most `most` values, at least half of that once as many were offered.
    pub fn new(most: usize) -> EvenSample<T> {
        EvenSample { kept: Vec::new(), seen: 0, stride: 1, most: most.max(1) }
    }

    pub fn add(&mut self, value: T) {
        if self.seen.is_multiple_of(self.stride) {
            if self.kept.len() == self.most {
                let mut number = 0;
                self.kept.retain(|_| {
                    number += 1;
                    number % 2 == 1
                });
                self.stride *= 2;
            }
            if self.seen.is_multiple_of(self.stride) {
                self.kept.push(value);
            }
        }
        self.seen += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sample_is_evenly_spaced_and_bounded() {
        for count in [0_u64, 1, 7, 8, 9, 16, 17, 100, 1000] {
            let mut sample = EvenSample::new(8);
            (0..count).for_each(|value| sample.add(value));
            assert_eq!(sample.seen, count);
            assert!(sample.kept.len() <= 8 && sample.kept.len() as u64 >= count.min(4), "{sample:?}");
            let spaced: Vec<u64> = (0..sample.kept.len() as u64).map(|i| i * sample.stride).collect();
            assert_eq!(sample.kept, spaced, "of {count}");
        }
    }
}
