//! The state of every slot: free, in use, or retired until a later commit.
//!
//! Bookkeeping without I/O. Slots are numbered across all segments; each segment holds the same number of slots.
//!
//! Invariants: 1. a slot whose version a durable or pinned generation may name is never handed out: [`Slots::retire`]
//! keeps it until [`Slots::release_retired`] learns that no such generation is left; 2. the lowest free slot is handed
//! out first, so that an import fills the segments front to back; 3. every slot is exactly one of free, in use and
//! retired.

use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::Place;
use crate::page::format::slot_header::{HEADER_BYTES, transfer_bytes};
use std::collections::BTreeSet;

/// Target size of a segment, bytes; segments of small scenes are smaller.
const SEGMENT_BYTES: u64 = 256 << 20;
/// Largest slot, bytes: the length of a payload is a 32-bit number.
const SLOT_BYTES_MAX: u64 = HEADER_BYTES as u64 + (1 << 32);
/// Target number of segments of a scene: each costs a file descriptor.
const SEGMENTS: u64 = 64;

/// Sizes that are fixed for the life of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotLayout {
    /// Bytes of a slot; a multiple of [`ALIGNMENT`].
    pub slot_bytes: u64,
    /// Slots in a segment, at least 1.
    pub slots_per_segment: u32,
}

impl SlotLayout {
    /// Slots for payloads of at most `capacity_bytes`, in segments that suit a scene of about `pages` pages: about 256
    /// MiB, less for a smaller scene, more where a scene would need too many files.
    pub fn new(capacity_bytes: usize, pages: u64) -> SlotLayout {
        let slot_bytes = transfer_bytes(capacity_bytes) as u64;
        let usual = (SEGMENT_BYTES / slot_bytes).min(pages);
        let slots = usual.max(pages / SEGMENTS).clamp(1, u64::from(u32::MAX));
        SlotLayout { slot_bytes, slots_per_segment: slots as u32 }
    }

    /// Bytes of a segment.
    pub fn segment_bytes(&self) -> u64 {
        self.slot_bytes * u64::from(self.slots_per_segment)
    }

    /// Place of slot number `slot`.
    pub fn place(&self, slot: u64) -> Place {
        let per = u64::from(self.slots_per_segment);
        Place { segment: (slot / per) as u32, offset: slot % per * self.slot_bytes }
    }

    /// Number of the slot at `place`; `None` if no slot starts there.
    pub fn slot(&self, place: Place) -> Option<u64> {
        let begins = place.offset.is_multiple_of(self.slot_bytes) && place.offset < self.segment_bytes();
        begins.then(|| u64::from(place.segment) * u64::from(self.slots_per_segment) + place.offset / self.slot_bytes)
    }

    /// Whether a store can have these sizes: aligned, not empty, no larger than the longest payload, segments
    /// addressable.
    pub fn is_possible(&self) -> bool {
        self.slot_bytes > ALIGNMENT as u64
            && self.slot_bytes <= SLOT_BYTES_MAX
            && self.slot_bytes.is_multiple_of(ALIGNMENT as u64)
            && self.slots_per_segment > 0
            && self.slot_bytes.checked_mul(u64::from(self.slots_per_segment)).is_some_and(|b| b <= i64::MAX as u64)
    }
}

/// State of a slot.
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

/// The slots of a store.
#[derive(Debug)]
pub struct Slots {
    layout: SlotLayout,
    states: Vec<SlotState>,
    free: BTreeSet<u64>,
    retired: Vec<Retired>,
}

/// Why slots cannot be as an index states.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SlotError {
    /// No slot starts there, or the segment does not exist.
    #[error("the index names segment {} offset {}, where there is no slot", .0.segment, .0.offset)]
    NoSlot(Place),
    /// Two versions name the same slot.
    #[error("the index names the slot at segment {} offset {} twice", .0.segment, .0.offset)]
    Twice(Place),
}

impl Slots {
    /// Slots of a store without segments.
    pub fn new(layout: SlotLayout) -> Slots {
        Slots { layout, states: Vec::new(), free: BTreeSet::new(), retired: Vec::new() }
    }

    /// The slots of `segments` existing segments; exactly the places in `used` are in use.
    ///
    /// # Errors
    /// A place is not a slot, or is named twice.
    pub fn with_used(
        layout: SlotLayout,
        segments: u32,
        used: impl IntoIterator<Item = Place>,
    ) -> Result<Slots, SlotError> {
        let mut slots = Slots::new(layout);
        (0..segments).for_each(|_| slots.add_segment());
        for place in used {
            slots.mark_used(place)?;
        }
        Ok(slots)
    }

    /// At opening, marks a free slot as in use because the index of the current or of a pinned generation names it.
    /// [`Slots::retire`] then retires past versions.
    ///
    /// # Errors
    /// The place is not a slot, or is named twice.
    pub fn mark_used(&mut self, place: Place) -> Result<(), SlotError> {
        let slot = self.number(place).ok_or(SlotError::NoSlot(place))?;
        if !self.free.remove(&slot) {
            return Err(SlotError::Twice(place));
        }
        self.states[slot as usize] = SlotState::InUse;
        Ok(())
    }

    /// The sizes of slots and segments.
    pub fn layout(&self) -> SlotLayout {
        self.layout
    }

    /// Number of segments.
    pub fn segments(&self) -> u32 {
        (self.states.len() / self.layout.slots_per_segment as usize) as u32
    }

    /// Number of slots.
    pub fn total(&self) -> u64 {
        self.states.len() as u64
    }

