//! What a run is beside its pages, as it stands in a checkpoint.

pub mod run_state;
