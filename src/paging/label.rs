//! Labels: the entry of a page as bytes beside the page in its slot, so that the index can be rebuilt from the slots alone.
//!
//! Invariants: 1. a label is a function of the page's entry, without the id, which the slot holds anyway;
//! 2. untrusted bytes give an entry or nothing, never a panic.

use crate::base::ids::PageId;
use crate::scene::page_meta::{PageBounds, PageMeta};

/// Bytes of a label.
pub const LABEL_BYTES: usize = 40;

/// The label of a page: rows, degree, events applied, bounds; little-endian.
pub fn label(meta: &PageMeta) -> [u8; LABEL_BYTES] {
    let PageBounds { lo, hi, sigma_max } = meta.bounds;
    let floats = [lo[0], lo[1], lo[2], hi[0], hi[1], hi[2], sigma_max].map(f32::to_bits);
    let words = [meta.rows, u32::from(meta.sh_degree), meta.events_applied];
    let mut bytes = [0; LABEL_BYTES];
    for (to, word) in bytes.chunks_exact_mut(4).zip(words.into_iter().chain(floats)) {
        to.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

/// The entry of page `id` from its label; `None` for bytes that [`label`] never gives.
pub fn meta_from_label(id: PageId, bytes: &[u8]) -> Option<PageMeta> {
    let mut words = [0u32; LABEL_BYTES / 4];
    let bytes: &[u8; LABEL_BYTES] = bytes.try_into().ok()?;
    for (word, from) in words.iter_mut().zip(bytes.chunks_exact(4)) {
        *word = u32::from_le_bytes(from.try_into().ok()?);
    }
    let [rows, sh_degree, events_applied, floats @ ..] = words;
    let [x, y, z, x_hi, y_hi, z_hi, sigma_max] = floats.map(f32::from_bits);
    let bounds = PageBounds { lo: [x, y, z], hi: [x_hi, y_hi, z_hi], sigma_max };
    let sh_degree = u8::try_from(sh_degree).ok().filter(|&d| d <= 3)?;
    Some(PageMeta { id, rows, sh_degree, events_applied, bounds })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_come_back_and_impossible_ones_do_not() {
        let bounds = PageBounds { lo: [1.0, -2.0, 3.5], hi: [4.0, f32::MAX, 1e-40], sigma_max: 0.25 };
        let meta = PageMeta { id: PageId::initial(3), rows: 77, sh_degree: 2, events_applied: 5, bounds };
        let mut bytes = label(&meta);
        assert_eq!(meta_from_label(meta.id, &bytes), Some(meta));
        assert_eq!(meta_from_label(meta.id, &bytes[1..]), None);
        bytes[4] = 4;
        assert_eq!(meta_from_label(meta.id, &bytes), None);
    }
}