    /// Number of free slots.
    pub fn free(&self) -> u64 {
        self.free.len() as u64
    }

    /// Number of retired slots.
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
#[allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn layout(slots_per_segment: u32) -> SlotLayout {
        SlotLayout { slot_bytes: 8192, slots_per_segment }
    }

    #[test]
    fn segments_fit_the_scene() {
        let capacity = 745_472;
        let small = SlotLayout::new(capacity, 10);
        assert_eq!((small.slots_per_segment, small.slot_bytes), (10, 4096 + 745_472));
        let usual = SlotLayout::new(capacity, 20_000);
        assert!(usual.segment_bytes() <= 256 << 20 && usual.segment_bytes() > 255 << 20);
        let huge = SlotLayout::new(capacity, 1_000_000);
        assert!(1_000_000_u64.div_ceil(u64::from(huge.slots_per_segment)) <= SEGMENTS + 1);
        assert_eq!(SlotLayout::new(1, 0).slots_per_segment, 1);
        for layout in [small, usual, huge] {
            assert!(layout.is_possible());
            for slot in [0, 1, 349, 350, 999_999] {
                assert_eq!(layout.slot(layout.place(slot)), Some(slot));
            }
        }
        assert_eq!(usual.slot(Place { segment: 0, offset: 4096 }), None);
        assert_eq!(usual.slot(Place { segment: 0, offset: usual.segment_bytes() }), None);
        let largest = SlotLayout { slot_bytes: SLOT_BYTES_MAX, slots_per_segment: 1 };
        assert!(largest.is_possible() && largest.slot_bytes == transfer_bytes(u32::MAX as usize) as u64);
        let wrong = [(0, 1), (4096, 1), (8193, 1), (8192, 0), (1 << 62, 4), (1 << 62, 1), (SLOT_BYTES_MAX + 4096, 1)];
        assert!(wrong.iter().all(|&(slot_bytes, n)| !SlotLayout { slot_bytes, slots_per_segment: n }.is_possible()));
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
        assert_eq!(error(&[place(0, 0), place(0, 0)]), SlotError::Twice(place(0, 0)));
        for wrong in [place(2, 0), place(0, 4096), place(0, 16384), place(u32::MAX, u64::MAX - 4095)] {
            assert_eq!(error(&[wrong]), SlotError::NoSlot(wrong));
        }
    }

    /// A simple model: for every kept generation, the places it names.
    #[derive(Default)]
    struct Model {
        /// Place, and generation of the write.
        present: BTreeMap<u8, (Place, u64)>,
        /// Committed generations that are kept, with their places.
        kept: BTreeMap<u64, Vec<Place>>,
        pinned: Vec<u64>,
        generation: u64,
        durable: u64,
    }

    /// All sequences of seven operations on two pages: rewrite a page, cut and acknowledge a commit (with and without a
    /// pin, with a write between cut and acknowledgement), drop the pins. After each operation, no place that a kept
    /// generation names was handed out, and the three states add up.
    #[test]
    fn no_sequence_of_operations_hands_out_a_named_slot() {
        const OPERATIONS: u32 = 6;
        const LENGTH: u32 = 7;
        for code in 0..OPERATIONS.pow(LENGTH) {
            let mut slots = Slots::new(layout(1));
            let mut model = Model { generation: 1, ..Model::default() };
            let mut rest = code;
            for _ in 0..LENGTH {
                match rest % OPERATIONS {
                    0 => write(&mut slots, &mut model, 0),
                    1 => write(&mut slots, &mut model, 1),
                    2 => commit(&mut slots, &mut model, false, None),
                    3 => commit(&mut slots, &mut model, true, None),
                    4 => commit(&mut slots, &mut model, false, Some(0)),
                    _ => drop_pins(&mut slots, &mut model),
                }
                rest /= OPERATIONS;
                let used = slots.total() - slots.free() - slots.retired();
                assert_eq!(used, model.present.len() as u64, "sequence {code}");
                for place in model.kept.values().flatten() {
                    assert_ne!(slots.state(*place), Some(SlotState::Free), "sequence {code}");
                }
            }
            drop_pins(&mut slots, &mut model);
            commit(&mut slots, &mut model, false, None);
            assert_eq!(slots.retired(), 0, "sequence {code}: slots have leaked");
        }
    }

    fn write(slots: &mut Slots, model: &mut Model, page: u8) {
        let place = slots.allocate().unwrap_or_else(|| {
            slots.add_segment();
            slots.allocate().unwrap()
        });
        assert!(model.kept.values().flatten().all(|p| *p != place), "a named slot was handed out");
        if let Some((old, written)) = model.present.insert(page, (place, model.generation)) {
            assert!(slots.retire(old, written, model.generation));
        }
    }

    fn commit(slots: &mut Slots, model: &mut Model, pin: bool, write_meanwhile: Option<u8>) {
        let cut = model.generation;
        // From the cut on, the generation being committed counts as naming its places.
        model.kept.insert(cut, model.present.values().map(|p| p.0).collect());
        model.generation += 1;
        if let Some(page) = write_meanwhile {
            write(slots, model, page);
        }
        let last = std::mem::replace(&mut model.durable, cut);
        if !model.pinned.contains(&last) {
            model.kept.remove(&last);
        }
        if pin {
            model.pinned.push(cut);
        }
        slots.release_retired(cut, &model.pinned);
    }

    fn drop_pins(slots: &mut Slots, model: &mut Model) {
        model.pinned.clear();
        let durable = model.durable;
        model.kept.retain(|generation, _| *generation == durable);
        slots.release_retired(durable, &[]);
    }
}
