//! Reads the pages of a store one by one, so that the scene may be larger than memory: what the Gaussians of each page are like.
//!
//! `cargo run --release --example read_store -- runs/village` reads the checkpoint of a run that keeps one
//! (`gsscale-train ... --keep-checkpoint`), or a spill directory.

use gsscale::base::math::sigmoid;
use gsscale::train::error::TrainError;
use gsscale::train::stores::StoredStart;
use std::path::{Path, PathBuf};

/// Memory for pages, bytes.
const HOST_MEM: u64 = 1 << 30;
const PAGE_ROWS: usize = 4096;

fn main() -> Result<(), TrainError> {
    let Some(folder) = std::env::args_os().nth(1).map(PathBuf::from) else {
        gsscale::tell!("usage: read_store OUT");
        std::process::exit(2);
    };
    let [pages, rows, solid] = count(&folder)?;
    gsscale::say!("{rows} Gaussians in {pages} pages, {solid} more than half opaque");
    Ok(())
}

/// Pages, Gaussians, and how many of these are more than half opaque.
pub fn count(folder: &Path) -> Result<[usize; 3], TrainError> {
    let mut store = StoredStart::open(folder, HOST_MEM, 1)?;
    let (mut pages, mut rows, mut solid) = (0, 0, 0);
    let degree = store.sh_degree();
    // Positions are (world - origin) / scale.
    let (origin, scale) = ([0.0; 3], 1.0);
    store.for_each_page((origin, scale), (PAGE_ROWS, degree), &mut |_, page| {
        let opacities = &page.columns.opacities;
        let is_solid = opacities.iter().filter(|logit| sigmoid(**logit) > 0.5).count();
        gsscale::say!("page {pages}: {} Gaussians, {is_solid} more than half opaque", opacities.len());
        (pages, rows, solid) = (pages + 1, rows + opacities.len(), solid + is_solid);
        Ok(())
    })?;
    Ok([pages, rows, solid])
}
