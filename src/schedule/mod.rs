//! Which view comes when and which pages it needs: pure planning, no I/O.

pub mod model;
pub mod order;
pub mod plan;
pub mod visibility;
