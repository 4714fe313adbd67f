//! Which view comes when: pure functions of the seed, no I/O.

pub mod order;
