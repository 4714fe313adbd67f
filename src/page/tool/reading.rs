//! A store opened read-only: its map, its generations, and the places of their pages. Nothing is written, not even the
//! repairs that opening a map normally makes.
//!
//! Of a store in use by another process only the map can be read: its file is copied until a copy verifies. The pages
//! cannot be read, because slots of the last generation may be overwritten meanwhile.
//!
//! Invariants: 1. no file of the folder is opened for writing, created, or removed; 2. a [`StoreReader`] of a store
//! that is not in use keeps writers out.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::open_for_reading;
use crate::page::engine::threaded::ThreadedEngine;
use crate::page::folder::protocol_files::DriveFile;
use crate::page::folder::spill_dir::{LOCK, LOCK_MAGIC, read_format, segments_in};
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::SlotRef;
use crate::page::format::spill_format::SpillFormat;
use crate::page::map::commit::{CommitConfig, CommitError, MAP_NAME, WITNESS_NAME};
use crate::page::map::entries::{MapContent, MapError};
use crate::page::map::generations::Generations;
use crate::page::map::manifest::Manifest;
use crate::page::map::opening::{StoredPage, check_segments, pages_at, slot_and_label};
use crate::page::map::witness::Witness;
use crate::page::tool::slot_reader::SlotReader;
use crate::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use redb::StorageBackend;
use redb::backends::InMemoryBackend;
use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Memory for the map's cache, bytes.
const CACHE_BYTES: usize = 8 << 20;
/// Most copies of a map in use, until one verifies.
const COPIES_MAX: u32 = 20;

/// Why a store cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The folder or its FORMAT file cannot be used, or another process uses the store.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The map cannot be used.
    #[error(transparent)]
    Commit(#[from] CommitError),
}

impl From<MapError> for ReadError {
    fn from(error: MapError) -> ReadError {
        CommitError::Map(error).into()
    }
}

/// The part of a store to read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// The map only; works on a store in use.
    Map,
    /// Pages as well; a store in use is refused.
    Pages,
}

/// Whether the map must be at least as new as the witness says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WitnessRule {
    /// It must, and the witness must exist.
    Obeyed,
    /// The witness is ignored and may be missing: for salvage.
    Ignored,
}

#[derive(Debug)]
pub struct StoreReader {
    folder: PathBuf,
    format: SpillFormat,
    manifest: Manifest,
    content: MapContent,
    generations: Generations,
    used_by: Option<String>,
    /// Keeps writers out.
    _lock: Option<File>,
}

impl StoreReader {
    /// Opens the store in `folder` and verifies its whole map. Reads no page data.
    /// Errors: there is no store, it has another version, its map is damaged, or it is in use and `access` includes
    /// pages.
    pub fn open(folder: &Path, access: Access, rule: WitnessRule) -> Result<StoreReader, ReadError> {
        let format = format_at(folder)?;
        let (lock, used_by) = match lock_for_reading(folder)? {
            Ok(lock) => (lock, None),
            Err(who) => (None, Some(who)),
        };
        if let Some(who) = used_by.as_ref().filter(|_| access == Access::Pages) {
            return Err(in_use(folder, who).into());
        }
        let (manifest, content) = match used_by {
            None => open_map(folder, format.store, rule, false)?,
            Some(_) => open_copy(folder, format.store, rule)?,
        };
        let generations = Generations::of(&content);
        let folder = folder.to_path_buf();
        Ok(StoreReader { folder, format, manifest, content, generations, used_by, _lock: lock })
    }

    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Identity of the store and sizes of its slots.
    pub fn format(&self) -> &SpillFormat {
        &self.format
    }

    /// The process that uses the store, as its lock file says.
    pub fn used_by(&self) -> Option<&str> {
        self.used_by.as_deref()
    }

    /// The generations, kept ones and pins.
    pub fn generations(&self) -> &Generations {
        &self.generations
    }

    /// Number of transactions of the map.
    pub fn transactions(&self) -> u64 {
        self.content.counters.sequence
    }

    /// Number of entries of the map.
    pub fn entries(&self) -> usize {
        self.content.versions.len()
    }

