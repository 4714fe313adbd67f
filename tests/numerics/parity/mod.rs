//! Every stage on the device against its twin on the CPU. Both get the same inputs, so that the rounding of one stage
//! does not add to the next. The best adapter is used; in CI a software adapter.

mod cost;
mod frame;
mod gate;
mod loss;
mod pages;
mod ranges;
mod rows;
mod tiles;
mod weights;
