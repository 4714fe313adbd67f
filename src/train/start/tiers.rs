//! Where the pages of a run live, by its config: all in memory, or in frames over a spill directory.
//!
//! Invariants: 1. nothing here changes a bit of the result; 2. [`Tiers::close`] removes the checkpoint (the spill
//! directory, or that of a run in memory) unless a run can resume from it; see [`Tiers::is_done`].

use crate::base::error::InputResult;
use crate::config::file::TrainConfig;
use crate::config::values::{Residence, checkpoint_folder};
use crate::optim::moments::Moments;
use crate::page::engine::memory::MemoryEngine;
use crate::page::engine::open::{DEPTH, open_engine};
use crate::page::engine::page_engine::PageEngine;
use crate::page::folder::file_system::free_bytes;
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::map::commit::CommitError;
use crate::page::map::opening::Opened;
use crate::page::tool::uncommitted::create_or_replace;
use crate::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use crate::page::versions::slots::SlotLayout;
use crate::paging::pager::{Pager, PagerConfig};
use crate::scene::page_layout::capacity_bytes;
use crate::train::commits::checkpoint::{Checkpoint, CommitOptions, FirstCommit};
use crate::train::error::TrainError;
use crate::train::inputs::machine::drive_of;
use crate::train::memory::{HostBudget, MemoryEstimate, PLAN_BYTES, PREFETCH_BYTES_MAX, staging_bytes};
use crate::train::stores::ownership::{Stored, commit_config};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Fewest frames of a run before its views are measured: enough for import and probe.
const FIRST_FRAMES: usize = 64;
/// 1/8 of the frames may be prefetched.
const PREFETCH_SHARE: usize = 8;

#[derive(Debug, Default)]
pub struct Tiers {
    spill: Option<SpillDir>,
    /// Commits to the spill directory, or to the output folder of a run in memory.
    pub checkpoint: Option<Checkpoint>,
    /// The run is finished, so its checkpoint is not needed.
    pub is_done: bool,
    /// A run that ends before its first commit leaves its spill directory as an empty store: without a store, a later resume would take
    /// the drive for one that is not mounted. Of a run that has trained, or that has replaced such a store.
    pub leaves_store: bool,
    /// `--keep-checkpoint`.
    keeps: bool,
    /// All pages are in memory; the store holds committed versions only.
    is_in_memory: bool,
    /// The checkpoint is in the output folder.
    is_in_output: bool,
    /// The run resumed from this store.
    has_resumed: bool,
    /// For a dry run: a folder on the drive of the spill directory.
    planned_on: Option<PathBuf>,
    /// I/O engine, for reports; empty if all pages stay in memory.
    pub engine: String,
    /// Codec of stored pages.
    pub codec: Codec,
    /// Bytes by which the files of the pages grow at once.
    pub segment_bytes: u64,
    /// Messages about the drive and the choice of the engine.
    pub notes: Vec<String>,
}

/// When a run with this config commits.
pub fn commit_options(config: &TrainConfig) -> CommitOptions {
    let full_wait = Duration::try_from_secs_f64(config.disk_full_wait).unwrap_or_default();
    CommitOptions { every: config.commit_every, full_wait }
}

/// Codec of `--spill-codec`. Halves cost one pass and save a third of the bytes on any drive. zstd is never chosen: it pays
/// only on slow drives, for pages that are seldom read, and `gsscale-iotune` advises it there.
fn codec(config: &TrainConfig) -> Codec {
    config.spill_codec.0.unwrap_or(match config.moments {
        Moments::F32 => Codec::Raw,
        Moments::Bf16 => Codec::Halves,
    })
}

/// Pager sizes of a run that keeps all pages in memory.
fn in_memory(config: &TrainConfig) -> PagerConfig {
    let (policy, transfers) = (config.evict, config.transfers);
    PagerConfig { policy, transfers, ..PagerConfig::in_memory(config.page_rows as usize, config.sh_degree) }
}

/// Pager sizes of a run within `host_mem` bytes.
fn pager_config(config: &TrainConfig, host_mem: u64) -> PagerConfig {
    let mut pager = PagerConfig { frames: config.frames as usize, plan_bytes: PLAN_BYTES, ..in_memory(config) };
    let affordable = (host_mem / pager.frame_bytes() as u64) as usize;
    if pager.frames == 0 {
        pager.frames = (affordable / PREFETCH_SHARE).max(FIRST_FRAMES);
    }
    let frames = if config.frames > 0 { pager.frames } else { affordable };
    pager.prefetch_bytes = prefetch_bytes(config, frames, pager.frame_bytes());
    pager
}

