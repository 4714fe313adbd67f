//! The state of every slot: free, in use, or retired until a later commit.
//!
//! Bookkeeping without I/O. Slots are numbered across all segments; each segment holds the same number of slots.
//!
//! Invariants: 1. a slot whose version a durable or pinned generation may name is never handed out: [`Slots::retire`]
//! keeps it until [`Slots::release_retired`] learns that no such generation is left; 2. the lowest free slot is handed
//! out first, so that an import fills the segments front to back; 3. every slot is exactly one of free, in use and
//! retired.

use crate::page::engine::page_engine::Place;
pub use crate::page::format::spill_format::SlotLayout;
use std::collections::BTreeSet;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SlotState {
    /// May be handed out.
    Free,
    /// Holds the current version of a page, or is being written.
    InUse,
    /// Holds a past version that a durable or pinned generation may name.
    Retired,
}

/// A past version, which generations `written..retired` may name.
#[derive(Debug, Clone, Copy)]
struct Retired {
    slot: u64,
    written: u64,
    retired: u64,
}

#[derive(Debug)]
pub struct Slots {
    layout: SlotLayout,
    states: Vec<SlotState>,
    free: BTreeSet<u64>,
    retired: Vec<Retired>,
}

impl Slots {
    /// Slots of a store without segments.
    pub fn new(layout: SlotLayout) -> Slots {
        Slots { layout, states: Vec::new(), free: BTreeSet::new(), retired: Vec::new() }
    }

    /// The slots of `segments` existing segments; exactly the places in `used` are in use.
    /// Errors: a place is not a slot, or is named twice.
    pub fn with_used(
        layout: SlotLayout,
        segments: u32,
        used: impl IntoIterator<Item = Place>,
    ) -> Result<Slots, String> {
        let mut slots = Slots::new(layout);
        (0..segments).for_each(|_| slots.add_segment());
        for place in used {
            let Place { segment, offset } = place;
            let none = || format!("the index names segment {segment} offset {offset}, where there is no slot");
            let slot = slots.number(place).ok_or_else(none)?;
            if !slots.free.remove(&slot) {
                return Err(format!("the index names the slot at segment {segment} offset {offset} twice"));
            }
            slots.states[slot as usize] = SlotState::InUse;
        }
        Ok(slots)
    }

    /// The sizes of slots and segments.
    pub fn layout(&self) -> SlotLayout {
        self.layout
    }

    pub fn segments(&self) -> u32 {
        (self.states.len() / self.layout.slots_per_segment as usize) as u32
    }

    pub fn total(&self) -> u64 {
        self.states.len() as u64
    }

    pub fn free(&self) -> u64 {
        self.free.len() as u64
    }

    pub fn retired(&self) -> u64 {
        self.retired.len() as u64
    }

    /// State of the slot at `place`; `None` if no slot starts there.
    pub fn state(&self, place: Place) -> Option<SlotState> {
        self.number(place).map(|slot| self.states[slot as usize])
    }

    /// Takes the lowest free slot; `None` if another segment is needed.
    pub fn allocate(&mut self) -> Option<Place> {
        let slot = self.free.pop_first()?;
        self.states[slot as usize] = SlotState::InUse;
        Some(self.layout.place(slot))
    }

    /// Adds the slots of the next segment, number [`Slots::segments`], which must exist by now.
    pub fn add_segment(&mut self) {
        let first = self.states.len() as u64;
        self.states.resize(self.states.len() + self.layout.slots_per_segment as usize, SlotState::Free);
        self.free.extend(first..self.states.len() as u64);
    }

    /// Frees a slot that no generation names. Returns whether it was in use.
    pub fn release(&mut self, place: Place) -> bool {
        let Some(slot) = self.in_use(place) else { return false };
        self.states[slot as usize] = SlotState::Free;
        self.free.insert(slot);
        true
    }

    /// Retires the version that was written for generation `written` and superseded in generation `retired`: its slot
    /// is freed when no durable or pinned generation between the two is left. A version that no generation can have
    /// named (`written == retired`) is freed at once. Returns whether the slot was in use.
    pub fn retire(&mut self, place: Place, written: u64, retired: u64) -> bool {
        if written >= retired {
            return self.release(place);
        }
        let Some(slot) = self.in_use(place) else { return false };
        self.states[slot as usize] = SlotState::Retired;
        self.retired.push(Retired { slot, written, retired });
        true
    }

    /// Frees the retired slots that neither generation `durable`, now committed, nor the earlier generations `pinned`
    /// name. Returns how many.
    pub fn release_retired(&mut self, durable: u64, pinned: &[u64]) -> usize {
        let before = self.retired.len();
        let (states, free) = (&mut self.states, &mut self.free);
        self.retired.retain(|r| {
            let named = r.retired > durable || pinned.iter().any(|p| (r.written..r.retired).contains(p));
            if !named {
                states[r.slot as usize] = SlotState::Free;
                free.insert(r.slot);
            }
            named
        });
        before - self.retired.len()
    }

    fn number(&self, place: Place) -> Option<u64> {
        self.layout.slot(place).filter(|&slot| slot < self.total())
    }

    fn in_use(&self, place: Place) -> Option<u64> {
        self.number(place).filter(|&slot| self.states[slot as usize] == SlotState::InUse)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(slots_per_segment: u32) -> SlotLayout {
        SlotLayout { slot_bytes: 8192, slots_per_segment }
    }

    #[test]
    fn the_lowest_free_slot_is_first() {
        let mut slots = Slots::new(layout(2));
        assert_eq!(slots.allocate(), None);
        slots.add_segment();
        slots.add_segment();
        let places: Vec<Place> = (0..4).filter_map(|_| slots.allocate()).collect();
        assert!(places.is_sorted() && places.len() == 4 && slots.allocate().is_none());
        assert!(slots.release(places[2]) && slots.release(places[1]));
        assert!(!slots.release(places[1]), "freed twice");
        assert_eq!((slots.allocate(), slots.allocate()), (Some(places[1]), Some(places[2])));
    }

    #[test]
    fn an_impossible_index_is_refused() {
        let place = |segment, offset| Place { segment, offset };
        let slots = Slots::with_used(layout(2), 2, [place(1, 0), place(0, 8192)]).unwrap();
        assert_eq!((slots.total(), slots.free()), (4, 2));
        assert_eq!(slots.state(place(1, 0)), Some(SlotState::InUse));
        let error = |used: &[Place]| Slots::with_used(layout(2), 2, used.iter().copied()).unwrap_err();
        assert!(error(&[place(0, 0), place(0, 0)]).contains("twice"));
        for wrong in [place(2, 0), place(0, 4096), place(0, 16384), place(u32::MAX, u64::MAX - 4095)] {
            assert!(error(&[wrong]).contains("no slot"), "{wrong:?}");
        }
    }
}
