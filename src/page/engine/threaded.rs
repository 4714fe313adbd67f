//! Engines whose worker threads make blocking calls: `pread` (positioned reads and writes, which work everywhere) and
//! `mmap` (reads through memory maps, positioned writes).
//!
//! `pread` uses direct I/O where the file system allows it. Whatever goes through the page cache is dropped from there
//! as far as the system allows: a frame holds the bytes that were read, and a changed page is written to another slot.
//!
//! Invariants: those of [`PageEngine`]; besides, 1. every submitted transfer comes back exactly once, with its buffer, also when its work
//! panics; 2. dropping an engine carries out all submitted transfers and then ends the threads. The queue is unbounded: the submitter
//! bounds it by owning a bounded number of buffers.

use crate::page::engine::mmap::SegmentMaps;
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use crate::page::engine::segment_files::{SegmentFiles, WriteBehind, drop_cached};
use crate::page::engine::short_transfers::move_bytes;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// Segments as files; worker threads make blocking calls.
pub struct ThreadedEngine {
    shared: Arc<SharedSegments>,
    pool: TransferPool,
}

struct SharedSegments {
    segments: Mutex<SegmentFiles>,
    /// Reads go through these maps, if any.
    maps: Option<SegmentMaps>,
    behind: Mutex<WriteBehind>,
    direct: bool,
}

impl ThreadedEngine {
    /// Positioned reads and writes on the segments of a folder, with `threads` threads, which is also the most requests
    /// in flight at the drive. `direct` bypasses the page cache where the file system allows it.
    /// Errors: the folder cannot be used, or no thread can be started.
    pub fn pread(folder: &Path, threads: usize, direct: bool) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::new(folder, direct)?, None, threads)
    }

    /// As [`ThreadedEngine::pread`] for a read-only store: writes fail.
    /// Errors: no thread can be started.
    pub fn pread_read_only(folder: &Path, threads: usize) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::read_only(folder), None, threads)
    }

    /// Reads through memory maps of the segments of a folder, with `threads` threads that copy and write.
    /// Errors: the folder cannot be used, or no thread can be started.
    pub fn mmap(folder: &Path, threads: usize) -> io::Result<ThreadedEngine> {
        ThreadedEngine::over(SegmentFiles::new(folder, false)?, Some(SegmentMaps::default()), threads)
    }

    fn over(segments: SegmentFiles, maps: Option<SegmentMaps>, threads: usize) -> io::Result<ThreadedEngine> {
        let (direct, name) = (segments.is_direct(), if maps.is_some() { "mmap" } else { "pread" });
        let shared =
            Arc::new(SharedSegments { segments: Mutex::new(segments), maps, behind: Mutex::default(), direct });
        let worker = Arc::clone(&shared);
        let pool = TransferPool::new(name, threads, move |transfer| worker.execute(transfer))?;
        Ok(ThreadedEngine { shared, pool })
    }

    /// Whether transfers bypass the page cache.
    pub fn is_direct(&self) -> bool {
        self.shared.direct
    }
}

impl SharedSegments {
    fn execute(&self, transfer: &mut Transfer) -> io::Result<()> {
        let file = lock(&self.segments).file_of(transfer)?;
        match (&self.maps, transfer.direction) {
            (Some(maps), Direction::Read) => maps.copy_out(&file, transfer)?,
            _ => move_bytes(&file, transfer)?,
        }
        let (offset, bytes) = (transfer.place.offset, transfer.bytes as u64);
        match transfer.direction {
            _ if self.direct => {}
            Direction::Read => drop_cached(&file, offset, bytes),
            Direction::Write => lock(&self.behind).record_write(&file, offset, bytes),
        }
        Ok(())
    }
}

