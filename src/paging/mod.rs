//! One cache and one plan for every tier: brings the pages of a view into memory, takes them back, and writes the pages of a
//! commit beside training. Knows pages as bytes, metas and bounds; neither the optimizer nor the renderer.
//!
//! | part | responsible for |
//! | --- | --- |
//! | [`frames`] | which pages are in memory, in what state, and which is evicted next |
//! | [`plan`] | what the coming steps need, and what a cache makes of it |
//! | [`simulation`] | whole runs of the cache before they happen, by the same plan and the same order of eviction |
//! | `index` | the entry of every page, and the slot of its version on the drive |
//! | `mover` | transfers between frames and the store: what is in flight, and what failed |
//! | `cut` | which pages the last commit names, and the pages of a commit beside training |
//! | `tier` | these together: pages that move between memory and drive, and the frames that they leave |
//! | `fetch`, [`prefetch`] | pages that a caller waits for, and pages that the coming steps will wait for |
//! | [`pager`] | hands out the pages of a view and takes them back; commits |

mod cut;
pub mod error;
mod fetch;
pub mod frames;
mod index;
mod mover;
pub mod pager;
pub mod pinned;
pub mod plan;
pub mod prefetch;
pub mod simulation;
pub mod stats;
pub mod stored;
mod tier;
