//! Memory for pages in transfer: the plan of the coming steps, and encoded pages on their way to or from the drive.

use crate::page::format::codec::Codec;

/// The plan of a run whose next step needs the rest of [`PLAN_BYTES`], bytes: enough for the steps that are read ahead.
pub(super) const PLAN_BYTES_LEAST: usize = 1 << 20;
/// The most bytes of frames that may be filled ahead of their step.
pub(super) const PREFETCH_BYTES_MAX: usize = 256 << 20;

/// Memory for the plan of the coming steps, bytes.
pub const PLAN_BYTES: usize = 16 << 20;

/// Bytes that the plan takes beside the frames, and pages on their way of which `prefetch_bytes` may be in flight: raw
/// pages move between frames and drive without a copy.
pub fn staging_bytes(prefetch_bytes: usize, codec: Codec) -> u64 {
    (PLAN_BYTES + if codec == Codec::Raw { 0 } else { prefetch_bytes }) as u64
}

/// The memory that a run needs which holds `rest` bytes beside its staging, where staging took `staging` of `budget` bytes:
/// more memory means more frames, an eighth of which may be on their way.
pub(super) fn with_staging(rest: u64, staging: u64, budget: u64) -> u64 {
    let of_plan = staging.min(PLAN_BYTES as u64);
    let share = ((staging - of_plan) as f64 / budget.max(1) as f64).min(0.5);
    let most = of_plan + (staging - of_plan).max(2 * PREFETCH_BYTES_MAX as u64);
    (((rest + of_plan) as f64 / (1.0 - share)) as u64).min(rest + most).max(rest + staging)
}
