//! Stored pages: their labels (the entry of a page as bytes beside the page in its slot, so that the index can be rebuilt from the
//! slots alone), and checks of entry and values against the run.
//!
//! Invariants: 1. a label is a function of the page's entry, without the id, which the slot holds anyway; 2. untrusted bytes
//! give an entry or nothing, never a panic; 3. a page that passes the checks can be read into a frame and used without another.

use crate::base::ids::PageId;
use crate::page::format::slot_header::SlotRef;
use crate::scene::page_layout::{PageLayout, capacity_bytes};
use crate::scene::page_meta::{PageBounds, PageMeta};
use crate::scene::rows::{ColumnsRef, Rows};

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

/// Limits of the pages of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageLimits {
    pub page_rows: usize,
    /// Degree of the scene.
    pub sh_degree: u8,
    /// Length of the event log.
    pub events: usize,
}

impl PageLimits {
    /// The entry of a page from its label.
    /// Errors: what contradicts the label, the slot or the run, for people.
    pub fn meta_of(&self, page: PageId, slot: &SlotRef, label: &[u8]) -> Result<PageMeta, String> {
        let meta = meta_from_label(page, label).ok_or("its label is none")?;
        if meta.rows == 0 || meta.rows as usize > self.page_rows || meta.sh_degree > self.sh_degree {
            return Err("no page of this run has such sizes".to_string());
        }
        if meta.events_applied as usize > self.events {
            return Err("it has applied events that did not happen".to_string());
        }
        let layout = layout_of(&meta);
        if layout.bytes() != slot.payload_bytes as usize
            || layout.bytes() > capacity_bytes(self.page_rows, self.sh_degree)
        {
            return Err("its slot has another length".to_string());
        }
        Ok(meta)
    }
}

/// The layout of a page's payload.
pub fn layout_of(meta: &PageMeta) -> PageLayout {
    PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree }
}

/// Checks that training can produce every value in at most `step` steps: values are finite, second moments and statistics are not
/// negative, no row is newer.
/// Errors: the first value that is not.
pub fn check_values(rows: &Rows<'_>, step: u32) -> Result<(), String> {
    let Rows { columns, exp_avg, exp_avg_sq, stamp, grad2d, .. } = rows;
    for (table, name, least) in [
        (columns, "", f32::NEG_INFINITY),
        (exp_avg, "first moment of ", f32::NEG_INFINITY),
        (exp_avg_sq, "second moment of ", 0.0),
    ] {
        for (column, values) in named(table) {
            let width = values.len() / stamp.len().max(1);
            if let Some(at) = values.iter().position(|&v| !(v.is_finite() && v >= least)) {
                return Err(format!("row {}: {name}{column} is {}", at / width.max(1), values[at]));
            }
        }
    }
    if let Some(row) = grad2d.iter().position(|&g| !(g.is_finite() && g >= 0.0)) {
        return Err(format!("row {row}: grad2d is {}", grad2d[row]));
    }
    match stamp.iter().position(|&s| s > step) {
        Some(row) => Err(format!("row {row}: it contains {} steps, the run has done {step}", stamp[row])),
        None => Ok(()),
    }
}

fn named<'a>(table: &ColumnsRef<'a>) -> [(&'static str, &'a [f32]); 6] {
    let ColumnsRef { means, quats, scales, opacities, sh0, sh_n, .. } = *table;
    [("means", means), ("quats", quats), ("scales", scales), ("opacities", opacities), ("sh0", sh0), ("shN", sh_n)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::columns::Columns;
    use crate::scene::state::SceneState;

    #[test]
    fn values_that_training_never_leaves_are_named() {
        let good = || SceneState::from_columns(Columns::zeros(3, 1));
        assert_eq!(check_values(&good().view(), 0), Ok(()));
        let refused = |change: fn(&mut SceneState), words: &str| {
            let mut state = good();
            change(&mut state);
            assert_eq!(check_values(&state.view(), 7), Err(words.to_string()));
        };
        refused(|s| s.columns.means[4] = f32::NAN, "row 1: means is NaN");
        refused(|s| s.exp_avg.sh_n[26] = f32::INFINITY, "row 2: first moment of shN is inf");
        refused(|s| s.exp_avg_sq.opacities[2] = -1.0, "row 2: second moment of opacities is -1");
        refused(|s| s.grad2d[0] = -0.5, "row 0: grad2d is -0.5");
        refused(|s| s.stamp[1] = 8, "row 1: it contains 8 steps, the run has done 7");
    }

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
