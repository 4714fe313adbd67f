//! Where a run's pages live, as its config says: all in memory, or in frames over files in a spill directory.
//!
//! Invariants: 1. nothing here changes a bit of the result, only what is kept where; 2. [`Tiers::close`] removes the spill
//! directory, unless something was committed in it that a run can go on from: see [`Tiers::is_done`].

use super::checkpoint::Checkpoint;
use super::trainer::TrainError;
use crate::base::error::{InputError, InputResult};
use crate::cache::evict::EvictPolicy;
use crate::checkpoint::run_state::RunState;
use crate::config::file::TrainConfig;
use crate::page::codec::Codec;
use crate::page::commit::{CommitConfig, CommitError, Commits};
use crate::page::drive_rate::DriveRate;
use crate::page::engine::{DEPTH, IoEngine, open_engine};
use crate::page::folder::DriveFolder;
use crate::page::memory_store::MemoryStore;
use crate::page::opening::Opened;
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

/// Memory for the cache of the page map, bytes.
const MAP_CACHE_BYTES: usize = 8 << 20;

/// The tiers of a run.
#[derive(Debug, Default)]
pub struct Tiers {
    spill: Option<SpillDir>,
    /// Commits to the spill directory, where there is one.
    pub checkpoint: Option<Checkpoint>,
    /// The run did all that it had to: its checkpoint is of no use any more.
    pub is_done: bool,
    /// The directory had a run in it when it was opened.
    has_past: bool,
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
        Some(Ok(rate)) => match rate.codec() {
            // Costs one pass and saves a third of the bytes, on any drive.
            Codec::Raw if config.moments == "bf16" => Codec::Halves,
            codec => codec,
        },
        Some(Err(error)) => {
            notes.push(format!("the drive was not measured, pages are stored raw: {error}"));
            Codec::Raw
        }
    }
}

