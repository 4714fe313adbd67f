//! The frames with which a run begins: for whole views where the budget holds them, else for views in batches.
//!
//! Not here: frames of a scene that has grown (`fitting`).
//!
//! Invariant: a budget that holds no batch of the largest view is refused, and the error names the smallest budget that
//! suffices.

use crate::base::error::{InputError, InputResult};
use crate::base::units::{format_bytes, format_bytes_up};
use crate::config::file::TrainConfig;
use crate::train::memory::budget::{FRAMES_LEAST, frames_and_batch};
use crate::train::memory::estimate::{MemoryEstimate, list_bytes, obtainable_bytes};
use crate::train::memory::staging::with_staging;
use crate::train::step::working_set::WorkingSet;

/// Pages are numbered in 32 bits.
const PAGES_MOST: u64 = u32::MAX as u64;

/// What the largest view needs.
#[derive(Debug, Clone, Copy)]
pub(super) struct LargestNeed {
    /// Bytes of a frame.
    pub frame_bytes: u64,
    /// Pages of the view.
    pub pages: u64,
}

/// Frames at the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FirstFrames {
    pub frames: u64,
    /// The most pages of a batch of a view.
    pub pages_most: usize,
}

impl FirstFrames {
    /// Enough for every view in one batch.
    fn of_whole_views(frames: u64) -> FirstFrames {
        FirstFrames { frames, pages_most: usize::MAX }
    }
}

