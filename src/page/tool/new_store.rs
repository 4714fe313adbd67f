//! Builds a store from a tool: pages, then generations, then the rename to its final name.
//!
//! The store is built beside its target under another name and renamed when complete.
//!
//! Invariants: 1. the target is a complete store or nothing: a tool that fails or is killed leaves at most a folder
//! with suffix `PART_SUFFIX`, which the next attempt removes if it is a store without commits, and else refuses; 2. memory is
//! bounded by sixteen pages, and by sixteen more if they are encoded.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::base::whole_file::{folder_of, rename, sync_folder};
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::open::{IoEngine, open_engine};
use crate::page::folder::protocol_files::DriveFolder;
use crate::page::folder::spill_dir::{FORMAT, SpillDir};
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::{HEADER_BYTES, SlotRef};
use crate::page::map::commit::{Commits, Cut, PageChange};
use crate::page::map::opening::Opened;
use crate::page::tool::reading::{ReadError, commit_config};
use crate::page::tool::uncommitted::holds_no_commit;
use crate::page::versions::paged_store::{PageDone, PageMoved, PagedStore};
use crate::page::versions::slots::SlotLayout;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Suffix of the name of an unfinished store.
const PART_SUFFIX: &str = ".part";
/// Page writes in flight.
const IN_FLIGHT: usize = 16;

/// A store under construction.
#[derive(Debug)]
pub struct NewStore {
    target: PathBuf,
    part: PathBuf,
    /// `None` once the store has its final name.
    spill: Option<SpillDir>,
    commits: Commits,
    store: PagedStore,
    free: Vec<PageBuffer>,
    /// Labels of pages whose write has not completed.
    labels: BTreeMap<PageId, Vec<u8>>,
    changes: BTreeMap<PageId, Option<(SlotRef, Vec<u8>)>>,
}

/// The `.part` name for `target`.
pub fn part_of(target: &Path) -> PathBuf {
    let mut name = target.as_os_str().to_os_string();
    name.push(PART_SUFFIX);
    PathBuf::from(name)
}

/// The `.part` name of a new store for `target`, if neither exists. Removes what an attempt that was killed before its first commit left there.
/// Errors: one of them exists, or `target` lies in a store.
pub fn claim_new_store(target: &Path) -> InputResult<PathBuf> {
    let part = part_of(target);
    if std::fs::symlink_metadata(target).is_ok() {
        return Err(InputError::new(target, "exists already", "name a folder that does not exist; its parent must"));
    }
    if SpillDir::exists_in(&part) {
        let mut spill = SpillDir::open(&part, true)?;
        if holds_no_commit(&spill)? {
            // The name says that a store was being built here, in a folder of its own.
            spill.adopt_folder();
            spill.remove()?;
        }
    }
    if std::fs::symlink_metadata(&part).is_ok() {
        let problem = "an earlier attempt left this folder, and it may hold a whole store";
        return Err(InputError::new(part, problem, "remove it, or name another folder"));
    }
    refuse_inside_store(target)?;
    Ok(part)
}

/// Errors: `target` lies in a store.
pub fn refuse_inside_store(target: &Path) -> InputResult<()> {
    let whole = std::path::absolute(target).unwrap_or_else(|_| target.to_path_buf());
    let store = whole.ancestors().skip(1).find(|above| above.join(FORMAT).is_file());
    store.map_or(Ok(()), |store| {
        let problem = format!("it would lie in a store, {}", store.display());
        Err(InputError::new(target, problem, "name a place outside of it"))
    })
}

/// The error of a drive without space, by the name that the user gave; other errors stay.
fn no_space_for(target: &Path, error: ReadError) -> ReadError {
    match error {
        ReadError::Commit(error) if error.is_out_of_space() => {
            let problem = "there is no space for this store on its drive";
            InputError::new(target, problem, "free space there, or name a folder on another drive").into()
        }
        error => error,
    }
}

