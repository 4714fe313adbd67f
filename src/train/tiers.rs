//! Where a run's pages live, as its config says: all in memory, or in frames over files in a spill directory.
//!
//! Invariants: 1. nothing here changes a bit of the result, only what is kept where; 2. [`Tiers::close`] removes the
//! checkpoint (the spill directory, or that of a run in memory), unless a run can go on from it: see [`Tiers::is_done`].

use super::budget::HostBudget;
use super::checkpoint::Checkpoint;
use super::error::TrainError;
use super::first_commit::{FirstCommit, MAP_CACHE_BYTES, codec};
use super::memory::MemoryEstimate;
use super::places::drive_of;
use super::staging::{PLAN_BYTES, PREFETCH_BYTES_MAX, staging_bytes};
use crate::base::error::{InputError, InputResult};
use crate::checkpoint::run_state::RunState;
use crate::config::file::TrainConfig;
use crate::config::residence::Residence;
use crate::optim::moments::Moments;
use crate::page::engine::memory::MemoryEngine;
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::engine::page_engine::PageEngine;
use crate::page::folder::drive_rate::DriveRate;
use crate::page::folder::file_system::free_bytes;
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::format::spill_format::Purpose;
use crate::page::map::commit::{CommitConfig, CommitError, Commits};
use crate::page::map::opening::Opened;
use crate::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use crate::page::versions::slots::SlotLayout;
use crate::paging::pager::{Pager, PagerConfig};
use crate::scene::page_layout::capacity_bytes;
use std::path::{Path, PathBuf};

/// Fewest frames that a run gets before its views were looked at: enough for importing and probing.
const FIRST_FRAMES: usize = 64;
/// One frame in so many may be filled ahead of its step.
const PREFETCH_SHARE: usize = 8;

/// Space set aside for a last commit on a full drive: room for a segment, at least for the map to grow, bytes.
const RESERVE_BYTES_LEAST: u64 = 2 << 20;
const RESERVE_BYTES_MOST: u64 = 256 << 20;

/// The tiers of a run.
#[derive(Debug, Default)]
pub struct Tiers {
    spill: Option<SpillDir>,
    /// Commits to the spill directory, or to the output folder of a run in memory.
    pub checkpoint: Option<Checkpoint>,
    /// The run did all that it had to: its checkpoint is of no use any more, unless it is to be kept.
    pub is_done: bool,
    /// `--keep-checkpoint`.
    keeps: bool,
    /// All pages are in memory, and in a folder only as far as they were committed.
    is_in_memory: bool,
    /// The checkpoint is in the output folder.
    is_in_output: bool,
    /// The directory had a run in it when it was opened.
    has_past: bool,
    /// Of a dry run: a folder on the drive where the spill directory would be.
    planned_on: Option<PathBuf>,
    /// What moves pages, for reports; empty when all stay in memory.
    pub engine: String,
    /// How pages are stored.
    pub codec: Codec,
    /// What the user should know of how they were chosen.
    pub notes: Vec<String>,
}

/// How pages are stored, as `--spill-codec` says; `auto` measures the drive of `folder`, and is raw without one or where
/// it cannot be measured.
fn chosen_codec(config: &TrainConfig, folder: Option<&Path>, notes: &mut Vec<String>) -> Codec {
    if let Some(codec) = config.spill_codec.0 {
        return codec;
    }
    match folder.map(DriveRate::of) {
        None => Codec::Raw,
        Some(Ok(rate)) => match rate.codec() {
            // Costs one pass and saves a third of the bytes, on any drive.
            Codec::Raw if config.moments == Moments::Bf16 => Codec::Halves,
            codec => codec,
        },
        Some(Err(error)) => {
            notes.push(format!("the drive was not measured, pages are stored raw: {error}"));
            Codec::Raw
        }
    }
}

/// Sizes of the pager of a run within `host_mem` bytes.
fn pager_config(config: &TrainConfig, host_mem: u64) -> PagerConfig {
    let mut pager = PagerConfig {
        frames: config.frames as usize,
        policy: config.evict,
        plan_bytes: PLAN_BYTES,
        ..PagerConfig::in_memory(config.page_rows as usize, config.sh_degree)
    };
    let affordable = (host_mem / pager.frame_bytes() as u64) as usize;
    if pager.frames == 0 {
        pager.frames = (affordable / PREFETCH_SHARE).max(FIRST_FRAMES);
    }
    let frames = if config.frames > 0 { pager.frames } else { affordable };
    pager.prefetch_bytes = prefetch_bytes(config, frames, pager.frame_bytes());
    pager
}

