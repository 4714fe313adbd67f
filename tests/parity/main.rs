//! Every stage on the device against its twin on the CPU, stage by stage: both are given the same inputs, so that one
//! stage's roundings are not another's. On the best adapter there is, in CI a software one.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "../support/mod.rs"]
mod support;

mod frame;
mod loss;
mod rows;
mod tiles;
