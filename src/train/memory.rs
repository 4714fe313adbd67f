//! How much memory a run will take, and how much it took.
//!
//! What depends on the views (rows, intersections, images) is measured by rendering a few of them with the first
//! Gaussians; what is simple arithmetic is computed. The promise is 10 % of the peak that a run without growth has.

use super::trainer::{TrainError, Trainer};
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::scene::columns::row_width;
use crate::scene::state::row_bytes;

/// Views rendered to see what a view takes.
const PROBE_VIEWS: usize = 6;
/// Program, libraries and thread stacks, measured on an empty run: 16 MiB with the tables of a short one.
const BASE_BYTES: u64 = 12 << 20;

/// What a run is expected to hold in memory at its peak, by part, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MemoryEstimate {
    /// Values, moments, stamps, identities and statistics of all Gaussians.
    pub state: u64,
    /// Rows of one view, their gradients, the stages' intermediates, images and loss.
    pub view: u64,
    /// Decoded photos.
    pub targets: u64,
    /// The evaluated copy that a PLY is written from.
    pub export: u64,
    /// Everything else.
    pub base: u64,
}

impl MemoryEstimate {
    /// All parts.
    pub fn total(&self) -> u64 {
        self.base + self.state + self.view + self.export + self.targets
    }
}

/// Estimates a run before its first step; `driver` bytes were taken by the graphics driver when it was looked for a
/// device. The trainer renders a few views for it and keeps the memory for its own
/// steps: allocating it twice would break the heap into pieces and the promise with it.
///
/// # Errors
/// A view cannot be rendered.
pub fn estimate(
    config: &TrainConfig,
    dataset: &Dataset,
    trainer: &mut Trainer,
    driver: u64,
) -> Result<MemoryEstimate, TrainError> {
    let rows = trainer.scene.rows();
    let rows_max = if config.strategy == "none" { rows } else { rows.max(config.max_gaussians) };
    let pixels = trainer.probe_views(dataset, PROBE_VIEWS)? as u64;
    let held = trainer.view_bytes();
    // Image, coverage, gradient, and the tiles' copies of them.
    let of_pixels = (pixels * 4 * (3 + 1 + 3 + 6)).min(held);
    // More Gaussians make a view's part grow in proportion; the part of its pixels stays.
    let growth = rows_max as f64 / rows.max(1) as f64;
    let decoders = rayon::current_num_threads();
    Ok(MemoryEstimate {
        state: rows_max * row_bytes(config.sh_degree) as u64,
        view: of_pixels + ((held - of_pixels) as f64 * growth) as u64,
        targets: config.image_cache.0.min(TargetCache::bytes_to_keep_all(&dataset.views, decoders)),
        export: rows_max * row_width(config.sh_degree) as u64 * 4,
        base: BASE_BYTES + trainer.scene.rules.adam.bytes() as u64 + driver,
    })
}

/// The largest resident size of this process so far, bytes; `None` where the system does not tell.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:")
}

/// The resident size of this process now, bytes; `None` where the system does not tell.
pub fn host_bytes_now() -> Option<u64> {
    status_field("VmRSS:")
}

/// Memory that programs could still take on this machine, bytes.
pub fn host_bytes_available() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    field(&text, "MemAvailable:")
}

fn status_field(name: &str) -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    field(&text, name)
}

fn field(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find(|l| l.starts_with(name))?;
    let kib: u64 = line[name.len()..].trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kib * 1024)
}
