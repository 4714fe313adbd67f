//! An I/O engine that fails on purpose, around a working one.
//!
//! Every operation is counted by kind. Rules say which operation fails, how, and whether all later operations of that
//! kind fail too. Rules may change while the engine is in use. Invariant: every buffer comes back as it was handed
//! over, the first invariant of [`PageEngine`]; a rule may break the others.

use gsscale::base::rng::mix64;
use gsscale::page::engine::buffer::ALIGNMENT;
use gsscale::page::engine::page_engine::{Completion, Direction, PageEngine, Place, Transfer};
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Kinds of operations, each with its own count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Operation {
    /// A transfer from the store.
    Read,
    /// A transfer to the store.
    Write,
    /// [`PageEngine::sync`].
    Sync,
    /// [`PageEngine::create_segment`].
    Create,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// An error is reported and nothing is done. `Other` stands for EIO.
    Error(io::ErrorKind),
    /// Only the first half is moved, with an error.
    Short,
    /// Only the first half is moved, and reported as complete: a torn page.
    Torn,
    /// This bit of the transfer is flipped.
    FlipBit(u64),
    /// Nothing is done, and reported as complete.
    Lost,
    /// The transfer goes to or comes from another place.
    Misdirected(Place),
}

/// A rule: which operation fails, and how.
#[derive(Debug, Clone, Copy)]
pub struct Rule {
    pub on: Operation,
    /// Number of the operation of this kind, from 0.
    pub nth: u64,
    /// Whether all later operations of the kind fail as well.
    pub for_ever: bool,
    pub fault: Fault,
}

#[derive(Debug, Default)]
struct Plan {
    rules: Vec<Rule>,
    counts: BTreeMap<Operation, u64>,
    /// Seed of the completion order; `None` keeps the order.
    reorder: Option<u64>,
}

/// The rules of an engine, shared with its test.
#[derive(Debug, Clone, Default)]
pub struct Faults(Arc<Mutex<Plan>>);

impl Faults {
    pub fn new() -> Faults {
        Faults::default()
    }

    /// Adds a rule. The first rule that fits an operation applies.
    pub fn add(&self, on: Operation, nth: u64, for_ever: bool, fault: Fault) {
        self.plan().rules.push(Rule { on, nth, for_ever, fault });
    }

    /// Removes the rules; counts continue.
    pub fn clear(&self) {
        self.plan().rules.clear();
    }

    /// From now on transfers complete one by one, in an order given by the seed.
    pub fn reorder(&self, seed: u64) {
        self.plan().reorder = Some(seed);
    }

    pub fn count(&self, on: Operation) -> u64 {
        self.plan().counts.get(&on).copied().unwrap_or(0)
    }

    fn plan(&self) -> MutexGuard<'_, Plan> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn next(&self, on: Operation) -> Option<Fault> {
        let mut plan = self.plan();
        let count = plan.counts.entry(on).or_default();
        let n = *count;
        *count += 1;
        let hit = |r: &&Rule| r.on == on && (r.nth == n || r.for_ever && r.nth < n);
        plan.rules.iter().find(hit).map(|r| r.fault)
    }

    /// A random number below `n` if completions are reordered.
    fn pick(&self, n: usize) -> Option<usize> {
        let mut plan = self.plan();
        let seed = plan.reorder.as_mut()?;
        *seed = mix64(*seed);
        Some((*seed % n.max(1) as u64) as usize)
    }
}

/// The original of a transfer that was changed on its way in.
#[derive(Debug)]
struct Changed {
    fault: Fault,
    place: Place,
    bytes: usize,
}

pub struct FaultyEngine {
    inner: Box<dyn PageEngine>,
    faults: Faults,
    changed: BTreeMap<u64, Changed>,
    ended: Vec<Completion>,
}

impl FaultyEngine {
    /// Wraps `inner`, with the rules of `faults`.
    pub fn new(inner: Box<dyn PageEngine>, faults: Faults) -> FaultyEngine {
        FaultyEngine { inner, faults, changed: BTreeMap::new(), ended: Vec::new() }
    }

    /// Restores a transfer to what was handed over, and reports the result that the fault asks for.
    fn restore(&mut self, mut completion: Completion) -> Completion {
        let Some(Changed { fault, place, bytes }) = self.changed.remove(&completion.transfer.token) else {
            return completion;
        };
        let transfer = &mut completion.transfer;
        (transfer.place, transfer.bytes) = (place, bytes);
        match fault {
            Fault::Short => completion.result = Err(io::ErrorKind::UnexpectedEof.into()),
            // On a read, the arriving bytes; on a write, the caller's memory is unchanged.
            Fault::FlipBit(bit) => flip(transfer, bit),
            _ => {}
        }
        completion
    }
}

fn flip(transfer: &mut Transfer, bit: u64) {
    let bit = bit as usize % (transfer.bytes * 8).max(1);
    transfer.buffer.as_mut_slice()[bit / 8] ^= 1 << (bit % 8);
}

impl PageEngine for FaultyEngine {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        match self.faults.next(Operation::Create) {
            Some(Fault::Error(kind)) => Err(kind.into()),
            Some(_) => Err(io::ErrorKind::Other.into()),
            None => self.inner.create_segment(segment, bytes),
        }
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        self.inner.check_segment(segment, bytes)
    }

    fn submit(&mut self, mut transfer: Transfer) {
        let on = match transfer.direction {
            Direction::Read => Operation::Read,
            Direction::Write => Operation::Write,
        };
        let Some(fault) = self.faults.next(on) else { return self.inner.submit(transfer) };
        match fault {
            Fault::Error(kind) => return self.ended.push(Completion { transfer, result: Err(kind.into()) }),
            Fault::Lost => return self.ended.push(Completion { transfer, result: Ok(()) }),
            _ => {}
        }
        self.changed.insert(transfer.token, Changed { fault, place: transfer.place, bytes: transfer.bytes });
        match fault {
            Fault::Short | Fault::Torn => transfer.bytes = transfer.bytes / 2 / ALIGNMENT * ALIGNMENT,
            Fault::FlipBit(bit) if on == Operation::Write => flip(&mut transfer, bit),
            Fault::Misdirected(place) => transfer.place = place,
            _ => {}
        }
        self.inner.submit(transfer);
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        let mut completions = Vec::new();
        self.inner.complete(wait && self.ended.is_empty(), &mut completions);
        for completion in completions {
            let restored = self.restore(completion);
            self.ended.push(restored);
        }
        match self.faults.pick(self.ended.len()) {
            Some(chosen) if !self.ended.is_empty() => done.push(self.ended.swap_remove(chosen)),
            Some(_) => {}
            None => done.append(&mut self.ended),
        }
    }

    fn in_flight(&self) -> usize {
        self.inner.in_flight() + self.ended.len()
    }

    fn sync(&mut self) -> io::Result<()> {
        match self.faults.next(Operation::Sync) {
            Some(Fault::Error(kind)) => Err(kind.into()),
            Some(Fault::Lost) => Ok(()),
            Some(_) => Err(io::ErrorKind::Other.into()),
            None => self.inner.sync(),
        }
    }
}
