//! Estimates the memory of a run before its first step by rendering a few views with the first Gaussians.

use super::device_memory;
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::scene::columns::row_width;
use crate::scene::partition::first_fill;
use crate::train::error::TrainError;
use crate::train::memory::estimate::{
    BASE_BYTES, INDEX_BYTES, MemoryEstimate, bytes_of_copies, frames_in_memory, largest_decode,
};
use crate::train::state::trainer::{Probed, Trainer};
use crate::train::step::working_set::WorkingSet;

/// Views to render, spread evenly over the dataset.
const PROBE_VIEWS: usize = 6;

/// Most bytes of a renderer for a row in view that are expected of any scene: splat, gradients and staging, and some twenty
/// intersections with tiles.
const RENDERER_ROW_BYTES_MOST: u64 = 2048;

/// Known upper bound of a run's rows: the current rows, or the cap if that is more.
pub(crate) fn rows_at_most(config: &TrainConfig, rows: u64) -> u64 {
    if config.strategy.grows() { rows.max(config.max_gaussians) } else { rows }
}

/// Input of an estimate.
#[derive(Debug, Clone)]
pub struct Probe {
    pub views: Vec<usize>,
    /// Gaussians of the scene.
    pub rows: u64,
    /// Pages of the scene.
    pub pages: usize,
    /// Bytes that the graphics driver allocated during the search for a device.
    pub driver: u64,
}

impl Probe {
    /// The probe of a run: `largest` (the view that needs most pages) and a few views spread over the dataset. The
    /// largest comes first, so that buffers get their final size at once instead of growing with spare capacity.
    pub fn of_run(dataset: &Dataset, trainer: &Trainer, largest: Option<usize>, driver: u64) -> Probe {
        let every = dataset.views.len().div_ceil(PROBE_VIEWS).max(1);
        let spread = (0..dataset.views.len()).step_by(every).filter(|view| largest != Some(*view));
        let views = largest.into_iter().chain(spread).collect();
        Probe { views, rows: trainer.scene.rows(), pages: trainer.scene.pager.index().len(), driver }
    }
}

/// How long views take.
#[derive(Debug, Clone, Copy)]
pub struct ViewTimes {
    /// Median seconds of rendering one forward and backward.
    pub seconds: f64,
    /// Largest share of the Gaussians that one draws.
    pub visible_share: f64,
}

/// Estimates the memory of a run with all pages in memory: without growth, grown to its cap, and with `last` Gaussians. The trainer renders
/// the views of the probe and keeps the allocations for its steps; allocating twice would fragment the heap and exceed
/// the estimate. Also returns how long views take.
/// Errors: a view cannot be rendered.
pub fn estimate(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    probe: &Probe,
    last_rows: u64,
) -> Result<([MemoryEstimate; 3], ViewTimes), TrainError> {
    let rows = probe.rows;
    let Probed { pixels, visible, device, seconds } = trainer
        .probe_views(dataset, &probe.views)
        .map_err(|error| device_memory::refusal(error, config, dataset, &trainer.scene, &probe.views))?;
    let pixels = pixels as u64;
    let [working, rendering] = trainer.run_memory().view_bytes();
    // Image, coverage, gradient, and per-tile copies of them.
    let of_pixels = (pixels * 4 * (3 + 1 + 3 + 6)).min(rendering);
    // The part of the rows grows with the number of Gaussians and with the SH degree; the part of the pixels is
    // constant.
    let (first, last) = trainer.sh_degrees();
    let wider = row_width(last) as f64 / row_width(first) as f64;
    // A view that was probed in batches had the working set of one of them.
    let working = (working as f64 * wider).max((visible * WorkingSet::row_bytes(last)) as f64);
    let of_rows = working + (rendering - of_pixels) as f64;
    let decoders = rayon::current_num_threads();
    // A photo that a step waits for is decoded even if it exceeds the cache.
    let keep_all = TargetCache::bytes_to_keep_all(&dataset.views, decoders);
    let targets = config.image_cache.0.min(keep_all).max(largest_decode(dataset).0);
    let pages = probe.pages as f64;
    let is_growing = config.strategy.grows();
    let copies = if is_growing { bytes_of_copies(probe.pages, trainer.scene.pager.frame_bytes()) } else { 0 };
    let base = BASE_BYTES + trainer.scene.rules.adam.bytes() as u64 + probe.driver;
    let base = base + trainer.photos.iter().map(|parameter| parameter.value_bytes(dataset)).sum::<u64>();
    let memory = [rows, rows_at_most(config, rows), last_rows].map(|rows_then| {
        let growth = rows_then as f64 / rows.max(1) as f64;
        // The parts of few rows say little about those of many: most of them is what a renderer holds for any number.
        let most = |bytes: f64, row_bytes: u64| bytes.max((bytes * growth).min((rows_then * row_bytes) as f64));
        let page_rows = config.page_rows as usize;
        let fills_up = growth * first_fill(page_rows, true) as f64 > page_rows as f64;
        MemoryEstimate {
            frames: frames_in_memory(rows_then, last, fills_up),
            staging: 0,
            view: of_pixels + most(of_rows, WorkingSet::row_bytes(last) as u64 + RENDERER_ROW_BYTES_MOST) as u64,
            view_pixels: of_pixels,
            working: most(working, WorkingSet::row_bytes(last) as u64) as u64,
            targets,
            index: (pages * growth) as u64 * INDEX_BYTES,
            copies,
            base: base + config.export.formats().map(|format| format.memory_bytes(rows_then)).max().unwrap_or(0),
            device: device.map(|view| view.grown(growth)),
        }
    });
    Ok((memory, ViewTimes { seconds, visible_share: visible as f64 / rows.max(1) as f64 }))
}