    /// The kept generation of this number or pin; the latest if `None`.
    /// Errors: no such generation is kept; the message lists the kept ones.
    pub fn find(&self, generation: Option<&str>) -> InputResult<u64> {
        let refuse = |problem: String| {
            let pins = self.generations.pins().iter().map(|(name, g)| format!("{g} ({name})"));
            let unnamed = self.generations.kept().filter(|g| !self.generations.pins().values().any(|p| p == g));
            let list: Vec<String> = unnamed.map(|g| g.to_string()).chain(pins).collect();
            let list = if list.is_empty() { "none".to_string() } else { list.join(", ") };
            Err(InputError::new(&self.folder, problem, format!("kept generations: {list}")))
        };
        let Some(word) = generation else {
            let latest = self.generations.latest();
            return if latest > 0 { Ok(latest) } else { refuse("this store holds no commit yet".into()) };
        };
        let named = self.generations.pins().get(word).copied();
        let found = named.or_else(|| word.parse().ok().filter(|g| self.generations.is_kept(*g)));
        found.map_or_else(|| refuse(format!("generation '{word}' is not kept")), Ok)
    }

    /// Pages of a kept generation, ascending by id.
    /// Errors: the generation is not kept, or the map contradicts itself.
    pub fn pages_at(&self, generation: u64) -> Result<Vec<StoredPage>, CommitError> {
        self.check_kept(generation)?;
        pages_at(&self.content.versions, generation)
    }

    /// The run state of a kept generation.
    /// Errors: the run state is not kept, or cannot be read.
    pub fn run_state(&self, generation: u64) -> Result<Vec<u8>, CommitError> {
        self.check_kept(generation)?;
        Ok(self.manifest.run_state(generation)?)
    }

    fn check_kept(&self, generation: u64) -> Result<(), CommitError> {
        if self.generations.is_kept(generation) { Ok(()) } else { Err(CommitError::NotKept(generation)) }
    }

    pub fn note(&self, generation: u64) -> &[u8] {
        self.content.generations.get(&generation).map_or(&[], Vec::as_slice)
    }

    /// Every version that a kept generation sees, each once, ordered by place.
    /// Errors: the map contradicts itself.
    pub fn live_versions(&self) -> Result<Vec<(PageId, SlotRef, Vec<u8>)>, CommitError> {
        let mut live: BTreeMap<Place, (PageId, SlotRef, Vec<u8>)> = BTreeMap::new();
        for version in &self.content.versions {
            if let Some((slot, label)) = slot_and_label(version)? {
                live.insert(slot.place, (version.page, slot, label.to_vec()));
            }
        }
        Ok(live.into_values().collect())
    }

    /// Numbers and lengths of the existing segment files, ascending.
    /// Errors: the folder cannot be read.
    pub fn segments(&self) -> InputResult<Vec<(u32, u64)>> {
        segments_in(&self.folder)
    }

    pub fn slot_reader(&self) -> SlotReader {
        SlotReader::new(&self.folder, self.format.store, self.format.layout.slot_bytes)
    }

    /// A paged store of `pages` on an engine that cannot write.
    /// Errors: the map names an impossible slot; a segment that `pages` use, or many before it, are missing or have
    /// another length; or the engine cannot be started.
    pub fn paged_store(&self, pages: &[StoredPage], threads: usize) -> Result<PagedStore, ReadError> {
        let engine = ThreadedEngine::pread_read_only(&self.folder, threads)
            .map_err(|e| InputError::io(&self.folder, "opening the pages", &e))?;
        let SpillFormat { store, layout, .. } = self.format;
        let config =
            PagedStoreConfig { store, layout, codec: Codec::Raw, generation: self.generations.next(), serial: 0 };
        let segments = check_segments(&engine, layout, pages.iter().map(|p| &p.slot))?.number;
        let used = pages.iter().map(|p| &p.slot);
        let opened = PagedStore::open(Box::new(engine), config, segments, used);
        opened.map_err(|e| CommitError::Contradiction(e).into())
    }
}

/// Commit settings for tools that write to a store.
pub fn commit_config(store: u128) -> CommitConfig {
    CommitConfig { store, cache_bytes: CACHE_BYTES, reserve_bytes: 0 }
}

