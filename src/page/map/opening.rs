//! Creating and opening a store; its content at opening: the pages of its last generation, and the free slots.
//!
//! The drive holds no list of free slots. A slot is in use if the last generation names it, retired if only another
//! kept generation does, and free otherwise; so no crash can leave a list that disagrees with the map.

use crate::base::ids::PageId;
use crate::page::engine::page_engine::{PageEngine, Place};
use crate::page::engine::segment_files::segment_file_name;
use crate::page::folder::protocol_files::{Folder, MAP_NAME, MAP_NEW_NAME, WITNESS_NAME};
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::{CommitConfig, CommitError, Commits};
use crate::page::map::entries::{MapContent, MapVersion};
use crate::page::map::generations::Generations;
use crate::page::map::manifest::Manifest;
use crate::page::map::witness::Witness;
use crate::page::mutants::{Mutant, active};
use crate::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use crate::page::versions::slots::SlotLayout;
use std::collections::{BTreeMap, BTreeSet};
use std::io;

/// Serial numbers that one opening of the store may use between two commits: opening a later generation starts beyond
/// them. Openings of the same generation, because the earlier ones ended without a commit, start at the same number. So
/// of two versions whose slots name the same generation, the higher serial number may be the older version. The map
/// never relies on serial numbers; only a salvage without a map does.
const SERIALS_PER_LIFE: u64 = 1 << 32;

/// Most segments that an error lists, and most that are created again.
const WRONG_SEGMENTS_LISTED: usize = 8;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredPage {
    pub page: PageId,
    pub slot: SlotRef,
    /// The label, opaque to this layer.
    pub label: Vec<u8>,
    /// The generation that wrote this version.
    pub since: u64,
}

/// A slot that only past generations name.
#[derive(Debug, Clone, Copy)]
struct PastSlots {
    slot: SlotRef,
    until: u64,
}

#[derive(Debug)]
pub struct Opened {
    pub commits: Commits,
    /// Pages of the last generation, ascending by id; empty before the first commit.
    pub pages: Vec<StoredPage>,
    pub run_state: Vec<u8>,
    /// The whole content of the map, for tools; the current pages are in `pages`.
    pub content: MapContent,
    past: Vec<PastSlots>,
}

impl Opened {
    /// Creates an empty store in `folder`, durable when this returns. Overwrites the remains of an interrupted
    /// creation.
    /// Errors: the folder cannot be written, or contains a store already.
    pub fn create(folder: Box<dyn Folder>, config: CommitConfig) -> Result<Opened, CommitError> {
        let (map_error, witness_error) = (CommitError::file(MAP_NAME), CommitError::file(WITNESS_NAME));
        if folder.open(MAP_NAME).map_err(&map_error)?.is_some() {
            let taken = io::Error::new(io::ErrorKind::AlreadyExists, "this folder already contains a store");
            return Err(map_error(taken));
        }
        let witness = folder.create(WITNESS_NAME).and_then(|file| Witness::create(file, config.store));
        witness.map_err(witness_error)?;
        let file = folder.create(MAP_NEW_NAME).map_err(&map_error)?;
        drop(Manifest::create(file, config.store, config.cache_bytes)?);
        // Entries may become durable in any order: first sync all files, then give the map the name that makes them a
        // store.
        let named = sync_entries(folder.as_ref()).and_then(|()| folder.rename(MAP_NEW_NAME, MAP_NAME));
        named.and_then(|()| sync_entries(folder.as_ref())).map_err(map_error)?;
        Opened::open(folder, config)
    }

