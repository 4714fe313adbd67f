//! Exchange with other programs: scenes in and out as PLY, out as SPZ and SOG, the levels of a SOG in, scalars for TensorBoard.

pub mod clean;
pub mod foreign;
pub mod format;
pub mod frames;
pub mod meta;
pub mod ply;
pub mod sink;
pub mod sog;
pub mod spz;
pub mod start_view;
pub mod tensorboard;
pub mod transform;
