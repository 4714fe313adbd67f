//! Commits: make written pages a durable generation, and open the store at the last one.
//!
//! A commit at a step boundary runs in this order: 1. every write has completed in full (the pager has written the
//! dirty pages back to free slots); 2. the segments are synced; 3. one transaction of the page map, durable when it
//! returns, names the new versions; 4. the witness records it: the commit is acknowledged; 5. only now slots and map
//! entries that no kept generation sees become free.
//!
//! Invariants: 1. a store opens at the last acknowledged generation or at one whose commit was in progress, never at
//! another and never at a mixture; 2. after a failed write, sync or transaction this process commits nothing more,
//! except after a lack of space (never that of a sync): then the map is reopened, the reserve is given up, and the commit may be repeated;
//! 3. nothing durable names a file whose folder entry is not durable.
//!
//! One process at a time owns the store; the caller holds the lock on its folder.

use crate::base::error::{REMEDY_TOO_MANY_FILES, is_out_of_space, is_too_many_files};
use crate::base::ids::PageId;
use crate::page::folder::protocol_files::Folder;
pub use crate::page::folder::protocol_files::{MAP_NAME, RESERVE_NAME, RESERVE_NEW_NAME, WITNESS_NAME};
use crate::page::format::slot_header::SlotRef;
use crate::page::map::entries::{MapBatch, MapError};
use crate::page::map::generations::Generations;
use crate::page::map::manifest::Manifest;
use crate::page::map::witness::Witness;
use crate::page::mutants::{Mutant, active};
use crate::page::versions::page_error::{PageError, REMEDY_SPACE};
use crate::page::versions::paged_store::{PageDone, PagedStore};
use std::io;

/// Bytes per write while the reserve is filled.
const RESERVE_PIECE_BYTES: usize = 1 << 20;

/// Settings that are fixed while a store is open.
#[derive(Debug, Clone, Copy)]
pub struct CommitConfig {
    /// Identity of the store, part of every value and slot.
    pub store: u128,
    /// Memory for the map's cache, bytes.
    pub cache_bytes: usize,
    /// Bytes of the reserve: room for one segment and for the map to grow. 0: no reserve.
    pub reserve_bytes: u64,
}

/// A page that changed since the last generation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PageChange {
    pub page: PageId,
    /// Its slot and label; `None`: the page was removed.
    pub version: Option<(SlotRef, Vec<u8>)>,
}

/// Content of a generation, beside the unchanged pages.
#[derive(Debug, Clone, Copy)]
pub struct Cut<'a> {
    /// All pages that changed since the last acknowledged commit, each once.
    pub changes: &'a [PageChange],
    /// The trainer's state, needed to resume.
    pub run_state: &'a [u8],
    /// A few bytes that lists of generations show.
    pub note: &'a [u8],
    /// If set, the generation is pinned under this name.
    pub pin: Option<&'a str>,
}

/// The commits of one open store.
pub struct Commits {
    pub(super) folder: Box<dyn Folder>,
    pub(super) config: CommitConfig,
    /// `None` after the drive was full: the map must be reopened. Its last transaction may be durable and not in the witness.
    pub(super) manifest: Option<Manifest>,
    pub(super) witness: Witness,
    pub(super) generations: Generations,
    pub(super) poison: Option<String>,
}

impl Commits {
    pub fn config(&self) -> CommitConfig {
        self.config
    }

    /// The generations, kept ones and pins.
    pub fn generations(&self) -> &Generations {
        &self.generations
    }

    /// The error after which commits stopped, if any.
    pub fn poison(&self) -> Option<&str> {
        self.poison.as_deref()
    }

    /// Commits, and returns the number of the generation, which is then durable. Page writes that ended meanwhile are
    /// in `done`.
    /// Errors: nothing was acknowledged. Unless [`CommitError::is_out_of_space`], this process commits nothing more;
    /// the store then opens at the last acknowledged generation or at this one.
    pub fn commit(
        &mut self,
        store: &mut PagedStore,
        done: &mut Vec<PageDone>,
        cut: &Cut<'_>,
    ) -> Result<u64, CommitError> {
        self.poisoning(store, |commits, store| commits.commit_steps(store, done, None, cut))
    }

