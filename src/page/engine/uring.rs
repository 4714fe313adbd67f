//! The io_uring engine (Linux): many requests in flight without a thread for each.
//!
//! Transfers are cut into requests of at most [`REQUEST_BYTES`], because larger ones may stop midway with EAGAIN. At
//! most as many requests are submitted as the ring has entries, so neither queue overflows. Direct I/O is used where
//! the file system allows it. SQPOLL is off (it costs a core), and so is IOPOLL (it never completes on virtual drives).
//! Long-lived buffers are registered as far as the limit on locked memory allows. Files are not registered: there are
//! few, and looking one up costs little next to moving a mebibyte.
//!
//! Safety: the kernel reads and writes page buffers while this process runs. The bytes of a `PageBuffer` stay in
//! place when the buffer is moved. A transfer is moved into its flight on submission; nothing touches its bytes there,
//! and it leaves only after the kernel has completed every request that names it. Dropping the engine waits for all
//! completions; leaking the engine leaks the buffers.
//!
//! Invariants: those of [`PageEngine`]; besides, 1. a request counts as with the kernel from when it enters the
//! submission queue until its completion is taken; 2. nothing blocks while no request is with the kernel; 3. if the
//! kernel refuses the ring itself, requests not yet taken end with an error, and taken ones are waited for.
#![allow(unsafe_code)] // the ring takes addresses of buffers that it owns

use crate::base::error::is_too_many_files;
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use crate::page::engine::registered::RegisteredBuffers;
use crate::page::engine::segment_files::{SegmentFiles, WriteBehind, drop_cached};
use crate::page::engine::short_transfers::Resume;
use io_uring::{IoUring, opcode, squeue, types};
use slab::Slab;
use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// Most bytes of one request.
pub const REQUEST_BYTES: usize = 1 << 20;
/// Most refusals by the kernel to take requests, a millisecond apart, before the ring counts as broken.
const REFUSALS_MAX: u32 = 5000;
/// Temporary shortages in the kernel: EAGAIN, EBUSY, ENOMEM.
const SHORTAGES: [i32; 3] = [11, 16, 12];

/// Segments as files, transferred by io_uring.
pub struct UringEngine {
    ring: IoUring,
    registered: RegisteredBuffers,
    segments: SegmentFiles,
    behind: WriteBehind,
    flights: Slab<RingTransfer>,
    requests: Slab<RingRequest>,
    /// Requests not yet in the submission queue, oldest first.
    waiting: VecDeque<usize>,
    /// Requests in the submission queue that the kernel has not taken, oldest first.
    offered: VecDeque<usize>,
    /// Requests in the submission queue or taken by the kernel.
    with_kernel: usize,
    entries: usize,
    done: Vec<Completion>,
    broken: Option<i32>,
}

struct RingTransfer {
    transfer: Transfer,
    /// Address of the buffer's first byte, as a number: only the kernel dereferences it.
    address: usize,
    /// The buffer's index in the ring's table.
    registered: Option<u16>,
    file: Option<Arc<File>>,
    requests_left: usize,
    error: Option<io::Error>,
}

/// One piece of a transfer.
struct RingRequest {
    flight: usize,
    start: usize,
    bytes: usize,
    resume: Resume,
}

impl UringEngine {
    /// Opens a folder of segments with a ring of `entries` requests (rounded up to a power of two, at most 4096).
    /// `direct` bypasses the page cache where the file system allows it.
    /// Errors: the kernel refuses the ring (too old, or forbidden as in many containers), or the folder cannot be used.
    pub fn open(folder: &Path, entries: usize, direct: bool) -> io::Result<UringEngine> {
        let entries = entries.clamp(1, 4096).next_power_of_two();
        let ring = working_ring(entries as u32)?;
        Ok(UringEngine {
            registered: RegisteredBuffers::of(&ring.submitter()),
            ring,
            segments: SegmentFiles::new(folder, direct)?,
            behind: WriteBehind::default(),
            flights: Slab::new(),
            requests: Slab::new(),
            waiting: VecDeque::new(),
            offered: VecDeque::new(),
            with_kernel: 0,
            entries,
            done: Vec::new(),
            broken: None,
        })
    }

    /// Whether transfers bypass the page cache.
    pub fn is_direct(&self) -> bool {
        self.segments.is_direct()
    }

    /// Whether the kernel supports registered buffers: since Linux 5.19.
    pub fn supports_registration(&self) -> bool {
        self.registered.is_supported()
    }

