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
use crate::page::format::seal::{SealBroken, SealScope};
use crate::page::map::manifest_write::Writer;
use crate::page::map::map_file::MapFile;
use crate::page::map::mutants::{Mutant, active};
use crate::page::versions::page_error::is_out_of_space;
use redb::{Builder, Database, ReadableDatabase, ReadableTable, StorageBackend, TableDefinition};
use std::collections::BTreeMap;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

pub(in crate::page) const PAGES: TableDefinition<'_, (u64, u64), &[u8]> = TableDefinition::new("pages");
pub(in crate::page) const GENERATIONS: TableDefinition<'_, u64, &[u8]> = TableDefinition::new("generations");
pub(in crate::page) const RUN_STATES: TableDefinition<'_, u64, &[u8]> = TableDefinition::new("run_states");
pub(in crate::page) const PINS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("pins");
pub(in crate::page) const HEADER: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("header");

/// Table numbers in seals.
pub(in crate::page) const PAGES_SEAL: u8 = 1;
pub(in crate::page) const GENERATIONS_SEAL: u8 = 2;
pub(in crate::page) const RUN_STATES_SEAL: u8 = 3;
pub(in crate::page) const PINS_SEAL: u8 = 4;
pub(in crate::page) const HEADER_SEAL: u8 = 5;
/// Key of the counters in the header table.
pub(in crate::page) const COUNTERS: &str = "counters";

/// Most transactions and generations: one a second for 68 years. Serial numbers of writes are derived from generations
/// and would overflow beyond this limit.
const SEQUENCE_MAX: u64 = 1 << 31;
const GENERATION_MAX: u64 = 1 << 31;

/// Why the map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The bytes of the map are not those written.
    #[error("the page map is damaged: {0}")]
    Damaged(String),
    /// The map is undamaged, but older than the last acknowledged commit: a bit flipped, or an old copy was restored.
    #[error("the page map is at transaction {found}, but transaction {acknowledged} was acknowledged")]
    Stale {
        /// Number of the map's last transaction.
        found: u64,
        /// Number of the last transaction in the witness.
        acknowledged: u64,
    },
    /// redb panicked.
    #[error("the page map's library panicked: {0}")]
    Panicked(String),
    /// The drive is full. Nothing was lost; the map must be reopened.
    #[error("no space for the page map: {0}")]
    Full(io::Error),
    /// The drive failed.
    #[error("the page map cannot be read or written: {0}")]
    Io(io::Error),
    /// An earlier call failed.
    #[error("the page map stopped after an earlier error")]
    Poisoned,
}

impl From<io::Error> for MapError {
    fn from(error: io::Error) -> MapError {
        if is_out_of_space(&error) { MapError::Full(error) } else { MapError::Io(error) }
    }
}

impl From<redb::Error> for MapError {
    fn from(error: redb::Error) -> MapError {
        match error {
            redb::Error::Io(e) => e.into(),
            redb::Error::PreviousIo => MapError::Poisoned,
            other => MapError::Damaged(other.to_string()),
        }
    }
}

/// Runs calls of redb; a panic becomes an error.
fn guarded<T>(calls: impl FnOnce() -> Result<T, Fault>) -> Result<T, MapError> {
    match catch_unwind(AssertUnwindSafe(calls)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(Fault::Library(error))) => Err((*error).into()),
        Ok(Err(Fault::Map(error))) => Err(error),
        Err(panic) => {
            let text = panic.downcast_ref::<&str>().map(|s| (*s).to_string());
            let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
            Err(MapError::Panicked(text.unwrap_or_else(|| "without a message".to_string())))
        }
    }
}

/// An error inside [`guarded`].
pub(in crate::page) enum Fault {
    Library(Box<redb::Error>),
    Map(MapError),
}

impl<E: Into<redb::Error>> From<E> for Fault {
    fn from(error: E) -> Fault {
        Fault::Library(Box::new(error.into()))
    }
}

pub(in crate::page) fn damaged(place: impl std::fmt::Display, problem: impl std::fmt::Display) -> Fault {
    Fault::Map(MapError::Damaged(format!("{place}: {problem}")))
}

/// Counters of the whole map, written with every transaction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Counters {
    /// Number of transactions.
    pub sequence: u64,
    /// The latest generation; 0 before the first commit.
    pub latest: u64,
    /// Number of the next generation; never used twice.
    pub next: u64,
    /// Number of entries of all tables except the header's.
    pub(in crate::page) entries: u64,
    /// Sum of the checksums of these entries.
    pub(in crate::page) tally: u64,
}

