//! Hands finished recordings to the queue of the device: at once, or on a thread of its own.
//!
//! A software driver computes inside the call that submits. A device behind a bus computes beside the host. So where a bus is emulated
//! ([`super::bus`]), a thread makes the call: the emulated device computes beside the host on any driver, and what a run does between two
//! waits hides behind compute as it would on hardware. Elsewhere the caller submits. An error that a submission on the thread causes names the
//! stage that the host has reached meanwhile.
//!
//! Invariants: 1. recordings reach the queue in the order of [`Submitter::submit`]; 2. uniforms of a recording are written right before it,
//! and its staging memory is mapped right after it, by the same thread; 3. whoever waits for a [`Ticket`] is woken, also if its
//! recording is dropped; 4. the thread ends before its device is dropped; 5. a mapping is asked for after the commands that use the
//! memory were submitted, so the API maps the memory when those are done.

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::{Builder, JoinHandle};

use super::error::{GpuError, GpuResult};
use super::faults::{Faults, lock};

/// Where staging memory is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum MapState {
    /// Commands that use it are being recorded.
    Recorded,
    /// Those commands are submitted, or about to be; the mapping follows them.
    Pending,
    /// The host may use it.
    Mapped,
    /// It could not be mapped.
    Failed,
}

/// A [`MapState`] that several threads share.
#[derive(Debug, Clone)]
pub(super) struct SharedState(Arc<AtomicU8>);

impl SharedState {
    pub(super) fn new(state: MapState) -> SharedState {
        SharedState(Arc::new(AtomicU8::new(state as u8)))
    }

    pub(super) fn set(&self, state: MapState) {
        self.0.store(state as u8, Ordering::Release);
    }

    pub(super) fn get(&self) -> MapState {
        const BY_NUMBER: [MapState; 4] = [MapState::Recorded, MapState::Pending, MapState::Mapped, MapState::Failed];
        BY_NUMBER[usize::from(self.0.load(Ordering::Acquire)) % BY_NUMBER.len()]
    }
}

/// A mapping to ask for once the commands that use the memory are submitted.
#[derive(Debug)]
pub(super) struct Mapping {
    raw: wgpu::Buffer,
    mode: wgpu::MapMode,
    size: u64,
    state: SharedState,
}

impl Mapping {
    /// The mapping of the first `size` bytes of `raw`, which reports to `state`.
    pub(super) fn new(raw: &wgpu::Buffer, mode: wgpu::MapMode, size: u64, state: &SharedState) -> Mapping {
        Mapping { raw: raw.clone(), mode, size, state: state.clone() }
    }

    /// Notes that the commands are submitted, or about to be.
    pub(super) fn set_pending(&self) {
        self.state.set(MapState::Pending);
    }

    /// Asks for the mapping.
    pub(super) fn start(self) {
        let state = self.state;
        self.raw.map_async(self.mode, ..self.size, move |result| {
            state.set(if result.is_ok() { MapState::Mapped } else { MapState::Failed });
        });
    }
}

/// A submission, possibly still to be made.
#[derive(Debug, Clone, Default)]
pub(super) struct Ticket(Arc<OnceLock<Option<wgpu::SubmissionIndex>>>);

impl Ticket {
    /// Waits until the submission is made; `None` if its recording was dropped instead.
    pub(super) fn index(&self) -> Option<wgpu::SubmissionIndex> {
        self.0.wait().clone()
    }
}

/// A finished recording.
#[derive(Debug)]
pub(super) struct Job {
    /// What to write to the buffers of uniforms.
    pub(super) uniforms: Vec<(wgpu::Buffer, Vec<u8>)>,
    pub(super) commands: wgpu::CommandBuffer,
    /// Staging memory to map when the commands are done.
    pub(super) mappings: Vec<Mapping>,
    pub(super) waker: Waker,
}

/// Wakes those who wait for a ticket, at the latest when it is dropped.
#[derive(Debug)]
pub(super) struct Waker(Ticket);

impl Waker {
    pub(super) fn of(ticket: &Ticket) -> Waker {
        Waker(ticket.clone())
    }