    /// As [`Commits::commit`], for a generation that was [cut](PagedStore::cut) earlier and whose pages have been
    /// written since.
    /// Errors: as [`Commits::commit`].
    pub fn commit_cut(
        &mut self,
        store: &mut PagedStore,
        done: &mut Vec<PageDone>,
        generation: u64,
        cut: &Cut<'_>,
    ) -> Result<u64, CommitError> {
        self.poisoning(store, |commits, store| commits.commit_steps(store, done, Some(generation), cut))
    }

    /// Runs a step of a commit unless commits have stopped; an error other than a lack of space stops them.
    fn poisoning<T>(
        &mut self,
        store: &mut PagedStore,
        step: impl FnOnce(&mut Commits, &mut PagedStore) -> Result<T, CommitError>,
    ) -> Result<T, CommitError> {
        self.refuse_if_poisoned()?;
        let result = step(self, store);
        if let Some(error) = result.as_ref().err().filter(|error| !error.is_out_of_space()) {
            let cause = error.to_string();
            store.poison_with(cause.clone());
            self.poison.get_or_insert(cause);
        }
        result
    }

    fn commit_steps(
        &mut self,
        store: &mut PagedStore,
        done: &mut Vec<PageDone>,
        generation: Option<u64>,
        cut: &Cut<'_>,
    ) -> Result<u64, CommitError> {
        if !active(Mutant::SegmentsNotSynced) && !active(Mutant::SegmentsSyncedAfterMap) {
            let first = done.len();
            store.sync(done)?;
            // A page that could not be written for lack of space is not durable, although nothing else failed.
            let short = done[first..].iter().find_map(|d| d.result.as_ref().err().filter(|e| e.is_out_of_space()));
            if let Some(error) = short {
                return Err(CommitError::Full(io::Error::new(io::ErrorKind::StorageFull, error.to_string())));
            }
        }
        self.ensure_open()?;
        let generation = generation.unwrap_or_else(|| store.cut());
        // The map's value for a version of a page: the slot reference, then the label.
        let value = |(slot, label): &(SlotRef, Vec<u8>)| [&slot.to_bytes()[..], label].concat();
        let put = cut.changes.iter().map(|c| (c.page, c.version.as_ref().map(value)));
        let texts = (cut.note.to_vec(), cut.run_state.to_vec());
        let batch = self.generations.plan_commit(generation, put.collect(), texts, cut.pin);
        if active(Mutant::SlotsFreedBeforeAcknowledgement) {
            let kept = self.generations.kept().filter(|g| !batch.drop_generations.contains(g));
            store.commit_done(batch.latest, &kept.collect::<Vec<u64>>());
        }
        self.acknowledge(&batch)?;
        if active(Mutant::SegmentsSyncedAfterMap) {
            store.sync(done)?;
        }
        self.free_slots(store);
        Ok(generation)
    }

    /// Pins kept generations under names and removes pins; frees what only the removed pins kept.
    /// Errors: a generation is not kept; otherwise as [`Commits::commit`].
    pub fn pin(&mut self, store: &mut PagedStore, put: &[(String, u64)], drop: &[String]) -> Result<(), CommitError> {
        if let Some((_, generation)) = put.iter().find(|(_, generation)| !self.generations.is_kept(*generation)) {
            return Err(CommitError::NotKept(*generation));
        }
        self.poisoning(store, |commits, store| {
            commits.ensure_open()?;
            commits.acknowledge(&commits.generations.plan_pins(put, drop))?;
            commits.free_slots(store);
            Ok(())
        })
    }

    /// Makes a kept generation the latest again, drops the later ones with their pins, and closes the store.
    /// Errors: the generation is not kept; otherwise as [`Commits::commit`].
    pub fn rollback(mut self, generation: u64) -> Result<(), CommitError> {
        self.refuse_if_poisoned()?;
        self.check_kept(generation)?;
        let batch = self.generations.plan_rollback(generation);
        self.acknowledge(&batch)
    }

    /// The run state of a kept generation.
    /// Errors: the generation is not kept, or cannot be read.
    pub fn run_state(&self, generation: u64) -> Result<Vec<u8>, CommitError> {
        self.check_kept(generation)?;
        let manifest = self.manifest.as_ref().ok_or(MapError::Poisoned)?;
        Ok(manifest.run_state(generation)?)
    }

    pub(super) fn check_kept(&self, generation: u64) -> Result<(), CommitError> {
        if self.generations.is_kept(generation) { Ok(()) } else { Err(CommitError::NotKept(generation)) }
    }

