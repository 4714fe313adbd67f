//! An engine and files that fail on purpose, and tests that run in a process of their own.

#[path = "../../support/apply_event.rs"]
pub mod apply_event;
#[cfg(unix)]
#[path = "../../support/child.rs"]
pub mod child;
#[path = "../../support/faulty_engine.rs"]
pub mod faulty_engine;
pub mod guarded;
#[path = "../../support/hush.rs"]
pub mod hush;
#[path = "../../support/rounds.rs"]
pub mod rounds;