    fn submitted(&self, index: wgpu::SubmissionIndex) {
        let _ = self.0.0.set(Some(index)); // nobody else sets it
    }
}

impl Drop for Waker {
    fn drop(&mut self) {
        let _ = self.0.0.set(None); // set already if the submission was made
    }
}

impl Job {
    /// Submits the recording. The driver reports errors of the submission by itself.
    fn run(self, device: &wgpu::Device, queue: &wgpu::Queue, faults: &Faults) -> Result<(), wgpu::PollError> {
        for (raw, bytes) in &self.uniforms {
            queue.write_buffer(raw, 0, bytes);
        }
        let index = queue.submit([self.commands]);
        for mapping in self.mappings {
            mapping.start();
        }
        // Without a poll a lost device would go unnoticed, because submissions to it are silently dropped. Mappings that are ready are
        // noted before the ticket is, so a host that waits for this one need not poll, which takes as long as a submission under way.
        let polled = faults.poll(device, wgpu::PollType::Poll);
        self.waker.submitted(index);
        polled
    }
}

/// The thread that submits, and the way to it.
#[derive(Debug)]
struct Worker {
    jobs: Sender<Job>,
    thread: JoinHandle<()>,
}

/// Submits recordings.
#[derive(Debug)]
pub(super) struct Submitter {
    device: wgpu::Device,
    queue: wgpu::Queue,
    faults: Arc<Faults>,
    worker: Option<Worker>,
    last: Mutex<Option<Ticket>>,
}

impl Submitter {
    /// Submits to `queue`: on a thread if `beside_host` is set.
    /// Errors: the thread could not be started.
    pub(super) fn new(
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        faults: &Arc<Faults>,
        beside_host: bool,
    ) -> GpuResult<Submitter> {
        let (device, queue, faults) = (device.clone(), queue.clone(), Arc::clone(faults));
        let worker = match beside_host {
            true => Some(Worker::start(device.clone(), queue.clone(), Arc::clone(&faults))?),
            false => None,
        };
        Ok(Submitter { device, queue, faults, worker, last: Mutex::default() })
    }

    /// Submits a recording called `name`, or has the thread do so.
    /// Errors: the driver could not be asked for its progress, or the thread has ended.
    pub(super) fn submit(&self, name: &'static str, job: Job) -> GpuResult<()> {
        let Some(worker) = &self.worker else {
            return job.run(&self.device, &self.queue, &self.faults).map_err(|e| GpuError::validation(name, e));
        };
        *lock(&self.last) = Some(job.waker.0.clone());
        worker.jobs.send(job).map_err(|_| GpuError::validation(name, "the thread that submits has ended"))
    }

    /// Waits until every recording has been submitted.
    pub(super) fn drain(&self) {
        let last = lock(&self.last).clone();
        if let Some(ticket) = last {
            ticket.index();
        }
    }
}

impl Worker {
    fn start(device: wgpu::Device, queue: wgpu::Queue, faults: Arc<Faults>) -> GpuResult<Worker> {
        let (jobs, received) = channel::<Job>();
        let work = move || {
            for job in received {
                // The next wait for the device returns the same error.
                let _ = job.run(&device, &queue, &faults);
            }
        };
        let thread = Builder::new().name("submit".into()).spawn(work);
        let thread = thread.map_err(|e| GpuError::validation("the thread that submits", e))?;
        Ok(Worker { jobs, thread })
    }
}

impl Drop for Submitter {
    fn drop(&mut self) {
        if let Some(Worker { jobs, thread }) = self.worker.take() {
            drop(jobs);
            let _ = thread.join(); // a panic there was reported when it happened
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_that_is_dropped_wakes_those_who_wait_for_it() {
        let ticket = Ticket::default();
        let waker = Waker::of(&ticket);
        let waiting = std::thread::spawn({
            let ticket = ticket.clone();
            move || ticket.index().is_none()
        });
        drop(waker);
        assert!(matches!(waiting.join(), Ok(true)));
    }
}
