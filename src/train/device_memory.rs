//! The device memory of a run, before its first step: the table beside that of host memory, and the refusal of a budget below
//! the least.
//!
//! Not here: the sums ([`crate::render::device_needs`]).

use super::error::TrainError;
use super::memory::MemoryEstimate;
use super::pages::PagedScene;
use crate::base::error::{InputError, InputResult};
use crate::base::units::{format_bytes, format_bytes_up};
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;

use crate::gpu::{GpuError, budget_for_buffers, bytes_for_buffers};
use crate::render::RenderError;
use crate::render::device_needs::{DeviceNeeds, ViewSizes};

/// The needs of the largest view that was probed, grown to the cap on Gaussians; `None` without a device.
fn needs(config: &TrainConfig, memory: &MemoryEstimate) -> Option<DeviceNeeds> {
    memory.device.map(|view| DeviceNeeds::new(view, config.sh_degree))
}

/// Refuses a `--device-mem` below the least that the largest view takes, now or grown to the cap on Gaussians.
///
/// # Errors
/// The budget is too small.
pub(super) fn check(config: &TrainConfig, memory: &[MemoryEstimate; 3]) -> InputResult<()> {
    let [Some(now), Some(grown)] = [&memory[0], &memory[1]].map(|memory| needs(config, memory)) else { return Ok(()) };
    let (budget, least) = (config.device_mem.0, now.least().max(grown.least()));
    if budget == 0 || bytes_for_buffers(budget) >= least {
        return Ok(());
    }
    let problem = format!(
        "{} are too little: pictures and splats of the largest view take {}{}",
        format_bytes(budget),
        format_bytes(now.least()),
        if grown == now { String::new() } else { format!(", and {} at --max-gaussians", format_bytes(grown.least())) }
    );
    let remedy = format!(
        "give at least {} ({} draws every view in one piece), lower --max-gaussians, or make the photos smaller with \
         --data-factor",
        format_bytes_up(budget_for_buffers(least)),
        format_bytes_up(budget_for_buffers(now.whole().max(grown.whole())))
    );
    Err(InputError::new("--device-mem", problem, remedy))
}

/// The refusal of a `--device-mem` that could not hold a view of the probe: names the least that holds the largest of
/// `views`, by the rows of the pages of each, of which the view may see fewer. Other errors stay as they are.
pub(super) fn refusal(
    error: TrainError,
    config: &TrainConfig,
    dataset: &Dataset,
    scene: &PagedScene,
    views: &[usize],
) -> TrainError {
    if !matches!(error, TrainError::Render(RenderError::Device(GpuError::OutOfBudget { .. }))) {
        return error;
    }
    let index = scene.pager.index();
    let of_view = |&view: &usize| {
        let camera = &dataset.views[view].camera;
        let rows = scene.pager.pages_of_view(camera).iter().map(|page| u64::from(index[page.index()].rows)).sum();
        ViewSizes { rows, isects: 0, pixels: camera.pixels() as u64 }
    };
    let largest = views.iter().map(of_view).fold(ViewSizes::default(), ViewSizes::max);
    let least = DeviceNeeds::new(largest, config.sh_degree).least();
    if bytes_for_buffers(config.device_mem.0) >= least {
        return error;
    }
    let problem = format!(
        "{} are too little: a view of up to {} Gaussians in {} pixels takes more even in the smallest parts",
        format_bytes(config.device_mem.0),
        largest.rows,
        largest.pixels
    );
    let remedy = format!(
        "give at least {}, make the photos smaller with --data-factor, or train with --device cpu",
        format_bytes_up(budget_for_buffers(least))
    );
    InputError::new("--device-mem", problem, remedy).into()
}

/// The lines of the plan about the device; empty without one. `memory` is the estimate to describe.
pub(super) fn describe(config: &TrainConfig, memory: &MemoryEstimate) -> String {
    let Some(needs) = needs(config, memory) else { return String::new() };
    let part = |name: &str, bytes: u64| format!("    {name:<44} {:>10}\n", format_bytes(bytes));
    let budget = match config.device_mem.0 {
        0 => String::from("no limit is set (--device-mem)"),
        bytes if bytes_for_buffers(bytes) >= needs.whole() => format!("--device-mem allows {}", format_bytes(bytes)),
        bytes => {
            format!("--device-mem allows {}: rows come in chunks, the picture in ranges of tiles", format_bytes(bytes))
        }
    };
    let mut text = format!(
        "device  about {} for the largest view in one piece, {} at least; {budget}\n",
        format_bytes(budget_for_buffers(needs.whole())),
        format_bytes(budget_for_buffers(needs.least()))
    );
    text.push_str(&part("rows and their gradients", needs.rows));
    text.push_str(&part("splats and their gradients", needs.splats));
    text.push_str(&part("lists of the tiles", needs.lists));
    text.push_str(&part("pictures", needs.pixels));
    text.push_str(&part("staging of uploads", needs.staging));
    text
}
