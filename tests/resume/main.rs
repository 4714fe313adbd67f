//! A run that is killed or stopped and goes on ends with the bytes of one that was left alone. Through the real binary.
#![cfg(unix)]
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "../support/scenes.rs"]
mod scenes;

mod bench;
mod changes;
mod events;
mod kills;
mod more_steps;
mod ownership;
mod paths;
mod stops;
