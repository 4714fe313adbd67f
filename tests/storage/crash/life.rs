//! One life of a process over the simulated disk: opens the real store, then writes, splits and commits pages until the
//! power fails, an injected error occurs, or the life's work is done.

use super::cut::Frozen;
use super::disk::{Disk, Rng};
use super::engine::SimStore;
use super::oracle::{Acknowledged, Oracle, Snapshot, fill, payload_bytes, read_and_compare, version_of};
use gsscale::base::ids::PageId;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::{HEADER_BYTES, SlotRef};
use gsscale::page::map::commit::{CommitConfig, CommitError, Commits, Cut, PageChange};
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::page_error::PageError;
use gsscale::page::versions::paged_store::{PageDone, PageMoved, PagedStore};
use gsscale::page::versions::slots::SlotLayout;
use std::collections::{BTreeMap, BTreeSet};

pub const STORE: u128 = 0x5eed;
pub const LAYOUT: SlotLayout = SlotLayout { slot_bytes: 8192, slots_per_segment: 3 };
pub const CONFIG: CommitConfig = CommitConfig { store: STORE, cache_bytes: 1 << 18, reserve_bytes: 8192 };
const PAGES_MAX: usize = 7;

#[derive(Debug)]
pub enum End {
    /// Power failure, or an error that ends the process.
    Stopped,
    /// The store broke a promise.
    Violation(String),
}

impl From<CommitError> for End {
    fn from(_: CommitError) -> End {
        End::Stopped
    }
}

impl From<PageError> for End {
    fn from(_: PageError) -> End {
        End::Stopped
    }
}

/// A page as this process sees it.
#[derive(Debug, Clone, Copy)]
pub struct Held {
    pub version: u64,
    /// `None`: dirty, only in memory.
    pub slot: Option<SlotRef>,
    /// Slot of the previous version, until the page is written.
    pub before: Option<SlotRef>,
}

/// An open store and the process's knowledge of it.
pub struct Life<'a> {
    pub commits: Commits,
    pub store: PagedStore,
    pub oracle: &'a mut Oracle,
    pub pages: BTreeMap<PageId, Held>,
    pub changed: BTreeSet<PageId>,
    /// A cut whose commit is pending.
    pub frozen: Option<Frozen>,
    next_version: u64,
    next_page: u32,
}

/// Opens or creates the store; judges its state and compares its pages.
pub fn open<'a>(disk: &Disk, oracle: &'a mut Oracle, seed: u64) -> Result<Life<'a>, End> {
    let opened = match Opened::open(Box::new(disk.clone()), CONFIG) {
        Err(CommitError::NoStore) if !oracle.is_created => {
            oracle.snapshots.insert(0, Snapshot::default());
            Opened::create(Box::new(disk.clone()), CONFIG)
        }
        Err(CommitError::NoStore) => return Err(End::Violation("the store is gone".to_string())),
        other => other,
    };
    let opened = opened.map_err(|error| stopped_by(disk, &error))?;
    oracle.is_created = true;
    oracle.judge(&opened).map_err(End::Violation)?;
    let mut store = paged_store(disk, &opened, seed).map_err(|e| End::Violation(e.to_string()))?;
    let given = disk.faults_given();
    let unreadable = oracle.compare(&opened, &mut store);
    match unreadable {
        Ok(0) => {}
        _ if disk.has_crashed() || disk.faults_given() > given => return Err(End::Stopped),
        Ok(_) => return Err(End::Violation("committed pages cannot be read".to_string())),
        Err(what) => return Err(End::Violation(what)),
    }
    let pages =
        opened.pages.iter().map(|p| (p.page, Held { version: version_of(p), slot: Some(p.slot), before: None }));
    let pages = pages.collect();
    let next_version = 1 + seed % 1000 + 1000 * (oracle.commits + seed % (1 << 30));
    let next_page = opened.pages.iter().map(|p| (p.page.to_bits() >> 32) as u32 + 1).max().unwrap_or(0);
    let commits = opened.commits;
    Ok(Life { commits, store, oracle, pages, changed: BTreeSet::new(), frozen: None, next_version, next_page })
}

pub fn paged_store(disk: &Disk, opened: &Opened, seed: u64) -> Result<PagedStore, CommitError> {
    opened.paged_store(Box::new(SimStore::new(disk.clone(), seed)), LAYOUT, Codec::Raw)
}

