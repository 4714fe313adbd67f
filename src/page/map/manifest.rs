//! The page map on the drive: which version of every page belongs to which generation, in redb.
//!
//! redb decides which transaction counts after a crash; it does not tell a flipped bit in a value from a good one, and
//! it may panic on a damaged file. So here: every value carries a checksum bound to its key; one sum over all entries
//! tells a missing or doubled entry; opening verifies the library's own tree of checksums and every value before it
//! changes anything; panics inside the library become [`MapError::Panicked`]; after any failed call the map takes no
//! more. What a page's value means is not known here.
//!
//! Entries are keyed (page, generation): the page is as the entry says from that generation on, until its next entry.
//! Invariant: what [`Manifest::apply`] was given is in the map entirely or not at all, and durable when it returned.

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

/// Numbers of the tables in seals.
pub(in crate::page) const PAGES_SEAL: u8 = 1;
pub(in crate::page) const GENERATIONS_SEAL: u8 = 2;
pub(in crate::page) const RUN_STATES_SEAL: u8 = 3;
pub(in crate::page) const PINS_SEAL: u8 = 4;
pub(in crate::page) const HEADER_SEAL: u8 = 5;
/// Key of the counters in the header table.
pub(in crate::page) const COUNTERS: &str = "counters";

/// Most transactions and generations: one a second for 68 years. Numbers of writes follow from generations, so beyond it
/// they would run over.
const SEQUENCE_MAX: u64 = 1 << 31;
const GENERATION_MAX: u64 = 1 << 31;

/// Why the map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// Bytes of the map are not what was written.
    #[error("the page map is damaged: {0}")]
    Damaged(String),
    /// The map is whole, but older than what was acknowledged: a bit flipped, or an old copy was put in place.
    #[error("the page map is at transaction {found}, but transaction {acknowledged} had been acknowledged")]
    Stale {
        /// Transaction of the map.
        found: u64,
        /// Transaction that the witness knows.
        acknowledged: u64,
    },
    /// The library panicked.
    #[error("the page map's library panicked: {0}")]
    Panicked(String),
    /// The drive is full. Nothing was lost; the map must be opened again.
    #[error("no space for the page map: {0}")]
    Full(io::Error),
    /// The drive failed.
    #[error("the page map cannot be read or written: {0}")]
    Io(io::Error),
    /// An earlier call failed.
    #[error("the page map takes no more after an earlier error")]
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

/// Runs calls of the library. A panic in it is an error.
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

/// What can go wrong inside [`guarded`].
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

/// Counts of the whole map, written with every transaction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Counters {
    /// Transactions so far.
    pub sequence: u64,
    /// The generation that the store is at; 0 before the first commit.
    pub latest: u64,
    /// Number of the next generation; never used twice.
    pub next: u64,
    /// Entries of all tables but the header's.
    pub(in crate::page) entries: u64,
    /// Sum of the checksums of all these entries.
    pub(in crate::page) tally: u64,
}

/// One version of a page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MapVersion {
    /// The page.
    pub page: PageId,
    /// First generation that it belongs to.
    pub generation: u64,
    /// What the store keeps about it; `None`: from this generation on there is no such page.
    pub value: Option<Vec<u8>>,
}

/// Everything in a map but the run states.
#[derive(Debug, Default)]
pub struct MapContent {
    /// Counts.
    pub counters: Counters,
    /// All versions, ordered by page, then generation.
    pub versions: Vec<MapVersion>,
    /// The kept generations and a note about each.
    pub generations: BTreeMap<u64, Vec<u8>>,
    /// Named generations.
    pub pins: BTreeMap<String, u64>,
}

/// One transaction.
#[derive(Debug, Default)]
pub struct MapBatch {
    /// Versions that begin with a generation of this transaction.
    pub put_versions: Vec<MapVersion>,
    /// Versions that no kept generation needs.
    pub drop_versions: Vec<(PageId, u64)>,
    /// A new generation: number, note, run state.
    pub put_generation: Option<(u64, Vec<u8>, Vec<u8>)>,
    /// Generations that are not kept any longer.
    pub drop_generations: Vec<u64>,
    /// Names to give.
    pub put_pins: Vec<(String, u64)>,
    /// Names to take away.
    pub drop_pins: Vec<String>,
    /// The generation that the store is at afterwards.
    pub latest: u64,
    /// Number of the next generation afterwards.
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
    /// A new map in an empty file, durable when this returns. The folder is the caller's to sync.
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

    /// Opens the map in `file`, verifies all of it and reads what it holds. Unless it succeeds, `file` stays as it was.
    ///
    /// # Errors
    /// The map is damaged, older than transaction `acknowledged`, or cannot be read or written. [`MapError::Full`]: the
    /// file is as a crash leaves it, and may be opened again.
    pub fn open(
        file: Arc<dyn StorageBackend>,
        store: u128,
        acknowledged: u64,
        cache_bytes: usize,
    ) -> Result<(Manifest, MapContent), MapError> {
        let (mut manifest, content) = Manifest::look(file, store, acknowledged, cache_bytes)?;
        manifest.file.let_through()?;
        manifest.poisoned = false;
        Ok((manifest, content))
    }

    /// As [`Manifest::open`], but `file` stays as it is whatever happens: the map takes no transaction.
    ///
    /// # Errors
    /// As [`Manifest::open`].
    pub fn look(
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

    /// Counts after the last transaction.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Carries out one transaction: durable when this returns.
    ///
    /// # Errors
    /// It may be durable or not; nothing but opening the map again tells. The map takes no more.
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
    /// It is not there, damaged or cannot be read.
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
                return Err(damaged("entries", "some are missing, doubled or from another time"));
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
        // The library would write while closing; the last acknowledged transaction is to be the last write.
        self.file.shut();
        let database = self.database.take();
        // A panic while closing a damaged map has nothing left to harm.
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

/// Number and sum of checksums of entries.
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

/// What a map says about generations cannot contradict itself.
fn check_generations(content: &MapContent) -> Result<(), Fault> {
    let Counters { sequence, latest, next, .. } = content.counters;
    if sequence > SEQUENCE_MAX || next > GENERATION_MAX {
        return Err(damaged("counters", format!("no store gets to transaction {sequence} and generation {next}")));
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
