//! What changed between two generations.

use super::{StorePlace, run_state_of};
use crate::base::ids::PageId;
use crate::page::map::opening::StoredPage;
use crate::page::tool::reading::Access;
use crate::paging::label::meta_from_label;
use crate::train::error::TrainError;
use serde::Serialize;
use std::collections::BTreeMap;

/// Pages, their rows and their bytes on the drive.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct PageSum {
    /// Pages.
    pub pages: u64,
    /// Rows in them.
    pub rows: u64,
    /// Bytes of their slots.
    pub bytes: u64,
}

/// From one generation to another.
#[derive(Debug, Clone, Serialize)]
pub struct StoreDiff {
    /// Number of the first one.
    pub from: u64,
    /// Number of the other.
    pub to: u64,
    /// Their steps.
    pub steps: [u32; 2],
    /// Rows of all pages.
    pub rows: [u64; 2],
    /// Pages that only the other one has (halves of a page that was split are among them).
    pub added: PageSum,
    /// Pages that only the first one has.
    pub removed: PageSum,
    /// Pages whose bytes are others, as the other one has them.
    pub changed: PageSum,
    /// Rows of changed pages as the first one has them.
    pub changed_rows_before: u64,
    /// Pages that are the same slots.
    pub same: PageSum,
    /// Names of the pages that were added, removed, changed.
    pub names: [Vec<String>; 3],
}

/// Compares two kept generations by number or name; with `names`, lists the pages.
///
/// # Errors
/// The store cannot be opened, or a generation is not kept.
pub fn diff(place: &StorePlace, from: &str, to: &str, names: bool) -> Result<StoreDiff, TrainError> {
    let store = place.open(Access::Map)?;
    let (from, to) = (store.find(Some(from))?, store.find(Some(to))?);
    let steps = [run_state_of(&store, from)?.step, run_state_of(&store, to)?.step];
    let before: BTreeMap<PageId, StoredPage> = by_id(store.pages_at(from)?);
    let after = by_id(store.pages_at(to)?);
    let mut diff = StoreDiff {
        from,
        to,
        steps,
        rows: [&before, &after].map(|pages| pages.values().map(rows_of).sum()),
        added: PageSum::default(),
        removed: PageSum::default(),
        changed: PageSum::default(),
        changed_rows_before: 0,
        same: PageSum::default(),
        names: Default::default(),
    };
    for (id, page) in &after {
        let (sum, list) = match before.get(id) {
            None => (&mut diff.added, Some(0)),
            Some(other) if other.slot == page.slot => (&mut diff.same, None),
            Some(other) => {
                diff.changed_rows_before += rows_of(other);
                (&mut diff.changed, Some(2))
            }
        };
        sum.add(page);
        if let Some(list) = list.filter(|_| names) {
            diff.names[list].push(id.to_string());
        }
    }
    for (id, page) in before.iter().filter(|(id, _)| !after.contains_key(id)) {
        diff.removed.add(page);
        if names {
            diff.names[1].push(id.to_string());
        }
    }
    Ok(diff)
}

impl PageSum {
    fn add(&mut self, page: &StoredPage) {
        self.pages += 1;
        self.rows += rows_of(page);
        self.bytes += page.slot.transfer_bytes() as u64;
    }
}

fn by_id(pages: Vec<StoredPage>) -> BTreeMap<PageId, StoredPage> {
    pages.into_iter().map(|page| (page.page, page)).collect()
}

fn rows_of(page: &StoredPage) -> u64 {
    meta_from_label(page.page, &page.label).map_or(0, |meta| u64::from(meta.rows))
}
