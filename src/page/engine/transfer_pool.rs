//! Worker threads that carry out transfers, for engines whose system calls block.
//!
//! The queue is unbounded: the submitter bounds it by owning a bounded number of buffers.
//!
//! Invariants: 1. every submitted transfer comes back exactly once, with its buffer, also when the work panics;
//! 2. dropping the pool carries out all submitted transfers and then ends the threads.

use crate::page::engine::page_engine::{Completion, Transfer};
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

/// A pool of threads that carry out transfers.
pub struct TransferPool {
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
                    let next = waiting.lock().unwrap_or_else(PoisonError::into_inner).recv();
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
#[allow(clippy::unwrap_used)] // a panic is a failed test
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
