//! Rollback and prune, the two commands that change an existing store, and clone: all kept generations with their names and states, and
//! only the slots that they need. The copy has a new identity, so slots of the two stores cannot be confused; generations keep their numbers.
//!
//! Invariants: 1. rollback and prune hold the lock of the store; each is one transaction of the map and writes no byte of a page; 2. a clone
//! verifies every page while it reads it.

use super::{StorePlace, run_state_of};
use crate::base::error::InputError;
use crate::base::ids::PageId;
use crate::page::engine::open::{IoEngine, open_engine};
use crate::page::engine::segment_files::segment_file_name;
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::{SlotRef, StoredAs};
use crate::page::map::opening::Opened;
use crate::page::tool::new_store::{NewStore, claim_new_store};
use crate::page::tool::reading::{Access, StoreReader, commit_config};
use crate::page::versions::slots::SlotLayout;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Result of a rollback, done or planned.
#[derive(Debug, Clone, Serialize)]
pub struct RolledBack {
    /// The latest generation after the rollback.
    pub generation: u64,
    pub step: u32,
    /// Dropped later generations.
    pub dropped: Vec<u64>,
    pub dropped_names: Vec<String>,
    pub is_done: bool,
}

/// Makes a kept generation the latest again; drops later generations with their names. Without `yes` nothing changes.
/// Errors: the store is in use or cannot be opened, or the generation is not kept.
pub fn rollback(place: &StorePlace, generation: &str, yes: bool) -> Result<RolledBack, TrainError> {
    let (generation, step, dropped, dropped_names, store) = {
        let store = place.open(Access::Pages)?;
        let generation = store.find(Some(generation))?;
        let pins = store.generations().pins().iter();
        let names: Vec<String> = pins.filter(|(_, g)| **g > generation).map(|(name, _)| name.clone()).collect();
        let dropped: Vec<u64> = store.generations().kept().filter(|g| *g > generation).collect();
        (generation, run_state_of(&store, generation)?.trainer.step, dropped, names, store.format().store)
    };
    let is_done = yes && !dropped.is_empty();
    if is_done {
        let spill = open_same(place, store)?;
        let opened = Opened::open(Box::new(DriveFolder::new(&place.folder)), commit_config(spill.format().store))?;
        opened.commits.rollback(generation)?;
    }
    Ok(RolledBack { generation, step, dropped, dropped_names, is_done })
}

/// Opens for writing the store that was read before.
fn open_same(place: &StorePlace, store: u128) -> Result<SpillDir, InputError> {
    let spill = SpillDir::open(&place.folder, true)?;
    if spill.format().store == store {
        return Ok(spill);
    }
    Err(InputError::new(
        &place.folder,
        "another store has replaced this one meanwhile",
        "list its generations with gsscale-ckpt ls",
    ))
}

/// Names to remove.
#[derive(Debug, Clone, Default)]
pub struct PruneRequest {
    pub names: Vec<String>,
    /// All names except those of this many newest named generations.
    pub keep: Option<usize>,
    /// Only report, change nothing.
    pub dry_run: bool,
}

/// Result of a prune, done or planned.
#[derive(Debug, Clone, Serialize)]
pub struct Pruned {
    pub dropped_names: Vec<String>,
    /// Generations that are no longer kept.
    pub dropped: Vec<u64>,
    pub kept: Vec<u64>,
    /// Bytes of freed slots, which the run can reuse; the segment files keep their length.
    pub bytes_freed: u64,
    pub is_done: bool,
}

/// Removes names and frees the generations that only these names kept. The last two generations always stay.
/// Errors: the store is in use or cannot be opened, or a name does not exist.
pub fn prune(place: &StorePlace, request: &PruneRequest) -> Result<Pruned, TrainError> {
    let before = place.open(Access::Pages)?;
    let pins = before.generations().pins();
    if let Some(unknown) = request.names.iter().find(|name| !pins.contains_key(*name)) {
        let names: Vec<&str> = pins.keys().map(String::as_str).collect();
        let names = if names.is_empty() { "none".to_string() } else { names.join(", ") };
        let problem = format!("no checkpoint is named '{unknown}'");
        return Err(InputError::new(&place.folder, problem, format!("use one of: {names}")).into());
    }
    let mut dropped_names = request.names.clone();
    if let Some(keep) = request.keep {
        let mut named: Vec<u64> = pins.values().copied().collect();
        named.sort_unstable();
        named.dedup();
        let gone = &named[..named.len().saturating_sub(keep)];
        dropped_names.extend(pins.iter().filter(|(_, g)| gone.contains(g)).map(|(name, _)| name.clone()));
    }
    dropped_names.sort_unstable();
    dropped_names.dedup();
    let plan = before.generations().plan_pins(&[], &dropped_names);
    let kept: Vec<u64> = before.generations().kept().filter(|g| !plan.drop_generations.contains(g)).collect();
    let bytes_of = |store: &StoreReader| -> Result<u64, TrainError> {
        Ok(store.live_versions()?.iter().map(|(_, slot, _)| slot.transfer_bytes() as u64).sum())
    };
    let (bytes_before, dropped) = (bytes_of(&before)?, plan.drop_generations);
    let is_done = !request.dry_run && !dropped_names.is_empty();
    let mut bytes_freed = 0;
    if is_done {
        // The reader's lock excludes every writer, also this process's own, so drop it first.
        let store = before.format().store;
        drop(before);
        write_pins(place, store, &dropped_names)?;
        let after = place.open(Access::Pages)?;
        bytes_freed = bytes_before - bytes_of(&after)?;
    }
    Ok(Pruned { dropped_names, dropped, kept, bytes_freed, is_done })
}