/// Bytes of pages in flight ahead of their step, each way, with so many frames.
fn prefetch_bytes(config: &TrainConfig, frames: usize, frame_bytes: usize) -> usize {
    let bytes = match config.prefetch_bytes.0 as usize {
        0 => (frames / PREFETCH_SHARE).saturating_mul(frame_bytes).min(PREFETCH_BYTES_MAX),
        bytes => bytes,
    };
    // At least one page each way, or nothing would ever be ahead.
    bytes.max(frame_bytes)
}

/// The memory of a run whose pages are all in it as long as they fit.
pub(super) fn budget_in_memory(config: &TrainConfig, host_mem: u64, memory: &MemoryEstimate) -> HostBudget {
    let frame_bytes = PagerConfig::in_memory(config.page_rows as usize, config.sh_degree).frame_bytes();
    let ahead = prefetch_bytes(config, (host_mem / frame_bytes as u64) as usize, frame_bytes);
    let staging = staging_bytes(2 * ahead, codec(config));
    HostBudget::new(host_mem, memory, config.host_mem.0 > 0).in_memory(ahead, staging)
}

/// The pager with its pages moving when `--transfers` says.
fn with_transfers(mut pager: Pager, config: &TrainConfig) -> Pager {
    pager.set_transfers(config.transfers);
    pager
}

/// The same of a run that was not begun, with this budget and a drive that is fast enough for raw pages where the codec is
/// chosen by its speed.
pub fn first_staging_bytes(config: &TrainConfig, host_mem: u64) -> u64 {
    let codec = chosen_codec(config, None, &mut Vec::new());
    staging_bytes(2 * pager_config(config, host_mem).prefetch_bytes, codec)
}

/// Opens the tiers for a scene of about `pages` pages, within `host_mem` bytes. The pager has few frames at first where
/// their number follows from the budget: see [`Pager::allow_frames`]. With `dry`, nothing is written: what would lie on the
/// drive is in memory, where it must fit ([`super::preflight::too_large_for_a_dry_run`]).
///
/// # Errors
/// The spill directory cannot be used, or the I/O engine does not work here.
pub fn open(config: &TrainConfig, pages: usize, host_mem: u64, dry: bool) -> Result<(Pager, Tiers), TrainError> {
    let (page_rows, sh_degree) = (config.page_rows as usize, config.sh_degree);
    let residence = config.residence();
    if residence == Residence::Memory {
        let in_memory = PagerConfig { policy: config.evict, ..PagerConfig::in_memory(page_rows, sh_degree) };
        return Ok((with_transfers(Pager::in_memory(in_memory), config), Tiers::default()));
    }
    let pager = pager_config(config, host_mem);
    let layout = SlotLayout::new(capacity_bytes(page_rows, sh_degree), pages as u64);
    let mut tiers = Tiers::default();
    tiers.keeps = config.keep_checkpoint;
    let Some(spill_dir) = residence.spill_dir().filter(|_| !dry) else {
        tiers.planned_on = residence.spill_dir().map(drive_of);
        let engine = Box::new(MemoryEngine::new());
        let codec = chosen_codec(config, None, &mut tiers.notes);
        (tiers.engine, tiers.codec) = (engine.name().to_string(), codec);
        let of_store = PagedStoreConfig { store: 0, layout, codec, generation: 1, serial: 1 };
        return Ok((with_transfers(Pager::new(pager, PagedStore::new(engine, of_store)), config), tiers));
    };
    let spill = SpillDir::create(spill_dir, Purpose::Checkpoint, layout, false)?;
    let (folder, of_commits) = (DriveFolder::new(spill.folder()), commit_config(&spill));
    // From here on an error removes the directory.
    let (engine, codec) = tiers.take_spill(spill, config)?;
    let opened = Commits::create(Box::new(folder), of_commits)?;
    let store = opened.paged_store(engine, layout, codec)?;
    let mut checkpoint = Checkpoint::new(opened.commits, spill_dir, config);
    checkpoint.fill_reserve()?;
    tiers.checkpoint = Some(checkpoint);
    Ok((with_transfers(Pager::new(pager, store), config), tiers))
}

