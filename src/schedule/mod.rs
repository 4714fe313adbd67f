//! Which view comes when and which pages it needs: pure planning, no I/O.

pub mod auto;
pub mod bound;
pub mod model;
pub mod order;
pub mod places;
pub mod plan;
pub mod replay;
pub mod tour;
pub mod visibility;
