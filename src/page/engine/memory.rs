//! A page engine in memory: the oracle of the other engines, and the store of runs that fit in memory.
//!
//! Invariants: those of [`PageEngine`]; besides, a transfer is carried out on submission, and transfers complete in
//! order.

use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use std::collections::{BTreeMap, VecDeque};
use std::io;

/// Segments as plain memory. Physical memory is taken only as it is written.
#[derive(Debug, Default)]
pub struct MemoryEngine {
    segments: BTreeMap<u32, Vec<u8>>,
    done: VecDeque<Completion>,
}

impl MemoryEngine {
    pub fn new() -> MemoryEngine {
        MemoryEngine::default()
    }

    /// The bytes of a segment, for tests that corrupt them.
    pub fn segment_mut(&mut self, segment: u32) -> Option<&mut [u8]> {
        self.segments.get_mut(&segment).map(Vec::as_mut_slice)
    }

    fn transfer(&mut self, transfer: &mut Transfer) -> io::Result<()> {
        let missing = || io::Error::new(io::ErrorKind::NotFound, "the segment does not exist");
        let beyond = || io::Error::new(io::ErrorKind::UnexpectedEof, "the place lies beyond the end of the segment");
        let segment = self.segments.get_mut(&transfer.place.segment).ok_or_else(missing)?;
        let start = usize::try_from(transfer.place.offset).map_err(|_| beyond())?;
        let end = start.checked_add(transfer.bytes).ok_or_else(beyond)?;
        let there = segment.get_mut(start..end).ok_or_else(beyond)?;
        match transfer.direction {
            Direction::Read => transfer.buffer.as_mut_slice()[..transfer.bytes].copy_from_slice(there),
            Direction::Write => there.copy_from_slice(&transfer.buffer.as_slice()[..transfer.bytes]),
        }
        Ok(())
    }
}

impl PageEngine for MemoryEngine {
    fn name(&self) -> &'static str {
        "memory"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        let too_large = |_| io::Error::from(io::ErrorKind::OutOfMemory);
        let bytes = usize::try_from(bytes).map_err(too_large)?;
        match self.segments.get(&segment) {
            Some(there) if there.len() == bytes => Ok(()),
            Some(_) => Err(io::Error::new(io::ErrorKind::AlreadyExists, "the segment exists with another size")),
            None => {
                self.segments.insert(segment, vec![0; bytes]);
                Ok(())
            }
        }
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        let is_there = self.segments.get(&segment).is_some_and(|there| there.len() as u64 == bytes);
        if is_there { Ok(()) } else { Err(io::ErrorKind::NotFound.into()) }
    }

    fn submit(&mut self, mut transfer: Transfer) {
        let result = self.transfer(&mut transfer);
        self.done.push_back(Completion { transfer, result });
    }

    fn complete(&mut self, _wait: bool, done: &mut Vec<Completion>) {
        done.extend(self.done.drain(..));
    }

    fn in_flight(&self) -> usize {
        self.done.len()
    }

    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}
