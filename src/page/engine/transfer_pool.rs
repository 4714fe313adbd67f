//! Worker threads that carry out transfers, for engines whose system calls block.
//!
//! The queue is unbounded: the submitter bounds it by owning a bounded number of buffers.
//!
//! Invariants: 1. every submitted transfer comes back exactly once, with its buffer, also when the work panics;
//! 2. dropping the pool carries out all submitted transfers and then ends the threads.

use crate::page::engine::page_engine::{Completion, Transfer};
use std::collections::VecDeque;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// A pool of threads that carry out transfers.
pub struct TransferPool {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
    in_flight: usize,
}

type Work = dyn Fn(&mut Transfer) -> io::Result<()> + Send + Sync;

struct Shared {
    work: Box<Work>,
    queue: Mutex<Queue>,
    /// Notified when a transfer is queued and when the pool ends.
    waiting: Condvar,
    /// Notified when a transfer has finished.
    done: Condvar,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Transfer>,
    done: Vec<Completion>,
    ended: bool,
}

impl TransferPool {
    /// Starts `threads` threads (at least one) named `name` that do `work`.
    ///
    /// # Errors
    /// The system refuses the first thread. Fewer threads than requested only make the pool slower.
    pub fn new(
        name: &str,
        threads: usize,
        work: impl Fn(&mut Transfer) -> io::Result<()> + Send + Sync + 'static,
    ) -> io::Result<TransferPool> {
        let shared = Arc::new(Shared {
            work: Box::new(work),
            queue: Mutex::default(),
            waiting: Condvar::new(),
            done: Condvar::new(),
        });
        let mut pool = TransferPool { shared, workers: Vec::new(), in_flight: 0 };
        for i in 0..threads.max(1) {
            let shared = Arc::clone(&pool.shared);
            match std::thread::Builder::new().name(format!("{name}-{i}")).spawn(move || shared.run_worker()) {
                Ok(worker) => pool.workers.push(worker),
                Err(error) if pool.workers.is_empty() => return Err(error),
                Err(_) => break,
            }
        }
        Ok(pool)
    }

    /// Queues a transfer; transfers start in order of submission.
    pub fn submit(&mut self, transfer: Transfer) {
        self.in_flight += 1;
        self.shared.lock().waiting.push_back(transfer);
        self.shared.waiting.notify_one();
    }

    /// Moves finished transfers to `done`. With `wait`, blocks until at least one has finished, if any is in flight.
    pub fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        let mut queue = self.shared.lock();
        while wait && self.in_flight > 0 && queue.done.is_empty() {
            queue = self.shared.done.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
        self.in_flight -= queue.done.len();
        done.append(&mut queue.done);
    }

    /// Submitted transfers whose completion has not been collected.
    pub fn in_flight(&self) -> usize {
        self.in_flight
    }
}

impl Drop for TransferPool {
    fn drop(&mut self) {
        self.shared.lock().ended = true;
        self.shared.waiting.notify_all();
        for worker in self.workers.drain(..) {
            // Workers catch the panics of their work, so there is no error to report.
            let _ = worker.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn run_worker(&self) {
        let mut queue = self.lock();
        loop {
            if let Some(mut transfer) = queue.waiting.pop_front() {
                drop(queue);
                let result = catch_unwind(AssertUnwindSafe(|| (self.work)(&mut transfer)))
                    .unwrap_or_else(|_| Err(io::Error::other("an I/O thread panicked")));
                queue = self.lock();
                queue.done.push(Completion { transfer, result });
                self.done.notify_one();
            } else if queue.ended {
                return;
            } else {
                queue = self.waiting.wait(queue).unwrap_or_else(PoisonError::into_inner);
            }
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