    /// Number of registered buffers.
    pub fn registered(&self) -> usize {
        self.registered.len()
    }

    /// Moves waiting requests into the submission queue while it has room.
    fn fill_ring(&mut self) {
        while self.with_kernel < self.entries {
            let Some(&id) = self.waiting.front() else { return };
            let flight_id = self.requests[id].flight;
            if let Err(error) = self.prepare(flight_id) {
                if is_too_many_files(&error) && self.with_kernel > 0 {
                    return; // a completion will free a file descriptor
                }
                self.flights[flight_id].error.get_or_insert(error);
            }
            self.waiting.pop_front();
            if self.flights[flight_id].error.is_some() {
                self.end_request(id);
                continue;
            }
            let entry = self.entry_of(id);
            // SAFETY: the entry names bytes of a buffer that the flight owns until the kernel has completed the request
            // (see the head of this file), and a file that the flight keeps open for as long.
            if unsafe { self.ring.submission().push(&entry) }.is_err() {
                self.waiting.push_front(id);
                return;
            }
            self.offered.push_back(id);
            self.with_kernel += 1;
        }
    }

    /// Opens the file of a flight, if it is not open yet.
    fn prepare(&mut self, flight: usize) -> io::Result<()> {
        let flight = &mut self.flights[flight];
        if let Some(raw) = self.broken {
            return Err(io::Error::from_raw_os_error(raw));
        }
        if flight.file.is_none() && flight.error.is_none() {
            flight.file = Some(self.segments.file_of(&flight.transfer)?);
        }
        Ok(())
    }

    fn entry_of(&self, id: usize) -> squeue::Entry {
        let request = &self.requests[id];
        let flight = &self.flights[request.flight];
        let from = request.start + request.resume.done;
        let bytes = (request.bytes - request.resume.done) as u32;
        let offset = flight.transfer.place.offset + from as u64;
        let file = types::Fd(flight.file.as_ref().map_or(-1, |f| f.as_raw_fd()));
        let memory = std::ptr::with_exposed_provenance_mut::<u8>(flight.address + from);
        let entry = match (flight.transfer.direction, flight.registered) {
            (Direction::Read, None) => opcode::Read::new(file, memory, bytes).offset(offset).build(),
            (Direction::Write, None) => opcode::Write::new(file, memory, bytes).offset(offset).build(),
            (Direction::Read, Some(n)) => opcode::ReadFixed::new(file, memory, bytes, n).offset(offset).build(),
            (Direction::Write, Some(n)) => opcode::WriteFixed::new(file, memory, bytes, n).offset(offset).build(),
        };
        // After a temporary refusal the request may block on a kernel thread instead.
        let flags = if request.resume.tries > 0 { squeue::Flags::ASYNC } else { squeue::Flags::empty() };
        entry.flags(flags).user_data(id as u64)
    }

