//! The run state in a checkpoint (everything except pages), and the commit interval.

pub mod interval;
mod older_states;
pub mod run_state;