/// A spill directory with a run that can go on.
pub struct Stored {
    spill: SpillDir,
    opened: Opened,
    /// What the run is beside its pages.
    pub run_state: RunState,
}

impl Stored {
    /// Opens the checkpoint in `folder` at its last commit; `None` where a store is there in which nothing was committed. An
    /// empty folder is no such store: it may be the mount point of a drive that is not mounted. `allow_remote`: also on a network file system.
    ///
    /// # Errors
    /// There is none, it is damaged, or in use.
    pub fn open(folder: &Path, allow_remote: bool) -> Result<Option<Stored>, TrainError> {
        if !SpillDir::exists_in(folder) {
            let problem = "the checkpoint of this run is not there: it is removed when a run ends without \
                           --keep-checkpoint, and made by the first commit";
            let remedy = "start the run again with --overwrite; if its pages were moved, name their folder with --spill-dir; \
                          if their drive is not mounted, mount it";
            return Err(InputError::new(folder, problem, remedy).into());
        }
        let spill = SpillDir::open(folder, allow_remote)?;
        if spill.holds_no_commit()? {
            return Ok(None);
        }
        let opened = match Commits::open(Box::new(DriveFolder::new(folder)), commit_config(&spill)) {
            Err(error @ CommitError::NoStore) => {
                let remedy = "gsscale-ckpt salvage rebuilds the map from the pages, in another folder";
                return Err(InputError::new(folder, error.to_string(), remedy).into());
            }
            opened => opened?,
        };
        let run_state = RunState::from_bytes(&opened.run_state).map_err(|e| {
            InputError::new(folder, e.to_string(), "go on with the program that made it, or start the run again")
        })?;
        Ok(Some(Stored { spill, opened, run_state }))
    }

    /// Removes the checkpoint. Gives the names of files that stay because they are not the store's.
    ///
    /// # Errors
    /// A file cannot be removed.
    pub fn remove(self) -> InputResult<Vec<String>> {
        drop(self.opened);
        self.spill.remove()
    }

    /// Whether every segment that it names is there. A kill while a checkpoint is removed leaves a map without them.
    pub fn is_whole(&self) -> bool {
        let engine = open_engine(IoEngine::Pread, self.spill.folder(), DEPTH);
        let layout = self.spill.format().layout;
        engine.is_ok_and(|engine| self.opened.paged_store(engine.store, layout, Codec::Raw).is_ok())
    }

    /// The tiers of the run that goes on, its pages in them.
    ///
    /// # Errors
    /// The I/O engine does not work here, or what is stored contradicts itself. The directory stays as it is.
    pub fn into_tiers(self, config: &TrainConfig, host_mem: u64) -> Result<(Pager, Tiers), TrainError> {
        let Stored { spill, opened, run_state } = self;
        let mut pager = pager_config(config, host_mem);
        let bytes = (opened.pages.len() * pager.frame_bytes()) as u64;
        // A run in memory stays there while that is no question; otherwise its checkpoint serves as a spill directory.
        let is_in_memory = config.residence() == Residence::Memory && bytes <= host_mem / 2;
        if is_in_memory {
            let in_memory = PagerConfig::in_memory(config.page_rows as usize, config.sh_degree);
            pager = PagerConfig { policy: config.evict, ..in_memory };
        }
        let layout = spill.format().layout;
        if layout.slot_bytes != pager.frame_bytes() as u64 {
            return Err(CommitError::Contradiction("slots have another size than pages".to_string()).into());
        }
        let mut tiers = Tiers::default();
        (tiers.has_past, tiers.is_in_memory, tiers.keeps) = (true, is_in_memory, config.keep_checkpoint);
        tiers.is_in_output = config.residence().spill_dir().is_none();
        let folder = spill.folder().to_path_buf();
        let (engine, codec) = tiers.take_spill(spill, config)?;
        let store = opened.paged_store(engine, layout, codec)?;
        let pager = Pager::open(pager, store, &opened.pages, run_state.events.len())?;
        let mut checkpoint = Checkpoint::new(opened.commits, &folder, config);
        checkpoint.set_optional(is_in_memory);
        checkpoint.fill_reserve()?;
        tiers.checkpoint = Some(checkpoint);
        Ok((with_transfers(pager, config), tiers))
    }
}