/// Frames at the start, and the budget from which they follow.
pub(super) fn first_frames(
    config: &TrainConfig,
    need: &LargestNeed,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<(FirstFrames, Option<u64>)> {
    if config.frames > 0 {
        check_frames(u64::from(config.frames))?;
        return Ok((FirstFrames::of_whole_views(u64::from(config.frames)), host_mem));
    }
    // By the estimate without growth: the cap may never be reached, and growth takes frames when it happens.
    if let Some(frames) = whole_views(need, host_mem, memory) {
        return Ok((frames, host_mem));
    }
    let host_mem = raise_to_minimum(config, host_mem, least_memory(need, memory, host_mem));
    Ok((frames_of_budget(config, need, host_mem, memory)?, host_mem))
}

/// Least budget with which the largest view has its frames.
fn least_memory(need: &LargestNeed, memory: &MemoryEstimate, host_mem: Option<u64>) -> u64 {
    let rest = memory.fixed() - memory.staging + view_spare(memory) + need.pages * need.frame_bytes;
    with_margin(with_staging(rest, memory.staging, host_mem.unwrap_or(u64::MAX)), memory)
}

/// A budget that is enough at the next start too: the part of the graphics driver is measured, and differs from start to
/// start by up to 1/20.
fn with_margin(bytes: u64, memory: &MemoryEstimate) -> u64 {
    bytes + bytes / 50 + memory.base / 16
}

/// What lists of intersections may take more in a run with `bytes`, which were measured in a run with `budget`: lists fill their share of
/// the budget where a view needs longer ones. An eighth of what is added goes to lists again.
fn more_lists(bytes: u64, budget: u64) -> u64 {
    let more = list_bytes(bytes).saturating_sub(list_bytes(budget));
    more + more / 7
}

/// Margin for a view slightly larger than the rendered ones: its vectors grow by an eighth.
fn view_spare(memory: &MemoryEstimate) -> u64 {
    (memory.view - memory.view_pixels) / 8
}

/// Frames with which every view is one batch; `None` where the budget leaves too few.
fn whole_views(need: &LargestNeed, host_mem: Option<u64>, memory: &MemoryEstimate) -> Option<FirstFrames> {
    // Without a budget, the system reports no available memory: set no limit.
    let Some(budget) = host_mem else { return Some(FirstFrames::of_whole_views(PAGES_MOST)) };
    let frames = budget.saturating_sub(memory.fixed() + view_spare(memory)) / need.frame_bytes;
    (frames >= need.pages).then(|| FirstFrames::of_whole_views(frames.min(PAGES_MOST)))
}

/// Frames within the budget: for whole views, or for views in batches.
pub(super) fn frames_of_budget(
    config: &TrainConfig,
    need: &LargestNeed,
    host_mem: Option<u64>,
    memory: &MemoryEstimate,
) -> InputResult<FirstFrames> {
    let (whole, budget) = (whole_views(need, host_mem, memory), host_mem.unwrap_or(u64::MAX));
    if let Some(whole) = whole {
        return Ok(whole);
    }
    let rendering = memory.view - memory.working;
    // The margin for a larger view is left out where only the smallest batch remains: a run that grew into its budget resumes in it.
    let spare = (rendering - memory.view_pixels.min(rendering)) / 8;
    let beside = memory.fixed() - memory.working - memory.copies;
    let of_a_page = 2 * need.frame_bytes + page_working(config) + memory.copies.min(need.frame_bytes);
    let Some(left) = budget.checked_sub(beside).filter(|left| *left >= of_a_page) else {
        let problem = format!(
            "{} is not enough: pixels and splats of one view, photos, staging and tables take {}, and the smallest batch of a view {}",
            format_bytes(budget),
            format_bytes(beside),
            format_bytes(of_a_page)
        );
        let floor = with_margin(with_staging(beside - memory.staging + of_a_page, memory.staging, budget), memory);
        let whole = least_memory(need, memory, host_mem);
        let remedy = format!(
            "give at least {} ({} keeps each view in one batch), or lower --image-cache, --prefetch-bytes, --page-rows, \
             --sh-degree or the size of the photos",
            format_bytes_up(floor + more_lists(floor, budget)),
            format_bytes_up(whole + more_lists(whole, budget))
        );
        return Err(InputError::new("--host-mem", problem, remedy));
    };
    let left = left.saturating_sub(spare);
    let (frames, pages_most) = frames_and_batch(left, need.frame_bytes, page_working(config), memory.copies > 0);
    Ok(FirstFrames { frames: (frames as u64).min(PAGES_MOST), pages_most })
}

/// Reduces the estimate of a grown scene to `budget` as the run will do: by fewer frames and, if these do not hold the largest view of
/// the grown scene (`need`), by views in batches. Returns the number of frames.
pub(super) fn shrink_to_budget(
    config: &TrainConfig,
    need: &LargestNeed,
    budget: u64,
    memory: &mut MemoryEstimate,
) -> u64 {
    let FirstFrames { frames, pages_most } = whole_views(need, Some(budget), memory).unwrap_or_else(|| {
        let left = budget.saturating_sub(memory.fixed() - memory.working - memory.copies);
        let (frames, pages_most) = frames_and_batch(left, need.frame_bytes, page_working(config), memory.copies > 0);
        FirstFrames { frames: frames as u64, pages_most }
    });
    in_batches(config, memory, pages_most, need.frame_bytes);
    memory.frames = memory.frames.min(frames.saturating_mul(need.frame_bytes));
    frames
}

/// Reduces the estimate to batches of `pages_most` pages: rows of a view, and copies of a round.
pub(super) fn in_batches(config: &TrainConfig, memory: &mut MemoryEstimate, pages_most: usize, frame_bytes: u64) {
    let pages = pages_most as u64;
    let working = pages.saturating_mul(page_working(config)).min(memory.working);
    memory.view -= memory.working - working;
    memory.working = working;
    memory.copies = memory.copies.min(pages.saturating_mul(frame_bytes));
}

/// `host_mem`, raised to `least` with a warning if the user set no budget and the machine has the memory.
pub(super) fn raise_to_minimum(config: &TrainConfig, host_mem: Option<u64>, least: u64) -> Option<u64> {
    let budget = host_mem.filter(|&budget| config.host_mem.0 == 0 && least > budget);
    let Some(short) = budget.filter(|_| obtainable_bytes().is_some_and(|most| least <= most)) else { return host_mem };
    crate::tell!(
        "warning: the run needs {} from its start, more than {}, the default share of the free memory: it takes more \
         as long as the machine has it; --host-mem sets a limit",
        format_bytes(least),
        format_bytes(short)
    );
    Some(least)
}

fn check_frames(frames: u64) -> InputResult<()> {
    if frames >= FRAMES_LEAST as u64 {
        return Ok(());
    }
    let problem = format!("{frames} is too few: a step writes one page back while it reads another");
    Err(InputError::new("--frames", problem, format!("give at least {FRAMES_LEAST}")))
}

/// Bytes of the working set for the rows of one full page.
pub(super) fn page_working(config: &TrainConfig) -> u64 {
    u64::from(config.page_rows) * WorkingSet::row_bytes(config.sh_degree) as u64
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    /// A scene whose widest view takes 80 MiB of splats, in a run whose other parts take 100 MiB.
    fn estimate() -> MemoryEstimate {
        MemoryEstimate {
            frames: 4096 * MIB,
            staging: 10 * MIB,
            view: 200 * MIB,
            view_pixels: 20 * MIB,
            working: 100 * MIB,
            targets: 20 * MIB,
            index: 10 * MIB,
            copies: 0,
            base: 40 * MIB,
            device: None,
        }
    }

    #[test]
    fn a_budget_without_the_margin_gives_the_smallest_batch_and_one_below_it_is_refused() {
        let config = TrainConfig { page_rows: 256, sh_degree: 3, ..TrainConfig::default() };
        let need = LargestNeed { frame_bytes: MIB, pages: 2000 };
        let of_a_page = 2 * need.frame_bytes + page_working(&config);
        // All but the working set, which batches make smaller.
        let least = 180 * MIB + of_a_page;
        let frames = |bytes: u64| frames_of_budget(&config, &need, Some(bytes), &estimate());
        assert_eq!(frames(least).unwrap(), FirstFrames { frames: 2, pages_most: 1 });
        let refusal = frames(least - 1).err().unwrap().to_string();
        assert!(refusal.contains("is not enough") && refusal.contains("give at least"), "{refusal}");
        // An eighth of the splats stays free before frames take more.
        assert_eq!(frames(least + 9 * MIB).unwrap(), frames(least).unwrap());
        assert!(frames(least + 40 * MIB).unwrap().frames > 20);
    }
}
