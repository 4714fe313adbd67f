//! The memory of `gsscale-eval`, which holds all Gaussians of a file: refused before it is taken.
//!
//! Not here: evaluations within a run, whose pages, photos and renderer the run has planned ([`super::estimate`]).

use super::estimate::{BASE_BYTES, frames_in_memory};
use crate::base::error::{InputError, InputResult};
use crate::base::units::{format_bytes, format_bytes_up, format_grouped};
use crate::dataset::loader::{Dataset, View};
use crate::dataset::target_cache::TargetCache;
use crate::render::lpips::Network;
use crate::scene::columns::Columns;
use std::path::Path;

/// Bytes of a renderer for a Gaussian in view: splat, sort and intersections with tiles.
const RENDERER_ROW_BYTES: u64 = 320;
/// Bytes of a renderer for a pixel: colour and coverage of the picture, and colour, transmittance and last splat of its tile.
const PIXEL_BYTES: u64 = 36;

/// Refuses an evaluation of these Gaussians on the held-out photos of a scene that may take more than `budget` bytes, with a cache of
/// `image_cache` bytes for photos.
/// Errors: the memory is too little; the error names `file`.
pub(crate) fn check_evaluation_fits(
    file: &Path,
    columns: &Columns,
    dataset: &Dataset,
    budget: u64,
    image_cache: u64,
    lpips: Option<Network>,
) -> InputResult<()> {
    let views: Vec<View> = dataset.test_views().iter().map(|&view| dataset.views[view].clone()).collect();
    let largest_decode = views.iter().map(|view| view.photo.decode_bytes()).max().unwrap_or(0);
    let keep_all = TargetCache::bytes_to_keep_all(&views, rayon::current_num_threads());
    let photos = image_cache.min(keep_all).max(largest_decode);
    let Some(largest) = views.iter().map(|view| &view.camera).max_by_key(|camera| camera.pixels()) else {
        return Ok(());
    };
    let rows = columns.rows() as u64;
    let gaussians =
        columns.bytes() as u64 + frames_in_memory(rows, columns.sh_degree, false) + rows * RENDERER_ROW_BYTES;
    let features = lpips.map_or(0, |network| network.bytes([largest.width, largest.height]));
    let needed = BASE_BYTES + photos + gaussians + features + largest.pixels() as u64 * PIXEL_BYTES;
    if needed <= budget {
        return Ok(());
    }
    let lpips = if features > 0 { format!(", {} for LPIPS", format_bytes(features)) } else { String::new() };
    let problem = format!(
        "evaluating {} Gaussians on photos of {} x {} pixels takes up to {} ({} for Gaussians, {} for photos{lpips}), more than {}",
        format_grouped(rows),
        largest.width,
        largest.height,
        format_bytes(needed),
        format_bytes(gaussians),
        format_bytes(photos),
        format_bytes(budget)
    );
    let smaller = if features > 0 { "use the weights of AlexNet, or " } else { "" };
    let remedy = format!(
        "give at least {} with --host-mem, {smaller}lower --image-cache, or measure smaller photos (--max-resolution)",
        format_bytes_up(needed + needed / 50)
    );
    Err(InputError::new(file, problem, remedy))
}
