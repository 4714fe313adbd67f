//! Before a run: does it fit in memory and on the drives, and what will it cost?
//!
//! [`plan`] holds the verdict; the other files measure and compute its parts.

#[cfg_attr(not(feature = "gpu"), path = "device_memory_absent.rs")]
pub(crate) mod device_memory;
pub(crate) mod drive_space;
pub mod first_look;
pub mod forecast;
pub(crate) mod growth_costs;
pub mod plan;
pub(crate) mod plan_text;
pub mod probe;
pub(crate) mod results_space;
