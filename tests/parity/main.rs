//! Every stage on the device against its twin on the CPU, stage by stage: each is given the same inputs, so that one
//! stage's roundings are not another's. On whatever adapter is there, in CI a software one.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod device;
mod loss;
mod rows;
