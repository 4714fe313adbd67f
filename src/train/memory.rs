//! Memory by part: the estimate of a run, staging, an evaluation, and the budget of a growing scene: how many frames
//! remain beside the other memory, and when a scene in memory no longer fits (the loop then starts paging).
//!
//! Parts that depend on views (rows, intersections, images) are measured by rendering a few views with the first Gaussians; the other parts
//! are computed. The estimate is within 10 % of the peak of a run without growth. Not here: whether a run fits (`preflight`).
//!
//! Invariants: 1. the number of frames follows from bytes: the budget minus what the run holds beside its frames. It never follows from a
//! page count guessed at the start. A frame takes memory once a page fills it; 2. frames shrink before the step that needs their memory, by
//! the largest growth that its view may have had since the last step; frames that were removed for growth that did not happen are added
//! again; 3. possible growth never stops a run: a step gets the frames that it needs while the run's current memory leaves room for them.
//! For such frames, a run without --host-mem exceeds its first share, up to the available memory of the machine; 4. no bit of the result
//! depends on the budget.

use crate::base::error::{InputError, InputResult};
use crate::base::machine::{host_bytes_now, memory_available, status_field};
use crate::base::units::{format_bytes, format_bytes_up, format_grouped};
use crate::dataset::loader::{Dataset, View};
use crate::dataset::target_cache::TargetCache;
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::render::lpips::Network;
use crate::render::view_sizes::ViewSizes;
use crate::scene::columns::{Column, Columns};
use crate::scene::state::row_bytes;
use crate::train::step::pages::{PAGES_PER_BATCH, PagedScene};
use std::path::Path;

/// Bytes per page of index, slot address and uses in the plan, for pages in memory or not.
pub(crate) const INDEX_BYTES: u64 = 256;
/// Memory of frames over memory of rows in a grown scene, since a split leaves pages partly empty. Measured: 1.18 with
/// 64 rows per page, 1.25 with 1024.
const GROWN_SPARE: f64 = 1.25;
/// Program, libraries and thread stacks, measured on an empty run: 19 MiB with the tables of a short one.
pub(crate) const BASE_BYTES: u64 = 15 << 20;

/// The least memory for the intersection lists of a view, bytes.
const LIST_BYTES_LEAST: u64 = 16 << 20;

/// Share of the available memory that a run without --host-mem takes, percent.
const BUDGET_PERCENT: u64 = 70;
/// Share of the available memory up to which a run without --host-mem may rise, percent: estimates err by up to a
/// tenth.
const REACH_PERCENT: u64 = 90;

/// Expected peak memory of a run by part, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MemoryEstimate {
    /// Pages in frames: values, moments, stamps, identities and statistics.
    pub frames: u64,
    /// Pages in transfer, and the plan.
    pub staging: u64,
    /// Rows of one view, their gradients, the stages' intermediates, images and loss.
    pub view: u64,
    /// The part of `view` that depends on pixels alone.
    pub view_pixels: u64,
    /// Part of `view` for the rows and gradients of the largest view, in one batch: the part that batches make smaller.
    pub working: u64,
    /// Decoded photos.
    pub targets: u64,
    /// Index of all pages, in memory or not.
    pub index: u64,
    /// Copies of pages during a densification round.
    pub copies: u64,
    /// Everything else, with the optimizer's tables.
    pub base: u64,
    /// The largest sizes of the probed views on a device; `None` without a device.
    pub device: Option<ViewSizes>,
}

impl MemoryEstimate {
    /// All parts but the frames.
    pub fn fixed(&self) -> u64 {
        self.base + self.copies + self.view + self.staging + self.targets + self.index
    }

    pub fn total(&self) -> u64 {
        self.fixed() + self.frames
    }
}

/// The budget of a run: `asked` (`--host-mem`), or a share of the available memory if that is 0; `None` if the system does not report it.
pub fn host_budget(asked: u64) -> Option<u64> {
    match asked {
        0 => memory_available().map(|bytes| bytes / 100 * BUDGET_PERCENT),
        bytes => Some(bytes),
    }
}

/// Bytes that this process holds plus most of the available memory: the limit for raising the budget of a run without
/// --host-mem. `None` if the system does not report it.
pub fn obtainable_bytes() -> Option<u64> {
    // Anonymous memory only: cached files count as available already.
    let held = status_field("RssAnon:").or_else(host_bytes_now)?;
    Some(held + memory_available()? / 100 * REACH_PERCENT)
}

/// The most bytes that decoding one photo with its mask takes, and the view of that photo.
pub(crate) fn largest_decode(dataset: &Dataset) -> (u64, Option<&View>) {
    let largest = dataset.views.iter().max_by_key(|view| view.photo.decode_bytes());
    (largest.map_or(0, |view| view.photo.decode_bytes()), largest)
}

