//! Which view comes when, and which pages a view needs by their bounds. Not here: what a cache makes of it (`paging::plan`).

pub mod order;
pub mod tour;
pub mod visibility;