/// Bytes of prefetched pages in flight, each way, for `frames` frames.
fn prefetch_bytes(config: &TrainConfig, frames: usize, frame_bytes: usize) -> usize {
    let bytes = match config.prefetch_bytes.0 as usize {
        0 => (frames / PREFETCH_SHARE).saturating_mul(frame_bytes).min(PREFETCH_BYTES_MAX),
        bytes => bytes,
    };
    // At least one page each way, or prefetch would never happen.
    bytes.max(frame_bytes)
}

/// The budget of a run that keeps all pages in memory while they fit.
pub(crate) fn budget_in_memory(config: &TrainConfig, host_mem: u64, memory: &MemoryEstimate) -> HostBudget {
    let frame_bytes = in_memory(config).frame_bytes();
    let ahead = prefetch_bytes(config, (host_mem / frame_bytes as u64) as usize, frame_bytes);
    let staging = staging_bytes(2 * ahead, codec(config));
    HostBudget { prefetch_bytes: ahead, staging, ..HostBudget::new(host_mem, memory, config.host_mem.0 > 0) }
}

/// Staging of a run that has not begun, with this budget.
pub fn first_staging_bytes(config: &TrainConfig, host_mem: u64) -> u64 {
    staging_bytes(2 * pager_config(config, host_mem).prefetch_bytes, codec(config))
}

/// Opens the tiers for a scene of about `pages` pages, within `host_mem` bytes. If the number of frames follows from
/// the budget, the pager has few frames at first ([`Pager::allow_frames`]). With `dry`, pages of the drive are kept in
/// memory and must fit there (`plan_text::too_large_for_a_dry_run`).
/// Errors: the spill directory cannot be used, or the I/O engine does not work here.
pub fn open(config: &TrainConfig, pages: usize, host_mem: u64, dry: bool) -> Result<(Pager, Tiers), TrainError> {
    let residence = config.residence();
    if residence == Residence::Memory {
        return Ok((Pager::in_memory(in_memory(config)), Tiers::default()));
    }
    let pager = pager_config(config, host_mem);
    let layout = SlotLayout::new(capacity_bytes(config.page_rows as usize, config.sh_degree), pages as u64);
    let mut tiers = Tiers::default();
    tiers.keeps = config.keep_checkpoint;
    tiers.segment_bytes = layout.segment_bytes();
    let Some(spill_dir) = residence.spill_dir().filter(|_| !dry) else {
        tiers.planned_on = residence.spill_dir().map(drive_of);
        let engine = Box::new(MemoryEngine::new());
        (tiers.engine, tiers.codec) = (engine.name().to_string(), codec(config));
        let of_store = PagedStoreConfig { store: 0, layout, codec: tiers.codec, generation: 1, serial: 1 };
        return Ok((Pager::new(pager, PagedStore::new(engine, of_store)), tiers));
    };
    // Only here, after everything that can refuse the run: a resume that is refused changes nothing.
    let (spill, is_replaced) = create_or_replace(spill_dir, layout)?;
    if is_replaced {
        crate::tell!("replacing the store in {} of a run that ended before its first commit", spill_dir.display());
    }
    let (folder, of_commits) = (DriveFolder::new(spill.folder()), commit_config(&spill));
    // From here on, an error removes the directory, unless an earlier process left one.
    tiers.leaves_store = is_replaced;
    let engine = tiers.take_spill(spill, config)?;
    let opened = Opened::create(Box::new(folder), of_commits)?;
    let store = opened.paged_store(engine, layout, tiers.codec)?;
    let mut checkpoint = Checkpoint::new(opened.commits, spill_dir, commit_options(config));
    checkpoint.fill_reserve()?;
    tiers.checkpoint = Some(checkpoint);
    Ok((Pager::new(pager, store), tiers))
}

impl Tiers {
    /// The pager and tiers of a run that resumes from `stored`.
    /// Errors: the I/O engine does not work here, or the store is inconsistent. The directory stays unchanged.
    pub fn resume(stored: Stored, config: &TrainConfig, host_mem: u64) -> Result<(Pager, Tiers), TrainError> {
        let Stored { spill, opened, run_state } = stored;
        let mut pager = pager_config(config, host_mem);
        let bytes = (opened.pages.len() * pager.frame_bytes()) as u64;
        // A run in memory stays there if half of the budget holds it; otherwise its checkpoint becomes a spill
        // directory.
        let is_in_memory = config.residence() == Residence::Memory && bytes <= host_mem / 2;
        if is_in_memory {
            pager = in_memory(config);
        }
        let layout = spill.format().layout;
        if layout.slot_bytes != pager.frame_bytes() as u64 {
            return Err(CommitError::Contradiction("slots have another size than pages".to_string()).into());
        }
        let mut tiers = Tiers::default();
        (tiers.has_resumed, tiers.is_in_memory, tiers.keeps) = (true, is_in_memory, config.keep_checkpoint);
        tiers.is_in_output = config.residence().spill_dir().is_none();
        tiers.segment_bytes = layout.segment_bytes();
        let folder = spill.folder().to_path_buf();
        let engine = tiers.take_spill(spill, config)?;
        let store = opened.paged_store(engine, layout, tiers.codec)?;
        let pager = Pager::open(pager, store, &opened.pages, run_state.events.len())?;
        let mut checkpoint = Checkpoint::new(opened.commits, &folder, commit_options(config));
        checkpoint.is_optional = is_in_memory;
        checkpoint.fill_reserve()?;
        tiers.checkpoint = Some(checkpoint);
        Ok((pager, tiers))
    }

