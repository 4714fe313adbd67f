//! What a run is beside its pages, as it stands in a checkpoint, and how often one is made.

pub mod interval;
pub mod run_state;
