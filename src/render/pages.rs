//! Pages on a device: the interface of backends whose device holds the payloads of whole pages, and gathers and updates
//! their rows itself.
//!
//! Not here: which pages lie in which slot, and when they come and go (`train`).
//!
//! Invariants: 1. a slot holds the payload of one page: byte for byte, or packed ([`PageLayout::pack`]) if moments have 16 bits; 2. the result of a step does not depend on slots,
//! batches or the room for them.

use super::{LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::kernels::uniforms::{PageResult, PageSurvey};
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use crate::scene::optimizer_numbers::{RunNumbers, SplitLimits, StepNumbers};
use crate::scene::page_layout::PageLayout;

/// A place on a device for the payload of one page.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct DeviceSlot(pub u32);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotPage {
    /// The slot that holds the payload.
    pub slot: DeviceSlot,
    /// Layout of the payload; at least one row.
    pub layout: PageLayout,
}

/// What a device needs to know of a run before it holds pages.
#[derive(Debug, Clone)]
pub struct PageRules {
    /// Layout of the largest payload.
    pub largest: PageLayout,
    /// The optimizer.
    pub numbers: RunNumbers,
    /// Limits within which rows may split.
    pub splits: SplitLimits,
    /// Whether steps may weigh rows ([`Renderer::weigh_rows`]).
    pub weighs: bool,
}

/// The first part of a recorded step, up to its picture.
#[derive(Debug, Clone, Copy)]
pub struct StepJob<'a> {
    /// The pages of the view, in their slots.
    pub pages: &'a [SlotPage],
    /// The optimizer's numbers of the step.
    pub numbers: &'a StepNumbers,
    pub camera: &'a Camera,
    pub options: &'a RenderOptions,
    /// Rows that the columns have room for: an upper bound, or the caller's prediction. A step that lists more rows is not taken.
    pub rows_room: u32,
    /// Upper limit on the capacity of the list of intersections, which the renderer predicts. Tests lower it to inject a list without room.
    pub isects_most: u32,
}

/// The second part of a recorded step: loss, backward pass, update.
#[derive(Debug, Clone, Copy)]
pub struct RecordedUpdate<'a> {
    pub target: &'a Target,
    pub loss: &'a LossOptions,
    /// Whether statistics are collected.
    pub collects: bool,
    /// The step is not taken if more than one in this many rows has unusable gradients.
    pub rows_per_unusable: u32,
    /// An injected fault: the step is not taken, whatever its numbers are.
    pub closes: bool,
}

/// The outcome of a recorded step.
#[derive(Debug, Clone)]
pub struct StepDone {
    /// The reasons why the step, and every step behind it, changed nothing: bits of [`crate::kernels::gate`]; 0 for a step that was taken.
    pub closed: u32,
    /// Listed rows.
    pub rows: u32,
    /// Rows with unusable gradients.
    pub unusable: u32,
    pub loss: LossValue,
    /// What the update did to each page.
    pub pages: Vec<PageResult>,
}

/// Stages on pages, in place of those on rows:
///
/// ```text
/// begin_view ──> pages_in (each batch) ──> picture ─ ─ > picture_back ──> pages_out, begin_update, finish_update (each batch)
/// ```
///
/// `loss_value` and `unusable_splats` may follow the first `pages_out`, before anything is updated. A step of one batch may be recorded
/// without any wait instead:
///
/// ```text
/// record_picture ──> record_update ─ ─ ─ ─ ─ > finish_step
///                         └──> record_picture ──> record_update ─ ─ > finish_step
/// ```
/// Errors: calls fail where the device failed or has no memory, where no pages are held, and out of order. Their comments name other errors.
pub trait PageRenderer: Renderer {
    /// Prepares the device for pages of a run. Slots that exist are given up.
    fn prepare_page_storage(&mut self, rules: &PageRules) -> Result<(), RenderError>;

    /// Device memory that slots and views can still take, bytes; drops the view.
    fn room(&mut self) -> u64;

    /// Device memory of a slot, bytes.
    fn slot_bytes(&self) -> u64;