    /// Opens the store in `folder`: verifies the whole map and finds the last generation. Reads no page data.
    /// Errors: there is no store, it is damaged or older than the last acknowledged commit, or it cannot be read or
    /// written. The files of a refused store stay unchanged.
    pub fn open(folder: Box<dyn Folder>, config: CommitConfig) -> Result<Opened, CommitError> {
        let file = folder.open(MAP_NAME).map_err(CommitError::file(MAP_NAME))?.ok_or(CommitError::NoStore)?;
        let witness_error = CommitError::file(WITNESS_NAME);
        let witness = folder.open(WITNESS_NAME).map_err(&witness_error)?;
        let witness = witness.ok_or_else(|| witness_error(io::ErrorKind::NotFound.into()))?;
        let mut witness = Witness::open(witness, config.store).map_err(&witness_error)?;
        // A killed process may have left folder entries that are not durable; this sync makes them so.
        sync_entries(folder.as_ref()).map_err(CommitError::file("the folder"))?;
        let (manifest, content) = Manifest::open(file, config.store, witness.sequence(), config.cache_bytes)?;
        // A commit that was durable but not yet acknowledged is acknowledged now.
        if witness.sequence() < content.counters.sequence {
            witness.record(content.counters.sequence).map_err(witness_error)?;
        }
        let generations = Generations::of(&content);
        let run_state = match content.counters.latest {
            0 => Vec::new(),
            latest => manifest.run_state(latest)?,
        };
        let commits = Commits { folder, config, manifest: Some(manifest), witness, generations, poison: None };
        let pages = pages_at(&content.versions, content.counters.latest)?;
        let past = past_slots(&content.versions, &pages)?;
        Ok(Opened { commits, pages, run_state, content, past })
    }

    /// Pages of a kept generation, ascending by id.
    /// Errors: the generation is not kept.
    pub fn pages_at(&self, generation: u64) -> Result<Vec<StoredPage>, CommitError> {
        self.commits.check_kept(generation)?;
        pages_at(&self.content.versions, generation)
    }

    /// Checks that the segments with kept pages exist; changes nothing.
    /// Errors: a segment with kept pages is missing or has another length.
    pub fn check_segments(&self, engine: &dyn PageEngine, layout: SlotLayout) -> Result<(), CommitError> {
        let used = self.pages.iter().map(|page| &page.slot).chain(self.past.iter().map(|past| &past.slot));
        check_segments(engine, layout, used).map(drop)
    }

    /// The paged store on an engine that has the segments of this store. Segments that are gone and hold no kept page are created again.
    /// Errors: segments with kept pages are missing or have another length; the map names an impossible slot, or a slot
    /// twice; no space for a segment that is created again.
    pub fn paged_store(
        &self,
        mut engine: Box<dyn PageEngine>,
        layout: SlotLayout,
        codec: Codec,
    ) -> Result<PagedStore, CommitError> {
        let generations = self.commits.generations();
        let serial = (generations.next() + 1).saturating_mul(SERIALS_PER_LIFE);
        let store = self.commits.config().store;
        let config = PagedStoreConfig { store, layout, codec, generation: generations.next(), serial };
        let mut used: Vec<&SlotRef> = self.pages.iter().map(|p| &p.slot).collect();
        if active(Mutant::FreeListMissesOneSlot) {
            used.pop();
        }
        let past: &[PastSlots] = if active(Mutant::FreeListFromLatestOnly) { &[] } else { &self.past };
        used.extend(past.iter().map(|p| &p.slot));
        let Segments { number, unusable } = check_segments(engine.as_ref(), layout, used.iter().copied())?;
        for segment in unusable {
            let made = engine.create_segment(segment, layout.segment_bytes());
            made.map_err(CommitError::file("a segment file"))?;
        }
        let mut paged = PagedStore::open(engine, config, number, used).map_err(CommitError::Contradiction)?;
        for past in past {
            paged.free_from(&past.slot, past.until);
        }
        Ok(paged)
    }
}

fn sync_entries(folder: &dyn Folder) -> io::Result<()> {
    if active(Mutant::FolderNotSyncedForMap) { Ok(()) } else { folder.sync() }
}

pub(in crate::page) struct Segments {
    /// Their number: up to the last one with a kept page.
    pub number: u32,
    /// Those without a kept page that are missing or have another length, ascending.
    pub unusable: Vec<u32>,
}

