//! The page map on the drive: which version of every page belongs to which generation, stored in redb.
//!
//! redb decides which transaction counts after a crash. It does not detect a flipped bit in a value, and may panic on a
//! damaged file. Therefore: every value carries a checksum bound to its key; a sum over all entries reveals a missing
//! or doubled entry; opening verifies redb's own checksum tree and every value before it changes anything; panics
//! inside redb become [`MapError::Panicked`]; after a failed call the map accepts no more calls. The meaning of a
//! page's value is not known here.
//!
//! Entries are keyed (page, generation): an entry holds from its generation until the page's next entry.
//! Invariant: a batch given to [`Manifest::apply`] is in the map entirely or not at all, and durable when `apply`
//! returned.

use crate::base::ids::PageId;
use crate::page::format::encoding;
use crate::page::map::entries::{
    COUNTERS, GENERATIONS, HEADER, MapBatch, MapContent, MapCounters, MapError, MapFault, MapVersion, PAGES, PINS,
    RUN_STATES, Reader, Writer, damaged,
};
use crate::page::map::map_file::MapFile;
use crate::page::mutants::{Mutant, active};
use redb::{Builder, Database, ReadableDatabase, StorageBackend};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

/// Most transactions and generations: one a second for 68 years. Serial numbers of writes are derived from generations
/// and would overflow beyond this limit.
const SEQUENCE_MAX: u64 = 1 << 31;
const GENERATION_MAX: u64 = 1 << 31;

/// Runs calls of redb; a panic becomes an error.
fn guarded<T>(calls: impl FnOnce() -> Result<T, MapFault>) -> Result<T, MapError> {
    match catch_unwind(AssertUnwindSafe(calls)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(MapFault::Library(error))) => Err((*error).into()),
        Ok(Err(MapFault::Map(error))) => Err(error),
        Err(panic) => {
            let text = panic.downcast_ref::<&str>().map(|s| (*s).to_string());
            let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
            Err(MapError::Panicked(text.unwrap_or_else(|| "without a message".to_string())))
        }
    }
}

pub struct Manifest {
    database: Option<Database>,
    file: MapFile,
    store: u128,
    counters: MapCounters,
    poisoned: bool,
}

impl Manifest {
    /// Creates a map in an empty file, durable when this returns. The caller syncs the folder.
    /// Errors: the file cannot be written.
    pub fn create(file: Arc<dyn StorageBackend>, store: u128, cache_bytes: usize) -> Result<Manifest, MapError> {
        let file = MapFile::new(file);
        let database = guarded(|| Ok(builder(cache_bytes).create_with_backend(file.clone())?))?;
        let counters = MapCounters { next: 1, ..MapCounters::default() };
        let mut manifest = Manifest { database: Some(database), file, store, counters, poisoned: false };
        manifest.apply(&MapBatch { next: 1, ..MapBatch::default() })?;
        Ok(manifest)
    }

    /// Opens the map in `file`, verifies all of it and reads its content. On failure `file` stays unchanged.
    /// Errors: the map is damaged, older than transaction `acknowledged`, or cannot be read or written.
    /// [`MapError::Full`]: the file is in the state after a crash and may be reopened.
    pub fn open(
        file: Arc<dyn StorageBackend>,
        store: u128,
        acknowledged: u64,
        cache_bytes: usize,
    ) -> Result<(Manifest, MapContent), MapError> {
        let (mut manifest, content) = Manifest::open_read_only(file, store, acknowledged, cache_bytes)?;
        manifest.file.release_held()?;
        manifest.poisoned = false;
        Ok((manifest, content))
    }

    /// As [`Manifest::open`], but read-only: `file` never changes, and the map accepts no transaction.
    /// Errors: as [`Manifest::open`].
    pub fn open_read_only(
        file: Arc<dyn StorageBackend>,
        store: u128,
        acknowledged: u64,
        cache_bytes: usize,
    ) -> Result<(Manifest, MapContent), MapError> {
        let file = MapFile::with_deferred_writes(file)?;
        if file.len()? == 0 {
            return Err(MapError::Damaged("the file is empty".to_string()));
        }
        let database = guarded(|| Ok(builder(cache_bytes).create_with_backend(file.clone())?));
        let mut manifest = Manifest { database: None, file, store, counters: MapCounters::default(), poisoned: true };
        manifest.database = Some(database?);
        let content = manifest.read_all()?;
        manifest.counters = content.counters;
        if content.counters.sequence < acknowledged && !active(Mutant::WitnessIgnored) {
            return Err(MapError::Stale { found: content.counters.sequence, acknowledged });
        }
        Ok((manifest, content))
    }

    /// Counters after the last transaction.
    pub fn counters(&self) -> MapCounters {
        self.counters
    }

