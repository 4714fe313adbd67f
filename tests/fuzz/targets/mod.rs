//! The targets, each with good inputs to damage.

mod config;
mod map;
mod pages;
mod photos;
mod ply;
mod scenes;
mod store_dir;
mod torch;

pub use config::config;
pub use map::{map_values, run_state};
pub use pages::{page_payload, slot_header};
pub use photos::{decoded, photo, pictures};
pub use ply::ply;
pub use scenes::{colmap_binary, colmap_text, image_names, opensfm, reality_capture, transforms};
pub use store_dir::store_dir;
pub use torch::torch;

/// The first byte of an input selects the mode for the rest.
fn split_mode(input: &[u8]) -> (u8, &[u8]) {
    input.split_first().map_or((0, input), |(mode, rest)| (*mode, rest))
}

fn with_mode(mode: u8, rest: &[u8]) -> Vec<u8> {
    [&[mode], rest].concat()
}
