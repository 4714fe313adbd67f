//! The only place where cache, store and plan meet: brings the pages of a view into memory, and takes them back.
//! Knows pages as bytes, metas and bounds; neither the optimizer nor the renderer.

pub mod ahead;
mod commit;
pub mod error;
mod fetch;
mod freeze;
pub mod label;
pub mod pager;
pub mod pinned;
pub mod stats;
pub mod stored;
mod transfers;
mod window;