/// Memory for the intersection lists of a view in a run that may take `host_mem` bytes: the lists of a few views of drone photos
/// fit into an eighth, and longer lists are made in parts.
pub(crate) fn list_bytes(host_mem: u64) -> u64 {
    (host_mem / 8).max(LIST_BYTES_LEAST)
}

/// Refuses photos that cannot be decoded within `host_mem`, judging by their headers
/// ([`crate::dataset::photo_header`]).
/// Errors: decoding the largest photo takes more than `host_mem`.
pub(crate) fn check_photos_fit(dataset: &Dataset, host_mem: Option<u64>) -> InputResult<()> {
    let (bytes, Some(view)) = largest_decode(dataset) else { return Ok(()) };
    let Some(budget) = host_mem.filter(|budget| bytes > *budget) else { return Ok(()) };
    let header = &view.photo.header;
    let problem = format!(
        "decoding it takes up to {}, more than the whole memory of the run ({})",
        format_bytes(bytes),
        format_bytes(budget)
    );
    let remedy = "raise --host-mem, or make the photos smaller and give their folder with --images";
    let place = format!("view {}, {} x {} pixels", view.name, header.width, header.height);
    Err(InputError::new(&view.photo.image_path, problem, remedy).at(place))
}

/// Bytes of the page copies that a densification round makes, one batch at a time.
pub(crate) fn bytes_of_copies(pages: usize, frame_bytes: usize) -> u64 {
    (pages.min(PAGES_PER_BATCH) * frame_bytes) as u64
}

/// Bytes of all pages in memory for `rows` rows at `sh_degree`; `has_grown` if pages have split.
pub(crate) fn frames_in_memory(rows: u64, sh_degree: u8, has_grown: bool) -> u64 {
    let spare = if has_grown { GROWN_SPARE } else { 1.0 };
    (rows as f64 * row_bytes(sh_degree) as f64 * spare) as u64
}

/// Memory of a small plan, bytes: enough for the steps of the prefetch.
pub(crate) const PLAN_BYTES_LEAST: usize = 1 << 20;
/// Most bytes of frames that may be prefetched.
pub(crate) const PREFETCH_BYTES_MAX: usize = 256 << 20;

/// Memory for the plan of the coming steps, bytes.
pub const PLAN_BYTES: usize = 16 << 20;

/// Bytes of the plan and of encoded pages in transfer, of which `prefetch_bytes` may be in flight. Raw pages move
/// between frames and drive without a copy, so they need no staging.
pub fn staging_bytes(prefetch_bytes: usize, codec: Codec) -> u64 {
    (PLAN_BYTES + if codec == Codec::Raw { 0 } else { prefetch_bytes }) as u64
}

/// The budget of a run that holds `rest` bytes besides staging, if a budget of `budget` bytes had `staging` bytes of
/// staging. A larger budget has more frames, and with them more staging: up to an eighth of the frames may be in transfer.
pub(crate) fn with_staging(rest: u64, staging: u64, budget: u64) -> u64 {
    let of_plan = staging.min(PLAN_BYTES as u64);
    let share = ((staging - of_plan) as f64 / budget.max(1) as f64).min(0.5);
    let most = of_plan + (staging - of_plan).max(2 * PREFETCH_BYTES_MAX as u64);
    (((rest + of_plan) as f64 / (1.0 - share)) as u64).min(rest + most).max(rest + staging)
}

/// Bytes of a renderer for a Gaussian in view: splat, sort and intersections with tiles.
const RENDERER_ROW_BYTES: u64 = 320;
/// Bytes of a renderer for a pixel: colour and coverage of the picture, and colour, transmittance and last splat of its tile.
const PIXEL_BYTES: u64 = 36;

/// Memory of Gaussians that are evaluated, bytes: `columns` of all values, their pages, and the renderer's.
fn bytes_of_evaluated(rows: u64, sh_degree: u8, columns: u64) -> u64 {
    columns + frames_in_memory(rows, sh_degree, false) + rows * RENDERER_ROW_BYTES
}

/// Checks that the Gaussians that the header of `file` states can be evaluated, before they are read.
/// Errors: they alone exceed the budget.
pub(crate) fn check_gaussians_alone_fit(file: &Path, rows: u64, sh_degree: u8, budget: u64) -> InputResult<()> {
    let values = 4 * Column::ALL.iter().map(|column| column.width(sh_degree) as u64).sum::<u64>();
    let needed = BASE_BYTES + bytes_of_evaluated(rows, sh_degree, rows * values);
    if needed <= budget {
        return Ok(());
    }
    let (rows, needed, most) = (format_grouped(rows), format_bytes_up(needed + needed / 50), format_bytes(budget));
    let problem = format!("evaluating {rows} Gaussians takes at least {needed}, without photos, more than {most}");
    Err(InputError::new(file, problem, format!("give more than {needed} with --host-mem")))
}

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
    let gaussians = bytes_of_evaluated(rows, columns.sh_degree, columns.bytes() as u64);
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