impl NewStore {
    /// Starts a store for `target`, which does not exist. It may lie on a network drive: its pages are written once, in order.
    /// Errors: `target` exists, or the drive fails.
    pub fn create(target: &Path, layout: SlotLayout, codec: Codec) -> Result<NewStore, ReadError> {
        let part = claim_new_store(target)?;
        let spill = SpillDir::create(&part, layout, true)?;
        let begin = || -> Result<(Commits, PagedStore), ReadError> {
            let opened = Opened::create(Box::new(DriveFolder::new(&part)), commit_config(spill.format().store))?;
            let engine = open_engine(IoEngine::Auto, &part, IN_FLIGHT)?;
            let store = opened.paged_store(engine.store, layout, codec)?;
            Ok((opened.commits, store))
        };
        match begin() {
            Ok((commits, store)) => {
                let (free, labels, changes) = (Vec::new(), BTreeMap::new(), BTreeMap::new());
                let target = target.to_path_buf();
                Ok(NewStore { target, part, spill: Some(spill), commits, store, free, labels, changes })
            }
            Err(error) => {
                let _ = spill.remove();
                Err(no_space_for(target, error))
            }
        }
    }

    /// Writes a version of `page` into the next generation.
    /// Errors: the drive fails.
    pub fn put(&mut self, page: PageId, label: &[u8], payload: &[u8]) -> Result<(), ReadError> {
        while self.store.in_flight() >= IN_FLIGHT {
            self.await_write()?;
        }
        let mut buffer = self.free.pop().unwrap_or_else(|| self.store.new_buffer());
        let room = buffer.as_mut_slice().get_mut(HEADER_BYTES..).and_then(|b| b.get_mut(..payload.len()));
        if let Some(room) = room {
            room.copy_from_slice(payload);
        }
        self.labels.insert(page, label.to_vec());
        let written = self.store.write(0, page, label, payload.len(), buffer);
        written.map_err(|(error, _)| no_space_for(&self.target, ReadError::Commit(error.into())))
    }

    /// Removes `page` from the next generation.
    pub fn remove(&mut self, page: PageId) {
        self.changes.insert(page, None);
    }

    /// Raises the number of the next generation to this one, if it is higher.
    pub fn skip_to(&mut self, generation: u64) {
        self.store.skip_to(generation);
    }

    /// Commits the pages written since the last commit, pinned under `names`; returns the generation.
    /// Errors: the drive fails.
    pub fn commit(&mut self, run_state: &[u8], note: &[u8], names: &[String]) -> Result<u64, ReadError> {
        while self.store.in_flight() > 0 {
            self.await_write()?;
        }
        let changes = std::mem::take(&mut self.changes).into_iter();
        let changes: Vec<PageChange> = changes.map(|(page, version)| PageChange { page, version }).collect();
        let pin = names.first().map(String::as_str);
        let cut = Cut { changes: &changes, run_state, note, pin };
        let mut done = Vec::new();
        let committed = self.commits.commit(&mut self.store, &mut done, &cut);
        let generation = committed.map_err(|error| no_space_for(&self.target, error.into()))?;
        let more: Vec<(String, u64)> = names.iter().skip(1).map(|name| (name.clone(), generation)).collect();
        if !more.is_empty() {
            let pinned = self.commits.pin(&mut self.store, &more, &[]);
            pinned.map_err(|error| no_space_for(&self.target, error.into()))?;
        }
        Ok(generation)
    }

    /// Renames the store to its target.
    /// Errors: the target exists by now, or the drive fails.
    pub fn finish(mut self) -> Result<(), ReadError> {
        let failed = |e: std::io::Error| InputError::io(&self.target, "renaming the store to its final name", &e);
        if std::fs::symlink_metadata(&self.target).is_ok() {
            return Err(
                InputError::new(&self.target, "was created meanwhile", "name another folder and start again").into()
            );
        }
        rename(&self.part, &self.target).map_err(failed)?;
        self.spill = None;
        sync_folder(folder_of(&self.target)).map_err(failed)?;
        Ok(())
    }

    /// Waits until at least one write has completed.
    fn await_write(&mut self) -> Result<(), ReadError> {
        let mut done = Vec::new();
        self.store.complete(true, &mut done);
        for PageDone { page, buffer, result, .. } in done {
            self.free.push(buffer);
            let moved = result.map_err(|e| no_space_for(&self.target, ReadError::Commit(e.into())))?;
            if let PageMoved::Written(slot) = moved {
                let label = self.labels.remove(&page).unwrap_or_default();
                self.changes.insert(page, Some((slot, label)));
            }
        }
        Ok(())
    }
}

impl Drop for NewStore {
    fn drop(&mut self) {
        // An unfinished store is useless; a file that cannot be removed stays under the `.part` name.
        if let Some(spill) = self.spill.take() {
            let _ = spill.remove();
        }
    }
}
