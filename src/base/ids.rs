//! Page ids.
//!
//! Invariants: 1. a page's id depends on where it came from, not when: the same splits give the same ids in any order
//! of time and under any budget; 2. ids of pages that exist at the same time are ordered as their places in the tree of
//! splits: all descendants of a page come between its neighbours.

/// Bits of the path within an initial page.
const PATH_BITS: u32 = 32;
/// Set in the number of an initial page that is frozen.
const FROZEN: u32 = 1 << 31;

/// Id of a page by lineage: the number of the initial page (upper 32 bits) and the path down the splits since (lower 32
/// bits, the in-order label of a binary tree: the root is 2^31, a child is half its parent's lowest set bit away).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PageId(u64);

impl PageId {
    /// The initial page number `index`, which is below 2^31 for a page that is trained.
    pub fn initial(index: u32) -> PageId {
        PageId((u64::from(index) << PATH_BITS) | 1 << (PATH_BITS - 1))
    }

    /// The initial page number `index` of those that are frozen: their rows are rendered and never change, so such a page never splits.
    /// Frozen pages come after all others.
    pub fn frozen(index: u32) -> PageId {
        PageId::initial(FROZEN | index)
    }

    pub fn is_frozen(self) -> bool {
        self.origin() & FROZEN != 0
    }

    /// The number of the initial page that this page is or came from.
    pub fn origin(self) -> u32 {
        (self.0 >> PATH_BITS) as u32
    }

    /// The ids of the two halves of this page, lower first; `None` after 31 splits in a row.
    pub fn children(self) -> Option<[PageId; 2]> {
        let half = (self.0 & self.0.wrapping_neg() & u64::from(u32::MAX)) >> 1;
        (half > 0).then_some([PageId(self.0 - half), PageId(self.0 + half)])
    }

    /// Whether this page came from a split.
    pub fn is_part(self) -> bool {
        self.0 as u32 != 1 << (PATH_BITS - 1)
    }

    /// As a number, for files.
    pub fn to_bits(self) -> u64 {
        self.0
    }

    /// Decodes a file's number; `None` for an impossible one.
    pub fn from_bits(bits: u64) -> Option<PageId> {
        (bits & u64::from(u32::MAX) != 0).then_some(PageId(bits))
    }
}

/// Parses the displayed form of [`PageId`]: `7`, `7.0`, `7.0.1`.
impl std::str::FromStr for PageId {
    type Err = String;

    fn from_str(text: &str) -> Result<PageId, String> {
        let wrong = || format!("'{text}' is not a page id; write for example 7 or 7.0.1");
        let mut parts = text.split('.');
        let first = parts.next().and_then(|n| n.parse().ok()).ok_or_else(wrong)?;
        parts.try_fold(PageId::initial(first), |id, part| {
            let half = match part {
                "0" => 0,
                "1" => 1,
                _ => return Err(wrong()),
            };
            id.children().map(|children| children[half]).ok_or_else(wrong)
        })
    }
}

impl std::fmt::Display for PageId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let path = self.0 as u32;
        write!(f, "{}", self.origin())?;
        // From the root down to the page: 0 is the lower half.
        let depth = PATH_BITS - 1 - path.trailing_zeros().min(PATH_BITS - 1);
        (0..depth).try_for_each(|level| write!(f, ".{}", path >> (PATH_BITS - 1 - level) & 1))
    }
}

/// Number of a page in the resident index: dense, in order of appearance. Valid only within one process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PageNo(pub u32);

impl PageNo {
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_ordered_like_the_tree_and_end_with_an_answer() {
        let root = PageId::initial(7);
        let [low, high] = root.children().unwrap_or([root; 2]);
        let [low_low, low_high] = low.children().unwrap_or([root; 2]);
        assert!(PageId::initial(6) < low_low && low_low < low_high && low_high < high && high < PageId::initial(8));
        assert_eq!(format!("{root} {low} {high} {low_high}"), "7 7.0 7.1 7.0.1");
        assert_eq!(
            [root, low, high, low_high, PageId::initial(0)].map(PageId::is_part),
            [false, true, true, true, false]
        );
        for page in [root, low, high, low_high] {
            assert_eq!(page.to_string().parse(), Ok(page));
        }
        for wrong in ["", "x", "7.", "7.2", ".1", "-1", "7.01"] {
            assert!(wrong.parse::<PageId>().is_err(), "{wrong}");
        }
        let mut id = root;
        let mut depth = 0;
        while let Some([_, next]) = id.children() {
            (id, depth) = (next, depth + 1);
        }
        assert_eq!(depth, 31);
        assert_eq!(PageId::from_bits(id.to_bits()), Some(id));
        assert_eq!(PageId::from_bits(5 << 32), None);
    }
}
