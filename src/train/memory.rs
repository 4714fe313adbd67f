//! How much memory a run will take, and how much it took.
//!
//! What depends on the views (rows, intersections, images) is measured by rendering a few of them with the first
//! Gaussians; what is simple arithmetic is computed. The promise is 10 % of the peak that a run without growth has.

use super::pages::PAGES_PER_BATCH;
use crate::base::error::{InputError, InputResult};
use crate::base::machine::memory_available;
use crate::base::units::format_bytes;
use crate::config::file::TrainConfig;
use crate::dataset::loader::{Dataset, View};
use crate::scene::state::row_bytes;

/// What is kept of a page that is not in memory: its entry, its place on the drive, its uses in the plan.
pub(super) const INDEX_BYTES: u64 = 256;
/// Pages that split have been full, and half of their rows left for another page: memory of the frames of a scene that has
/// grown over that of its rows. Measured: 1.18 with 64 rows to a page, 1.25 with 1024.
const GROWN_SPARE: f64 = 1.25;
/// Program, libraries and thread stacks, measured on an empty run: 16 MiB with the tables of a short one.
pub(super) const BASE_BYTES: u64 = 12 << 20;

/// Share of the memory that is available which a run takes when it is not told how much, percent.
const BUDGET_PERCENT: u64 = 70;
/// Share of the available memory that a run without a named budget may take beyond its first share, percent: what a run
/// holds is known to a tenth.
const REACH_PERCENT: u64 = 90;

/// What a run is expected to hold in memory at its peak, by part, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MemoryEstimate {
    /// Pages in frames: values, moments, stamps, identities and statistics.
    pub frames: u64,
    /// Pages on their way to or from a drive, and the plan.
    pub staging: u64,
    /// Rows of one view, their gradients, the stages' intermediates, images and loss.
    pub view: u64,
    /// Of these, what its pixels take, however many rows it has.
    pub view_pixels: u64,
    /// Decoded photos.
    pub targets: u64,
    /// The index of the pages, in memory or not.
    pub index: u64,
    /// Copies of pages that take part in a round of densification.
    pub copies: u64,
    /// Everything else, with the optimizer's tables.
    pub base: u64,
}

impl MemoryEstimate {
    /// All parts but the frames.
    pub fn fixed(&self) -> u64 {
        self.base + self.copies + self.view + self.staging + self.targets + self.index
    }

    /// All parts.
    pub fn total(&self) -> u64 {
        self.fixed() + self.frames
    }
}

/// Bytes that a run may take: what it was told, or a share of what this process could have; `None` where the system does
/// not tell.
pub fn host_budget(config: &TrainConfig) -> Option<u64> {
    match config.host_mem.0 {
        0 => memory_available().map(|bytes| bytes / 100 * BUDGET_PERCENT),
        bytes => Some(bytes),
    }
}

/// Bytes that this process could come to hold on this machine: what it holds, and most of what it could still get; `None`
/// where the system does not tell. For runs that were not told how much they may take and need more than they set out with.
pub fn within_reach() -> Option<u64> {
    // Not what it holds of files: that memory can go, and counts as available already.
    let held = status_field("RssAnon:").or_else(host_bytes_now)?;
    Some(held + memory_available()? / 100 * REACH_PERCENT)
}

/// Rows that a run may come to, as far as it is known: those there are, or the cap.
pub fn rows_at_most(config: &TrainConfig, rows: u64) -> u64 {
    if config.strategy.grows() { rows.max(config.max_gaussians) } else { rows }
}

/// The most that decoding a photo with its mask takes, bytes, and the view whose it is.
pub(super) fn largest_decode(dataset: &Dataset) -> (u64, Option<&View>) {
    let largest = dataset.views.iter().max_by_key(|view| view.photo.decode_bytes());
    (largest.map_or(0, |view| view.photo.decode_bytes()), largest)
}

/// Refuses a photo that cannot be decoded within the memory of the run, before it is decoded. What a photo takes follows from
/// its header ([`crate::dataset::photo_header`]).
///
/// # Errors
/// The photo that takes most takes more than `host_mem`.
pub(super) fn check_photos_fit(dataset: &Dataset, host_mem: Option<u64>) -> InputResult<()> {
    let (bytes, Some(view)) = largest_decode(dataset) else { return Ok(()) };
    let Some(budget) = host_mem.filter(|budget| bytes > *budget) else { return Ok(()) };
    let header = &view.photo.header;
    let problem = format!(
        "decoding it takes up to {}, more than the memory that there is for everything ({})",
        format_bytes(bytes),
        format_bytes(budget)
    );
    let remedy = "raise --host-mem, or make the photos smaller and give their folder with --images";
    let place = format!("view {}, {} x {} pixels", view.name, header.width, header.height);
    Err(InputError::new(&view.photo.image_path, problem, remedy).at(place))
}

/// Memory of the copies that a round of densification makes of the pages of a scene, a batch at a time.
pub(super) fn bytes_of_copies(pages: usize, frame_bytes: usize) -> u64 {
    (pages.min(PAGES_PER_BATCH) * frame_bytes) as u64
}

/// Memory of the pages of so many rows at a degree when all are in it; `has_grown` once pages were full and split.
pub(super) fn frames_in_memory(rows: u64, sh_degree: u8, has_grown: bool) -> u64 {
    let spare = if has_grown { GROWN_SPARE } else { 1.0 };
    (rows as f64 * row_bytes(sh_degree) as f64 * spare) as u64
}

/// The largest resident size of this process so far, bytes; `None` where the system does not tell.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:")
}

/// The resident size of this process now, bytes; `None` where the system does not tell.
pub fn host_bytes_now() -> Option<u64> {
    status_field("VmRSS:")
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
