//! Before a run: does it fit in memory and on the drives, and what will it cost?
//!
//! [`plan`] holds the verdict on memory, [`forecast`] that on drives and what the run will take.

pub(crate) mod device_memory;
pub mod first_look;
pub mod forecast;
pub mod plan;
pub(crate) mod plan_text;