/// Sizes of the pager of a scene of about `pages` pages, within `host_mem` bytes.
fn pager_config(config: &TrainConfig, pages: usize, host_mem: u64) -> PagerConfig {
    let mut pager = PagerConfig {
        frames: config.frames as usize,
        policy: policy(config),
        prefetch_bytes: config.prefetch_bytes.0 as usize,
        plan_bytes: PLAN_BYTES,
        ..PagerConfig::in_memory(config.page_rows as usize, config.sh_degree)
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
    pager
}

/// Bytes that the plan takes beside the frames, and pages on their way of which `prefetch_bytes` may be in flight: raw
/// pages move between frames and drive without a copy.
pub fn staging_bytes(prefetch_bytes: usize, codec: &str) -> u64 {
    (PLAN_BYTES + if codec == Codec::Raw.to_string() { 0 } else { prefetch_bytes }) as u64
}

/// The same of a run that was not begun, with this budget and a drive that is fast enough for raw pages where the codec is
/// chosen by its speed.
pub fn first_staging_bytes(config: &TrainConfig, pages: usize, host_mem: u64) -> u64 {
    let codec = chosen_codec(config, None, &mut Vec::new()).to_string();
    staging_bytes(2 * pager_config(config, pages, host_mem).prefetch_bytes, &codec)
}

/// Opens the tiers for a scene of about `pages` pages, within `host_mem` bytes. The pager has few frames at first where
/// their number follows from the budget: see [`Pager::allow_frames`]. With `dry`, nothing is written: pages stay in
/// memory.
///
/// # Errors
/// The spill directory cannot be used, or the I/O engine does not work here.
pub fn open(config: &TrainConfig, pages: usize, host_mem: u64, dry: bool) -> Result<(Pager, Tiers), TrainError> {
    let (page_rows, sh_degree) = (config.page_rows as usize, config.sh_degree);
    if dry || (config.spill_dir.is_empty() && config.frames == 0) {
        return Ok((Pager::in_memory(PagerConfig::in_memory(page_rows, sh_degree)), Tiers::default()));
    }
    let pager = pager_config(config, pages, host_mem);
    let layout = SlotLayout::new(capacity_bytes(page_rows, sh_degree), pages as u64);
    let mut tiers = Tiers::default();
    if config.spill_dir.is_empty() {
        let engine = Box::new(MemoryStore::new());
        let codec = chosen_codec(config, None, &mut tiers.notes);
        (tiers.engine, tiers.codec) = (engine.name().to_string(), codec.to_string());
        let of_store = PagedStoreConfig { store: 0, layout, codec, generation: 1, serial: 1 };
        return Ok((Pager::new(pager, PagedStore::new(engine, of_store)), tiers));
    }
    let spill = SpillDir::create(Path::new(&config.spill_dir), Purpose::Checkpoint, layout, false)?;
    let (folder, of_commits) = (DriveFolder::new(spill.folder()), commit_config(&spill));
    // From here on an error removes the directory.
    let (engine, codec) = tiers.take_spill(spill, config)?;
    let opened = Commits::create(Box::new(folder), of_commits)?;
    let store = opened.paged_store(engine, layout, codec)?;
    tiers.checkpoint = Some(Checkpoint::new(opened.commits, config));
    Ok((Pager::new(pager, store), tiers))
}

/// A spill directory with a run that can go on.
pub struct Stored {
    spill: SpillDir,
    opened: Opened,
    /// What the run is beside its pages.
    pub run_state: RunState,
}

impl Stored {
    /// Opens the spill directory of a run at its last commit.
    ///
    /// # Errors
    /// It is gone or damaged, in use, or nothing was committed in it.
    pub fn open(folder: &Path) -> Result<Stored, TrainError> {
        let again = "start the run again, with --overwrite and another --spill-dir, or after removing this one";
        if !folder.exists() {
            let problem = "the spill directory of this run is not there: it is removed when a run ends";
            return Err(InputError::new(folder, problem, again).into());
        }
        let spill = SpillDir::open(folder, false)?;
        let nothing = || InputError::new(folder, "this run was cut off before its first commit", again);
        let opened = match Commits::open(Box::new(DriveFolder::new(folder)), commit_config(&spill)) {
            Err(CommitError::NoStore) => return Err(nothing().into()),
            opened => opened?,
        };
        if opened.commits.generations().latest() == 0 {
            return Err(nothing().into());
        }
        let run_state = RunState::from_bytes(&opened.run_state).map_err(|e| {
            InputError::new(folder, e.to_string(), "go on with the program that made it, or start the run again")
        })?;
        Ok(Stored { spill, opened, run_state })
    }

    /// The tiers of the run that goes on, its pages in them.
    ///
    /// # Errors
    /// The I/O engine does not work here, or what is stored contradicts itself. The directory stays as it is.
    pub fn into_tiers(self, config: &TrainConfig, host_mem: u64) -> Result<(Pager, Tiers), TrainError> {
        let Stored { spill, opened, run_state } = self;
        let pager = pager_config(config, opened.pages.len(), host_mem);
        let layout = spill.format().layout;
        if layout.slot_bytes != pager.frame_bytes() as u64 {
            return Err(CommitError::Contradiction("slots have another size than pages".to_string()).into());
        }
        let mut tiers = Tiers::default();
        tiers.has_past = true;
        let (engine, codec) = tiers.take_spill(spill, config)?;
        let store = opened.paged_store(engine, layout, codec)?;
        let pager = Pager::open(pager, store, &opened.pages, run_state.events.len())?;
        tiers.checkpoint = Some(Checkpoint::new(opened.commits, config));
        Ok((pager, tiers))
    }
}

fn commit_config(spill: &SpillDir) -> CommitConfig {
    CommitConfig { store: spill.format().store, cache_bytes: MAP_CACHE_BYTES, reserve_bytes: 0 }
}

impl Tiers {
    /// Takes over a spill directory and starts what moves its pages.
    fn take_spill(&mut self, spill: SpillDir, config: &TrainConfig) -> InputResult<(Box<dyn PageStore>, Codec)> {
        self.notes.extend(spill.warnings().iter().cloned());
        let folder = spill.folder().to_path_buf();
        self.spill = Some(spill);
        let codec = chosen_codec(config, Some(&folder), &mut self.notes);
        let opened = open_engine(config.io.parse().unwrap_or(IoEngine::Auto), &folder, DEPTH)?;
        self.notes.extend(opened.notes);
        (self.engine, self.codec) = (opened.store.name().to_string(), codec.to_string());
        Ok((opened.store, codec))
    }

    /// Whether a run that stops now can go on from the spill directory.
    pub fn can_resume(&self) -> bool {
        let has_commit = self.checkpoint.as_ref().is_some_and(Checkpoint::has_commit);
        !self.is_done && (self.has_past || has_commit)
    }

    /// Whether pages may leave memory for a drive.
    pub fn spills(&self) -> bool {
        self.spill.is_some()
    }

    /// Bytes that pages may take on the drive: what is free, and what those of a run that goes on have already; `None`
    /// without a drive, or where the system does not tell.
    ///
    /// # Errors
    /// The folder is gone.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        let Some(spill) = &self.spill else { return Ok(None) };
        let segments = spill.segments()?.len() as u64;
        let taken = if self.has_past { segments * spill.format().layout.segment_bytes() } else { 0 };
        Ok(spill.free_bytes()?.map(|free| free.saturating_add(taken)))
    }

    /// Closes the spill directory, and removes it unless a run can go on from it; the pager is gone by now. Gives what
    /// should be said about it.
    pub fn close(&mut self) -> Vec<String> {
        let is_kept = self.can_resume();
        self.checkpoint = None;
        let Some(spill) = self.spill.take().filter(|_| !is_kept) else { return Vec::new() };
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
