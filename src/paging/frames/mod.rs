//! The frames of one tier of memory: which pages they hold, in what state, and which page is evicted next. Moves no bytes.

pub mod evict;
pub mod table;
