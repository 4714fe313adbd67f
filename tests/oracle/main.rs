//! The kernels against fixtures computed in float64 by an independent reference (conventions and tolerances are in
//! the README.md beside the fixtures). One file per group of fixtures.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

#[path = "../support/mod.rs"]
mod support;

mod adam;
mod adam_seeds;
mod loss;
mod projection;
mod raster;
mod sh;
mod torch32;
