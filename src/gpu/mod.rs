//! Compute on a GPU through wgpu: the device, its memory, shaders, and recording of work. Knows neither Gaussians nor
//! stages; depends only on [`crate::base`].
//!
//! How the parts work together:
//!
//! ```text
//! Gpu::open ──> gpu.buffer(label, bytes) ──> Buffer::view / slice ──> BufferView
//!           ──> gpu.pipeline(shader, entry, defines) ──> Pipeline
//!           ──> gpu.begin("step") ──> Recorder: upload, uniform, clear, dispatch, copy, read_back
//!           ──> gpu.submit(recorder) ──> Readback::to_vec
//! ```
//!
//! Rules that hold for every shader:
//!
//! 1. All bindings are in `@group(0)`, numbered from 0 without gaps in a file. Views are given to
//!    [`Recorder::dispatch`] in the order of the numbers that the entry point uses. A uniform struct, if any, is
//!    binding 0.
//! 2. Workgroups are 1-D. Beyond 65,535 workgroups [`groups_1d`] folds them into two dimensions, and the shader finds
//!    its index with `linear_group` of `shared/dispatch.wgsl`.
//! 3. Counts come from uniforms or buffers: a view of an empty buffer still spans some bytes. `arrayLength` counts only a table
//!    that is never empty (`recent` of `gather.wgsl`).
//! 4. No workgroup waits for another; no invocation loops more than 65,535 times in total.
//! 5. Contents of a new buffer are arbitrary (it may be reused): use [`Recorder::clear`] where zeros are needed. Workgroup memory is
//!    arbitrary too: a stage writes a word before it reads the word.
//! 6. Only one recorder may be open, set aside or not: reused buffers rely on commands that run in the order recorded.
//!
//! Files import each other in one direction: `error` <- `bus`, `faults` <- `submitter` <- `driver` (the wgpu device that the others
//! share) <- `buffers`, `belt`, `shader` <- `submission_count` <- `readback` <- `profile` <- `device` <- `record`.

mod adapter;
mod belt;
mod buffers;
mod bus;
mod device;
mod driver;
mod error;
mod faults;
mod injected;
mod layout;
mod profile;
mod readback;
mod record;
mod shader;
mod sources;
mod submission_count;
mod submitter;

pub use adapter::{AdapterSummary, DeviceKind, STORAGE_BUFFERS_MOST, WORKGROUP, list_adapters};
pub use belt::staging_bytes;
pub use buffers::{Buffer, BufferView};
pub use bus::EmulatedBus;
pub use device::{Gpu, GpuOptions, Subgroups, budget_for_buffers, bytes_for_buffers};
pub use error::{GpuError, GpuResult};
pub use injected::{FaultKind, InjectedFault};
pub use layout::StructLayout;
pub use profile::StageTime;
pub use readback::Readback;
pub use record::{Recorder, Recording, Submission, groups_1d};
pub use shader::{Pipeline, validate};
pub use sources::{Defines, SOURCES, Source, preprocess, variants};

/// The device that the user requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best hardware GPU; [`GpuError::NoHardwareGpu`] if there is none.
    Auto,
    /// The best adapter, even a software one.
    Gpu,
    /// The best adapter whose name contains this text, ignoring case.
    Named(String),
}

/// Traffic over the bus and work since the device was opened, and memory, for reports.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Bytes from the host to the device: uploads and uniforms.
    pub bytes_uploaded: u64,
    /// Bytes from the device to the host.
    pub bytes_read_back: u64,
    /// Device memory of live buffers, staging and uniforms, bytes.
    pub device_bytes: u64,
    /// Most device memory ever allocated, bytes, including free buffers in the pool.
    pub device_bytes_peak: u64,
    /// Buffers allocated so far: constant once warmed up.
    pub device_allocations: u64,
    /// The part of this memory that stages uploads, uniforms and read-backs, bytes. It may lie in host memory.
    pub staging_bytes: u64,
    /// Work recorded so far.
    pub work: Work,
}

/// Work of a device, as it was recorded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Work {
    pub dispatches: u64,
    /// Workgroups of all dispatches.
    pub workgroups: u64,
    /// Bytes of all storage bindings of all dispatches. Most stages read or write each byte of a binding once.
    pub bytes_bound: u64,
}
