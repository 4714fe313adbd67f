//! One step and the pages under it: cull, gather, picture, loss, backward pass, update, on the host and on devices that hold
//! pages.
//!
//! [`train_step`] is the page to read first; each other file is one part of it.

pub mod batch;
pub mod catch_up;
pub mod comparison;
pub mod device_flights;
pub mod device_slots;
pub mod device_tier;
pub mod pages;
pub(crate) mod soundness;
pub mod train_step;
pub mod view;
