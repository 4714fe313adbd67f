//! The collector of the driver's asynchronous error reports.
//!
//! Invariants: (1) a lost device stays lost: every later call reports it; (2) any other error is returned exactly once, by
//! the call that caused it or, if the report came late, by the next call.

use super::error::{GpuError, GpuResult};
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

/// Locks, even after another holder panicked: every holder leaves valid data.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The driver's error reports, collected until the next check.
#[derive(Debug, Default)]
pub(super) struct Faults {
    state: Mutex<FaultState>,
}

#[derive(Debug, Default)]
struct FaultState {
    doing: String,
    first: Option<GpuError>,
    lost: Option<GpuError>,
}

impl Faults {
    /// Names the stage that the following calls belong to.
    pub(super) fn set_stage(&self, what: &str) {
        let mut state = lock(&self.state);
        state.doing.clear();
        state.doing.push_str(what);
    }

    /// Keeps the first report; later ones are consequences of it.
    pub(super) fn report(&self, error: &wgpu::Error) {
        let mut state = lock(&self.state);
        let stage = state.doing.clone();
        let message = causes(error);
        state.first.get_or_insert(match error {
            wgpu::Error::OutOfMemory { .. } => GpuError::OutOfMemory { stage, message },
            wgpu::Error::Validation { .. } | wgpu::Error::Internal { .. } => GpuError::Validation { stage, message },
        });
    }

    /// Whether an error was reported and not yet returned.
    pub(super) fn is_reported(&self) -> bool {
        let state = lock(&self.state);
        state.first.is_some() || state.lost.is_some()
    }

    /// Records the loss of the device.
    pub(super) fn lost(&self, message: String) {
        let mut state = lock(&self.state);
        let stage = state.doing.clone();
        let message = if message.trim().is_empty() { "the driver reports no reason".to_string() } else { message };
        state.lost.get_or_insert(GpuError::DeviceLost { stage, message });
    }

    /// Polls a device. wgpu 30 ends a poll that finds the device lost with a panic; here that is a loss, which the next check returns.
    /// Errors: those of the poll.
    pub(super) fn poll(&self, device: &wgpu::Device, until: wgpu::PollType) -> Result<(), wgpu::PollError> {
        silence_polls();
        IS_POLLING.set(true);
        let polled = catch_unwind(AssertUnwindSafe(|| device.poll(until)));
        IS_POLLING.set(false);
        match polled {
            Ok(polled) => polled.map(|_| ()),
            Err(panic) => {
                let message = panic.downcast_ref::<String>().map_or("the driver reports no reason", String::as_str);
                self.lost(message.to_string());
                Ok(())
            }
        }
    }

    /// Returns the collected error, if any.
    pub(super) fn check(&self) -> GpuResult<()> {
        let mut state = lock(&self.state);
        if let Some(lost) = &state.lost {
            return Err(lost.clone());
        }
        state.first.take().map_or(Ok(()), Err)
    }
}

thread_local! {
    /// Whether this thread polls a device: a panic is a loss then, and is told as one.
    static IS_POLLING: Cell<bool> = const { Cell::new(false) };
}

/// Keeps panics in polls from being printed; other panics are printed as before.
fn silence_polls() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let print = take_hook();
        set_hook(Box::new(move |panic| {
            if !IS_POLLING.get() {
                print(panic);
            }
        }));
    });
}

/// An error with its chain of causes on one line.
fn causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(source) = cause {
        let message = source.to_string();
        if !text.contains(&message) {
            text.push_str(": ");
            text.push_str(&message);
        }
        cause = source.source();
    }
    text
}
