//! The expected contents of a store: every acknowledged state, and the state under commit.

use gsscale::base::ids::PageId;
use gsscale::base::rng::mix64;
use gsscale::page::format::slot_header::{HEADER_BYTES, SlotRef};
use gsscale::page::map::commit::{CommitError, Commits};
use gsscale::page::map::opening::{Opened, StoredPage};
use gsscale::page::versions::page_error::PageError;
use gsscale::page::versions::paged_store::{PageMoved, PagedStore};
use std::collections::BTreeMap;

/// The pages of a generation by the number of their version, and the run state.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Snapshot {
    pub pages: BTreeMap<PageId, u64>,
    pub run_state: Vec<u8>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Acknowledged {
    pub latest: u64,
    pub pins: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Default)]
pub struct Oracle {
    /// Whether the creation of the store returned.
    pub is_created: bool,
    pub acknowledged: Acknowledged,
    /// The states that pending transactions may leave: several after a transaction without space, which may be durable
    /// all the same.
    pub in_flight: Vec<Candidate>,
    pub snapshots: BTreeMap<u64, Snapshot>,
    /// Largest generation number so far.
    pub highest: u64,
    pub commits: u64,
}

/// The state that a pending transaction would leave.
#[derive(Debug, Clone)]
pub struct Candidate {
    pub after: Acknowledged,
    /// Generations created by this transaction and the pending ones before it.
    pub snapshots: Vec<(u64, Snapshot)>,
}

/// Length and bytes of version `version` of `page`.
pub fn payload_bytes(page: PageId, version: u64) -> usize {
    64 + (mix64(page.to_bits() ^ version << 20) % 192) as usize
}

pub fn fill(page: PageId, version: u64, payload: &mut [u8]) {
    for (i, piece) in payload.chunks_mut(8).enumerate() {
        let bytes = mix64(page.to_bits() ^ (version << 20) ^ i as u64).to_le_bytes();
        piece.copy_from_slice(&bytes[..piece.len()]);
    }
}

/// Reads a version and compares it. `Ok(false)`: the store reports it as unreadable.
pub fn read_and_compare(store: &mut PagedStore, page: PageId, slot: &SlotRef, version: u64) -> Result<bool, String> {
    match read(store, page, slot) {
        Err(PageError::Read { .. } | PageError::Damaged { .. }) => Ok(false),
        Err(error) => Err(format!("reading page {page}: {error}")),
        Ok(payload) => {
            let mut expected = vec![0; payload_bytes(page, version)];
            fill(page, version, &mut expected);
            if payload == expected { Ok(true) } else { Err(format!("wrong bytes of page {page} version {version}")) }
        }
    }
}

fn read(store: &mut PagedStore, page: PageId, slot: &SlotRef) -> Result<Vec<u8>, PageError> {
    let buffer = store.new_buffer();
    store.read(u64::MAX, page, slot, buffer);
    let mut done = Vec::new();
    loop {
        store.complete(true, &mut done);
        let Some(at) = done.iter().position(|d| d.token == u64::MAX) else { continue };
        let end = done.swap_remove(at);
        return end.result.map(|moved| {
            let PageMoved::Read { payload_bytes } = moved else { return Vec::new() };
            end.buffer.as_slice()[HEADER_BYTES..][..payload_bytes].to_vec()
        });
    }
}

impl Oracle {
    /// A transaction begins. `change` maps a state to the next; `snapshot` is the generation that the transaction
    /// creates.
    pub fn begin(&mut self, change: impl Fn(&mut Acknowledged), snapshot: Option<(u64, Snapshot)>) {
        let now = Candidate { after: self.acknowledged.clone(), snapshots: Vec::new() };
        let bases = std::iter::once(now).chain(self.in_flight.iter().cloned());
        let begun: Vec<Candidate> = bases
            .map(|mut candidate| {
                change(&mut candidate.after);
                candidate.snapshots.extend(snapshot.clone());
                candidate
            })
            .collect();
        self.in_flight.extend(begun);
    }

