//! The device memory of a run, before its first step: the table beside that of host memory, and the refusal of a budget below
//! the least.
//!
//! Not here: the sums ([`crate::render::device_needs`]).

use super::memory::MemoryEstimate;
use crate::base::error::{InputError, InputResult};
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::gpu::{budget_for_buffers, bytes_for_buffers};
use crate::render::device_needs::DeviceNeeds;

/// The needs of the largest view that was probed, grown to the cap on Gaussians; `None` without a device.
fn needs(config: &TrainConfig, memory: &MemoryEstimate) -> Option<DeviceNeeds> {
    memory.device.map(|view| DeviceNeeds::new(view, config.sh_degree))
}

/// Refuses a `--device-mem` below the least that the largest view takes, now or grown to the cap on Gaussians.
///
/// # Errors
/// The budget is too small.
pub(super) fn check(config: &TrainConfig, memory: &[MemoryEstimate; 2]) -> InputResult<()> {
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
        format_bytes(budget_for_buffers(least)),
        format_bytes(budget_for_buffers(now.whole().max(grown.whole())))
    );
    Err(InputError::new("--device-mem", problem, remedy))
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
