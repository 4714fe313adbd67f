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