fn commit_config(spill: &SpillDir) -> CommitConfig {
    let reserve_bytes = spill.format().layout.segment_bytes().clamp(RESERVE_BYTES_LEAST, RESERVE_BYTES_MOST);
    CommitConfig { store: spill.format().store, cache_bytes: MAP_CACHE_BYTES, reserve_bytes }
}

impl Tiers {
    /// Takes over a spill directory and starts what moves its pages.
    fn take_spill(&mut self, spill: SpillDir, config: &TrainConfig) -> InputResult<(Box<dyn PageEngine>, Codec)> {
        self.notes.extend(spill.warnings().iter().filter(|_| !self.is_in_memory).cloned());
        let folder = spill.folder().to_path_buf();
        self.spill = Some(spill);
        let codec = match self.is_in_memory {
            true => codec(config),
            false => chosen_codec(config, Some(&folder), &mut self.notes),
        };
        let opened = open_engine(config.io, &folder, DEPTH)?;
        self.notes.extend(opened.notes);
        (self.engine, self.codec) = (opened.store.name().to_string(), codec);
        Ok((opened.store, codec))
    }

    /// A run whose pages stay in memory commits to its output folder `out`, from its first commit on. Nothing for other
    /// runs: those with a spill directory commit there, and `--frames` alone, which is for comparisons, has no drive.
    pub fn commit_in(&mut self, out: &Path, config: &TrainConfig) {
        if config.residence() == Residence::Memory {
            self.checkpoint = Some(Checkpoint::later(FirstCommit::of(out, config), config));
            (self.is_in_memory, self.is_in_output, self.keeps) = (true, true, config.keep_checkpoint);
        }
    }

    /// Whether a run that stops now can go on from its checkpoint.
    pub fn can_resume(&self) -> bool {
        !self.is_done && self.has_checkpoint()
    }

    /// Whether the checkpoint stays at a clean end.
    pub fn keeps_checkpoint(&self) -> bool {
        self.keeps
    }

    fn has_checkpoint(&self) -> bool {
        self.has_past || self.checkpoint.as_ref().is_some_and(Checkpoint::has_commit)
    }

    /// Whether pages may leave memory for a drive.
    pub fn spills(&self) -> bool {
        (self.spill.is_some() || self.planned_on.is_some()) && !self.is_in_memory
    }

    /// Bytes of the files that hold pages on the drive; 0 without one, or where they cannot be listed.
    pub fn drive_bytes(&self) -> u64 {
        let of =
            |spill: &SpillDir| spill.segments().map_or(0, |s| s.len() as u64 * spill.format().layout.segment_bytes());
        let made = self.checkpoint.as_ref().and_then(Checkpoint::spill);
        self.spill.as_ref().or(made).map_or(0, of)
    }

    /// Bytes that pages may take on the drive: what is free, and what they have already, of a run that goes on or of the
    /// import; `None` without a drive, or where the system does not tell.
    ///
    /// # Errors
    /// The folder is gone.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        if let Some(folder) = &self.planned_on {
            return Ok(free_bytes(folder).ok().flatten());
        }
        let Some(spill) = &self.spill else { return Ok(None) };
        let taken = spill.segments()?.len() as u64 * spill.format().layout.segment_bytes();
        Ok(spill.free_bytes()?.map(|free| free.saturating_add(taken)))
    }

    /// Closes the checkpoint, and removes it unless a run can go on from it or it is to be kept; the pager is gone by now.
    /// Gives what should be said about it.
    pub fn close(&mut self) -> Vec<String> {
        let is_kept = self.has_checkpoint() && (self.keeps || !self.is_done);
        let made = self.checkpoint.take().and_then(Checkpoint::into_folder);
        let Some(spill) = self.spill.take().or(made).filter(|_| !is_kept) else { return Vec::new() };
        let folder = spill.folder().to_path_buf();
        match spill.remove() {
            Ok(foreign) if foreign.is_empty() => {
                if self.is_in_output {
                    // An earlier life of the run made it. Only if it is empty.
                    let _ = std::fs::remove_dir(&folder);
                }
                Vec::new()
            }
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
