//! The content of a store at opening: the pages of its last generation, and the free slots.
//!
//! The drive holds no list of free slots. A slot is in use if the last generation names it, retired if only another
//! kept generation does, and free otherwise; so no crash can leave a list that disagrees with the map.

use crate::base::ids::PageId;
use crate::page::engine::page_engine::{PageEngine, Place};
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::SlotRef;
use crate::page::map::commit::{CommitError, Commits};
use crate::page::map::manifest::{MapContent, MapVersion};
use crate::page::map::mutants::{Mutant, active};
use crate::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use crate::page::versions::slots::SlotLayout;
use std::collections::BTreeMap;

/// Serial numbers that one opening of the store may use between two commits: opening a later generation starts beyond
/// them. Openings of the same generation, because the earlier ones ended without a commit, start at the same number. So
/// of two versions whose slots name the same generation, the higher serial number may be the older version. The map
/// never relies on serial numbers; only a salvage without a map does.
const SERIALS_PER_LIFE: u64 = 1 << 32;

/// Most segments that an error lists.
const WRONG_SEGMENTS_LISTED: usize = 8;

/// A page of a generation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredPage {
    /// The page.
    pub page: PageId,
    /// Its slot.
    pub slot: SlotRef,
    /// The label, opaque to this layer.
    pub label: Vec<u8>,
    /// The generation that wrote this version.
    pub since: u64,
}

/// A slot that only past generations name.
#[derive(Debug, Clone, Copy)]
struct Past {
    slot: SlotRef,
    until: u64,
}

/// A store as opened.
#[derive(Debug)]
pub struct Opened {
    /// The store's commits.
    pub commits: Commits,
    /// Pages of the last generation, ascending by id; empty before the first commit.
    pub pages: Vec<StoredPage>,
    /// Run state of the last generation.
    pub run_state: Vec<u8>,
    /// The whole content of the map, for tools; the current pages are in `pages`.
    pub content: MapContent,
    past: Vec<Past>,
}

impl Opened {
    /// Decodes the values of `content`.
    ///
    /// # Errors
    /// A value cannot be decoded, or two pages name one slot.
    pub(in crate::page) fn new(
        commits: Commits,
        content: MapContent,
        run_state: Vec<u8>,
    ) -> Result<Opened, CommitError> {
        let pages = pages_at(&content.versions, content.counters.latest)?;
        let past = past_slots(&content.versions, &pages)?;
        Ok(Opened { commits, pages, run_state, content, past })
    }

    /// Pages of a kept generation, ascending by id.
    ///
    /// # Errors
    /// The generation is not kept.
    pub fn pages_at(&self, generation: u64) -> Result<Vec<StoredPage>, CommitError> {
        if !self.commits.generations().is_kept(generation) {
            return Err(CommitError::NotKept(generation));
        }
        pages_at(&self.content.versions, generation)
    }

    /// The paged store on an engine that has the segments of this store.
    ///
    /// # Errors
    /// Segments are missing or have another length; the map names an impossible slot, or a slot twice.
    pub fn paged_store(
        &self,
        engine: Box<dyn PageEngine>,
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
        let past: &[Past] = if active(Mutant::FreeListFromLatestOnly) { &[] } else { &self.past };
        used.extend(past.iter().map(|p| &p.slot));
        let last = used.iter().map(|slot| slot.place.segment).max();
        let segments = check_segments(engine.as_ref(), layout, last)?;
        let mut paged = PagedStore::open(engine, config, segments, used)
            .map_err(|error| CommitError::Contradiction(error.to_string()))?;
        for past in past {
            paged.retire_past(&past.slot, past.until);
        }
        Ok(paged)
    }
}

/// Checks all segments up to `last`, the highest one that the map names, and returns their number. Stops after a few
/// wrong segments, so that a map naming an absurdly high segment costs neither time nor memory.
pub(in crate::page) fn check_segments(
    engine: &dyn PageEngine,
    layout: SlotLayout,
    last: Option<u32>,
) -> Result<u32, CommitError> {
    let Some(last) = last else { return Ok(0) };
    let check = |segment| engine.check_segment(segment, layout.segment_bytes()).err().map(|e| (segment, e));
    let wrong: Vec<String> = (0..=last)
        .filter_map(check)
        .take(WRONG_SEGMENTS_LISTED + 1)
        .map(|(segment, error)| format!("{}: {error}", segment_file_name(segment)))
        .collect();
    match wrong.as_slice() {
        [] => last.checked_add(1).ok_or_else(|| CommitError::Contradiction(format!("it names segment {last}"))),
        [listed @ .., _] if listed.len() == WRONG_SEGMENTS_LISTED => {
            Err(CommitError::Segments(format!("{}; and more", listed.join("; "))))
        }
        all => Err(CommitError::Segments(all.join("; "))),
    }
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
fn past_slots(versions: &[MapVersion], present: &[StoredPage]) -> Result<Vec<Past>, CommitError> {
    let present: BTreeMap<Place, PageId> = present.iter().map(|p| (p.slot.place, p.page)).collect();
    let mut past: BTreeMap<Place, (PageId, Past)> = BTreeMap::new();
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
                past.insert(slot.place, (page, Past { slot, until }));
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