    /// The transaction was acknowledged; the store reports the state `found` and the kept generations `kept`.
    pub fn acknowledge(&mut self, found: &Acknowledged, kept: &[u64]) -> Result<(), String> {
        let candidates = std::mem::take(&mut self.in_flight);
        if candidates.iter().all(|c| c.after != *found) {
            return Err(format!("acknowledged {found:?}, under way was {candidates:?}"));
        }
        // The kept generations show which earlier transactions are durable.
        let brought = candidates.into_iter().filter(|c| c.after == *found).flat_map(|c| c.snapshots);
        self.snapshots.extend(brought.filter(|(generation, _)| kept.contains(generation)));
        self.acknowledged = found.clone();
        let latest = found.latest;
        self.snapshots.retain(|g, _| *g <= latest);
        self.highest = self.highest.max(latest);
        self.commits += 1;
        Ok(())
    }

    /// Checks that the state of a newly opened store is one of the possible states, and adopts it.
    pub fn judge(&mut self, opened: &Opened) -> Result<(), String> {
        let generations = opened.commits.generations();
        let found = state_of(&opened.commits);
        let kept: Vec<u64> = generations.kept().collect();
        if found == self.acknowledged {
            self.in_flight.clear();
        } else {
            let expected = self.acknowledged.clone();
            self.acknowledge(&found, &kept)
                .map_err(|other| format!("opened wrongly; {expected:?} expected, {other}"))?;
        }
        if let Some((name, generation)) = found.pins.iter().find(|(_, g)| !kept.contains(g)) {
            return Err(format!("pin {name} names generation {generation}, which is not kept: {kept:?}"));
        }
        let previous = self.snapshots.range(..found.latest).next_back().map(|(g, _)| *g);
        if let Some(previous) = previous.filter(|g| !kept.contains(g) && *g > 0) {
            return Err(format!("generation {previous} before the latest is not kept: {kept:?}"));
        }
        self.snapshots.retain(|g, _| kept.contains(g) || *g == 0);
        Ok(())
    }

    /// Compares pages and run state of all kept generations with the committed ones. Returns the number of unreadable
    /// pages.
    pub fn compare(&self, opened: &Opened, store: &mut PagedStore) -> Result<u64, String> {
        let mut unreadable = 0;
        let mut compared: Vec<(PageId, u64)> = Vec::new();
        for generation in opened.commits.generations().kept() {
            let snapshot = self.snapshots.get(&generation).ok_or(format!("generation {generation} never was"))?;
            let pages = opened.pages_at(generation).map_err(|e| e.to_string())?;
            let found: BTreeMap<PageId, u64> = pages.iter().map(|p| (p.page, version_of(p))).collect();
            if found != snapshot.pages {
                return Err(format!("generation {generation} has pages {found:?} instead of {:?}", snapshot.pages));
            }
            for page in &pages {
                if compared.contains(&(page.page, version_of(page))) {
                    continue;
                }
                compared.push((page.page, version_of(page)));
                let is_good = read_and_compare(store, page.page, &page.slot, version_of(page))?;
                unreadable += u64::from(!is_good);
            }
            match opened.commits.run_state(generation) {
                Ok(state) if state == snapshot.run_state => {}
                Ok(_) => return Err(format!("generation {generation} has another run state")),
                Err(CommitError::Map(_)) => unreadable += 1,
                Err(error) => return Err(error.to_string()),
            }
        }
        Ok(unreadable)
    }
}

/// The version in a page's label.
pub fn version_of(page: &StoredPage) -> u64 {
    page.label.first_chunk().map_or(u64::MAX, |bytes| u64::from_le_bytes(*bytes))
}

fn state_of(commits: &Commits) -> Acknowledged {
    Acknowledged { latest: commits.generations().latest(), pins: commits.generations().pins().clone() }
}

impl Oracle {
    /// [`Oracle::acknowledge`] with the state that the store reports.
    pub fn acknowledge_by(&mut self, commits: &Commits) -> Result<(), String> {
        let kept: Vec<u64> = commits.generations().kept().collect();
        self.acknowledge(&state_of(commits), &kept)
    }
}