/// Checks the segments of the `used` slots, and those before them. Stops after a few wrong segments, so that a map naming an
/// absurdly high segment costs neither time nor memory.
/// Errors: a segment of a used slot, or more than a few of the others, are missing or have another length.
pub(in crate::page) fn check_segments<'a>(
    engine: &dyn PageEngine,
    layout: SlotLayout,
    used: impl Iterator<Item = &'a SlotRef>,
) -> Result<Segments, CommitError> {
    let used: BTreeSet<u32> = used.map(|slot| slot.place.segment).collect();
    let Some(&last) = used.last() else { return Ok(Segments { number: 0, unusable: Vec::new() }) };
    let check = |segment: u32| engine.check_segment(segment, layout.segment_bytes()).err().map(|e| (segment, e));
    let few = WRONG_SEGMENTS_LISTED + 1;
    let wrong: Vec<(u32, io::Error)> = used.iter().copied().filter_map(check).take(few).collect();
    if !wrong.is_empty() {
        return Err(wrong_segments(&wrong));
    }
    let wrong: Vec<(u32, io::Error)> =
        (0..last).filter(|segment| !used.contains(segment)).filter_map(check).take(few).collect();
    if wrong.len() == few {
        return Err(wrong_segments(&wrong));
    }
    let number = last.checked_add(1).ok_or_else(|| CommitError::Contradiction(format!("it names segment {last}")))?;
    Ok(Segments { number, unusable: wrong.into_iter().map(|(segment, _)| segment).collect() })
}

fn wrong_segments(wrong: &[(u32, io::Error)]) -> CommitError {
    let listed = wrong.iter().take(WRONG_SEGMENTS_LISTED);
    let listed: Vec<String> =
        listed.map(|(segment, error)| format!("{}: {error}", segment_file_name(*segment))).collect();
    let more = if wrong.len() > WRONG_SEGMENTS_LISTED { "; and more" } else { "" };
    CommitError::Segments(listed.join("; ") + more)
}

/// The pages that `generation` sees in `versions`, which are ordered by page, then generation.
pub(in crate::page) fn pages_at(versions: &[MapVersion], generation: u64) -> Result<Vec<StoredPage>, CommitError> {
    let mut pages = Vec::new();
    for run in versions.chunk_by(|a, b| a.page == b.page) {
        let Some(version) = run.iter().rfind(|v| v.generation <= generation) else { continue };
        if let Some((slot, label)) = slot_and_label(version)? {
            pages.push(StoredPage { page: version.page, slot, label: label.to_vec(), since: version.generation });
        }
    }
    Ok(pages)
}

/// Slots of versions that the last generation does not see, each once.
fn past_slots(versions: &[MapVersion], present: &[StoredPage]) -> Result<Vec<PastSlots>, CommitError> {
    let present: BTreeMap<Place, PageId> = present.iter().map(|p| (p.slot.place, p.page)).collect();
    let mut past: BTreeMap<Place, (PageId, PastSlots)> = BTreeMap::new();
    for pair in versions.windows(2).filter(|pair| pair[0].page == pair[1].page) {
        let (page, until) = (pair[0].page, pair[1].generation);
        let Some((slot, _)) = slot_and_label(&pair[0])? else { continue };
        // A version that differs only in its label shares its slot with the page's next version.
        match (present.get(&slot.place), past.get(&slot.place)) {
            (Some(other), _) | (_, Some((other, _))) if *other != page => {
                let what = format!(
                    "pages {page} and {other} are both at segment {} offset {}",
                    slot.place.segment, slot.place.offset
                );
                return Err(CommitError::Contradiction(what));
            }
            (Some(_), _) => {}
            _ => {
                past.insert(slot.place, (page, PastSlots { slot, until }));
            }
        }
    }
    Ok(past.into_values().map(|(_, past)| past).collect())
}

pub(in crate::page) fn slot_and_label(version: &MapVersion) -> Result<Option<(SlotRef, &[u8])>, CommitError> {
    let Some(value) = &version.value else { return Ok(None) };
    let wrong = || CommitError::Contradiction(format!("the value of page {} cannot be decoded", version.page));
    let (slot, label) = value.split_first_chunk().ok_or_else(wrong)?;
    Ok(Some((SlotRef::from_bytes(slot).ok_or_else(wrong)?, label)))
}