    /// Takes over a spill directory and starts its I/O engine.
    fn take_spill(&mut self, spill: SpillDir, config: &TrainConfig) -> InputResult<Box<dyn PageEngine>> {
        self.notes.extend(spill.warnings().iter().filter(|_| !self.is_in_memory).cloned());
        let folder = spill.folder().to_path_buf();
        self.spill = Some(spill);
        let opened = open_engine(config.io, &folder, DEPTH)?;
        self.notes.extend(opened.notes);
        (self.engine, self.codec) = (opened.store.name().to_string(), codec(config));
        Ok(opened.store)
    }

    /// Sets up commits to the output folder `out` for a run in memory. Other runs stay unchanged: a run with a spill
    /// directory commits there, and `--frames` alone, which is for comparisons, does not commit.
    pub fn commit_in(&mut self, out: &Path, config: &TrainConfig) {
        if config.residence() == Residence::Memory {
            let first = FirstCommit {
                folder: checkpoint_folder(out),
                io: config.io,
                codec: codec(config),
                capacity_bytes: capacity_bytes(config.page_rows as usize, config.sh_degree),
            };
            self.checkpoint = Some(Checkpoint::later(first, commit_options(config)));
            (self.is_in_memory, self.is_in_output, self.keeps) = (true, true, config.keep_checkpoint);
        }
    }

    /// Whether a run that stops now can resume from its checkpoint.
    pub fn can_resume(&self) -> bool {
        !self.is_done && self.has_checkpoint()
    }

    /// Whether this run made the folder of its spill directory.
    pub fn made_spill_dir(&self) -> bool {
        self.spill.as_ref().is_some_and(SpillDir::made_folder)
    }

    fn has_checkpoint(&self) -> bool {
        self.has_resumed || self.checkpoint.as_ref().is_some_and(|checkpoint| checkpoint.done > 0)
    }

    /// Whether pages may be evicted to a drive.
    pub fn spills(&self) -> bool {
        (self.spill.is_some() || self.planned_on.is_some()) && !self.is_in_memory
    }

    /// Bytes of the files of the pages; 0 without a drive or if they cannot be listed.
    pub fn drive_bytes(&self) -> u64 {
        let made = self.checkpoint.as_ref().and_then(|checkpoint| checkpoint.spill.as_ref());
        let Some(spill) = self.spill.as_ref().or(made) else { return 0 };
        let files = std::fs::read_dir(spill.folder()).into_iter().flatten().flatten();
        files.filter_map(|file| file.metadata().ok()).map(|about| about.len()).sum()
    }

    /// Bytes that pages may take on the drive: free bytes plus bytes of existing segments (of the import or a resumed
    /// run); `None` without a drive or if the system does not report them.
    /// Errors: the folder does not exist.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        if let Some(folder) = &self.planned_on {
            return Ok(free_bytes(folder).ok().flatten());
        }
        let Some(spill) = &self.spill else { return Ok(None) };
        let taken = spill.segments()?.len() as u64 * spill.format().layout.segment_bytes();
        Ok(spill.free_bytes()?.map(|free| free.saturating_add(taken)))
    }

    /// Closes the checkpoint and removes it, unless a run can resume from it or it is to be kept. The pager must be
    /// dropped before. Returns messages for the user.
    pub fn close(&mut self) -> Vec<String> {
        let is_kept = self.has_checkpoint() && (self.keeps || !self.is_done);
        let made = self.checkpoint.take().and_then(|checkpoint| checkpoint.spill);
        let Some(spill) = self.spill.take().or(made).filter(|_| !is_kept) else { return Vec::new() };
        let folder = spill.folder().to_path_buf();
        if self.leaves_store && !self.is_done && !self.is_in_output {
            let cleared = spill.clear();
            return cleared.err().map(|error| format!("pages could not be removed: {error}")).into_iter().collect();
        }
        match spill.remove() {
            Ok(foreign) if foreign.is_empty() => {
                if self.is_in_output {
                    // An earlier process of the run created the folder. This succeeds only if it is empty.
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
