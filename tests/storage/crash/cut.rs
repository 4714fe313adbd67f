//! Commits beside training: the pages of a cut are written while newer versions are made and written; the commit
//! follows later.

use super::life::{End, Life};
use super::oracle::{fill, payload_bytes};
use gsscale::base::ids::PageId;
use gsscale::page::format::slot_header::{HEADER_BYTES, SlotRef};
use gsscale::page::map::commit::{Cut, PageChange};
use gsscale::page::versions::paged_store::PageMoved;
use std::collections::{BTreeMap, BTreeSet};

/// A generation that is cut and not yet committed.
#[derive(Debug)]
pub struct Frozen {
    generation: u64,
    /// Pages of the generation with their versions.
    pages: BTreeMap<PageId, u64>,
    /// Slots of the versions that are already written.
    slots: BTreeMap<PageId, SlotRef>,
    /// Pages that differ from the last commit.
    changed: BTreeSet<PageId>,
}

impl Life<'_> {
    /// Cuts: later changes belong to the next generation.
    pub fn freeze(&mut self) {
        if self.frozen.is_some() {
            return;
        }
        let generation = self.store.cut();
        let pages = self.pages.iter().map(|(page, held)| (*page, held.version)).collect();
        let slots = self.pages.iter().filter_map(|(page, held)| Some((*page, held.slot?))).collect();
        let changed = std::mem::take(&mut self.changed);
        self.frozen = Some(Frozen { generation, pages, slots, changed });
    }

    /// Abandons the cut: the versions that it wrote become ordinary versions.
    pub fn thaw(&mut self) {
        if let Some(frozen) = self.frozen.take() {
            self.changed.extend(frozen.changed);
        }
    }

    /// Whether the cut still needs the version in memory, which is not yet written.
    pub fn is_frozen(&self, page: PageId) -> bool {
        let Some(frozen) = &self.frozen else { return false };
        !frozen.slots.contains_key(&page)
            && frozen.pages.get(&page).is_some_and(|v| self.pages.get(&page).is_some_and(|held| held.version == *v))
    }

    /// Pages that the cut still needs written.
    pub fn unwritten(&self) -> Vec<PageId> {
        let Some(frozen) = &self.frozen else { return Vec::new() };
        frozen.pages.keys().copied().filter(|page| !frozen.slots.contains_key(page)).collect()
    }

    /// Writes the cut's version of a page, which may have a newer version by now. Does nothing without space.
    pub fn write_frozen(&mut self, page: PageId) -> Result<(), End> {
        let Some(frozen) = &mut self.frozen else { return Ok(()) };
        let (generation, version) = (frozen.generation, frozen.pages[&page]);
        let mut buffer = self.store.new_buffer();
        let bytes = payload_bytes(page, version);
        fill(page, version, &mut buffer.as_mut_slice()[HEADER_BYTES..][..bytes]);
        match self.store.write_for(generation, page.to_bits(), page, &version.to_le_bytes(), bytes, buffer) {
            Err((error, _)) if error.is_out_of_space() => return Ok(()),
            other => other.map_err(|(error, _)| error)?,
        }
        let mut done = Vec::new();
        while done.is_empty() && self.store.in_flight() > 0 {
            self.store.complete(true, &mut done);
        }
        for end in done {
            let slot = match end.result {
                Ok(PageMoved::Written(slot)) => slot,
                Err(error) if !error.is_out_of_space() => return Err(error.into()),
                _ => continue,
            };
            frozen.slots.insert(page, slot);
            let Some(held) = self.pages.get_mut(&page) else {
                self.store.free(&slot);
                continue;
            };
            if held.slot.is_some() {
                self.store.free(&slot);
                continue;
            }
            if let Some(before) = held.before.take() {
                self.store.free_from(&before, generation);
            }
            match held.version == version {
                true => held.slot = Some(slot),
                false => held.before = Some(slot),
            }
        }
        Ok(())
    }

    /// Commits the cut; without space, abandons it.
    pub fn commit_frozen(&mut self, pin: Option<&str>) -> Result<(), End> {
        for page in self.unwritten() {
            self.write_frozen(page)?;
        }
        if !self.unwritten().is_empty() {
            self.thaw();
            return Ok(());
        }
        let Some(frozen) = &self.frozen else { return Ok(()) };
        let generation = frozen.generation;
        let change = |page: &PageId| {
            let version = frozen.pages.get(page).map(|v| (frozen.slots[page], v.to_le_bytes().to_vec()));
            PageChange { page: *page, version }
        };
        let changes: Vec<PageChange> = frozen.changed.iter().map(change).collect();
        let run_state = generation.to_le_bytes().repeat(2);
        let cut = Cut { changes: &changes, run_state: &run_state, note: b"frozen", pin };
        self.begin(generation, frozen.pages.clone(), &cut)?;
        match self.commits.commit_cut(&mut self.store, &mut Vec::new(), generation, &cut) {
            Err(error) if error.is_out_of_space() => {
                self.thaw();
                return Ok(());
            }
            other => other?,
        };
        self.frozen = None;
        self.oracle.acknowledge_by(&self.commits).map_err(End::Violation)
    }
}
