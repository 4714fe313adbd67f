//! Pages on a drive: the cache and its schedule, the I/O engines, the page store, commits, and recovery from faults.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod support;

mod batches;
mod commits;
mod crash;
#[cfg(unix)]
mod engines;
mod faults;
mod pages;
mod paging;
mod replay;
mod schedule;
#[cfg(unix)]
mod spill_dir;
mod store;
