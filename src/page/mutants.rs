//! Deliberate bugs in the commit protocol, switched on by the crash tests to prove that the tests detect them.
//!
//! Builds without debug assertions, which users run, have no mutants: [`active`] is `false` there at compile time.
//! Invariant: a mutant is active only on the thread that chose it, and nowhere by default.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mutant {
    /// The map is committed before the segments are synced.
    SegmentsNotSynced,
    /// Segments are synced only after the map's commit.
    SegmentsSyncedAfterMap,
    /// Slots of superseded versions become free before the map's commit.
    SlotsFreedBeforeAcknowledgement,
    /// Slots of superseded versions become free at once, whatever generations are kept.
    SlotsFreedAtOnce,
    /// At opening, every slot that the latest generation does not name is free.
    FreeListFromLatestOnly,
    /// At opening, one slot of the latest generation is free.
    FreeListMissesOneSlot,
    /// Pinned generations do not keep their slots.
    PinsNotKept,
    /// Only the latest generation is kept, not the one before it.
    PreviousNotKept,
    /// Map entries of a version are removed while a kept generation needs them.
    EntriesCollectedTooEarly,
    /// Map entries of superseded versions stay although their slots become free.
    EntriesNotCollected,
    /// Removing a page records no entry.
    RemovalNotRecorded,
    /// Payload checksums of pages are not verified.
    PayloadNotVerified,
    /// A slot with any valid header and checksum passes for the page that the map names.
    SlotIdentityNotVerified,
    /// A slot of the right page and place passes for the right version.
    SlotGenerationNotVerified,
    /// A partial transfer counts as complete.
    ShortAccepted,
    /// A failed write does not poison the store.
    WriteErrorIgnored,
    /// A failed sync of segments is repeated, and the second result is trusted.
    SyncRetried,
    /// A failed transaction of the map is repeated.
    MapCommitRetried,
    /// A poisoned store continues.
    PoisonIgnored,
    /// The folder is not synced after a segment was created.
    FolderNotSyncedForSegment,
    /// The folder is not synced after the store was created.
    FolderNotSyncedForMap,
    /// Checksums of map values are not verified.
    ValuesNotVerified,
    /// Checksums of map values are not bound to their keys.
    ValuesNotBoundToKeys,
    /// The map's sums over all entries are not compared.
    TallyNotVerified,
    /// A map older than the acknowledged one opens without an error.
    WitnessIgnored,
    /// The witness is written before the map's commit.
    WitnessBeforeMap,
    /// The witness is one slot, overwritten in place.
    WitnessInOneSlot,
    /// The transaction of the map is not durable when it returns.
    MapNotDurable,
    /// Writes after a cut for the generation that was cut count as the next one's.
    CutForgotten,
    /// A rollback resets the generation numbers.
    GenerationsReused,
}

#[cfg(debug_assertions)]
mod switch {
    use super::Mutant;
    use std::cell::Cell;

    thread_local! {
        static CHOSEN: Cell<Option<Mutant>> = const { Cell::new(None) };
    }

    /// Whether `mutant` is active on this thread.
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
