//! Deliberate mistakes of the commit protocol, switched on by the crash tests to prove that the tests would notice them.
//!
//! Builds without debug assertions, which users run, know no mutant: [`active`] is `false` there at compile time.
//! Invariant: a mutant is active on the thread that chose it only, and nowhere by default.

/// One mistake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mutant {
    /// The map is committed before the segments are synced.
    SegmentsNotSynced,
    /// Segments are synced only after the map's commit.
    SegmentsSyncedAfterMap,
    /// Slots of superseded versions become free before the map's commit.
    SlotsFreedBeforeAcknowledgement,
    /// Slots of superseded versions become free at once, whichever generations are kept.
    SlotsFreedAtOnce,
    /// The free list at opening is what the latest generation does not name.
    FreeListFromLatestOnly,
    /// The free list at opening forgets one slot of the latest generation.
    FreeListMissesOneSlot,
    /// Pinned generations do not keep their slots.
    PinsNotKept,
    /// Only the latest generation is kept, not the one before it.
    PreviousNotKept,
    /// Map entries of a version go while a kept generation still needs them.
    EntriesCollectedTooEarly,
    /// Map entries of superseded versions stay although their slots become free.
    EntriesNotCollected,
    /// A page that was removed leaves no mark.
    RemovalNotRecorded,
    /// Payload checksums of pages are not verified.
    PayloadNotVerified,
    /// A slot with any good header and checksum is taken for the page that the map says is there.
    SlotIdentityNotVerified,
    /// A slot of the right page and place is taken for the right version.
    SlotGenerationNotVerified,
    /// A transfer of fewer bytes than asked for counts as done.
    ShortAccepted,
    /// A failed write does not poison the store.
    WriteErrorIgnored,
    /// A failed sync of segments is tried again and its second answer believed.
    SyncRetried,
    /// A failed transaction of the map is tried again.
    MapCommitRetried,
    /// The store goes on after it was poisoned.
    PoisonIgnored,
    /// The folder is not synced after a segment was created.
    FolderNotSyncedForSegment,
    /// The folder is not synced after the store was created.
    FolderNotSyncedForMap,
    /// Checksums of map values are not verified.
    ValuesNotVerified,
    /// Checksums of map values are not bound to their keys.
    ValuesNotBoundToKeys,
    /// The map's sums over all its entries are not compared.
    TallyNotVerified,
    /// An older map than the acknowledged one is opened without a word.
    WitnessIgnored,
    /// The witness is written before the map's commit.
    WitnessBeforeMap,
    /// The witness is one slot, overwritten in place.
    WitnessInOneSlot,
    /// The transaction of the map is not durable when it returns.
    MapNotDurable,
    /// What is written after a cut for the generation that was cut counts as the next one's.
    CutForgotten,
    /// Generation numbers start again after a rollback.
    GenerationsReused,
}

#[cfg(debug_assertions)]
mod switch {
    use super::Mutant;
    use std::cell::Cell;

    thread_local! {
        static CHOSEN: Cell<Option<Mutant>> = const { Cell::new(None) };
    }

    /// Whether `mutant` was chosen on this thread.
    pub fn active(mutant: Mutant) -> bool {
        CHOSEN.get() == Some(mutant)
    }

    /// Chooses the mutant of this thread.
    pub fn choose(mutant: Option<Mutant>) {
        CHOSEN.set(mutant);
    }
}

#[cfg(not(debug_assertions))]
mod switch {
    use super::Mutant;

    /// No mutant is ever active in builds that users run.
    pub const fn active(_mutant: Mutant) -> bool {
        false
    }

    /// Builds that users run have no mutants to choose from.
    pub fn choose(_mutant: Option<Mutant>) {}
}

pub use switch::{active, choose};