    /// Makes up to `wanted` more slots, numbered on from those that exist; returns how many. Fewer than wanted, even none, where
    /// the device has no more memory.
    fn add_slots(&mut self, wanted: usize) -> Result<usize, RenderError>;

    /// Copies payloads into slots.
    fn write_slots(&mut self, payloads: &[(SlotPage, &[u8])]) -> Result<(), RenderError>;

    /// Copies slots into payloads. Waits.
    fn read_slots(&mut self, payloads: &mut [(SlotPage, &mut [u8])]) -> Result<(), RenderError>;

    /// Begins to copy slots to the host, as they are after the work submitted so far, from the first on; returns how
    /// many. Fewer than all, even none, if memory is short. Does not wait. The slots may get other payloads at once,
    /// because the device copies in the order of the calls.
    fn begin_reads(&mut self, slots: &[SlotPage]) -> Result<usize, RenderError>;

    /// Ends the copies that [`PageRenderer::begin_reads`] began first, into payloads in the same order. Waits for the copies, not for work
    /// submitted after them. Whatever happens, none of these copies is under way afterwards.
    fn finish_reads(&mut self, payloads: &mut [(SlotPage, &mut [u8])]) -> Result<(), RenderError>;

    /// As [`Renderer::rows_in`], for the rows of `pages` that the view's camera may draw, evaluated at the step. Returns how many.
    /// Waits for that number.
    /// Errors: as [`Renderer::rows_in`]; the pages are stored with another SH degree than the view asks for; no pages are held.
    fn pages_in(&mut self, pages: &[SlotPage], step: &StepNumbers) -> Result<usize, RenderError>;

    /// Propagates the gradients of the picture to the splats of a batch, as far as an update of the rows needs them.
    /// Errors: as [`Renderer::rows_out`].
    fn pages_out(&mut self, batch: usize) -> Result<(), RenderError>;

    /// Begins the step on the rows of a batch, in their slots, which collects statistics if `collects`. `pages` are those of
    /// [`PageRenderer::pages_in`], perhaps in other slots. Does not wait.
    /// Errors: [`PageRenderer::pages_out`] of the batch has not run, or the device failed: some pages may be updated then.
    fn begin_update(&mut self, batch: usize, pages: &[SlotPage], collects: bool) -> Result<(), RenderError>;

    /// Waits for the update that [`PageRenderer::begin_update`] began. Returns what it did to each page.
    fn finish_update(&mut self) -> Result<Vec<PageResult>, RenderError>;

    /// What decides whether a round edits rows of these pages, which have all steps so far. Waits.
    fn survey(&mut self, pages: &[SlotPage]) -> Result<Vec<PageSurvey>, RenderError>;

    /// Clears the statistics of all rows of these pages. Does not wait.
    /// No page is changed where that fails.
    fn clear_statistics(&mut self, pages: &[SlotPage]) -> Result<(), RenderError>;

    /// Takes the change of the number of rows by bin of the mean growth score since the last call, modulo 2^32. Waits.
    fn take_bins(&mut self) -> Result<Vec<u32>, RenderError>;

    /// Records a step of one batch up to its picture, without waiting. False where memory is short or the sizes of its lists cannot be
    /// predicted yet: the caller then runs the stages above.
    /// Errors: the device failed, or holds no pages; the pages are stored with another SH degree than the view asks for.
    fn record_picture(&mut self, job: &StepJob<'_>) -> Result<bool, RenderError>;

    /// Records loss, gradients and update of the step whose picture was recorded last, without waiting; the step is in flight then. The
    /// update changes nothing if the gate is closed by this step or an earlier one. False, and no step, where memory is short.
    /// Errors: the device failed: pages may be updated then. There is no recorded picture.
    fn record_update(&mut self, update: &RecordedUpdate<'_>) -> Result<bool, RenderError>;

    /// Waits for the first step in flight.
    fn finish_step(&mut self) -> Result<StepDone, RenderError>;

    /// Opens the gate again, once every step in flight is finished.
    fn open_gate(&mut self) -> Result<(), RenderError>;
}
