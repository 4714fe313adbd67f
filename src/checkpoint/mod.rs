//! The run state in a checkpoint (everything except pages), and the commit interval.

pub mod interval;
pub mod run_state;
