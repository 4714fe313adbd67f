//! Scenes in and out of other programs: PLY; what TensorBoard reads.

pub mod ply;
pub mod tensorboard;
