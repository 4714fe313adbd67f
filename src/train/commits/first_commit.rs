//! The checkpoint of a run in memory: its first commit creates the store in the output folder.
//!
//! From then on the run has a spill directory without eviction: a commit writes the pages that changed since the last
//! commit. Invariant: a failed creation leaves no files and does not change the pager.

use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::format::codec::Codec;
use crate::page::map::commit::{CommitConfig, Commits};
use crate::page::map::opening::Opened;
use crate::page::tool::uncommitted::remove_uncommitted;
use crate::page::versions::paged_store::PagedStore;
use crate::page::versions::slots::SlotLayout;
use crate::paging::pager::Pager;
use crate::train::error::TrainError;
use std::path::PathBuf;

/// Memory for the cache of the page map, bytes.
pub(crate) const MAP_CACHE_BYTES: usize = 8 << 20;

/// Settings of the checkpoint to create.
#[derive(Debug, Clone)]
pub(crate) struct FirstCommit {
    /// `checkpoint/` in the output folder of the run.
    pub folder: PathBuf,
    pub io: IoEngine,
    pub codec: Codec,
    /// Bytes of a full page.
    pub capacity_bytes: usize,
}

impl FirstCommit {
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
        let opened = Opened::create(Box::new(DriveFolder::new(&self.folder)), config)?;
        let store = opened.paged_store(engine, layout, self.codec)?;
        Ok((opened.commits, store))
    }
}
