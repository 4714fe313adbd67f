//! What tools do with stores: read one, build one, find pages without a map, tell which hold no commit.

pub mod new_store;
pub mod reading;
pub mod slot_reader;
pub mod uncommitted;
