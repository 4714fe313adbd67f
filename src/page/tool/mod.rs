//! What tools need of a store beside a run's: looking without writing, building a new store, finding pages without a map.

pub mod new_store;
pub mod reading;
pub mod scan;
pub mod slot_reader;