/// A page may gain this many times the mean growth of all pages.
const UNEVEN: f64 = 2.0;

/// Fewest frames of a run: write back needs some.
pub(crate) const FRAMES_LEAST: usize = 2;
/// An extension of frames or memory adds 1/8 on top, so that the next steps of a growing scene need no extension.
pub(crate) const SPARE_SHARE: usize = 8;
/// Vectors grow by an eighth for a view that is slightly larger than earlier views.
const VIEW_SPARE: f64 = 1.125;

/// Bytes of a page in memory beside its rows: the header and half a memory page of rounding. Negligible for pages of
/// 1,000 rows, a fifth of pages of 32 rows.
const AROUND_ROWS: f64 = HEADER_BYTES as f64 + 2048.0;

/// Memory of the largest view so far, bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewMemory {
    /// With the current SH degree.
    pub now: u64,
    /// With the SH degree of the last step.
    pub at_last: u64,
}

/// The memory budget of a run, from which its number of frames follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostBudget {
    /// The whole budget, bytes.
    pub(crate) bytes: u64,
    /// Bytes that do not grow with the scene, without staging.
    pub(crate) constant: u64,
    /// Whether densification rounds copy pages.
    pub(crate) copies_pages: bool,
    /// Bytes for pages in transfer and the plan.
    pub(crate) staging: u64,
    /// Bytes of a view that depend on its pixels alone.
    pub(crate) view_pixels: u64,
    /// The user set the budget (--host-mem), so it never rises.
    pub(crate) is_named: bool,
    /// The budget has risen above the run's first share.
    pub(crate) is_raised: bool,
    /// The plan has shrunk to leave memory for frames.
    pub(crate) is_plan_small: bool,
    /// Number of commits when paging could not start for lack of drive space.
    pub(crate) failed_after: Option<u64>,
    /// Bytes in flight ahead of their step, each way, if a run in memory starts paging.
    pub(crate) prefetch_bytes: usize,
}

impl HostBudget {
    /// A budget of `bytes`, set by the user if `is_named`, for a run with the estimate `memory`.
    pub fn new(bytes: u64, memory: &MemoryEstimate, is_named: bool) -> HostBudget {
        HostBudget {
            bytes,
            constant: memory.base + memory.targets,
            copies_pages: memory.copies > 0,
            staging: memory.staging,
            view_pixels: memory.view_pixels,
            is_named,
            is_raised: false,
            is_plan_small: false,
            failed_after: None,
            prefetch_bytes: 0,
        }
    }

    /// Frames for a step whose view needs `needed` pages: the budget minus the run's current memory and the growth that
    /// the view may have had since its rows were last counted. If the view needs more frames, it gets them, with spare
    /// frames for splits, from the memory reserved for growth.
    pub(crate) fn frames(&self, scene: &PagedScene, view: ViewMemory, needed: usize) -> usize {
        let with_splits = self.frames_left(scene, view.at_last, 1.0).min(needed + needed / 4 + 1);
        let bare = self.frames_at_most(scene, view).min(needed);
        self.frames_left(scene, view.at_last, growth_due(scene)).max(with_splits).max(bare).max(FRAMES_LEAST)
    }

    /// The frames, and the most pages of a batch, for a view that does not fit in one batch. The renderer holds `rendering` bytes,
    /// and the working set `working_row` bytes for each row of a batch. For each page, a batch takes two frames (the second for the
    /// next batch and for pages that split), a part of the working set and, in a densification round, a copy of the page. Also the bytes by
    /// which the smallest batch exceeds the budget.
    pub(crate) fn batches(&self, scene: &PagedScene, rendering: u64, working_row: usize) -> (usize, usize, u64) {
        let taken = self.bytes_beside_frames(scene, rendering, growth_due(scene)) - self.copies(scene) + self.staging;
        let left = self.bytes.saturating_sub(taken);
        let frame = scene.pager.frame_bytes() as u64;
        let working = (scene.rules.page_rows * working_row) as u64;
        let (frames, pages) = frames_and_batch(left, frame, working, self.copies_pages);
        let least = 2 * frame + working + if self.copies_pages { frame } else { 0 };
        (frames, pages, (taken + least).saturating_sub(self.bytes))
    }

    fn copies(&self, scene: &PagedScene) -> u64 {
        let pages = scene.pager.index().len();
        if self.copies_pages { bytes_of_copies(pages, scene.pager.frame_bytes()) } else { 0 }
    }

    /// Frames that fit beside the run's current memory, without growth.
    pub(crate) fn frames_at_most(&self, scene: &PagedScene, view: ViewMemory) -> usize {
        self.frames_left(scene, view.now, 1.0)
    }

