//! Where a run's pages live, as its config says: all in memory, or in frames over files in a spill directory.
//!
//! Invariants: 1. nothing here changes a bit of the result, only what is kept where; 2. the spill directory is scratch:
//! [`Tiers::close`] removes it, whether the run ended well or not.

use crate::base::error::InputResult;
use crate::cache::evict::EvictPolicy;
use crate::config::file::TrainConfig;
use crate::page::codec::Codec;
use crate::page::drive_rate::DriveRate;
use crate::page::engine::{DEPTH, IoEngine, open_engine};
use crate::page::memory_store::MemoryStore;
use crate::page::paged_store::{PagedStore, PagedStoreConfig};
use crate::page::slots::SlotLayout;
use crate::page::spill_dir::SpillDir;
use crate::page::spill_format::Purpose;
use crate::page::store::PageStore;
use crate::paging::pager::{Pager, PagerConfig};
use crate::scene::page_layout::capacity_bytes;
use std::path::Path;

/// Fewest frames that a run gets before its views were looked at: enough for importing and probing.
const FIRST_FRAMES: usize = 64;
/// Share of the frames that may be filled ahead of their step, and the most bytes of it.
const PREFETCH_SHARE: usize = 8;
const PREFETCH_BYTES_MAX: usize = 256 << 20;
/// Memory for the plan of the coming steps, bytes.
pub const PLAN_BYTES: usize = 16 << 20;

/// The tiers of a run.
#[derive(Debug, Default)]
pub struct Tiers {
    spill: Option<SpillDir>,
    /// What moves pages, for reports; empty when all stay in memory.
    pub engine: String,
    /// How pages are stored, for reports.
    pub codec: String,
    /// What the user should know of how they were chosen.
    pub notes: Vec<String>,
}

/// Which pages leave memory first, as `--evict` says.
fn policy(config: &TrainConfig) -> EvictPolicy {
    if config.evict == "lru" { EvictPolicy::LeastRecentlyUsed } else { EvictPolicy::FarthestNextUse }
}

/// How pages are stored, as `--spill-codec` says; `auto` measures the drive of `folder`, and is raw without one or where
/// it cannot be measured.
fn chosen_codec(config: &TrainConfig, folder: Option<&Path>, notes: &mut Vec<String>) -> Codec {
    if let Ok(codec) = config.spill_codec.parse() {
        return codec;
    }
    match folder.map(DriveRate::of) {
        None => Codec::Raw,
        Some(Ok(rate)) => rate.codec(),
        Some(Err(error)) => {
            notes.push(format!("the drive was not measured, pages are stored raw: {error}"));
            Codec::Raw
        }
    }
}

/// Opens the tiers for a scene of about `pages` pages, within `host_mem` bytes. The pager has few frames at first where
/// their number follows from the budget: see [`Pager::allow_frames`]. With `dry`, nothing is written: pages stay in
/// memory.
///
/// # Errors
/// The spill directory cannot be used, or the I/O engine does not work here.
pub fn open(config: &TrainConfig, pages: usize, host_mem: u64, dry: bool) -> InputResult<(Pager, Tiers)> {
    let (page_rows, sh_degree) = (config.page_rows as usize, config.sh_degree);
    if dry || (config.spill_dir.is_empty() && config.frames == 0) {
        return Ok((Pager::in_memory(PagerConfig::in_memory(page_rows, sh_degree)), Tiers::default()));
    }
    let mut pager = PagerConfig {
        frames: config.frames as usize,
        policy: policy(config),
        prefetch_bytes: config.prefetch_bytes.0 as usize,
        plan_bytes: PLAN_BYTES,
        ..PagerConfig::in_memory(page_rows, sh_degree)
    };
    let affordable = (host_mem / pager.frame_bytes() as u64) as usize;
    if pager.frames == 0 {
        pager.frames = (affordable / PREFETCH_SHARE).max(FIRST_FRAMES).min(pages.max(1));
    }
    if pager.prefetch_bytes == 0 {
        let frames = if config.frames > 0 { pager.frames } else { affordable };
        pager.prefetch_bytes = (frames / PREFETCH_SHARE).saturating_mul(pager.frame_bytes()).min(PREFETCH_BYTES_MAX);
    }
    // At least one page each way, or nothing would ever be ahead.
    pager.prefetch_bytes = pager.prefetch_bytes.max(pager.frame_bytes());
    let layout = SlotLayout::new(capacity_bytes(page_rows, sh_degree), pages as u64);
    let mut tiers = Tiers::default();
    let mut codec = chosen_codec(config, None, &mut tiers.notes);
    let mut store = 0;
    let engine: Box<dyn PageStore> = if config.spill_dir.is_empty() {
        Box::new(MemoryStore::new())
    } else {
        let spill = SpillDir::create(Path::new(&config.spill_dir), Purpose::Scratch, layout, false)?;
        store = spill.format().store;
        tiers.notes.extend(spill.warnings().iter().cloned());
        let folder = spill.folder().to_path_buf();
        tiers.spill = Some(spill);
        codec = chosen_codec(config, Some(&folder), &mut tiers.notes);
        match open_engine(config.io.parse().unwrap_or(IoEngine::Auto), &folder, DEPTH) {
            Ok(opened) => {
                tiers.notes.extend(opened.notes);
                opened.store
            }
            Err(error) => {
                tiers.close();
                return Err(error);
            }
        }
    };
    tiers.engine = engine.name().to_string();
    tiers.codec = codec.to_string();
    let of_store = PagedStoreConfig { store, layout, codec, generation: 1, serial: 1 };
    Ok((Pager::new(pager, PagedStore::new(engine, of_store)), tiers))
}

impl Tiers {
    /// Whether pages may leave memory for a drive.
    pub fn spills(&self) -> bool {
        self.spill.is_some()
    }

    /// Bytes that may still be written to the drive; `None` without one, or where the system does not tell.
    ///
    /// # Errors
    /// The folder is gone.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        self.spill.as_ref().map_or(Ok(None), SpillDir::free_bytes)
    }

    /// Removes the spill directory; the pager is gone by now. Gives what should be said about it.
    pub fn close(&mut self) -> Vec<String> {
        let Some(spill) = self.spill.take() else { return Vec::new() };
        let folder = spill.folder().to_path_buf();
        match spill.remove() {
            Ok(foreign) if foreign.is_empty() => Vec::new(),
            Ok(foreign) => vec![format!("{} is kept: {} are not ours", folder.display(), foreign.join(", "))],
            Err(error) => vec![format!("the spill directory could not be removed: {error}")],
        }
    }
}

impl Drop for Tiers {
    fn drop(&mut self) {
        self.close();
    }
}