/// The last generation in the map of `store` in `folder`, 0 before the first commit. The caller holds the lock.
/// Errors: the map is missing, damaged, or older than its witness.
pub(in crate::page) fn latest_generation(folder: &Path, store: u128) -> Result<u64, ReadError> {
    let (_, content) = open_map(folder, store, WitnessRule::Obeyed, false)?;
    Ok(content.counters.latest)
}

/// Content of the FORMAT file of `folder`.
/// Errors: the file is missing, damaged, or of another version.
pub fn format_at(folder: &Path) -> InputResult<SpillFormat> {
    let no_store = || {
        let remedy = "name a run's output folder or its spill directory; if its FORMAT file was lost, gsscale-ckpt \
                      salvage can still find its pages";
        InputError::new(folder, "it is not a store: it has no FORMAT file", remedy)
    };
    read_format(folder)?.ok_or_else(no_store)
}

/// Refuses a folder that a process is using.
/// Errors: the store is in use, or its lock cannot be read.
pub fn refuse_if_in_use(folder: &Path) -> InputResult<Option<File>> {
    lock_for_reading(folder)?.map_err(|who| in_use(folder, &who))
}

fn in_use(folder: &Path, who: &str) -> InputError {
    let problem = format!("a process is writing to this store ({who}), so its pages cannot be read");
    InputError::new(
        folder,
        problem,
        "wait for it to end, or stop it (Ctrl-C commits first); ls and inspect work meanwhile",
    )
}

/// Takes a lock that readers share and that excludes writers: `None` if the store was never locked, or the process that
/// uses the store.
fn lock_for_reading(folder: &Path) -> InputResult<Result<Option<File>, String>> {
    let path = folder.join(LOCK);
    let failed = |e: io::Error| InputError::io(&path, "finding out which process uses the store", &e);
    let file = match open_for_reading(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Ok(None)),
        file => file.map_err(failed)?,
    };
    match file.try_lock_shared() {
        Ok(()) => Ok(Ok(Some(file))),
        Err(TryLockError::Error(error)) => Err(failed(error)),
        Err(TryLockError::WouldBlock) => {
            let mut text = String::new();
            // A foreign lock file may contain anything; the holder then stays unknown.
            let _ = (&file).take(512).read_to_string(&mut text);
            Ok(Err(text.strip_prefix(LOCK_MAGIC).unwrap_or("unknown").trim().replace('\n', ", ")))
        }
    }
}

/// The map, from its file or from an in-memory copy of it.
fn open_map(folder: &Path, store: u128, rule: WitnessRule, copied: bool) -> Result<(Manifest, MapContent), ReadError> {
    let acknowledged = match rule {
        WitnessRule::Obeyed => {
            let failed = CommitError::file(WITNESS_NAME);
            let file = open_for_reading(&folder.join(WITNESS_NAME)).map_err(&failed)?;
            Witness::open(Arc::new(DriveFile::new(file)), store).map_err(&failed)?.sequence()
        }
        WitnessRule::Ignored => 0,
    };
    let mut file = match open_for_reading(&folder.join(MAP_NAME)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(CommitError::NoStore.into()),
        file => file.map_err(CommitError::file(MAP_NAME))?,
    };
    let backend: Arc<dyn StorageBackend> = if copied {
        let mut bytes = Vec::new();
        let memory = InMemoryBackend::new();
        let read = file.read_to_end(&mut bytes).and_then(|_| memory.set_len(bytes.len() as u64));
        read.and_then(|()| memory.write(0, &bytes)).map_err(CommitError::file(MAP_NAME))?;
        Arc::new(memory)
    } else {
        Arc::new(DriveFile::new(file))
    };
    Ok(Manifest::open_read_only(backend, store, acknowledged, CACHE_BYTES)?)
}

/// As [`open_map`], while a process commits to it: copies the file until a copy verifies.
fn open_copy(folder: &Path, store: u128, rule: WitnessRule) -> Result<(Manifest, MapContent), ReadError> {
    for copies in 1..COPIES_MAX {
        match open_map(folder, store, rule, true) {
            Err(ReadError::Commit(CommitError::Map(_))) => {
                std::thread::sleep(Duration::from_millis(10 * u64::from(copies)));
            }
            opened => return opened,
        }
    }
    open_map(folder, store, rule, true)
}