    fn frames_left(&self, scene: &PagedScene, view: u64, growth: f64) -> usize {
        let taken = self.bytes_beside_frames(scene, view, growth) + self.staging;
        (self.bytes.saturating_sub(taken) / scene.pager.frame_bytes() as u64) as usize
    }

    /// The least budget, larger than this one, with which a resumed run has `pages` frames.
    pub(crate) fn least_for(&self, scene: &PagedScene, view: ViewMemory, pages: usize) -> u64 {
        // A resumed run has the full plan again.
        let staging = self.staging + if self.is_plan_small { (PLAN_BYTES - PLAN_BYTES_LEAST) as u64 } else { 0 };
        let frame_bytes = scene.pager.frame_bytes() as u64;
        let of_rows = view.at_last.saturating_sub(self.view_pixels) as f64 * VIEW_SPARE;
        let beside_frames = self.bytes_beside_frames(scene, self.view_pixels + of_rows as u64, 1.0);
        let least = with_staging(beside_frames + pages as u64 * frame_bytes, staging, self.bytes);
        // A sixteenth of margin: the resumed run measures its memory anew.
        (least + least / 16).max(self.bytes + frame_bytes)
    }

    /// This budget with a small plan, which leaves memory for more frames; `None` if the plan is small already.
    pub(crate) fn with_small_plan(&self) -> Option<HostBudget> {
        let spare = (PLAN_BYTES - PLAN_BYTES_LEAST) as u64;
        let staging = self.staging.checked_sub(spare).filter(|_| !self.is_plan_small)?;
        Some(HostBudget { staging, is_plan_small: true, ..*self })
    }

    /// This budget raised to `bytes` and 1/8 more. `None` if the user set the budget or the machine lacks the memory.
    pub(crate) fn raised(&self, bytes: u64) -> Option<HostBudget> {
        let most = if self.is_named { None } else { obtainable_bytes() }?;
        let raised = (bytes + bytes / SPARE_SHARE as u64).min(most).max(self.bytes);
        (bytes <= most).then_some(HostBudget { bytes: raised, is_raised: true, ..*self })
    }

    /// Whether a run with this budget can keep all pages in memory.
    pub fn holds_all(&self, scene: &PagedScene, view: u64) -> bool {
        // Scan the index for split pages only if the answer depends on them.
        self.bytes_of_all(scene, view, true) <= self.bytes
            || (self.bytes_of_all(scene, view, false) <= self.bytes
                && !scene.pager.index().iter().any(|page| page.id.is_part()))
    }

    /// Bytes of a run with all pages in memory; `have_split` if pages have split.
    pub(crate) fn bytes_of_all(&self, scene: &PagedScene, view: u64, have_split: bool) -> u64 {
        let growth = growth_due(scene);
        let rows = frames_in_memory(scene.rows_bound(), scene.rules.sh_degree, have_split);
        let around_rows = scene.pager.index().len() as f64 * growth * AROUND_ROWS;
        self.bytes_beside_frames(scene, view, growth) + rows + around_rows as u64
    }

    /// Bytes of a run without frames and staging, when its rows have grown `growth` times.
    pub(crate) fn bytes_beside_frames(&self, scene: &PagedScene, view: u64, growth: f64) -> u64 {
        let of_rows = view.saturating_sub(self.view_pixels) as f64 * growth;
        let pages = scene.pager.index().len();
        let index = pages as f64 * growth * INDEX_BYTES as f64;
        self.constant + self.copies(scene) + self.view_pixels + (of_rows + index) as u64
    }
}

/// The frames, and the pages of a batch, within `left` bytes. Each page of a batch takes two frames, `working` bytes of the working
/// set and, if densification `copies` pages, a copy. At least one page and [`FRAMES_LEAST`] frames, even if they do not fit.
pub(crate) fn frames_and_batch(left: u64, frame: u64, working: u64, copies: bool) -> (usize, usize) {
    let copied = if copies { PAGES_PER_BATCH as u64 } else { 0 };
    let few = left / (2 * frame + working + if copies { frame } else { 0 });
    let many = left.saturating_sub(copied * frame) / (2 * frame + working);
    let pages = if few > copied { many } else { few }.max(1);
    let beside = pages * working + pages.min(copied) * frame;
    let frames = (left.saturating_sub(beside) / frame).max(2 * pages).max(FRAMES_LEAST as u64);
    (frames as usize, pages as usize)
}

/// Largest growth factor of a view's rows since they were last counted.
fn growth_due(scene: &PagedScene) -> f64 {
    let (rows, bound) = (scene.rows().max(1) as f64, scene.rows_bound() as f64);
    1.0 + UNEVEN * (bound / rows - 1.0).max(0.0)
}
