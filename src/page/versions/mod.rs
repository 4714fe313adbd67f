//! Versions of pages on an engine: which slot holds which version, and when a slot becomes free.

pub mod page_error;
pub mod paged_store;
pub mod slots;
