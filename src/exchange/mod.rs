//! Exchange with other programs: scenes in and out as PLY, out as SPZ, scalars for TensorBoard.

pub mod format;
pub mod frames;
pub mod meta;
pub mod ply;
pub mod sink;
pub mod spz;
pub mod tensorboard;
pub mod transform;
