//! What the page map consists of: tables of sealed entries, and the transaction that changes them.
//!
//! Every value is preceded by a checksum that also covers the store's identity, the table and the key, so that a value from the wrong
//! place or with a flipped bit is recognised (accidents, not forgery); the counters hold the number of entries and the sum of their
//! checksums, which reveals a missing or doubled entry.
//!
//! Invariant: every entry added or removed by `Writer` changes the counters of the same transaction.

use crate::base::error::is_out_of_space;
use crate::base::ids::PageId;
use crate::page::format::encoding;
use crate::page::mutants::{Mutant, active};
use redb::{Key, ReadTransaction, Table, TableDefinition, WriteTransaction};
use std::collections::BTreeMap;
use std::io;
use xxhash_rust::xxh3::Xxh3;

/// A table: its name, its number in seals, and the word for its entries in messages.
pub(in crate::page) struct Entries<K: Key + 'static> {
    pub table: TableDefinition<'static, K, &'static [u8]>,
    seal: u8,
    what: &'static str,
}

impl<K: Key + 'static> Entries<K> {
    const fn new(name: &'static str, seal: u8, what: &'static str) -> Entries<K> {
        Entries { table: TableDefinition::new(name), seal, what }
    }

    fn scope(&self, store: u128) -> SealScope {
        SealScope { store, table: self.seal }
    }

    /// The body and the checksum of a sealed value.
    pub(in crate::page) fn unseal<'a>(
        &self,
        store: u128,
        key: &impl SealKey,
        sealed: &'a [u8],
    ) -> Result<(&'a [u8], u64), MapFault> {
        match self.scope(store).unseal(bound(&key.bytes()), sealed) {
            Err(SealBroken) if active(Mutant::ValuesNotVerified) => {
                let (checksum, body) = sealed.split_first_chunk().ok_or_else(|| damaged(self.what, "too short"))?;
                Ok((body, u64::from_le_bytes(*checksum)))
            }
            result => result.map_err(|e| damaged(self.what, e)),
        }
    }
}

pub(in crate::page) const PAGES: Entries<(u64, u64)> = Entries::new("pages", 1, "page");
pub(in crate::page) const GENERATIONS: Entries<u64> = Entries::new("generations", 2, "generation");
pub(in crate::page) const RUN_STATES: Entries<u64> = Entries::new("run_states", 3, "run state");
pub(in crate::page) const PINS: Entries<&str> = Entries::new("pins", 4, "pin");
pub(in crate::page) const HEADER: Entries<&str> = Entries::new("header", 5, "counters");
/// Key of the counters in the header table.
pub(in crate::page) const COUNTERS: &str = "counters";

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
        if is_out_of_space(error.kind()) { MapError::Full(error) } else { MapError::Io(error) }
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

/// An error inside calls of redb.
pub(in crate::page) enum MapFault {
    Library(Box<redb::Error>),
    Map(MapError),
}

impl<E: Into<redb::Error>> From<E> for MapFault {
    fn from(error: E) -> MapFault {
        MapFault::Library(Box::new(error.into()))
    }
}

pub(in crate::page) fn damaged(place: impl std::fmt::Display, problem: impl std::fmt::Display) -> MapFault {
    MapFault::Map(MapError::Damaged(format!("{place}: {problem}")))
}

/// Counters of the whole map, written with every transaction.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct MapCounters {
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

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MapVersion {
    pub page: PageId,
    /// First generation that sees it.
    pub generation: u64,
    /// The store's value; `None`: the page is removed from this generation on.
    pub value: Option<Vec<u8>>,
}

/// Content of a map, except the run states.
#[derive(Debug, Default)]
pub struct MapContent {
    pub counters: MapCounters,
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
    pub put_pins: Vec<(String, u64)>,
    pub drop_pins: Vec<String>,
    /// The latest generation after this transaction.
    pub latest: u64,
    /// Number of the next generation after this transaction.
    pub next: u64,
}

/// A key as bytes, to which the seal of its value is bound.
pub(in crate::page) trait SealKey {
    fn bytes(&self) -> Vec<u8>;
}

impl SealKey for u64 {
    fn bytes(&self) -> Vec<u8> {
        self.to_le_bytes().to_vec()
    }
}

impl SealKey for (u64, u64) {
    fn bytes(&self) -> Vec<u8> {
        [self.0.to_le_bytes(), self.1.to_le_bytes()].concat()
    }
}

impl SealKey for &str {
    fn bytes(&self) -> Vec<u8> {
        self.as_bytes().to_vec()
    }
}

fn bound(key: &[u8]) -> &[u8] {
    if active(Mutant::ValuesNotBoundToKeys) { &[] } else { key }
}

/// Reads the entries of a map and adds them up.
pub(in crate::page) struct Reader<'a> {
    pub store: u128,
    pub transaction: &'a ReadTransaction,
    /// Number of entries read.
    pub entries: u64,
    /// Sum of their checksums.
    pub tally: u64,
}

impl Reader<'_> {
    /// Passes every entry of a table to `take`, in the order of keys.
    pub fn read<K>(
        &mut self,
        of: &Entries<K>,
        mut take: impl FnMut(K::SelfType<'_>, &[u8]) -> Result<(), MapFault>,
    ) -> Result<(), MapFault>
    where
        K: Key + 'static,
        for<'k> K::SelfType<'k>: SealKey,
    {
        for entry in self.transaction.open_table(of.table)?.range::<K::SelfType<'_>>(..)? {
            let (key, value) = entry?;
            let (body, checksum) = of.unseal(self.store, &key.value(), value.value())?;
            self.entries += 1;
            self.tally = self.tally.wrapping_add(checksum);
            take(key.value(), body)?;
        }
        Ok(())
    }
}

