//! GPU errors. Not here: the collector of the driver's reports (`faults`).
//!
//! Invariant: every error about work names the stage that was being recorded or waited for.

/// Why the device failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// `auto` was requested and there is no hardware GPU: the caller uses the CPU renderer.
    #[error("no hardware GPU was found (found: {found})")]
    NoHardwareGpu { found: String },
    /// The requested device does not exist or cannot be used.
    #[error("no usable GPU matches {wanted:?}; found: {found}\n  remedy: choose one of `gsscale-train --list-devices`")]
    NoSuchDevice {
        wanted: String,
        /// The adapters found, each with the reason if it cannot be used.
        found: String,
    },
    /// The driver refused to open the device.
    #[error("{device} could not be opened: {message}")]
    Open { device: String, message: String },
    /// The variable that asks for an emulated bus holds something else.
    #[error(
        "{variable}: {text:?} is not a rate and a latency\n  remedy: write for example {variable}=12GB/s,20us, or unset it"
    )]
    EmulatedBus { variable: &'static str, text: String },
    /// The budget of `--device-mem` cannot hold a buffer.
    #[error(
        "{what} needs {need} bytes of device memory, but {in_use} of the {budget} allowed are in use\n  remedy: raise \
         --device-mem, or train with smaller pictures (--data-factor)"
    )]
    OutOfBudget { what: String, need: u64, in_use: u64, budget: u64 },
    /// The device itself has no memory left.
    #[error(
        "{stage}: the device is out of memory ({message})\n  remedy: set or lower --device-mem, or close other programs that use the device"
    )]
    OutOfMemory { stage: String, message: String },
    #[error(
        "the device has no memory for {what}: {need} bytes beside the {in_use} in use\n  remedy: close other programs that \
         use the device"
    )]
    DeviceFull { what: String, need: u64, in_use: u64 },
    /// One buffer is larger than the device allows.
    #[error("{what} needs one buffer of {need} bytes; the device allows {limit}")]
    BufferTooLarge {
        what: String,
        need: u64,
        /// Largest buffer of the device, bytes.
        limit: u64,
    },
    /// One binding is larger than the device, or the test's limit, allows.
    #[error("{stage}: binding {binding} would span {need} bytes; the device allows {limit} in one binding")]
    BindingTooLarge { stage: String, binding: String, need: u64, limit: u64 },
    /// The views do not match the shader, or a copy does not match its source or target.
    #[error("{stage}: {problem}")]
    Bindings { stage: String, problem: String },
    /// A shader does not preprocess, parse or validate.
    #[error("shader {shader}: {problem}")]
    Shader { shader: String, problem: String },
    /// The API refused a call: a bug in this program.
    #[error("{stage}: the graphics API refused the work: {message}")]
    Validation { stage: String, message: String },
    /// The device is gone: unplugged, reset by the driver, or hung.
    #[error("{stage}: the device was lost: {message}")]
    DeviceLost { stage: String, message: String },
}

impl GpuError {
    /// The API refused the work of `stage`.
    pub(super) fn validation(stage: &str, message: impl ToString) -> GpuError {
        GpuError::Validation { stage: stage.into(), message: message.to_string() }
    }

    pub(super) fn shader(shader: &str, problem: impl Into<String>) -> GpuError {
        GpuError::Shader { shader: shader.into(), problem: problem.into() }
    }

    /// A mismatch in the work of `stage`.
    pub(super) fn bindings(stage: &str, problem: impl Into<String>) -> GpuError {
        GpuError::Bindings { stage: stage.into(), problem: problem.into() }
    }

    /// Whether a buffer or binding was refused for its size before any command that needs it was recorded. The same work in
    /// smaller parts may succeed.
    pub fn is_out_of_memory(&self) -> bool {
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
