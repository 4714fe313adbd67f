//! Generations of a store: which one is being written, and when slots of past versions become free.
//!
//! A cut ends a generation. Versions of the ended generation may still be written after the cut, by its number, beside
//! versions of the next one.
//!
//! Invariant: a retired slot keeps the whole range of generations that may name it.

use crate::page::format::slot_header::SlotRef;
use crate::page::versions::paged_store::PagedStore;

impl PagedStore {
    /// Version `slot` is superseded. If no committed generation can name it, its slot is free at once, otherwise after
    /// [`PagedStore::commit_done`]. A run without commits thus frees every slot at once.
    pub fn free(&mut self, slot: &SlotRef) {
        self.free_from(slot, self.config.generation);
    }

    /// As [`PagedStore::free`], but superseded from generation `from` on: one that is cut and not committed yet, or, at
    /// opening, one of the past.
    pub fn free_from(&mut self, slot: &SlotRef, from: u64) {
        let was_in_use = self.slots.retire(slot.place, slot.generation, from);
        debug_assert!(was_in_use, "a slot was freed twice: {slot:?}");
    }

    /// Ends generation [`PagedStore::generation`], which is about to be committed from the present index: later writes
    /// belong to the next generation, unless [`PagedStore::write_for`] names the ended one. [`PagedStore::sync`] must
    /// follow the last write of the generation and precede the commit.
    pub fn cut(&mut self) -> u64 {
        self.config.generation += 1;
        self.config.generation - 1
    }

    /// Acknowledges the commit of generation `durable`; of the earlier ones `pinned` are kept. Frees the slots that
    /// none of these names; returns how many.
    pub fn commit_done(&mut self, durable: u64, pinned: &[u64]) -> usize {
        self.slots.release_retired(durable, pinned)
    }
}
