//! Memory for pages in transfer: the plan of the coming steps, and encoded pages on their way to or from the drive.

use crate::page::format::codec::Codec;

/// Memory of a small plan, bytes: enough for the steps of the prefetch.
pub(crate) const PLAN_BYTES_LEAST: usize = 1 << 20;
/// Most bytes of frames that may be prefetched.
pub(crate) const PREFETCH_BYTES_MAX: usize = 256 << 20;

/// Memory for the plan of the coming steps, bytes.
pub const PLAN_BYTES: usize = 16 << 20;

/// Bytes of the plan and of encoded pages in transfer, of which `prefetch_bytes` may be in flight. Raw pages move
/// between frames and drive without a copy, so they need no staging.
pub fn staging_bytes(prefetch_bytes: usize, codec: Codec) -> u64 {
    (PLAN_BYTES + if codec == Codec::Raw { 0 } else { prefetch_bytes }) as u64
}

/// Memory of a run that holds `rest` bytes besides staging, if staging took `staging` of `budget` bytes: more memory
/// means more frames, and up to an eighth of the frames may be in transfer.
pub(crate) fn with_staging(rest: u64, staging: u64, budget: u64) -> u64 {
    let of_plan = staging.min(PLAN_BYTES as u64);
    let share = ((staging - of_plan) as f64 / budget.max(1) as f64).min(0.5);
    let most = of_plan + (staging - of_plan).max(2 * PREFETCH_BYTES_MAX as u64);
    (((rest + of_plan) as f64 / (1.0 - share)) as u64).min(rest + most).max(rest + staging)
}
