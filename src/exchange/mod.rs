//! Scenes in and out of other programs: PLY.

pub mod ply;
