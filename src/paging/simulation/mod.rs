//! Whole runs of the cache before they happen: for `gsscale-plan`, for preflight and for `--view-order auto`. No I/O.

pub mod replay;