fn write_pins(place: &StorePlace, store: u128, dropped_names: &[String]) -> Result<(), TrainError> {
    let spill = open_same(place, store)?;
    let mut opened = Opened::open(Box::new(DriveFolder::new(&place.folder)), commit_config(spill.format().store))?;
    let engine = open_engine(IoEngine::Pread, &place.folder, 1)?;
    let mut store = opened.paged_store(engine.store, spill.format().layout, Codec::Raw)?;
    opened.commits.pin(&mut store, &[], dropped_names)?;
    Ok(())
}

/// Result of a copy.
#[derive(Debug, Clone, Serialize)]
pub struct ClonedStore {
    /// The new folder.
    pub to: PathBuf,
    /// Numbers of the generations.
    pub generations: Vec<u64>,
    /// Versions of pages.
    pub versions: u64,
    pub bytes_read: u64,
}

/// Copies a store to the folder `to`, which does not exist.
/// Errors: the store is in use or damaged (the error names the page), or `to` cannot be written. No store is left at
/// `to` then.
pub fn clone_store(place: &StorePlace, to: &Path, stop: &StopFlag) -> Result<ClonedStore, TrainError> {
    claim_new_store(to)?;
    let store = place.open(Access::Pages)?;
    store.find(None)?;
    let live = store.live_versions()?;
    let codec = usual_codec(live.iter().map(|(_, slot, _)| slot));
    let mut copy = NewStore::create(to, layout_for(store.format().layout, live.len() as u64), codec)?;
    let mut reader = store.slot_reader();
    let (mut versions, mut bytes_read) = (0, 0);
    let mut before: BTreeMap<PageId, (SlotRef, Vec<u8>)> = BTreeMap::new();
    let generations: Vec<u64> = store.generations().kept().collect();
    for &generation in &generations {
        let mut now = BTreeMap::new();
        copy.skip_to(generation);
        for page in store.pages_at(generation)? {
            let version = (page.slot, page.label);
            let is_same = before.remove(&page.page).as_ref() == Some(&version);
            let (slot, label) = now.entry(page.page).insert_entry(version).into_mut();
            if is_same {
                continue;
            }
            stop.check()?;
            let payload = reader.payload(page.page, slot).map_err(|what| damaged(place, page.page, slot, &what))?;
            copy.put(page.page, label, payload)?;
            (versions, bytes_read) = (versions + 1, bytes_read + slot.transfer_bytes() as u64);
        }
        before.into_keys().for_each(|page| copy.remove(page));
        before = now;
        copy.commit(&store.run_state(generation)?, store.note(generation), &store.generations().names_of(generation))?;
    }
    copy.finish()?;
    Ok(ClonedStore { to: to.to_path_buf(), generations, versions, bytes_read })
}

/// The codec of most pages, for new pages.
pub(super) fn usual_codec<'a>(slots: impl Iterator<Item = &'a SlotRef>) -> Codec {
    let mut counts = [0u64; StoredAs::ALL.len()];
    slots.for_each(|slot| counts[slot.codec as usize] += 1);
    // Of equal counts the last in this order, which is the first form.
    StoredAs::ALL.into_iter().rev().max_by_key(|form| counts[*form as usize]).map_or(Codec::Raw, Codec::from)
}

fn damaged(place: &StorePlace, page: PageId, slot: &SlotRef, what: &str) -> InputError {
    let remedy =
        "gsscale-ckpt verify --deep lists all that is damaged; roll back to a generation without it, or salvage";
    InputError::new(place.folder.join(segment_file_name(slot.place.segment)), format!("page {page}: {what}"), remedy)
        .at(format!("offset {}", slot.place.offset))
}

/// The layout with segments sized for `slots` slots.
pub(super) fn layout_for(layout: SlotLayout, slots: u64) -> SlotLayout {
    let most = u64::from(layout.slots_per_segment);
    SlotLayout { slots_per_segment: slots.clamp(1, most) as u32, ..layout }
}