/// An error without a cause on the disk is a violation.
fn stopped_by(disk: &Disk, error: &dyn std::fmt::Display) -> End {
    if disk.has_crashed() || disk.faults_given() > 0 {
        End::Stopped
    } else {
        End::Violation(format!("an error from nowhere: {error}"))
    }
}

impl Life<'_> {
    /// Gives a page, new or existing, a new version in memory.
    pub fn edit(&mut self, page: PageId) {
        self.next_version += 1;
        let version = self.next_version;
        let held = self.pages.entry(page).or_insert(Held { version, slot: None, before: None });
        held.version = version;
        held.before = held.before.or(held.slot.take());
        held.slot = None;
        self.changed.insert(page);
    }

    /// Replaces a page by its two halves.
    pub fn split(&mut self, page: PageId) {
        let Some(children) = page.children() else { return };
        if let Some(slot) = self.pages.remove(&page).and_then(|held| held.before.or(held.slot)) {
            self.store.free(&slot);
        }
        self.changed.insert(page);
        children.into_iter().for_each(|child| self.edit(child));
    }

    /// Writes a dirty page, as an eviction does. Without space the page stays dirty.
    pub fn write(&mut self, page: PageId) -> Result<(), End> {
        let Some(held) = self.pages.get(&page).copied().filter(|held| held.slot.is_none()) else { return Ok(()) };
        if self.is_frozen(page) {
            return self.write_frozen(page);
        }
        let mut buffer = self.store.new_buffer();
        let bytes = payload_bytes(page, held.version);
        fill(page, held.version, &mut buffer.as_mut_slice()[HEADER_BYTES..][..bytes]);
        let label = held.version.to_le_bytes();
        match self.store.write(page.to_bits(), page, &label, bytes, buffer) {
            Err((error, _)) if error.is_out_of_space() => return Ok(()),
            other => other.map_err(|(error, _)| error)?,
        }
        let mut done = Vec::new();
        while done.is_empty() && self.store.in_flight() > 0 {
            self.store.complete(true, &mut done);
        }
        self.take_ends(done)
    }

    fn take_ends(&mut self, done: Vec<PageDone>) -> Result<(), End> {
        for end in done {
            let slot = match end.result {
                Ok(PageMoved::Written(slot)) => slot,
                Err(error) if !error.is_out_of_space() => return Err(error.into()),
                _ => continue,
            };
            let Some(held) = self.pages.get_mut(&end.page) else { continue };
            held.slot = Some(slot);
            if let Some(before) = held.before.take() {
                self.store.free(&before);
            }
        }
        Ok(())
    }

    /// Commits; without space nothing changes.
    pub fn commit(&mut self, pin: Option<&str>) -> Result<(), End> {
        self.thaw();
        let dirty: Vec<PageId> = self.pages.iter().filter(|(_, h)| h.slot.is_none()).map(|(p, _)| *p).collect();
        for page in dirty {
            self.write(page)?;
        }
        if self.pages.values().any(|held| held.slot.is_none()) {
            return Ok(());
        }
        let change = |page: &PageId| {
            let version = self.pages.get(page).and_then(|h| Some((h.slot?, h.version.to_le_bytes().to_vec())));
            PageChange { page: *page, version }
        };
        let changes: Vec<PageChange> = self.changed.iter().map(change).collect();
        let run_state = self.next_version.to_le_bytes().repeat(1 + self.changed.len());
        let cut = Cut { changes: &changes, run_state: &run_state, note: b"note", pin };
        let mut done = Vec::new();
        let pages: BTreeMap<PageId, u64> = self.pages.iter().map(|(page, held)| (*page, held.version)).collect();
        self.begin(self.store.generation(), pages.clone(), &cut)?;
        let mut result = self.commits.commit(&mut self.store, &mut done, &cut);
        // A correct process stops after an error; a confused process may retry and must be refused.
        if result.as_ref().is_err_and(|error| !error.is_out_of_space()) {
            self.begin(self.store.generation(), pages, &cut)?;
            result = result.or_else(|error| self.commits.commit(&mut self.store, &mut done, &cut).map_err(|_| error));
        }
        self.take_ends(done)?;
        match result {
            Err(error) if error.is_out_of_space() => return Ok(()),
            other => other?,
        };
        self.oracle.acknowledge_by(&self.commits).map_err(End::Violation)?;
        self.changed.clear();
        Ok(())
    }

    /// A commit of these pages with their versions begins.
    pub fn begin(&mut self, generation: u64, pages: BTreeMap<PageId, u64>, cut: &Cut<'_>) -> Result<(), End> {
        if generation <= self.oracle.highest {
            return Err(End::Violation(format!("generation {generation} comes a second time")));
        }
        let snapshot = Snapshot { pages, run_state: cut.run_state.to_vec() };
        let change = |after: &mut Acknowledged| {
            after.latest = generation;
            after.pins.extend(cut.pin.map(|name| (name.to_string(), generation)));
        };
        self.oracle.begin(change, Some((generation, snapshot)));
        Ok(())
    }

    pub fn pin(&mut self, put: &[(String, u64)], drop: &[String]) -> Result<(), End> {
        let change = |after: &mut Acknowledged| {
            drop.iter().for_each(|name| {
                after.pins.remove(name);
            });
            after.pins.extend(put.iter().cloned());
        };
        self.oracle.begin(change, None);
        match self.commits.pin(&mut self.store, put, drop) {
            Err(error) if error.is_out_of_space() => return Ok(()),
            other => other?,
        }
        self.oracle.acknowledge_by(&self.commits).map_err(End::Violation)
    }

    pub fn ids(&self) -> Vec<PageId> {
        self.pages.keys().copied().collect()
    }

    fn check_read(&mut self, disk: &Disk, page: PageId) -> Result<(), End> {
        let Some((slot, version)) = self.pages.get(&page).and_then(|h| Some((h.slot?, h.version))) else {
            return Ok(());
        };
        let given = disk.faults_given();
        match read_and_compare(&mut self.store, page, &slot, version) {
            Ok(true) => Ok(()),
            Ok(false) if disk.has_crashed() || disk.faults_given() > given => Err(End::Stopped),
            // A failed sync may have dropped written data.
            Ok(false) if self.store.poison().is_some() => Err(End::Stopped),
            Ok(false) => Err(End::Violation(format!("page {page} cannot be read back"))),
            Err(what) => Err(End::Violation(what)),
        }
    }

    pub fn step(&mut self, disk: &Disk, rng: &mut Rng) -> Result<(), End> {
        let ids: Vec<PageId> = self.pages.keys().copied().collect();
        let some = |rng: &mut Rng| ids.get(rng.below(ids.len() as u64) as usize).copied();
        match rng.below(20) {
            0..4 => {
                let page = some(rng).filter(|_| ids.len() >= PAGES_MAX || rng.one_in(2)).unwrap_or_else(|| {
                    self.next_page += 1;
                    PageId::initial(self.next_page - 1)
                });
                self.edit(page);
            }
            4..7 => {
                let dirty: Vec<PageId> = ids.iter().copied().filter(|p| self.pages[p].slot.is_none()).collect();
                if let Some(page) = dirty.get(rng.below(dirty.len() as u64) as usize) {
                    self.write(*page)?;
                }
            }
            7 => {
                if let Some(page) = some(rng).filter(|_| ids.len() < PAGES_MAX) {
                    self.split(page);
                }
            }
            8..10 => {
                if let Some(page) = some(rng) {
                    self.check_read(disk, page)?;
                }
            }
            10..15 => {
                let name = ["a", "b"][rng.below(2) as usize];
                let is_free = !self.commits.generations().pins().contains_key(name);
                let pin = Some(name).filter(|_| is_free && rng.one_in(4));
                match self.frozen.is_some() && !rng.one_in(8) {
                    true => self.commit_frozen(pin)?,
                    false => self.commit(pin)?,
                }
            }
            15..17 => self.freeze(),
            17..19 => {
                if let Some(page) = self.unwritten().first().copied() {
                    self.write_frozen(page)?;
                }
            }
            _ => {
                let pins = self.commits.generations().pins().clone();
                let latest = self.commits.generations().latest();
                match pins.keys().next() {
                    Some(name) if rng.one_in(2) => self.pin(&[], std::slice::from_ref(name))?,
                    _ if latest > 0 => self.pin(&[("c".to_string(), latest)], &[])?,
                    _ => {}
                }
            }
        }
        Ok(())
    }
}

/// Without a mutant, an error must have a cause.
pub fn end_of(disk: &Disk, end: End) -> End {
    match end {
        End::Stopped if !disk.has_crashed() && disk.faults_given() == 0 => {
            End::Violation("an error from nowhere".to_string())
        }
        other => other,
    }
}
