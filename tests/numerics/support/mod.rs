//! Reference fixtures, dense Adam, a second renderer, and a device.

#[path = "../../support/apply_event.rs"]
pub mod apply_event;
#[path = "../../support/child.rs"]
pub mod child;
pub mod dense_adam;
pub mod fixture;
#[path = "../../support/gpu.rs"]
pub mod gpu;
pub mod reference64;
#[allow(dead_code)] // no photo scenes are read here
#[path = "../../support/shared.rs"]
mod shared;
