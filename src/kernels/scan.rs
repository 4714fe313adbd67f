//! Exclusive prefix sums: counts to 64-bit offsets.

/// `offsets[i]` = sum of `counts[..i]`, with the total as one more entry at the end. Returns the total.
/// `offsets` is resized to `counts.len() + 1` and keeps its allocation.
pub fn scan(counts: &[u64], offsets: &mut Vec<u64>) -> u64 {
    offsets.clear();
    offsets.reserve(counts.len() + 1);
    let mut sum = 0u64;
    for &count in counts {
        offsets.push(sum);
        sum += count;
    }
    offsets.push(sum);
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_exclusive_and_64_bit() {
        let mut offsets = vec![9; 3];
        assert_eq!(scan(&[3, 0, 1 << 32, 2], &mut offsets), (1 << 32) + 5);
        assert_eq!(offsets, [0, 3, 3, (1 << 32) + 3, (1 << 32) + 5]);
        assert_eq!(scan(&[], &mut offsets), 0);
        assert_eq!(offsets, [0]);
    }
}
