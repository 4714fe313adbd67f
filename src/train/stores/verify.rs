//! Verifies a store and lists every fault with its page and place.
//!
//! Always checked: the map (checksum of every value, sums over all values, the witness), the state of every kept
//! generation, every entry against its run, the length of every segment, the header of every slot. Deep: checksum,
//! decoding and values of every payload.

use super::{StorePlace, options_of};
use crate::checkpoint::run_state::RunState;
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::CommitError;
use crate::page::tool::reading::{Access, ReadError, StoreReader, WitnessRule};
use crate::paging::stored::{PageLimits, check_values, layout_of};
use crate::train::error::TrainError;
use serde::Serialize;

/// One fault of a store.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Fault {
    /// The faulty part: map, state, segment, entry, header, payload, values.
    pub kind: &'static str,
    pub page: Option<String>,
    /// First generation of the version, or the generation of a state.
    pub generation: Option<u64>,
    /// File in the store's folder.
    pub file: Option<String>,
    /// Offset of the slot in it, bytes.
    pub offset: Option<u64>,
    pub what: String,
}

/// Result of a verification.
#[derive(Debug, Clone, Serialize)]
pub struct Verdict {
    pub store: std::path::PathBuf,
    /// Whether payloads were read.
    pub deep: bool,
    /// Kept generations checked.
    pub generations: u64,
    /// Versions of pages checked.
    pub versions: u64,
    /// Bytes of slots read.
    pub bytes_read: u64,
    /// All faults, in the order map, states, segments, slots by place.
    pub faults: Vec<Fault>,
}

/// Verifies a store.
/// Errors: the folder is not a store, has another format version, is in use, or cannot be read. Damage is not an error
/// here.
pub fn verify(place: &StorePlace, deep: bool) -> Result<Verdict, TrainError> {
    let store = place.folder.clone();
    let mut verdict = Verdict { store, deep, generations: 0, versions: 0, bytes_read: 0, faults: Vec::new() };
    let store = match StoreReader::open(&place.folder, Access::Pages, WitnessRule::Obeyed) {
        Err(ReadError::Commit(error)) => {
            verdict.faults.push(fault_of_map(&error));
            return Ok(verdict);
        }
        store => store?,
    };
    place.check_owner(&store)?;
    let limits = check_states(&store, &mut verdict);
    let versions = match store.live_versions() {
        Err(error) => {
            verdict.faults.push(fault_of_map(&error));
            return Ok(verdict);
        }
        Ok(versions) => versions,
    };
    let slots: Vec<SlotRef> = versions.iter().map(|(_, slot, _)| *slot).collect();
    check_segments(&store, &slots, &mut verdict)?;
    let mut reader = store.slot_reader();
    for (page, slot, label) in versions {
        let mut fault = |kind, what: String| verdict.faults.push(fault_of_slot(kind, &page.to_string(), &slot, what));
        verdict.versions += 1;
        let meta = match limits.map(|(limits, _)| limits.meta_of(page, &slot, &label)).transpose() {
            Ok(meta) => meta,
            Err(what) => {
                fault("entry", what);
                None
            }
        };
        if let Err(what) = reader.check_header(page, &slot) {
            fault("header", what);
            continue;
        }
        if !deep {
            continue;
        }
        verdict.bytes_read += slot.transfer_bytes() as u64;
        match (reader.payload(page, &slot), meta, limits) {
            (Err(what), ..) => fault("payload", what),
            (Ok(payload), Some(meta), Some((_, step))) => {
                if let Err(what) = check_values(&layout_of(&meta).rows(payload, 0), step) {
                    fault("values", what);
                }
            }
            _ => {}
        }
    }
    Ok(verdict)
}

/// Checks every run state; returns the limits and the step of the last one.
fn check_states(store: &StoreReader, verdict: &mut Verdict) -> Option<(PageLimits, u32)> {
    let mut last = None;
    for generation in store.generations().kept() {
        verdict.generations += 1;
        let read = || -> Result<(PageLimits, u32), String> {
            let bytes = store.run_state(generation).map_err(|e| e.to_string())?;
            let state = RunState::from_bytes(&bytes)?;
            let (config, _) = options_of(store.folder(), &state).map_err(|e| e.problem)?;
            let (page_rows, events) = (config.page_rows as usize, state.events.len());
            Ok((PageLimits { page_rows, sh_degree: config.sh_degree, events }, state.trainer.step))
        };
        match read() {
            Ok(limits) => last = Some(limits),
            Err(what) => {
                verdict.faults.push(Fault { kind: "state", generation: Some(generation), what, ..Fault::default() })
            }
        }
    }
    last
}

/// Checks that every segment with slots exists with its full length.
fn check_segments(store: &StoreReader, slots: &[SlotRef], verdict: &mut Verdict) -> Result<(), TrainError> {
    let there = store.segments()?;
    let full = store.format().layout.segment_bytes();
    let mut needed: Vec<u32> = slots.iter().map(|slot| slot.place.segment).collect();
    needed.sort_unstable();
    needed.dedup();
    for segment in needed {
        let bytes = there.iter().find(|(number, _)| *number == segment).map(|(_, bytes)| *bytes);
        let what = match bytes {
            None => "it is missing".to_string(),
            Some(bytes) if bytes != full => format!("it has {bytes} bytes instead of {full}"),
            Some(_) => continue,
        };
        let file = Some(segment_file_name(segment));
        verdict.faults.push(Fault { kind: "segment", file, what, ..Fault::default() });
    }
    Ok(())
}

fn fault_of_map(error: &CommitError) -> Fault {
    let file = match error {
        CommitError::File { name, .. } => name,
        _ => crate::page::map::commit::MAP_NAME,
    };
    // Drop the remedy, which follows the first line.
    let what = error.to_string().lines().next().unwrap_or_default().to_string();
    Fault { kind: "map", file: Some(file.to_string()), what, ..Fault::default() }
}

fn fault_of_slot(kind: &'static str, page: &str, slot: &SlotRef, what: String) -> Fault {
    Fault {
        kind,
        page: Some(page.to_string()),
        generation: Some(slot.generation),
        file: Some(segment_file_name(slot.place.segment)),
        offset: Some(slot.place.offset),
        what,
    }
}
