//! What tools need beyond a run: reading a store without writing, building a new store, finding pages without a map.

pub mod new_store;
pub mod reading;
pub mod scan;
pub mod slot_reader;
