//! How much memory a run will take, and how much it took.
//!
//! What depends on the views (rows, intersections, images) is measured by rendering a few of them with the first
//! Gaussians; what is simple arithmetic is computed. The promise is 10 % of the peak that a run without growth has.

use super::catch_up::{gather, visible_rows};
use crate::config::file::TrainConfig;
use crate::config::limits::RunOptions;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::optim::deferred::DeferredAdam;
use crate::render::cpu::CpuRenderer;
use crate::render::{Gradients, RenderError, Renderer};
use crate::scene::columns::{Columns, row_width};
use crate::scene::state::{SceneState, row_bytes};

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

/// Estimates a run from its first Gaussians.
///
/// # Errors
/// A view cannot be rendered.
pub fn estimate(config: &TrainConfig, dataset: &Dataset, columns: &Columns) -> Result<MemoryEstimate, RenderError> {
    let rows = columns.rows() as u64;
    let rows_max = if config.strategy == "none" { rows } else { rows.max(config.max_gaussians) };
    let view = probe_view(config, dataset, columns)?;
    // More Gaussians make a view's part grow in proportion; the part of its pixels stays.
    let growth = rows_max as f64 / rows.max(1) as f64;
    let decoders = rayon::current_num_threads();
    Ok(MemoryEstimate {
        state: rows_max * row_bytes(config.sh_degree) as u64,
        view: view.pixels + (view.rows as f64 * growth) as u64,
        targets: config.image_cache.0.min(TargetCache::bytes_to_keep_all(&dataset.views, decoders)),
        export: rows_max * row_width(config.sh_degree) as u64 * 4,
        base: BASE_BYTES + view.tables,
    })
}

/// Bytes of the heaviest probed view: what grows with its rows, and what only with its pixels. And of the optimizer's
/// tables, which grow with the steps of the run.
struct ProbedView {
    tables: u64,
    rows: u64,
    pixels: u64,
}

fn probe_view(config: &TrainConfig, dataset: &Dataset, columns: &Columns) -> Result<ProbedView, RenderError> {
    let options = RunOptions::new(config, dataset.scene_scale);
    let adam = DeferredAdam::new(options.rates, options.adam, options.render.simd);
    let state = SceneState::from_columns(columns.clone());
    let mut renderer = CpuRenderer::new();
    let mut rows = Vec::new();
    let mut working = Columns::zeros(0, config.sh_degree);
    let mut gradients = Gradients::default();
    let stride = dataset.views.len().div_ceil(PROBE_VIEWS);
    let mut pixels = 0;
    for view in dataset.views.iter().step_by(stride) {
        visible_rows(&state, &adam, 0, &view.camera, &mut rows);
        gather(&state, &adam, 0, &rows, &mut working);
        Renderer::forward(&mut renderer, &working, &view.camera, &options.render)?;
        let v_rgb = vec![0.0; 3 * view.camera.pixels()];
        renderer.backward(&working, &v_rgb, None, &mut gradients);
        pixels = pixels.max(view.camera.pixels() as u64);
    }
    let held = renderer.scratch_bytes() + (working.bytes() + gradients.columns.bytes()) as u64;
    // Image, coverage, gradient, and the tiles' copies of them.
    let of_pixels = (pixels * 4 * (3 + 1 + 3 + 6)).min(held);
    Ok(ProbedView { rows: held - of_pixels, pixels: of_pixels, tables: adam.bytes() as u64 })
}

/// The largest resident size of this process so far, bytes; `None` where the system does not tell.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:")
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
