//! Pages as bytes: buffers, slots on disk and the engines that move between them. Nothing here knows what a page holds.

pub mod buffer;
pub mod halves;
pub mod store;