    /// Submits the queue to the kernel and waits for `want` completions.
    fn submit_and_wait(&mut self, want: usize) {
        let mut refusals = 0;
        while self.broken.is_none() {
            let Err(error) = self.ring.submit_and_wait(want) else { break };
            let raw = error.raw_os_error().unwrap_or(0);
            if error.kind() == io::ErrorKind::Interrupted {
                continue;
            }
            if !SHORTAGES.contains(&raw) || refusals >= REFUSALS_MAX {
                self.broken = Some(raw);
                break;
            }
            if want == 0 || !self.ring.completion().is_empty() {
                break;
            }
            refusals += 1;
            std::thread::sleep(Duration::from_millis(1));
        }
        let not_taken = self.ring.submission().len();
        self.offered.drain(..self.offered.len().saturating_sub(not_taken));
        if self.broken.is_some() {
            self.fail_offered();
            if want > 0 && self.ring.completion().is_empty() {
                // Completions of taken requests arrive without a system call.
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }

    /// Ends the requests that a broken ring still holds. The kernel reads the queue only during a system call, and none
    /// follows.
    fn fail_offered(&mut self) {
        let raw = self.broken.unwrap_or(0);
        for id in std::mem::take(&mut self.offered) {
            let flight = self.requests[id].flight;
            self.flights[flight].error.get_or_insert_with(|| io::Error::from_raw_os_error(raw));
            self.with_kernel -= 1;
            self.end_request(id);
        }
    }

    /// Collects completions from the kernel.
    fn take_answers(&mut self) {
        loop {
            let Some(answer) = self.ring.completion().next() else { return };
            let id = answer.user_data() as usize;
            self.with_kernel -= 1;
            let outcome = usize::try_from(answer.result()).map_err(|_| io::Error::from_raw_os_error(-answer.result()));
            let request = &mut self.requests[id];
            let flight = &mut self.flights[request.flight];
            match request.resume.advance(flight.transfer.direction, outcome, request.bytes) {
                Ok(false) => self.waiting.push_front(id),
                Ok(true) => self.end_request(id),
                Err(error) => {
                    flight.error.get_or_insert(error);
                    self.end_request(id);
                }
            }
        }
    }

    fn end_request(&mut self, id: usize) {
        let request = self.requests.remove(id);
        let flight = &mut self.flights[request.flight];
        flight.requests_left -= 1;
        if flight.requests_left > 0 {
            return;
        }
        let flight = self.flights.remove(request.flight);
        if let Some(file) = flight.file.as_ref().filter(|_| !self.segments.is_direct()) {
            let (offset, bytes) = (flight.transfer.place.offset, flight.transfer.bytes as u64);
            match flight.transfer.direction {
                Direction::Read => drop_cached(file, offset, bytes),
                Direction::Write => self.behind.record_write(file, offset, bytes),
            }
        }
        let result = flight.error.map_or(Ok(()), Err);
        self.done.push(Completion { transfer: flight.transfer, result });
    }
}

impl PageEngine for UringEngine {
    fn name(&self) -> &'static str {
        "uring"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        self.segments.create(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        self.segments.check(segment, bytes)
    }

    fn submit(&mut self, mut transfer: Transfer) {
        if transfer.bytes > transfer.buffer.len() || transfer.bytes == 0 {
            // Checked before any address is computed from the length; `file_of` returns the error.
            let result = self.segments.file_of(&transfer).map(|_| ());
            self.done.push(Completion { transfer, result });
            return;
        }
        let (address, total) = (transfer.buffer.as_mut_slice().as_mut_ptr().expose_provenance(), transfer.bytes);
        let registered = self.registered.number_of(&self.ring.submitter(), &mut transfer.buffer, total);
        let requests_left = total.div_ceil(REQUEST_BYTES);
        let flight = RingTransfer { transfer, address, registered, file: None, requests_left, error: None };
        let flight = self.flights.insert(flight);
        for start in (0..total).step_by(REQUEST_BYTES) {
            let bytes = REQUEST_BYTES.min(total - start);
            let id = self.requests.insert(RingRequest { flight, start, bytes, resume: Resume::default() });
            self.waiting.push_back(id);
        }
        // Collects completions to make room in the ring, before anyone polls.
        self.take_answers();
        self.fill_ring();
        if !self.offered.is_empty() {
            self.submit_and_wait(0);
        }
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        self.registered.clear_ended(&self.ring.submitter());
        self.take_answers();
        self.fill_ring();
        while wait && self.done.is_empty() && self.with_kernel > 0 {
            self.submit_and_wait(1);
            self.take_answers();
            self.fill_ring();
        }
        if !self.offered.is_empty() {
            self.submit_and_wait(0);
        }
        done.append(&mut self.done);
    }

    fn in_flight(&self) -> usize {
        self.flights.len() + self.done.len()
    }

    fn sync(&mut self) -> io::Result<()> {
        let result = self.segments.sync();
        self.behind.drop_all();
        result
    }
}

impl Drop for UringEngine {
    fn drop(&mut self) {
        let mut done = Vec::new();
        while self.in_flight() > 0 {
            self.complete(true, &mut done);
        }
    }
}

/// A ring that has completed a request. Where rings are forbidden, creating one may fail, or using it.
fn working_ring(entries: u32) -> io::Result<IoUring> {
    let mut ring = IoUring::new(entries)?;
    // SAFETY: the request names neither memory nor a file.
    let pushed = unsafe { ring.submission().push(&opcode::Nop::new().build()) };
    pushed.map_err(|_| io::Error::other("the new ring is full"))?;
    while let Err(error) = ring.submit_and_wait(1) {
        if error.kind() != io::ErrorKind::Interrupted {
            return Err(error);
        }
    }
    let answer = ring.completion().next().map(|a| a.result());
    match answer {
        Some(0) => Ok(ring),
        Some(raw) => Err(io::Error::from_raw_os_error(-raw)),
        None => Err(io::Error::other("the new ring completes no request")),
    }
}
