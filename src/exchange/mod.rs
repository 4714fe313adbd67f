//! Exchange with other programs: scenes in and out as PLY, scalars for TensorBoard.

pub mod frames;
pub mod meta;
pub mod ply;
pub mod sink;
pub mod tensorboard;
pub mod transform;