    /// Creates the reserve, if missing; returns whether it exists now.
    /// Errors: creation failed for a reason other than space.
    pub fn fill_reserve(&mut self) -> Result<bool, CommitError> {
        let bytes = self.config.reserve_bytes;
        match fill_reserve(self.folder.as_ref(), bytes) {
            Ok(()) => Ok(true),
            Err(error) if is_out_of_space(error.kind()) => {
                self.give_up_reserve()?;
                Ok(false)
            }
            Err(error) => Err(CommitError::file(RESERVE_NAME)(error)),
        }
    }

    /// Deletes the reserve: its space is free for segments and the map. Returns whether there was one.
    /// Errors: the folder cannot be written.
    pub fn give_up_reserve(&mut self) -> Result<bool, CommitError> {
        let error = CommitError::file(RESERVE_NAME);
        let mut was_there = false;
        for name in [RESERVE_NAME, RESERVE_NEW_NAME] {
            was_there |= self.folder.open(name).map_err(&error)?.is_some();
            self.folder.remove(name).map_err(&error)?;
        }
        Ok(was_there)
    }

    /// Runs the transaction, records it in the witness, then updates the generations. On a full drive tries once more
    /// with the reserve's space.
    fn acknowledge(&mut self, batch: &MapBatch) -> Result<(), CommitError> {
        if active(Mutant::WitnessBeforeMap) {
            let next = self.witness.sequence() + 1;
            self.witness.record(next).map_err(CommitError::file(WITNESS_NAME))?;
        }
        let mut applied = self.apply(batch);
        if applied.is_err() && active(Mutant::MapCommitRetried) {
            self.manifest = None;
            applied = self.open_again().and_then(|_| self.apply(batch));
        }
        if matches!(applied, Err(MapError::Full(_))) && self.give_up_reserve()? {
            // The interrupted transaction may have been durable after all: reopening the map tells, and counts it if
            // so.
            applied = match self.open_again() {
                Ok(true) => return Ok(()),
                Ok(false) => self.apply(batch),
                Err(error) => Err(error),
            };
        }
        match applied {
            Err(MapError::Full(source)) => return Err(CommitError::Full(source)),
            other => other?,
        }
        let sequence = self.manifest.as_ref().map_or(0, |m| m.counters().sequence);
        match self.witness.record(sequence) {
            Err(error) if is_out_of_space(error.kind()) => {
                // The transaction is durable: reopening the map tells, and records it again.
                self.manifest = None;
                return Err(CommitError::Full(error));
            }
            recorded => recorded.map_err(CommitError::file(WITNESS_NAME))?,
        }
        self.generations.adopt(batch);
        Ok(())
    }

    /// Runs one transaction. A map that found no space is closed and must be reopened.
    fn apply(&mut self, batch: &MapBatch) -> Result<(), MapError> {
        let manifest = self.manifest.as_mut().ok_or(MapError::Poisoned)?;
        let result = manifest.apply(batch);
        if matches!(result, Err(MapError::Full(_))) {
            self.manifest = None;
        }
        result
    }

    /// Reopens a closed map. Returns whether the interrupted transaction was durable; if so it is now acknowledged and
    /// counted.
    fn open_again(&mut self) -> Result<bool, MapError> {
        if self.manifest.is_some() {
            return Ok(false);
        }
        let file = self.folder.open(MAP_NAME)?;
        let file = file.ok_or_else(|| MapError::Damaged("the file no longer exists".to_string()))?;
        let acknowledged = self.witness.sequence();
        let (manifest, content) = Manifest::open(file, self.config.store, acknowledged, self.config.cache_bytes)?;
        let was_durable = content.counters.sequence > acknowledged;
        if was_durable {
            self.witness.record(content.counters.sequence)?;
        }
        self.manifest = Some(manifest);
        self.generations = Generations::of(&content);
        Ok(was_durable)
    }

    fn ensure_open(&mut self) -> Result<(), CommitError> {
        match self.open_again() {
            Err(MapError::Full(source)) => Err(CommitError::Full(source)),
            other => Ok(other.map(|_| ())?),
        }
    }

    fn free_slots(&self, store: &mut PagedStore) {
        let kept: Vec<u64> = self.generations.kept().collect();
        let kept = if active(Mutant::SlotsFreedAtOnce) { Vec::new() } else { kept };
        store.commit_done(self.generations.latest(), &kept);
    }

