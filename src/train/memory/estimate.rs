//! Memory of a run: the expected peak by part, and the measured size of the process.
//!
//! The parts that depend on views (rows, intersections, images) are measured by rendering a few views with the first
//! Gaussians; the other parts are computed. The estimate is within 10 % of the peak of a run without growth.

use crate::base::error::{InputError, InputResult};
use crate::base::machine::memory_available;
use crate::base::units::format_bytes;
use crate::dataset::loader::{Dataset, View};
use crate::render::view_sizes::ViewSizes;
use crate::scene::state::row_bytes;
use crate::train::step::pages::PAGES_PER_BATCH;

/// Bytes per page of index, slot address and uses in the plan, for pages in memory or not.
pub(crate) const INDEX_BYTES: u64 = 256;
/// Memory of frames over memory of rows in a grown scene, since a split leaves pages partly empty. Measured: 1.18 with
/// 64 rows per page, 1.25 with 1024.
const GROWN_SPARE: f64 = 1.25;
/// Program, libraries and thread stacks, measured on an empty run: 16 MiB with the tables of a short one.
pub(crate) const BASE_BYTES: u64 = 12 << 20;

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

    /// All parts.
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

/// Peak resident size of this process, bytes; `None` if the system does not report it.
pub fn host_bytes_peak() -> Option<u64> {
    status_field("VmHWM:")
}

/// Makes [`host_bytes_peak`] count from now on, for a process that trains several times. Where the system cannot do that, the peak stays
/// that of the whole process.
pub fn reset_host_bytes_peak() {
    // Linux; a failure leaves the larger peak.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Current resident size of this process, bytes; `None` if the system does not report it.
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

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn a_reset_peak_forgets_memory_that_was_given_back() {
        const HELD: usize = 256 << 20;
        drop(std::hint::black_box(vec![1u8; HELD]));
        let before = host_bytes_peak().unwrap();
        assert!(before >= HELD as u64, "{before}");
        reset_host_bytes_peak();
        let after = host_bytes_peak().unwrap();
        assert!(after + HELD as u64 / 2 < before, "{before} bytes, then {after}");
    }
}
