//! Which generations are kept, which map entries they need, and what a commit adds and removes.
//!
//! Bookkeeping without I/O: transactions are planned here, carried out by [`super::commit`], and adopted here once
//! durable. A generation sees, of every page, the last entry that is not newer than itself.
//!
//! Invariants: 1. the latest generation, the one before it and every pinned one are kept; 2. an entry leaves the map
//! only when no kept generation sees it; 3. no number is given to two generations, so a slot of a dropped generation
//! cannot pass for one of a later generation.

use crate::base::ids::PageId;
use crate::page::map::entries::{MapBatch, MapContent, MapVersion};
use crate::page::mutants::{Mutant, active};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// An entry, seen by generations `from..until`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Superseded {
    page: PageId,
    from: u64,
    until: u64,
}

impl Superseded {
    fn is_seen(&self, kept: &BTreeSet<u64>) -> bool {
        if active(Mutant::EntriesCollectedTooEarly) {
            return false;
        }
        active(Mutant::EntriesNotCollected) || kept.range(self.from..self.until).next().is_some()
    }
}

#[derive(Debug, Default)]
pub struct Generations {
    latest: u64,
    next: u64,
    kept: BTreeSet<u64>,
    pins: BTreeMap<String, u64>,
    /// For every existing page, the generation of its last entry.
    last: HashMap<PageId, u64>,
    /// For every removed page that a kept generation still sees, the generation of the entry that records the removal.
    gone: BTreeMap<PageId, u64>,
    superseded: Vec<Superseded>,
}

impl Generations {
    pub fn of(content: &MapContent) -> Generations {
        let mut generations = Generations {
            latest: content.counters.latest,
            next: content.counters.next,
            kept: content.generations.keys().copied().collect(),
            pins: content.pins.clone(),
            ..Generations::default()
        };
        for version in &content.versions {
            generations.add(version);
        }
        generations
    }

    /// The latest generation; 0 before the first commit.
    pub fn latest(&self) -> u64 {
        self.latest
    }

    pub fn next(&self) -> u64 {
        self.next
    }

