//! Writes a transaction of the page map, and keeps the counters: every entry added or removed changes the sums.

use crate::page::format::encoding;
use crate::page::format::seal::SealScope;
use crate::page::map::manifest::{
    COUNTERS, Counters, Fault, GENERATIONS, GENERATIONS_SEAL, HEADER, HEADER_SEAL, MapBatch, PAGES, PAGES_SEAL, PINS,
    PINS_SEAL, RUN_STATES, RUN_STATES_SEAL, bound, damaged, unseal, version_key,
};
use redb::Table;

/// Writes one batch and keeps the counters.
pub(in crate::page) struct Writer {
    pub(in crate::page) store: u128,
    pub(in crate::page) counters: Counters,
}

impl Writer {
    /// Writes all of `batch` into the tables of `transaction`.
    pub(in crate::page) fn write(
        &mut self,
        transaction: &redb::WriteTransaction,
        batch: &MapBatch,
    ) -> Result<(), Fault> {
        let mut pages = transaction.open_table(PAGES)?;
        for (page, generation) in &batch.drop_versions {
            let (key, bytes) = ((page.to_bits(), *generation), version_key(page.to_bits(), *generation));
            self.remove(PAGES_SEAL, &mut pages, key, &bytes)?;
        }
        for version in &batch.put_versions {
            let page = version.page.to_bits();
            let mut body = vec![u8::from(version.value.is_some())];
            body.extend_from_slice(version.value.as_deref().unwrap_or(&[]));
            let key = version_key(page, version.generation);
            self.insert(PAGES_SEAL, &mut pages, (page, version.generation), &key, &body)?;
        }
        self.write_generations(transaction, batch)?;
        let mut pins = transaction.open_table(PINS)?;
        for name in &batch.drop_pins {
            self.remove(PINS_SEAL, &mut pins, name.as_str(), name.as_bytes())?;
        }
        for (name, generation) in &batch.put_pins {
            let body = encoding::to_bytes(generation).map_err(|e| damaged("pin", e))?;
            self.insert(PINS_SEAL, &mut pins, name.as_str(), name.as_bytes(), &body)?;
        }
        let body = encoding::to_bytes(&self.counters).map_err(|e| damaged("counters", e))?;
        let sealed = self.scope(HEADER_SEAL).seal(bound(COUNTERS.as_bytes()), &body);
        transaction.open_table(HEADER)?.insert(COUNTERS, sealed.as_slice())?;
        Ok(())
    }

    fn write_generations(&mut self, transaction: &redb::WriteTransaction, batch: &MapBatch) -> Result<(), Fault> {
        let mut generations = transaction.open_table(GENERATIONS)?;
        let mut run_states = transaction.open_table(RUN_STATES)?;
        for generation in &batch.drop_generations {
            let key = generation.to_le_bytes();
            self.remove(GENERATIONS_SEAL, &mut generations, *generation, &key)?;
            self.remove(RUN_STATES_SEAL, &mut run_states, *generation, &key)?;
        }
        if let Some((generation, note, run_state)) = &batch.put_generation {
            let key = generation.to_le_bytes();
            self.insert(GENERATIONS_SEAL, &mut generations, *generation, &key, note)?;
            self.insert(RUN_STATES_SEAL, &mut run_states, *generation, &key, run_state)?;
        }
        Ok(())
    }

    fn scope(&self, table: u8) -> SealScope {
        SealScope { store: self.store, table }
    }

    fn insert<'k, K: redb::Key + 'static>(
        &mut self,
        seal: u8,
        table: &mut Table<'_, K, &'static [u8]>,
        key: K::SelfType<'k>,
        key_bytes: &[u8],
        body: &[u8],
    ) -> Result<(), Fault> {
        let scope = self.scope(seal);
        let sealed = scope.seal(bound(key_bytes), body);
        let before = table.insert(key, sealed.as_slice())?;
        if let Some(before) = before {
            self.subtract(unseal(scope, key_bytes, before.value(), "overwritten entry")?.1);
        }
        self.counters.entries += 1;
        self.counters.tally = self.counters.tally.wrapping_add(scope.checksum(bound(key_bytes), body));
        Ok(())
    }

    fn remove<'k, K: redb::Key + 'static>(
        &mut self,
        seal: u8,
        table: &mut Table<'_, K, &'static [u8]>,
        key: K::SelfType<'k>,
        key_bytes: &[u8],
    ) -> Result<(), Fault> {
        let before = table.remove(key)?.ok_or_else(|| damaged("entry to remove", "it is not there"))?;
        self.subtract(unseal(self.scope(seal), key_bytes, before.value(), "entry to remove")?.1);
        Ok(())
    }

    fn subtract(&mut self, checksum: u64) {
        self.counters.entries = self.counters.entries.wrapping_sub(1);
        self.counters.tally = self.counters.tally.wrapping_sub(checksum);
    }
}
