// What the two halves of a pass of the radix sort share: blocks of 2048 keys, 4 bits to a pass.

struct SortUniforms {
    /// The number of keys is live[live_at], but never more than this.
    capacity: u32,
    live_at: u32,
    /// Blocks that the histogram has room for.
    blocks: u32,
    /// Lowest bit of this pass's digit.
    shift: u32,
}

/// Keys of one invocation; they stand side by side, so that the order within a block is that of the invocations.
const KEYS: u32 = 8u;
const BLOCK_KEYS: u32 = 2048u;
const DIGITS: u32 = 16u;
/// Words in which an invocation's counts are kept: digits w and w + 8 in the halves of word w.
const WORDS: u32 = 8u;

/// How many keys of each digit one invocation has, 4 bits each (a count of 8 fits): digits 0 to 7, then 8 to 15.
struct DigitCounts {
    low: u32,
    high: u32,
}

fn digit_count(counts: DigitCounts, digit: u32) -> u32 {
    return (select(counts.high, counts.low, digit < 8u) >> (4u * (digit & 7u))) & 15u;
}

fn digit_add(counts: DigitCounts, digit: u32) -> DigitCounts {
    let one = 1u << (4u * (digit & 7u));
    return DigitCounts(
        counts.low + select(0u, one, digit < 8u),
        counts.high + select(one, 0u, digit < 8u),
    );
}

/// Counts of digits `word` and `word` + 8.
fn digit_word(counts: DigitCounts, word: u32) -> u32 {
    return ((counts.low >> (4u * word)) & 15u) | (((counts.high >> (4u * word)) & 15u) << 16u);
}
