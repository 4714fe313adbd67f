//! An engine that fails on purpose, and tests that run in a process of their own.

#[cfg(unix)]
#[path = "../../support/child.rs"]
pub mod child;
#[path = "../../support/faulty_engine.rs"]
pub mod faulty_engine;
