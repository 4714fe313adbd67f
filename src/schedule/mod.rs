//! Which view comes when and which pages it needs: pure planning, no I/O.

pub mod order;
pub mod visibility;
