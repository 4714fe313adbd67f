//! Generations of a store: which one is being written, and when the slots of past versions become free.
//!
//! A cut ends a generation. What it consists of may still be written after it, for that generation by name, while
//! versions for the next one are written beside it.
//!
//! Invariant: a slot is retired with the generations that may name it, never with fewer.

use crate::page::format::slot_header::SlotRef;
use crate::page::versions::paged_store::PagedStore;

impl PagedStore {
    /// The version `slot` is no longer its page's. If no committed generation can name it, its slot is free at once,
    /// otherwise after [`PagedStore::commit_done`]. A run that commits nothing never has to wait.
    pub fn free(&mut self, slot: &SlotRef) {
        self.free_from(slot, self.config.generation);
    }

    /// As [`PagedStore::free`]: from generation `from` on, which was cut and is not committed yet, the version is no
    /// longer its page's.
    pub fn free_from(&mut self, slot: &SlotRef, from: u64) {
        let was_in_use = self.slots.retire(slot.place, slot.generation, from);
        debug_assert!(was_in_use, "a slot was freed twice: {slot:?}");
    }

    /// The index as of now is about to be committed as generation [`PagedStore::generation`]: what is written from here
    /// on belongs to the next, unless [`PagedStore::write_for`] says otherwise. Before the commit
    /// [`PagedStore::sync`] is called, after the last of these writes.
    pub fn cut(&mut self) -> u64 {
        self.config.generation += 1;
        self.config.generation - 1
    }

    /// Generation `durable` is committed, and of those before it `pinned` are kept: frees slots that none names.
    pub fn commit_done(&mut self, durable: u64, pinned: &[u64]) -> usize {
        self.slots.release_retired(durable, pinned)
    }

    /// At opening: the version `slot`, in use so far, is one that only generations before `until` name.
    pub fn retire_past(&mut self, slot: &SlotRef, until: u64) {
        let was_in_use = self.slots.retire(slot.place, slot.generation, until);
        debug_assert!(was_in_use, "a slot was retired twice: {slot:?}");
    }
}
