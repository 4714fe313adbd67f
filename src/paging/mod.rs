//! One cache and one plan for every tier: brings the pages of a view into memory, takes them back, and writes the pages of a
//! commit beside training. Knows pages as bytes, metas and bounds; neither the optimizer nor the renderer.
//!
//! | part | responsible for |
//! | --- | --- |
//! | [`frames`] | which pages are in memory, in what state, and which is evicted next |
//! | [`plan`] | what the coming steps need, and what a cache makes of it |
//! | [`simulation`] | whole runs of the cache before they happen, by the same plan and the same order of eviction |
//! | [`pager`] | the parts together: hands out the pages of a view and takes them back |

mod commit;
pub mod error;
mod fetch;
pub mod frames;
mod freeze;
pub mod label;
pub mod pager;
pub mod pinned;
pub mod plan;
pub mod prefetch;
pub mod simulation;
pub mod stats;
pub mod stored;
mod transfers;