    /// The kept generations, ascending.
    pub fn kept(&self) -> impl Iterator<Item = u64> + '_ {
        self.kept.iter().copied()
    }

    pub fn is_kept(&self, generation: u64) -> bool {
        self.kept.contains(&generation)
    }

    /// Pinned generations by name.
    pub fn pins(&self) -> &BTreeMap<String, u64> {
        &self.pins
    }

    pub fn names_of(&self, generation: u64) -> Vec<String> {
        self.pins.iter().filter(|(_, g)| **g == generation).map(|(name, _)| name.clone()).collect()
    }

    fn add(&mut self, version: &MapVersion) {
        let (page, until) = (version.page, version.generation);
        if let Some(from) = self.last.remove(&page).or_else(|| self.gone.remove(&page)) {
            self.superseded.push(Superseded { page, from, until });
        }
        match version.value {
            Some(_) => self.last.insert(page, until),
            None => self.gone.insert(page, until),
        };
    }

    /// Plans the transaction that makes `generation`, which is later than all, the latest. `put` holds the pages changed since the last
    /// generation, in any order, each once.
    pub fn plan_commit(
        &self,
        generation: u64,
        put: Vec<(PageId, Option<Vec<u8>>)>,
        texts: (Vec<u8>, Vec<u8>),
        pin: Option<&str>,
    ) -> MapBatch {
        // Entries of a generation that is there already would be superseded by themselves, and a removal among them lost.
        debug_assert!(generation > self.latest, "generation {generation} is planned after {}", self.latest);
        let mut pins = self.pins.clone();
        pins.extend(pin.map(|name| (name.to_string(), generation)));
        let mut versions: Vec<MapVersion> =
            put.into_iter().map(|(page, value)| MapVersion { page, generation, value }).collect();
        versions.sort_unstable_by_key(|v| v.page);
        if active(Mutant::RemovalNotRecorded) {
            versions.retain(|v| v.value.is_some());
        }
        let (note, run_state) = texts;
        self.drop_unseen(MapBatch {
            put_versions: versions,
            put_generation: Some((generation, note, run_state)),
            put_pins: pin.map(|name| (name.to_string(), generation)).into_iter().collect(),
            latest: generation,
            next: generation + 1,
            ..self.plan_with(self.kept_with(generation, &pins), generation)
        })
    }

    /// Plans the transaction that pins and unpins generations.
    pub fn plan_pins(&self, put: &[(String, u64)], drop: &[String]) -> MapBatch {
        let mut pins = self.pins.clone();
        drop.iter().for_each(|name| {
            pins.remove(name);
        });
        pins.extend(put.iter().cloned());
        let previous = self.kept.range(..self.latest).next_back().copied();
        let mut kept = self.kept_with(self.latest, &pins);
        kept.extend(previous);
        self.drop_unseen(MapBatch {
            put_pins: put.to_vec(),
            drop_pins: drop.iter().filter(|name| self.pins.contains_key(*name)).cloned().collect(),
            ..self.plan_with(kept, self.latest)
        })
    }

    /// Plans the transaction that makes the kept generation `to` the latest again; later ones are dropped with their
    /// pins. Not for [`Generations::adopt`]: the store is reopened afterwards.
    pub fn plan_rollback(&self, to: u64) -> MapBatch {
        let entries = self.superseded.iter().map(|s| (s.page, s.from));
        let last = self.last.iter().chain(&self.gone).map(|(page, from)| (*page, *from));
        let next = if active(Mutant::GenerationsReused) { to + 1 } else { self.next };
        MapBatch {
            drop_versions: entries.chain(last).filter(|(_, from)| *from > to).collect(),
            drop_generations: self.kept.range(to + 1..).copied().collect(),
            drop_pins: self.pins.iter().filter(|(_, g)| **g > to).map(|(name, _)| name.clone()).collect(),
            latest: to,
            next,
            ..MapBatch::default()
        }
    }

    /// Applies `batch` to this bookkeeping, once it is durable.
    pub fn adopt(&mut self, batch: &MapBatch) {
        for version in &batch.put_versions {
            self.add(version);
        }
        for generation in &batch.drop_generations {
            self.kept.remove(generation);
        }
        self.kept.extend(batch.put_generation.iter().map(|(generation, ..)| *generation));
        for name in &batch.drop_pins {
            self.pins.remove(name);
        }
        self.pins.extend(batch.put_pins.iter().cloned());
        (self.latest, self.next) = (batch.latest, batch.next);
        let dropped: BTreeSet<(PageId, u64)> = batch.drop_versions.iter().copied().collect();
        self.superseded.retain(|s| !dropped.contains(&(s.page, s.from)));
        for (page, from) in dropped {
            if self.last.get(&page) == Some(&from) {
                self.last.remove(&page);
            }
            if self.gone.get(&page) == Some(&from) {
                self.gone.remove(&page);
            }
        }
    }

    fn kept_with(&self, latest: u64, pins: &BTreeMap<String, u64>) -> BTreeSet<u64> {
        let mut kept: BTreeSet<u64> = std::iter::once(latest).filter(|g| *g > 0).collect();
        if !active(Mutant::PinsNotKept) {
            kept.extend(pins.values());
        }
        if !active(Mutant::PreviousNotKept) {
            kept.extend(Some(self.latest).filter(|g| *g > 0));
        }
        kept
    }

    fn plan_with(&self, kept: BTreeSet<u64>, latest: u64) -> MapBatch {
        let drop_generations = self.kept.difference(&kept).copied().collect();
        MapBatch { drop_generations, latest, next: self.next, ..MapBatch::default() }
    }

    /// Adds the entries that no kept generation sees after this transaction to those to drop.
    fn drop_unseen(&self, mut batch: MapBatch) -> MapBatch {
        let mut kept = self.kept.clone();
        kept.extend(batch.put_generation.iter().map(|(generation, ..)| *generation));
        batch.drop_generations.iter().for_each(|g| {
            kept.remove(g);
        });
        let newly = batch.put_versions.iter().filter_map(|&MapVersion { page, generation: until, .. }| {
            let from = *self.last.get(&page).or_else(|| self.gone.get(&page))?;
            Some(Superseded { page, from, until })
        });
        let (seen, needless): (Vec<_>, Vec<_>) =
            self.superseded.iter().copied().chain(newly).partition(|s| s.is_seen(&kept));
        batch.drop_versions.extend(needless.iter().map(|s| (s.page, s.from)));
        let with_past: BTreeSet<PageId> = seen.iter().map(|s| s.page).collect();
        batch.put_versions.retain(|v| v.value.is_some() || with_past.contains(&v.page));
        let put: BTreeSet<PageId> = batch.put_versions.iter().map(|v| v.page).collect();
        let gone = self.gone.iter().filter(|(page, _)| !with_past.contains(page) && !put.contains(page));
        batch.drop_versions.extend(gone.map(|(page, from)| (*page, *from)));
        batch.drop_versions.sort_unstable();
        batch
    }
}

#[cfg(all(test, debug_assertions))]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "generation 1 is planned after 1")]
    fn no_generation_is_planned_twice() {
        let mut generations = Generations::default();
        let plan = |generations: &Generations| generations.plan_commit(1, Vec::new(), Default::default(), None);
        let batch = plan(&generations);
        generations.adopt(&batch);
        plan(&generations);
    }
}
