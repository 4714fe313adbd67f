//! Deliberate mistakes in the commit protocol: the simulator must notice every mutant.

use super::random::{Counts, run_seed};
use gsscale::page::mutants::{Mutant, choose};
use std::panic::{AssertUnwindSafe, catch_unwind};

pub const MUTANTS: &[Mutant] = &[
    Mutant::SegmentsNotSynced,
    Mutant::SegmentsSyncedAfterMap,
    Mutant::SlotsFreedBeforeAcknowledgement,
    Mutant::SlotsFreedAtOnce,
    Mutant::FreeListFromLatestOnly,
    Mutant::FreeListMissesOneSlot,
    Mutant::PinsNotKept,
    Mutant::PreviousNotKept,
    Mutant::EntriesCollectedTooEarly,
    Mutant::EntriesNotCollected,
    Mutant::RemovalNotRecorded,
    Mutant::PayloadNotVerified,
    Mutant::SlotIdentityNotVerified,
    Mutant::SlotGenerationNotVerified,
    Mutant::ShortAccepted,
    Mutant::WriteErrorIgnored,
    Mutant::SyncRetried,
    Mutant::MapCommitRetried,
    Mutant::PoisonIgnored,
    Mutant::FolderNotSyncedForSegment,
    Mutant::FolderNotSyncedForMap,
    Mutant::ValuesNotVerified,
    Mutant::ValuesNotBoundToKeys,
    Mutant::TallyNotVerified,
    Mutant::WitnessIgnored,
    Mutant::WitnessBeforeMap,
    Mutant::WitnessInOneSlot,
    Mutant::MapNotDurable,
    Mutant::CutForgotten,
    Mutant::GenerationsReused,
];

/// Runs seeds with the mutant until it is noticed; returns the number of crashes and the violation.
pub fn hunt(mutant: Mutant, crashes_max: u64) -> Option<(u64, String)> {
    choose(Some(mutant));
    let mut counts = Counts::default();
    let mut found = None;
    for seed in 1 << 40.. {
        // Assertions of the store count as noticing.
        let ran = catch_unwind(AssertUnwindSafe(|| run_seed(seed, &mut counts)));
        let what = match ran {
            Ok(Ok(())) if counts.crashes < crashes_max => continue,
            Ok(Ok(())) => break,
            Ok(Err(what)) => what,
            Err(_) => "an assertion failed".to_string(),
        };
        found = Some((counts.crashes, what));
        break;
    }
    choose(None);
    found
}
