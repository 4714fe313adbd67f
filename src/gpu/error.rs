//! GPU errors, and the collector of the driver's asynchronous error reports.
//!
//! Invariants: (1) every error about work names the stage that was being recorded or waited for; (2) a lost device
//! stays lost: every later call reports it; (3) any other error is returned exactly once, by the call that caused it
//! or, if the report came late, by the next call.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks, even after another holder panicked: every holder leaves valid data.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Why the device failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// `auto` was requested and there is no hardware GPU: the caller uses the CPU renderer.
    #[error("no hardware GPU was found (found: {found})")]
    NoHardwareGpu {
        /// The adapters found, or "none".
        found: String,
    },
    /// The requested device does not exist or cannot be used.
    #[error("no usable GPU matches {wanted:?}; found: {found}\n  remedy: choose one of `gsscale-train --list-devices`")]
    NoSuchDevice {
        /// The user's request.
        wanted: String,
        /// The adapters found, each with the reason if it cannot be used.
        found: String,
    },
    /// The driver refused to open the device.
    #[error("{device} could not be opened: {message}")]
    Open {
        /// Name of the adapter.
        device: String,
        /// The driver's message.
        message: String,
    },
    /// The budget of `--device-mem` cannot hold a buffer.
    #[error(
        "{what} needs {need} bytes of device memory, but {in_use} of the {budget} allowed are in use\n  remedy: raise \
         --device-mem, or train with smaller pictures (--data-factor)"
    )]
    OutOfBudget {
        /// Label of the buffer.
        what: String,
        /// Bytes that the buffer needs.
        need: u64,
        /// Bytes in use by other buffers.
        in_use: u64,
        /// Bytes allowed in total.
        budget: u64,
    },
    /// The device itself has no memory left.
    #[error("{stage}: the device is out of memory ({message})\n  remedy: lower --device-mem")]
    OutOfMemory {
        /// Stage or buffer.
        stage: String,
        /// The driver's message.
        message: String,
    },
    /// The device has no memory for a buffer.
    #[error(
        "the device has no memory for {what}: {need} bytes beside the {in_use} in use\n  remedy: close other programs that \
         use the device"
    )]
    DeviceFull {
        /// Label of the buffer.
        what: String,
        /// Bytes that the buffer needs.
        need: u64,
        /// Bytes in use by other buffers.
        in_use: u64,
    },
    /// One buffer is larger than the device allows.
    #[error("{what} needs one buffer of {need} bytes; the device allows {limit}")]
    BufferTooLarge {
        /// Label of the buffer.
        what: String,
        /// Bytes that the buffer needs.
        need: u64,
        /// Largest buffer of the device, bytes.
        limit: u64,
    },
    /// One binding is larger than the device, or the test's limit, allows.
    #[error("{stage}: binding {binding} would span {need} bytes; the device allows {limit} in one binding")]
    BindingTooLarge {
        /// Stage.
        stage: String,
        /// Name of the variable in the shader.
        binding: String,
        /// Bytes of the view.
        need: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// The views do not match the shader, or a copy does not match its source or target.
    #[error("{stage}: {problem}")]
    Bindings {
        /// Stage.
        stage: String,
        /// The mismatch.
        problem: String,
    },
    /// A shader does not preprocess, parse or validate.
    #[error("shader {shader}: {problem}")]
    Shader {
        /// Name of the shader.
        shader: String,
        /// The problem.
        problem: String,
    },
    /// The API refused a call: a bug in this program.
    #[error("{stage}: the graphics API refused the work: {message}")]
    Validation {
        /// Stage.
        stage: String,
        /// The API's message.
        message: String,
    },
    /// The device is gone: unplugged, reset by the driver, or hung.
    #[error("{stage}: the device was lost: {message}")]
    DeviceLost {
        /// Stage.
        stage: String,
        /// The driver's message.
        message: String,
    },
}

impl GpuError {
    /// The API refused the work of `stage`.
    pub(super) fn validation(stage: &str, message: impl ToString) -> GpuError {
        GpuError::Validation { stage: stage.into(), message: message.to_string() }
    }

    /// A fault of a shader.
    pub(super) fn shader(shader: &str, problem: impl Into<String>) -> GpuError {
        GpuError::Shader { shader: shader.into(), problem: problem.into() }
    }

    /// A mismatch in the work of `stage`.
    pub(super) fn bindings(stage: &str, problem: impl Into<String>) -> GpuError {
        GpuError::Bindings { stage: stage.into(), problem: problem.into() }
    }
}

impl GpuError {
    /// Whether a buffer or binding was refused for its size before any command that needs it was recorded. The same work in
    /// smaller parts may succeed.
    pub fn lacks_room(&self) -> bool {
        matches!(
            self,
            GpuError::OutOfBudget { .. }
                | GpuError::DeviceFull { .. }
                | GpuError::BufferTooLarge { .. }
                | GpuError::BindingTooLarge { .. }
        )
    }
}

/// Result of calls that use a device.
pub type GpuResult<T> = Result<T, GpuError>;

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
        state.lost.get_or_insert(GpuError::DeviceLost { stage, message });
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
