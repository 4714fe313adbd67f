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
    /// An engine without segments.
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

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::page::engine::buffer::PageBuffer;
    use crate::page::engine::page_engine::Place;

    fn move_bytes(store: &mut MemoryEngine, direction: Direction, place: Place, buffer: PageBuffer) -> Completion {
        store.submit(Transfer { token: 1, direction, place, bytes: buffer.len(), buffer });
        let mut done = Vec::new();
        store.complete(true, &mut done);
        assert_eq!((done.len(), store.in_flight()), (1, 0));
        done.remove(0)
    }

    #[test]
    fn bytes_round_trip_and_buffers_are_returned() {
        let mut store = MemoryEngine::new();
        store.create_segment(2, 8192).unwrap();
        store.create_segment(2, 8192).unwrap();
        assert_eq!(store.create_segment(2, 4096).unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        let place = Place { segment: 2, offset: 4096 };
        let mut buffer = PageBuffer::zeroed(4096);
        buffer.as_mut_slice().fill(7);
        assert!(move_bytes(&mut store, Direction::Write, place, buffer).result.is_ok());
        let read = move_bytes(&mut store, Direction::Read, place, PageBuffer::zeroed(4096));
        assert!(read.result.is_ok() && read.transfer.buffer.as_slice().iter().all(|&b| b == 7));
        for place in [Place { segment: 2, offset: 8192 }, Place { segment: 2, offset: u64::MAX }] {
            let end = move_bytes(&mut store, Direction::Read, place, PageBuffer::zeroed(4096));
            assert_eq!(end.result.unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
            assert_eq!(end.transfer.buffer.len(), 4096);
        }
        let lost = Place { segment: 0, offset: 0 };
        let end = move_bytes(&mut store, Direction::Write, lost, PageBuffer::zeroed(4096));
        assert_eq!(end.result.unwrap_err().kind(), io::ErrorKind::NotFound);
        assert!(store.sync().is_ok());
    }
}
