//! Copies a store: all kept generations with their names and states, and only the slots that they need.
//!
//! Every page is verified while it is read. The copy has a new identity, so slots of the two stores cannot be confused;
//! generations keep their numbers.

use super::StorePlace;
use crate::base::error::InputError;
use crate::base::ids::PageId;
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::SlotRef;
use crate::page::tool::new_store::{NewStore, refuse_existing};
use crate::page::tool::reading::Access;
use crate::page::versions::slots::SlotLayout;
use crate::train::error::TrainError;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Result of a copy.
#[derive(Debug, Clone, Serialize)]
pub struct Copied {
    /// The new folder.
    pub to: PathBuf,
    /// Numbers of the generations.
    pub generations: Vec<u64>,
    /// Versions of pages.
    pub versions: u64,
    /// Bytes of slots read.
    pub bytes_read: u64,
}

/// Copies a store to the folder `to`, which does not exist.
/// Errors: the store is in use or damaged (the error names the page), or `to` cannot be written. No store is left at
/// `to` then.
pub fn clone_store(place: &StorePlace, to: &Path) -> Result<Copied, TrainError> {
    refuse_existing(to)?;
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
            let payload = reader.payload(page.page, slot).map_err(|what| damaged(place, page.page, slot, &what))?;
            copy.put(page.page, label, payload)?;
            (versions, bytes_read) = (versions + 1, bytes_read + slot.transfer_bytes() as u64);
        }
        before.into_keys().for_each(|page| copy.remove(page));
        before = now;
        copy.commit(&store.run_state(generation)?, store.note(generation), &store.generations().names_of(generation))?;
    }
    copy.finish()?;
    Ok(Copied { to: to.to_path_buf(), generations, versions, bytes_read })
}

/// The codec of most pages, for new pages.
pub(super) fn usual_codec<'a>(slots: impl Iterator<Item = &'a SlotRef>) -> Codec {
    let mut counts = [0u64; 3];
    slots.for_each(|slot| counts[slot.codec as usize] += 1);
    match counts {
        [raw, zstd, halves] if zstd > raw && zstd >= halves => Codec::Zstd { level: 1 },
        [raw, _, halves] if halves > raw => Codec::Halves,
        _ => Codec::Raw,
    }
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
