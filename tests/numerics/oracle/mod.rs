//! The kernels against fixtures computed in float64 by an independent reference. The README.md beside the fixtures
//! gives conventions and tolerances. One file per group of fixtures.

mod adam;
mod adam_seeds;
mod loss;
mod projection;
mod raster;
mod sh;
mod torch32;
