//! The dataset readers on generated scenes, good and bad, and on the real ones.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "../support/mod.rs"]
mod support;

mod colmap_bad;
mod colmap_good;
mod fuzz;
mod layouts;
mod mega_nerf;
mod real;
mod transforms_bad;
mod transforms_good;
mod write;