    /// Runs one transaction; durable when this returns.
    /// Errors: the transaction may or may not be durable; only reopening the map tells. The map accepts no more calls.
    pub fn apply(&mut self, batch: &MapBatch) -> Result<(), MapError> {
        if self.poisoned && !active(Mutant::PoisonIgnored) {
            return Err(MapError::Poisoned);
        }
        self.poisoned = true;
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        let start = MapCounters {
            sequence: self.counters.sequence + 1,
            latest: batch.latest,
            next: batch.next,
            ..self.counters
        };
        let mut writer = Writer { store: self.store, counters: start };
        let result = guarded(|| {
            let mut transaction = database.begin_write()?;
            transaction.set_two_phase_commit(true);
            writer.write(&transaction, batch)?;
            transaction.commit()?;
            Ok(())
        });
        match result {
            Ok(()) => {
                self.counters = writer.counters;
                self.poisoned = false;
                Ok(())
            }
            Err(error) => Err(self.file.failure().map_or(error, MapError::from)),
        }
    }

    /// The run state of a kept generation.
    /// Errors: the run state is missing, damaged or cannot be read.
    pub fn run_state(&self, generation: u64) -> Result<Vec<u8>, MapError> {
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        guarded(|| {
            let table = database.begin_read()?.open_table(RUN_STATES.table)?;
            let value = table.get(generation)?.ok_or_else(|| damaged("run state", format!("none of {generation}")))?;
            Ok(RUN_STATES.unseal(self.store, &generation, value.value())?.0.to_vec())
        })
    }

    fn read_all(&self) -> Result<MapContent, MapError> {
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        guarded(|| {
            let transaction = database.begin_read()?;
            let mut content = MapContent::default();
            let header = transaction.open_table(HEADER.table)?;
            let value = header.get(COUNTERS)?.ok_or_else(|| damaged("header", "no counters"))?;
            let (body, _) = HEADER.unseal(self.store, &COUNTERS, value.value())?;
            content.counters = encoding::from_bytes(body).map_err(|e| damaged("counters", e))?;
            let mut reader = Reader { store: self.store, transaction: &transaction, entries: 0, tally: 0 };
            reader.read(&PAGES, |(page, generation), body| {
                let page = PageId::from_bits(page).ok_or_else(|| damaged("page", "impossible id"))?;
                let value = match body.split_first() {
                    Some((0, [])) => None,
                    Some((1, rest)) => Some(rest.to_vec()),
                    _ => return Err(damaged(format!("page {page}"), "impossible value")),
                };
                content.versions.push(MapVersion { page, generation, value });
                Ok(())
            })?;
            reader.read(&GENERATIONS, |generation, note| {
                content.generations.insert(generation, note.to_vec());
                Ok(())
            })?;
            reader.read(&RUN_STATES, |_, _| Ok(()))?;
            reader.read(&PINS, |name, body| {
                let generation = encoding::from_bytes(body).map_err(|e| damaged("pin", e))?;
                content.pins.insert(name.to_string(), generation);
                Ok(())
            })?;
            let fits = (reader.entries, reader.tally) == (content.counters.entries, content.counters.tally);
            if !fits && !active(Mutant::TallyNotVerified) {
                return Err(damaged("entries", "some are missing, doubled or outdated"));
            }
            check_generations(&content)?;
            Ok(content)
        })
    }
}

impl Drop for Manifest {
    fn drop(&mut self) {
        // redb would write while closing, but the last acknowledged transaction must be the last write.
        self.file.shut();
        let database = self.database.take();
        // A panic while closing a damaged map can do no more harm.
        let _ = catch_unwind(AssertUnwindSafe(move || drop(database)));
    }
}

impl std::fmt::Debug for Manifest {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Manifest({:?}, poisoned: {})", self.counters, self.poisoned)
    }
}

fn builder(cache_bytes: usize) -> Builder {
    let mut builder = Builder::new();
    builder.set_cache_size(cache_bytes).set_check_integrity_on_open(true);
    builder
}

/// Checks that the generations in a map are consistent.
fn check_generations(content: &MapContent) -> Result<(), MapFault> {
    let MapCounters { sequence, latest, next, .. } = content.counters;
    if sequence > SEQUENCE_MAX || next > GENERATION_MAX {
        return Err(damaged("counters", format!("transaction {sequence} or generation {next} is impossible")));
    }
    let known = |generation: u64| content.generations.contains_key(&generation);
    if next <= latest || (latest > 0 && !known(latest)) || content.generations.keys().any(|g| *g > latest || *g == 0) {
        return Err(damaged("generations", format!("the latest is {latest}, the next {next}")));
    }
    if let Some((name, generation)) = content.pins.iter().find(|(_, generation)| !known(**generation)) {
        return Err(damaged(format!("pin {name:?}"), format!("there is no generation {generation}")));
    }
    if let Some(version) = content.versions.iter().find(|v| v.generation > latest || v.generation == 0) {
        return Err(damaged(format!("page {}", version.page), format!("impossible generation {}", version.generation)));
    }
    Ok(())
}