/// Writes one batch and keeps the counters.
pub(in crate::page) struct Writer {
    pub store: u128,
    pub counters: MapCounters,
}

impl Writer {
    /// Writes all of `batch` into the tables of `transaction`.
    pub fn write(&mut self, transaction: &WriteTransaction, batch: &MapBatch) -> Result<(), MapFault> {
        let mut pages = transaction.open_table(PAGES.table)?;
        for (page, generation) in &batch.drop_versions {
            self.remove(&PAGES, &mut pages, (page.to_bits(), *generation))?;
        }
        for version in &batch.put_versions {
            let mut body = vec![u8::from(version.value.is_some())];
            body.extend_from_slice(version.value.as_deref().unwrap_or(&[]));
            self.insert(&PAGES, &mut pages, (version.page.to_bits(), version.generation), &body)?;
        }
        let mut generations = transaction.open_table(GENERATIONS.table)?;
        let mut run_states = transaction.open_table(RUN_STATES.table)?;
        for generation in &batch.drop_generations {
            self.remove(&GENERATIONS, &mut generations, *generation)?;
            self.remove(&RUN_STATES, &mut run_states, *generation)?;
        }
        if let Some((generation, note, run_state)) = &batch.put_generation {
            self.insert(&GENERATIONS, &mut generations, *generation, note)?;
            self.insert(&RUN_STATES, &mut run_states, *generation, run_state)?;
        }
        let mut pins = transaction.open_table(PINS.table)?;
        for name in &batch.drop_pins {
            self.remove(&PINS, &mut pins, name.as_str())?;
        }
        for (name, generation) in &batch.put_pins {
            self.insert(&PINS, &mut pins, name.as_str(), &generation.to_le_bytes())?;
        }
        let body = encoding::to_bytes(&self.counters).map_err(|e| damaged("counters", e))?;
        let sealed = HEADER.scope(self.store).seal(bound(COUNTERS.as_bytes()), &body);
        transaction.open_table(HEADER.table)?.insert(COUNTERS, sealed.as_slice())?;
        Ok(())
    }

    fn insert<'k, K>(
        &mut self,
        of: &Entries<K>,
        table: &mut Table<'_, K, &'static [u8]>,
        key: K::SelfType<'k>,
        body: &[u8],
    ) -> Result<(), MapFault>
    where
        K: Key + 'static,
        K::SelfType<'k>: SealKey + Copy,
    {
        let sealed = of.scope(self.store).seal(bound(&key.bytes()), body);
        if let Some(before) = table.insert(key, sealed.as_slice())? {
            self.subtract(of.unseal(self.store, &key, before.value())?.1);
        }
        self.counters.entries += 1;
        let checksum = of.scope(self.store).checksum(bound(&key.bytes()), body);
        self.counters.tally = self.counters.tally.wrapping_add(checksum);
        Ok(())
    }

    fn remove<'k, K>(
        &mut self,
        of: &Entries<K>,
        table: &mut Table<'_, K, &'static [u8]>,
        key: K::SelfType<'k>,
    ) -> Result<(), MapFault>
    where
        K: Key + 'static,
        K::SelfType<'k>: SealKey + Copy,
    {
        let before = table.remove(key)?.ok_or_else(|| damaged("entry to remove", "it is not there"))?;
        self.subtract(of.unseal(self.store, &key, before.value())?.1);
        Ok(())
    }

    fn subtract(&mut self, checksum: u64) {
        self.counters.entries = self.counters.entries.wrapping_sub(1);
        self.counters.tally = self.counters.tally.wrapping_sub(checksum);
    }
}

/// Bytes that a seal adds before the body.
pub const SEAL_BYTES: usize = 8;

/// The value was not sealed under this scope and key, or has changed since.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("its checksum does not match")]
pub struct SealBroken;

/// The store and table that a seal is bound to, beside the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SealScope {
    pub store: u128,
    pub table: u8,
}

impl SealScope {
    pub fn checksum(self, key: &[u8], body: &[u8]) -> u64 {
        let mut hash = Xxh3::with_seed(u64::from(self.table));
        hash.update(&self.store.to_le_bytes());
        hash.update(&(key.len() as u64).to_le_bytes());
        hash.update(key);
        hash.update(body);
        hash.digest()
    }

    /// `body` preceded by its checksum.
    pub fn seal(self, key: &[u8], body: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(SEAL_BYTES + body.len());
        bytes.extend_from_slice(&self.checksum(key, body).to_le_bytes());
        bytes.extend_from_slice(body);
        bytes
    }

    /// The body of a sealed value, and its checksum.
    /// Errors: the value was not sealed under this scope and key, or has changed since.
    pub fn unseal<'a>(self, key: &[u8], sealed: &'a [u8]) -> Result<(&'a [u8], u64), SealBroken> {
        let (checksum, body) = sealed.split_first_chunk::<SEAL_BYTES>().ok_or(SealBroken)?;
        let checksum = u64::from_le_bytes(*checksum);
        if checksum == self.checksum(key, body) { Ok((body, checksum)) } else { Err(SealBroken) }
    }
}
