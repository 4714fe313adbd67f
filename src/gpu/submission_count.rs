//! Proof that the device has done what it was given: a count on the device to which every submission adds one, and which every read-back takes
//! with it.
//!
//! Metal gives up a command buffer that took too long or faulted, and says so in a status that wgpu 30 does not read: the submission looks
//! done, and its read-backs hold what their memory held before. With the count such a read-back is the loss of the device. Vulkan and DX12
//! report the loss by themselves, so no other device counts.
//!
//! Invariants: 1. a read-back is right only if all submissions before its own were finished, and its own copies were made; 2. a count that
//! is behind stays behind, so the next read-back finds the loss.

use super::buffers::{Buffer, BufferView};
use super::shader::Pipeline;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// What a read-back reports whose count is behind.
pub(super) const BEHIND: &str = "the device gave up work without an error, as Metal does with work that takes too long";

/// The count on the device and the one it must have reached.
#[derive(Debug)]
pub(super) struct SubmissionCount {
    finished: Buffer,
    pipeline: Arc<Pipeline>,
    submitted: AtomicU32,
}

impl SubmissionCount {
    /// Counts submissions from now on with a pipeline of `submission_count.wgsl`; `finished`, a u32, is 1: memory that was never written is 0.
    pub(super) fn new(pipeline: Arc<Pipeline>, finished: Buffer) -> SubmissionCount {
        SubmissionCount { finished, pipeline, submitted: AtomicU32::new(1) }
    }

    /// The count on the device, and its value once all submissions so far are finished.
    pub(super) fn expected(&self) -> (BufferView, u32) {
        (self.finished.view(), self.submitted.load(Ordering::Relaxed))
    }

    /// The last dispatch of a submission, which counts it.
    pub(super) fn counting_dispatch(&self) -> (Arc<Pipeline>, BufferView) {
        (Arc::clone(&self.pipeline), self.finished.view())
    }

    /// Notes that a submission is made now. One that an error prevented does not count.
    pub(super) fn note_submission(&self) {
        self.submitted.fetch_add(1, Ordering::Relaxed);
    }
}
