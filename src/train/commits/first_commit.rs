//! The checkpoint of a run in memory: its first commit creates the store in the output folder.
//!
//! From then on the run has a spill directory without eviction: a commit writes the pages that changed since the last
//! commit. Invariant: a failed creation leaves no files and does not change the pager.

use crate::config::file::TrainConfig;
use crate::config::residence::checkpoint_folder;
use crate::optim::moments::Moments;
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::map::commit::{CommitConfig, Commits};
use crate::page::tool::uncommitted::remove_uncommitted;
use crate::page::versions::paged_store::PagedStore;
use crate::page::versions::slots::SlotLayout;
use crate::paging::pager::Pager;
use crate::scene::page_layout::capacity_bytes;
use crate::train::error::TrainError;
use std::path::{Path, PathBuf};

/// Memory for the cache of the page map, bytes.
pub(crate) const MAP_CACHE_BYTES: usize = 8 << 20;

/// Settings of the checkpoint to create.
#[derive(Debug, Clone)]
pub(crate) struct FirstCommit {
    folder: PathBuf,
    io: IoEngine,
    codec: Codec,
    capacity_bytes: usize,
}

impl FirstCommit {
    /// The checkpoint in the output folder of a run.
    pub fn of(out: &Path, config: &TrainConfig) -> FirstCommit {
        FirstCommit {
            folder: checkpoint_folder(out),
            io: config.io,
            codec: codec(config),
            capacity_bytes: capacity_bytes(config.page_rows as usize, config.sh_degree),
        }
    }

    /// Folder of the checkpoint.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Creates the store and attaches it to the pager.
    pub fn make(&self, pager: &mut Pager) -> Result<(SpillDir, Commits), TrainError> {
        let layout = SlotLayout::new(self.capacity_bytes, pager.index().len() as u64);
        // An earlier process killed during its first commit leaves a store without commits.
        remove_uncommitted(&self.folder, true)?;
        // Allow a network file system: the user chose it for the results.
        let spill = SpillDir::create(&self.folder, layout, true)?;
        match self.make_in(&spill, layout) {
            Ok((commits, store)) => {
                pager.attach(store);
                Ok((spill, commits))
            }
            Err(error) => {
                spill.remove()?;
                Err(error)
            }
        }
    }

    fn make_in(&self, spill: &SpillDir, layout: SlotLayout) -> Result<(Commits, PagedStore), TrainError> {
        let engine = open_engine(self.io, &self.folder, DEPTH)?.store;
        let config = CommitConfig { store: spill.format().store, cache_bytes: MAP_CACHE_BYTES, reserve_bytes: 0 };
        let opened = Commits::create(Box::new(DriveFolder::new(&self.folder)), config)?;
        let store = opened.paged_store(engine, layout, self.codec)?;
        Ok((opened.commits, store))
    }
}

/// Codec of `--spill-codec`. Halves cost one pass and save a third of the bytes on any drive. zstd is never chosen: it pays
/// only on slow drives, for pages that are seldom read, and `gsscale-iotune` advises it there.
pub(crate) fn codec(config: &TrainConfig) -> Codec {
    config.spill_codec.0.unwrap_or(match config.moments {
        Moments::F32 => Codec::Raw,
        Moments::Bf16 => Codec::Halves,
    })
}