/// One version of a page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MapVersion {
    /// The page.
    pub page: PageId,
    /// First generation that sees it.
    pub generation: u64,
    /// The store's value; `None`: the page is removed from this generation on.
    pub value: Option<Vec<u8>>,
}

/// Content of a map, except the run states.
#[derive(Debug, Default)]
pub struct MapContent {
    /// The counters.
    pub counters: Counters,
    /// All versions, ordered by page, then generation.
    pub versions: Vec<MapVersion>,
    /// The kept generations with their notes.
    pub generations: BTreeMap<u64, Vec<u8>>,
    /// Pinned generations by name.
    pub pins: BTreeMap<String, u64>,
}

/// One transaction.
#[derive(Debug, Default)]
pub struct MapBatch {
    /// New versions, which start with a generation of this transaction.
    pub put_versions: Vec<MapVersion>,
    /// Versions that no kept generation sees.
    pub drop_versions: Vec<(PageId, u64)>,
    /// The new generation: number, note, run state.
    pub put_generation: Option<(u64, Vec<u8>, Vec<u8>)>,
    /// Generations that are no longer kept.
    pub drop_generations: Vec<u64>,
    /// Pins to add.
    pub put_pins: Vec<(String, u64)>,
    /// Pins to remove.
    pub drop_pins: Vec<String>,
    /// The latest generation after this transaction.
    pub latest: u64,
    /// Number of the next generation after this transaction.
    pub next: u64,
}

/// The open map.
pub struct Manifest {
    database: Option<Database>,
    file: MapFile,
    store: u128,
    counters: Counters,
    poisoned: bool,
}