impl PageEngine for ThreadedEngine {
    fn name(&self) -> &'static str {
        if self.shared.maps.is_some() { "mmap" } else { "pread" }
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).create(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        lock(&self.shared.segments).check(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        if let Some(maps) = self.shared.maps.as_ref().filter(|_| transfer.direction == Direction::Read) {
            // The copy meets and reports an error of opening the file.
            let file = lock(&self.shared.segments).file_of(&transfer);
            file.into_iter().for_each(|file| maps.read_ahead(&file, &transfer));
        }
        self.pool.submit(transfer);
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        self.pool.complete(wait, done);
    }

    fn in_flight(&self) -> usize {
        self.pool.in_flight()
    }

    fn sync(&mut self) -> io::Result<()> {
        let result = lock(&self.shared.segments).sync();
        lock(&self.shared.behind).drop_all();
        result
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

struct TransferPool {
    /// `None` once the pool ends.
    queue: Option<Sender<Transfer>>,
    done: Receiver<Completion>,
    workers: Vec<JoinHandle<()>>,
    in_flight: usize,
}

impl TransferPool {
    /// Starts `threads` threads (at least one) named `name` that do `work`. Fails if the system refuses the first
    /// thread; fewer threads than requested only make the pool slower.
    pub fn new(
        name: &str,
        threads: usize,
        work: impl Fn(&mut Transfer) -> io::Result<()> + Send + Sync + 'static,
    ) -> io::Result<TransferPool> {
        let (queue, waiting) = channel::<Transfer>();
        let (finished, done) = channel();
        let (waiting, work) = (Arc::new(Mutex::new(waiting)), Arc::new(work));
        let mut pool = TransferPool { queue: Some(queue), done, workers: Vec::new(), in_flight: 0 };
        for i in 0..threads.max(1) {
            let (waiting, work, finished) = (Arc::clone(&waiting), Arc::clone(&work), finished.clone());
            let run = move || {
                loop {
                    // One idle worker waits in `recv`, the others wait for its lock.
                    let next = lock(&waiting).recv();
                    let Ok(mut transfer) = next else { return };
                    let result = catch_unwind(AssertUnwindSafe(|| work(&mut transfer)))
                        .unwrap_or_else(|_| Err(io::Error::other("an I/O thread panicked")));
                    // The pool outlives its workers, and so does the receiver.
                    let _ = finished.send(Completion { transfer, result });
                }
            };
            match std::thread::Builder::new().name(format!("{name}-{i}")).spawn(run) {
                Ok(worker) => pool.workers.push(worker),
                Err(error) if pool.workers.is_empty() => return Err(error),
                Err(_) => break,
            }
        }
        Ok(pool)
    }

    /// Queues a transfer; transfers start in order of submission.
    pub fn submit(&mut self, transfer: Transfer) {
        // Workers end only after the queue, so that it accepts every transfer.
        if self.queue.as_ref().is_some_and(|queue| queue.send(transfer).is_ok()) {
            self.in_flight += 1;
        }
    }

    /// Moves finished transfers to `done`. With `wait`, blocks until at least one has finished, if any is in flight.
    pub fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        let before = done.len();
        done.extend(self.done.try_iter());
        if wait && done.len() == before && self.in_flight > 0 {
            done.extend(self.done.recv());
        }
        self.in_flight -= done.len() - before;
    }

    /// Submitted transfers whose completion has not been collected.
    pub fn in_flight(&self) -> usize {
        self.in_flight
    }
}

impl Drop for TransferPool {
    fn drop(&mut self) {
        self.queue = None;
        for worker in self.workers.drain(..) {
            // Workers catch the panics of their work, so there is no error to report.
            let _ = worker.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::engine::buffer::PageBuffer;
    use crate::page::engine::page_engine::{Direction, Place};

    #[test]
    fn every_buffer_is_returned_even_if_the_work_panics() {
        let mut pool = TransferPool::new("test", 3, |transfer| match transfer.token % 3 {
            0 => Ok(()),
            1 => Err(io::Error::from_raw_os_error(5)),
            _ => panic!("this is a test of panics"),
        })
        .unwrap();
        for token in 0..30 {
            let buffer = PageBuffer::zeroed(4096);
            let place = Place { segment: 0, offset: 0 };
            pool.submit(Transfer { token, direction: Direction::Read, place, bytes: 4096, buffer });
        }
        let mut done = Vec::new();
        while pool.in_flight() > 0 {
            pool.complete(true, &mut done);
        }
        done.sort_by_key(|c| c.transfer.token);
        assert_eq!(done.len(), 30);
        for (token, completion) in done.iter().enumerate() {
            assert_eq!((completion.transfer.token, completion.transfer.buffer.len()), (token as u64, 4096));
            assert_eq!(completion.result.is_ok(), token % 3 == 0);
        }
        pool.complete(true, &mut done);
        assert_eq!(done.len(), 30, "with nothing in flight, `complete` must not block");
    }
}
