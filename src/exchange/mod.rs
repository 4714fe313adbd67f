//! Exchange with other programs: scenes in and out as PLY, scalars for TensorBoard.

pub mod ply;
pub mod tensorboard;
