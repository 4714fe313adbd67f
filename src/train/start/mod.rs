//! How a run gets its first scene and its tiers.

pub mod first_scene;
pub mod tiers;