impl Manifest {
    /// Creates a map in an empty file, durable when this returns. The caller syncs the folder.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(file: Arc<dyn StorageBackend>, store: u128, cache_bytes: usize) -> Result<Manifest, MapError> {
        let file = MapFile::new(file);
        let database = guarded(|| Ok(builder(cache_bytes).create_with_backend(file.clone())?))?;
        let counters = Counters { next: 1, ..Counters::default() };
        let mut manifest = Manifest { database: Some(database), file, store, counters, poisoned: false };
        manifest.apply(&MapBatch { next: 1, ..MapBatch::default() })?;
        Ok(manifest)
    }

    /// Opens the map in `file`, verifies all of it and reads its content. On failure `file` stays unchanged.
    ///
    /// # Errors
    /// The map is damaged, older than transaction `acknowledged`, or cannot be read or written. [`MapError::Full`]: the
    /// file is in the state after a crash and may be reopened.
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
    ///
    /// # Errors
    /// As [`Manifest::open`].
    pub fn open_read_only(
        file: Arc<dyn StorageBackend>,
        store: u128,
        acknowledged: u64,
        cache_bytes: usize,
    ) -> Result<(Manifest, MapContent), MapError> {
        let file = MapFile::holding_back(file)?;
        if file.len()? == 0 {
            return Err(MapError::Damaged("the file is empty".to_string()));
        }
        let database = guarded(|| Ok(builder(cache_bytes).create_with_backend(file.clone())?));
        let mut manifest = Manifest { database: None, file, store, counters: Counters::default(), poisoned: true };
        manifest.database = Some(database?);
        let content = manifest.read_all()?;
        manifest.counters = content.counters;
        if content.counters.sequence < acknowledged && !active(Mutant::WitnessIgnored) {
            return Err(MapError::Stale { found: content.counters.sequence, acknowledged });
        }
        Ok((manifest, content))
    }

    /// Counters after the last transaction.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Runs one transaction; durable when this returns.
    ///
    /// # Errors
    /// The transaction may or may not be durable; only reopening the map tells. The map accepts no more calls.
    pub fn apply(&mut self, batch: &MapBatch) -> Result<(), MapError> {
        if self.poisoned && !active(Mutant::PoisonIgnored) {
            return Err(MapError::Poisoned);
        }
        self.poisoned = true;
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        let start =
            Counters { sequence: self.counters.sequence + 1, latest: batch.latest, next: batch.next, ..self.counters };
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
    ///
    /// # Errors
    /// The run state is missing, damaged or cannot be read.
    pub fn run_state(&self, generation: u64) -> Result<Vec<u8>, MapError> {
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        let scope = self.scope(RUN_STATES_SEAL);
        guarded(|| {
            let table = database.begin_read()?.open_table(RUN_STATES)?;
            let value = table.get(generation)?.ok_or_else(|| damaged("run state", format!("none of {generation}")))?;
            Ok(unseal(scope, &generation.to_le_bytes(), value.value(), "run state")?.0.to_vec())
        })
    }

    fn scope(&self, table: u8) -> SealScope {
        SealScope { store: self.store, table }
    }

    fn read_all(&self) -> Result<MapContent, MapError> {
        let database = self.database.as_ref().ok_or(MapError::Poisoned)?;
        guarded(|| {
            let transaction = database.begin_read()?;
            let mut content = MapContent::default();
            let header = transaction.open_table(HEADER)?;
            let value = header.get(COUNTERS)?.ok_or_else(|| damaged("header", "no counters"))?;
            let (body, _) = unseal(self.scope(HEADER_SEAL), COUNTERS.as_bytes(), value.value(), "counters")?;
            content.counters = encoding::from_bytes(body).map_err(|e| damaged("counters", e))?;
            let mut sum = Sum::default();
            self.read_versions(&transaction.open_table(PAGES)?, &mut content, &mut sum)?;
            for entry in transaction.open_table(GENERATIONS)?.iter()? {
                let (key, value) = entry?;
                let key = key.value();
                let scope = self.scope(GENERATIONS_SEAL);
                let note = sum.add(unseal(scope, &key.to_le_bytes(), value.value(), "generation")?);
                content.generations.insert(key, note.to_vec());
            }
            for entry in transaction.open_table(RUN_STATES)?.iter()? {
                let (key, value) = entry?;
                let scope = self.scope(RUN_STATES_SEAL);
                sum.add(unseal(scope, &key.value().to_le_bytes(), value.value(), "run state")?);
            }
            for entry in transaction.open_table(PINS)?.iter()? {
                let (key, value) = entry?;
                let body = sum.add(unseal(self.scope(PINS_SEAL), key.value().as_bytes(), value.value(), "pin")?);
                let generation = encoding::from_bytes(body).map_err(|e| damaged("pin", e))?;
                content.pins.insert(key.value().to_string(), generation);
            }
            let fits = (sum.entries, sum.tally) == (content.counters.entries, content.counters.tally);
            if !fits && !active(Mutant::TallyNotVerified) {
                return Err(damaged("entries", "some are missing, doubled or outdated"));
            }
            check_generations(&content)?;
            Ok(content)
        })
    }

    fn read_versions(
        &self,
        table: &impl ReadableTable<(u64, u64), &'static [u8]>,
        content: &mut MapContent,
        sum: &mut Sum,
    ) -> Result<(), Fault> {
        let scope = self.scope(PAGES_SEAL);
        for entry in table.iter()? {
            let (key, value) = entry?;
            let (page, generation) = key.value();
            let body = sum.add(unseal(scope, &version_key(page, generation), value.value(), "page")?);
            let page = PageId::from_bits(page).ok_or_else(|| damaged("page", "impossible id"))?;
            let value = match body.split_first() {
                Some((0, [])) => None,
                Some((1, rest)) => Some(rest.to_vec()),
                _ => return Err(damaged(format!("page {page}"), "impossible value")),
            };
            content.versions.push(MapVersion { page, generation, value });
        }
        Ok(())
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

pub(in crate::page) fn version_key(page: u64, generation: u64) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&page.to_le_bytes());
    key[8..].copy_from_slice(&generation.to_le_bytes());
    key
}

pub(in crate::page) fn bound(key: &[u8]) -> &[u8] {
    if active(Mutant::ValuesNotBoundToKeys) { &[] } else { key }
}

pub(in crate::page) fn unseal<'a>(
    scope: SealScope,
    key: &[u8],
    sealed: &'a [u8],
    what: &str,
) -> Result<(&'a [u8], u64), Fault> {
    match scope.unseal(bound(key), sealed) {
        Err(SealBroken) if active(Mutant::ValuesNotVerified) => {
            let (checksum, body) = sealed.split_first_chunk().ok_or_else(|| damaged(what, "too short"))?;
            Ok((body, u64::from_le_bytes(*checksum)))
        }
        result => result.map_err(|e| damaged(what, e)),
    }
}

/// Number of entries and sum of their checksums.
#[derive(Default)]
struct Sum {
    entries: u64,
    tally: u64,
}

impl Sum {
    fn add<'a>(&mut self, (body, checksum): (&'a [u8], u64)) -> &'a [u8] {
        self.entries += 1;
        self.tally = self.tally.wrapping_add(checksum);
        body
    }
}

/// Checks that the generations in a map are consistent.
fn check_generations(content: &MapContent) -> Result<(), Fault> {
    let Counters { sequence, latest, next, .. } = content.counters;
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