    fn refuse_if_poisoned(&self) -> Result<(), CommitError> {
        match &self.poison {
            Some(cause) if !active(Mutant::PoisonIgnored) => Err(CommitError::Poisoned(cause.clone())),
            _ => Ok(()),
        }
    }
}

impl std::fmt::Debug for Commits {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Commits({:?}, {:?}, poison: {:?})", self.manifest, self.witness, self.poison)
    }
}

/// Writes every byte, because some drives and file systems do not keep space that was only allocated. The rename comes
/// last: a file of the final name is filled, even if the process was killed or the power failed.
fn fill_reserve(folder: &dyn Folder, bytes: u64) -> io::Result<()> {
    if bytes == 0 {
        return folder.remove(RESERVE_NEW_NAME).and_then(|()| folder.remove(RESERVE_NAME));
    }
    if let Some(file) = folder.open(RESERVE_NAME)?
        && file.len()? >= bytes
    {
        return Ok(());
    }
    // A reserve that is too small is deleted, so that the new one can use its space.
    folder.remove(RESERVE_NAME)?;
    let file = folder.create(RESERVE_NEW_NAME)?;
    file.set_len(bytes)?;
    let piece = vec![0x5a; RESERVE_PIECE_BYTES];
    for at in (0..bytes).step_by(RESERVE_PIECE_BYTES) {
        file.write(at, &piece[..(bytes - at).min(RESERVE_PIECE_BYTES as u64) as usize])?;
    }
    file.sync_data()?;
    drop(file);
    folder.rename(RESERVE_NEW_NAME, RESERVE_NAME)?;
    folder.sync()
}

/// Why a store cannot be created, opened, or committed to.
#[derive(Debug, thiserror::Error)]
pub enum CommitError {
    /// Pages could not be made durable.
    #[error(transparent)]
    Pages(#[from] PageError),
    #[error(
        "{0}\n  remedy: check the drive, then start again: acknowledged commits are intact; if the map itself is damaged, \
         gsscale-ckpt salvage rebuilds it from the pages, in another folder"
    )]
    Map(#[from] MapError),
    /// No space. Nothing is lost; the commit may be repeated once there is space.
    #[error("there is no space for a commit: {0}\n  remedy: {REMEDY_SPACE}")]
    Full(io::Error),
    /// A file beside the map cannot be used.
    #[error("{name} cannot be used: {source}\n  remedy: {}", file_remedy(.source))]
    File {
        /// Name of the file in the store's folder.
        name: &'static str,
        source: io::Error,
    },
    /// An earlier error ended all commits of this process.
    #[error("commits stopped after a drive error ({0})\n  remedy: check the drive, then start again")]
    Poisoned(String),
    /// The folder contains no store.
    #[error("there is no page map in this folder")]
    NoStore,
    /// The map is undamaged, but its content is impossible.
    #[error("the page map contradicts itself: {0}\n  remedy: `gsscale-ckpt salvage` can rebuild it from the pages")]
    Contradiction(String),
    /// Segments are missing or have another length.
    #[error(
        "pages are missing: {0}\n  remedy: restore the segment files; `gsscale-ckpt salvage` recovers the remaining pages"
    )]
    Segments(String),
    /// The requested generation is not kept.
    #[error("generation {0} is not kept\n  remedy: `gsscale-ckpt ls` lists the kept generations")]
    NotKept(u64),
}

/// The remedy when a file beside the map cannot be used.
fn file_remedy(source: &io::Error) -> &'static str {
    match is_too_many_files(source) {
        true => REMEDY_TOO_MANY_FILES,
        false if is_out_of_space(source.kind()) => "free space on the drive of this folder",
        false => "check the drive; `gsscale-ckpt salvage` can rebuild the map",
    }
}

impl CommitError {
    /// The error of the system about the file `name`.
    pub(in crate::page) fn file(name: &'static str) -> impl Fn(io::Error) -> CommitError {
        move |source| CommitError::File { name, source }
    }

    /// Whether the error is only a lack of space: a later attempt may succeed.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            CommitError::Full(_) | CommitError::Map(MapError::Full(_)) => true,
            CommitError::Pages(error) => error.is_out_of_space(),
            _ => false,
        }
    }
}
