//! The device memory of a run, before its first step: the table beside that of host memory, and the refusal of a budget
//! below the minimum.
//!
//! Not here: the sums ([`crate::render::device_needs`]).

use crate::base::error::{InputError, InputResult};
use crate::base::units::{format_bytes, format_bytes_up};
use crate::config::file::TrainConfig;
use crate::dataset::loader::Dataset;
use crate::gpu::{GpuError, budget_for_buffers, bytes_for_buffers};
use crate::optim::method::OptimizerPlace;
use crate::optim::moments::Moments;
use crate::render::RenderError;
use crate::render::device_needs::{DeviceNeeds, ViewSizes};
use crate::scene::page_layout::PageLayout;
use crate::train::error::TrainError;
use crate::train::memory::{INDEX_BYTES, MemoryEstimate};
use crate::train::step::device_slots::{SLOTS_SHARE, slots_in};
use crate::train::step::pages::PagedScene;

/// The needs of the largest view that was probed, grown to the cap on Gaussians; `None` without a device.
fn needs(config: &TrainConfig, memory: &MemoryEstimate) -> Option<DeviceNeeds> {
    memory.device.map(|view| DeviceNeeds::new(view, config.sh_degree))
}

/// Bytes of the optimizer's tables on a device, for each step of a run, and of the bins of growth scores.
const TABLES_BYTES: (u64, u64) = (60, 128 << 10);

/// Whether the optimizer of a run, and so its pages, are on the device.
fn holds_pages(config: &TrainConfig) -> bool {
    config.optimizer_on.0 == Some(OptimizerPlace::Device)
}

/// Bytes on the device beside its views, for pages: their slots take a share of what the tables leave.
fn tables(config: &TrainConfig) -> u64 {
    u64::from(config.steps) * TABLES_BYTES.0 + TABLES_BYTES.1
}

/// The memory of a run whose views take `bytes`. Where the device holds pages, their lists take up to a quarter of the splats,
/// and their slots as much as the views.
fn with_pages(config: &TrainConfig, needs: &DeviceNeeds, bytes: u64) -> u64 {
    if holds_pages(config) { SLOTS_SHARE * (bytes + needs.splats / 4) + tables(config) } else { bytes }
}

/// The least memory of a run with such views.
fn least_of(config: &TrainConfig, needs: &DeviceNeeds) -> u64 {
    with_pages(config, needs, needs.least())
}

/// The memory with which a run draws such views in one piece.
fn whole_of(config: &TrainConfig, needs: &DeviceNeeds) -> u64 {
    with_pages(config, needs, needs.whole())
}

/// Refuses a `--device-mem` below the least that the largest view takes, now or grown to the cap on Gaussians.
/// Errors: the budget is too small.
pub(crate) fn check_device_memory(config: &TrainConfig, memory: &[MemoryEstimate; 3]) -> InputResult<()> {
    let [Some(now), Some(grown)] = [&memory[0], &memory[1]].map(|memory| needs(config, memory)) else { return Ok(()) };
    let (budget, least) = (config.device_mem.0, least_of(config, &now).max(least_of(config, &grown)));
    if budget == 0 || bytes_for_buffers(budget) >= least {
        return Ok(());
    }
    let problem = format!(
        "{} is not enough: pictures and splats of the largest view{} take {}{}",
        format_bytes(budget),
        if holds_pages(config) { ", and as much for pages," } else { "" },
        format_bytes(least_of(config, &now)),
        if grown == now { String::new() } else { format!(", and {} at --max-gaussians", format_bytes(least)) }
    );
    let remedy = format!(
        "give at least {} ({} draws every view in one piece), lower --max-gaussians, or make the photos smaller with \
         --data-factor",
        format_bytes_up(budget_for_buffers(least)),
        format_bytes_up(budget_for_buffers(whole_of(config, &now).max(whole_of(config, &grown))))
    );
    Err(InputError::new("--device-mem", problem, remedy))
}

/// The refusal of a `--device-mem` that could not hold a view of the probe: names the least that holds the largest of
/// `views`, by the rows of the pages of each, of which the view may see fewer. Other errors stay as they are.
pub(crate) fn refusal(
    error: TrainError,
    config: &TrainConfig,
    dataset: &Dataset,
    scene: &PagedScene,
    views: &[usize],
) -> TrainError {
    if !matches!(error, TrainError::Render(RenderError::Device(GpuError::OutOfBudget { .. }))) {
        return error;
    }
    let of_view = |&view: &usize| {
        let camera = &dataset.views[view].camera;
        let rows = scene.pager.rows_of(&scene.pager.pages_of_view(camera));
        ViewSizes { rows, isects: 0, pixels: camera.pixels() as u64 }
    };
    let largest = views.iter().map(of_view).fold(ViewSizes::default(), ViewSizes::widest);
    let least = least_of(config, &DeviceNeeds::new(largest, config.sh_degree));
    if bytes_for_buffers(config.device_mem.0) >= least {
        return error;
    }
    let problem = format!(
        "{} is not enough: a view of up to {} Gaussians in {} pixels takes more even in the smallest parts",
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

fn slot_bytes(config: &TrainConfig) -> u64 {
    let layout = PageLayout { rows: config.page_rows as usize, sh_degree: config.sh_degree };
    layout.bytes_on_device(config.moments == Moments::Bf16)
}

/// The lines of the plan about the device; empty without one. `memory` is the estimate to describe.
pub(crate) fn describe(config: &TrainConfig, memory: &MemoryEstimate) -> String {
    let Some(needs) = needs(config, memory) else { return String::new() };
    let part = |name: &str, bytes: u64| format!("    {name:<44} {:>10}\n", format_bytes(bytes));
    let budget = match config.device_mem.0 {
        0 => String::from("without a limit (--device-mem) about twice that is kept"),
        bytes if bytes_for_buffers(bytes) >= whole_of(config, &needs) => {
            format!("--device-mem allows {}", format_bytes(bytes))
        }
        bytes => {
            format!("--device-mem allows {}: rows come in chunks, the picture in ranges of tiles", format_bytes(bytes))
        }
    };
    let mut text = format!(
        "device  about {} for the largest view in one piece, {} at least; {budget}\n",
        format_bytes(budget_for_buffers(whole_of(config, &needs))),
        format_bytes(budget_for_buffers(least_of(config, &needs)))
    );
    text.push_str(&part("rows and their gradients", needs.rows));
    text.push_str(&part("splats and their gradients", needs.splats));
    text.push_str(&part("lists of the tiles", needs.lists));
    text.push_str(&part("pictures", needs.pixels));
    text.push_str(&part("staging of uploads", needs.staging));
    if holds_pages(config) {
        let room = bytes_for_buffers(config.device_mem.0).saturating_sub(tables(config));
        let room = if config.device_mem.0 == 0 { u64::MAX } else { room };
        let (slots, all) = (slots_in(room, slot_bytes(config)), (memory.index / INDEX_BYTES).max(1));
        let name = format!("slots for {} of {all} pages", slots.min(all));
        text.push_str(&part(&name, slots.min(all) * slot_bytes(config)));
        text.push_str(&part("tables of the optimizer", tables(config)));
    }
    text
}
