//! Steps in flight: steps on the pages of a device that are recorded as a whole without waiting, so that the host records the next step
//! while the device computes this one.
//!
//! ```text
//! host    record s │ record s+1 │ wait for s, its bounds │ record s+2 │ wait for s+1 ...
//! device           │ s ........................ │ s+1 ........................ │ s+2 ...
//! ```
//!
//! The gate on the device (`kernels::gate`) lets a step write only if its lists had room and its numbers are sound. A step that is not
//! taken, and the step behind it, change nothing. Both are given up. The first is taken again by the path that waits for each number
//! ([`super::train_step`]), which enlarges lists and decides what is skipped.
//!
//! # Where the pipeline drains
//! A step is recorded while another is in flight only if the host decides nothing by the outcome of the other step in between:
//!
//! | what | who holds back |
//! | --- | --- |
//! | a round, a reset, a raise or a check of growth follows the other step: it reads bins that the device counts, and pages apply it on the host | the trainer |
//! | evaluation, a saved file, a commit, the live page, a stop, a scene that outgrows its memory | the loop |
//! | a step was unsound or changed no row: further ones may end the run | the trainer |
//! | corrections of pictures, masks of blocks, views that may be left out | the trainer |
//! | a page of the view has events to apply | this file |
//! | a page of the view is leaving its slot, or there are too few frames for two views | this file |
//! | the view is several batches | this file |
//! | the step before was not taken | this file |
//! | memory for the step is short | the renderer; this file tries again some steps later |
//!
//! Payloads that the device lacks are copied up when a step is recorded, into slots of pages that leave behind the
//! steps in flight (`device_slots`). So the order of eviction is that of a run that waits. When a step that was not
//! taken is repeated, other pages lie in slots, so some pages are copied up again.
//!
//! A view of several batches gives each slot to several pages within its step. The host copies a page back before the slot takes
//! the next one, so it waits several times in such a step whatever is recorded. A step recorded behind it would need slots for its own pages
//! as well, which no such view leaves. So only payloads of the next step go up ahead there (`device_slots`).
//!
//! The list of pages of a step behind another comes from bounds that are as wide as the other step can make them
//! ([`crate::optim::one_step`]). So the list contains all pages that the exact bounds give. Any other page in the list has no row in view
//! and does not change. `Flights::finish` of the other step checks that no page is missing.
//!
//! Invariants: 1. the bytes of the result are those of a run that waits; 2. at most two steps are in flight; 3. a page of a
//! step in flight is pinned in its slot and in its frame, and is neither held nor released; 4. a step that was not taken leaves pages,
//! statistics and bounds as they were.

use super::device_slots::{Leaves, SlotCache, device_of};
use super::pages::PagedScene;
use super::soundness::{StepFault, StepFaults, steps_in_flight};
use super::train_step::{ROWS_PER_UNUSABLE, StepOutcome};
use crate::base::error::InputError;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::optim::one_step::OneStep;
use crate::paging::pinned::PinnedPage;
use crate::render::pages::{RecordedUpdate, StepDone, StepJob};
use crate::render::{LossOptions, RenderError, RenderOptions, Renderer};
use crate::scene::camera::Camera;
use crate::scene::frustum::Frustum;
use crate::scene::image::Target;
use crate::train::error::TrainError;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// After a step that lacked memory, no step is recorded for this number of steps.
const STEPS_WITHOUT: u32 = 16;
/// Spare room of the columns, rows, beyond the number that is expected.
const ROWS_MORE: u64 = 256;

/// What became of a step to record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RecordedStep {
    /// It is in flight.
    Done,
    /// Memory for the copies back behind the step in flight is short. The step can be recorded when the step in flight is finished.
    TooEarly,
    /// Memory is short.
    Short,
}

#[derive(Debug, Clone, Copy)]
pub struct StepToRecord<'a> {
    /// 0-based step.
    pub step: u32,
    pub camera: &'a Camera,
    /// Step and camera after it.
    pub next: Option<(u32, &'a Camera)>,
    /// How the view is drawn.
    pub render: &'a RenderOptions,
    pub target: &'a Target,
    pub loss: &'a LossOptions,
    /// Whether the step collects statistics.
    pub collects: bool,
    /// Rows that the view listed last; 0 if that is not known.
    pub rows_before: u32,
    /// The largest share of the rows in its pages that a view has listed so far.
    pub share: f64,
    pub pages_most: usize,
}

impl StepToRecord<'_> {
    /// Capacity for the listed rows of the view: an eighth more than this view listed last. If that is unknown, the
    /// largest listed share of any view is applied to the `in_pages` rows in its pages.
    fn rows_room(&self, in_pages: u64) -> u32 {
        let likely = match self.rows_before {
            0 => (in_pages as f64 * self.share) as u64,
            rows => u64::from(rows),
        };
        (likely + likely / 8 + ROWS_MORE).min(in_pages).min(u64::from(u32::MAX / 2)) as u32
    }
}

/// The most steps in flight.
const STEPS_IN_FLIGHT: usize = 2;

/// A step that is recorded and not finished.
#[derive(Debug)]
struct Flight {
    /// Its number, 0-based.
    pub step: u32,
    pub camera: Camera,
    /// Its pages, ascending by id.
    pub pages: Vec<PageNo>,
}

/// The steps in flight and their pages.
#[derive(Debug)]
pub(crate) struct Flights {
    /// In the order of their steps.
    steps: VecDeque<Flight>,
    /// Each page with the number of steps in flight that use it.
    pages: BTreeMap<PageNo, (PinnedPage, usize)>,
    /// No step before this one is recorded.
    not_before: u32,
    /// The most steps in flight.
    most: usize,
    /// Whether the step that was finished last was taken. If not, or before the first one, the predicted sizes of lists are doubtful.
    is_sure: bool,
    /// How far an update moves bounds.
    one_step: OneStep,
    faults: StepFaults,
}

impl Flights {
    /// No step in flight yet, for a run whose updates move bounds by at most `one_step`.
    pub fn new(one_step: OneStep) -> Flights {
        let (most, faults) = (steps_in_flight(STEPS_IN_FLIGHT), StepFaults::from_environment());
        Flights {
            steps: VecDeque::new(),
            pages: BTreeMap::new(),
            not_before: 0,
            most,
            is_sure: false,
            one_step,
            faults,
        }
    }

    pub fn in_flight(&self) -> usize {
        self.steps.len()
    }

    /// Whether one more step may be in flight. A step whose predicted list sizes are doubtful stays alone: a refusal would cost two steps.
    pub fn may_record(&self) -> bool {
        self.in_flight() < if self.is_sure { self.most } else { self.most.min(1) }
    }

    /// Begins a step. Copies back that began behind a step in flight are not waited for.
    pub(super) fn begin_step(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: u32,
    ) -> Result<(), TrainError> {
        if self.in_flight() == 0 {
            cache.finish_leaving(scene, renderer, u32::MAX, &mut self.pinned_pages())?;
        }
        cache.begin_step(scene, renderer, step)
    }

    /// The pages that steps in flight have pinned.
    pub(super) fn pinned_pages(&mut self) -> impl ExactSizeIterator<Item = &mut PinnedPage> {
        self.pages.values_mut().map(|(page, _)| page)
    }

    /// The pages that `camera` may need once the steps in flight are done, ascending by id. The bounds are widened by the
    /// most that a step after `now` steps can move them.
    pub(super) fn pages_behind(&self, scene: &PagedScene, camera: &Camera, now: u32) -> Vec<PageNo> {
        let mut pages = scene.pager.pages_of_view(camera);
        if self.pages.is_empty() {
            return pages;
        }
        let (planes, index) = (Frustum::new(camera).planes(), scene.pager.index());
        let widened = |page: &PageNo| self.one_step.widened(&index[page.index()].bounds, now);
        let known: BTreeSet<PageNo> = pages.iter().copied().collect();
        let others = self.pages.keys().filter(|page| !known.contains(page));
        pages.extend(others.filter(|page| planes.may_intersect(&widened(page))));
        pages.sort_unstable_by_key(|page| index[page.index()].id);
        pages
    }

    /// Whether the step can be recorded now, with these pages.
    fn is_recordable(&self, cache: &SlotCache, scene: &PagedScene, pages: &[PageNo], step: &StepToRecord<'_>) -> bool {
        let index = scene.pager.index();
        let is_behind = |page: &PageNo| scene.rules.is_behind(&index[page.index()]);
        let most = step.pages_most.min(scene.pager.pages_per_batch(pages.len())).min(cache.slots());
        if step.step < self.not_before || pages.is_empty() || pages.len() > most || pages.iter().any(is_behind) {
            return false;
        }
        let others = self.pages.keys().filter(|page| !pages.contains(page)).count() + cache.pages_leaving();
        // A step behind another must not wait. So there must be frames for both and as many again, and no page of the step may still be leaving.
        self.steps.is_empty()
            || (scene.pager.frames_max() >= 2 * (others + pages.len())
                && !pages.iter().any(|page| cache.is_leaving(*page)))
    }

    /// Records a step on the pages of a device, without waiting for anything that the device computes. False, with nothing changed, where
    /// that cannot be done now.
    /// Errors: a page could not be read, and nothing has changed; or the device failed ([`TrainError::Torn`]).
    pub fn record(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: &StepToRecord<'_>,
    ) -> Result<bool, TrainError> {
        let pages = self.pages_behind(scene, step.camera, step.step.saturating_sub(1));
        if !self.is_recordable(cache, scene, &pages, step) {
            return Ok(false);
        }
        renderer.weigh_rows(step.collects && scene.rules.strategy.needs_weights())?;
        scene.pager.begin_view(step.step, step.camera)?;
        self.begin_step(cache, scene, renderer, step.step)?;
        self.pin_flight(cache, scene, renderer, step.step, &pages)?;
        scene.pager.prefetch(step.step);
        match self.record_pinned(cache, scene, renderer, &pages, step) {
            Ok(RecordedStep::Done) => {
                self.steps.push_back(Flight { step: step.step, camera: *step.camera, pages });
                scene.pager.prefetch(step.step);
                Ok(true)
            }
            Ok(other) => {
                self.release_flight(cache, scene, &pages);
                if other == RecordedStep::Short {
                    self.not_before = step.step.saturating_add(STEPS_WITHOUT);
                }
                Ok(false)
            }
            Err(error) => {
                self.release_flight(cache, scene, &pages);
                Err(TrainError::torn(error))
            }
        }
    }

    /// Pins the pages of a step, as [`SlotCache::pin`]; those that another step in flight uses are pinned already.
    fn pin_flight(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: u32,
        pages: &[PageNo],
    ) -> Result<(), TrainError> {
        let new: Vec<PageNo> = pages.iter().copied().filter(|page| !self.pages.contains_key(page)).collect();
        let pinned = cache.pin(scene, renderer, (&new, self.pages.len()), (step, false))?;
        self.pages.extend(pinned.into_iter().map(|page| (page.page, (page, 0))));
        for page in pages {
            if let Some((_, users)) = self.pages.get_mut(page) {
                *users += 1;
            }
        }
        Ok(())
    }

    fn record_pinned(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        pages: &[PageNo],
        step: &StepToRecord<'_>,
    ) -> Result<RecordedStep, TrainError> {
        let (recorded, of_view) = (u64::from(step.step), pages.len() as u64);
        let _span = trace::span("record step").with("recorded", recorded).with("pages", of_view);
        let pinned: Vec<&PinnedPage> =
            pages.iter().filter_map(|page| self.pages.get(page)).map(|(page, _)| page).collect();
        let is_alone = self.in_flight() == 0;
        let in_slots = cache.load_after_queued_work(scene, renderer, (step.step, is_alone), &pinned)?;
        let Some(in_slots) = in_slots else { return Ok(RecordedStep::TooEarly) };
        let rows_in_pages: u64 = in_slots.iter().map(|page| page.layout.rows as u64).sum();
        let is_injected = |fault: StepFault| self.faults.is_injected_at(fault, step.step);
        let (rows_room, closes) = (step.rows_room(rows_in_pages), is_injected(StepFault::Closed));
        let job = StepJob {
            pages: &in_slots,
            numbers: &scene.rules.adam.at(step.step).numbers(),
            camera: step.camera,
            options: step.render,
            rows_room: if is_injected(StepFault::Rows) { 1 } else { rows_room },
            isects_most: if is_injected(StepFault::Isects) { 1 } else { u32::MAX },
        };
        if !device_of(renderer)?.record_picture(&job)? {
            return Ok(RecordedStep::Short);
        }
        scene.pager.prefetch(step.step);
        let StepToRecord { target, loss, collects, .. } = *step;
        let rows_per_unusable = ROWS_PER_UNUSABLE as u32;
        let update = RecordedUpdate { target, loss, collects, rows_per_unusable, closes };
        if !device_of(renderer)?.record_update(&update)? {
            return Ok(RecordedStep::Short);
        }
        if let Some((next, camera)) = step.next {
            let of_next = self.pages_behind(scene, camera, step.step);
            // If the step may have to be repeated, its pages stay.
            let leaves = if self.is_sure { Leaves::Used } else { Leaves::Unused };
            cache.load_ahead(scene, renderer, (next, &of_next), leaves)?;
        }
        Ok(RecordedStep::Done)
    }

    /// Waits for the first step in flight and takes over its effect on its pages. `None` if the step was not taken: no step is in flight
    /// any more then, and nothing has changed.
    /// Errors: the device failed ([`TrainError::Torn`]).
    pub fn finish(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
    ) -> Result<Option<StepOutcome>, TrainError> {
        let done = device_of(renderer)?.finish_step().map_err(TrainError::torn)?;
        let needs = RenderError::OutOfOrder { call: "finish", needs: "record" };
        let flight = self.steps.pop_front().ok_or_else(|| TrainError::torn(needs))?;
        self.is_sure = done.closed == 0;
        if done.closed != 0 {
            self.give_up(cache, scene, renderer, &flight).map_err(TrainError::torn)?;
            return Ok(None);
        }
        let outcome = self.take_over(cache, scene, &flight, &done);
        cache.finish_leaving(scene, renderer, flight.step, &mut self.pinned_pages())?;
        self.release_flight(cache, scene, &flight.pages);
        self.check_list_behind(scene)?;
        Ok(Some(outcome))
    }

    /// Gives up a step that was not taken and the steps in flight behind it, and opens the gate.
    fn give_up(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        flight: &Flight,
    ) -> Result<(), TrainError> {
        let _span = trace::span("give up").with("behind", self.in_flight() as u64);
        let behind = std::mem::take(&mut self.steps);
        let mut taken = 0;
        for _ in &behind {
            taken += usize::from(device_of(renderer)?.finish_step()?.closed == 0);
        }
        cache.finish_leaving(scene, renderer, u32::MAX, &mut self.pinned_pages())?;
        for given_up in std::iter::once(flight).chain(&behind) {
            self.release_flight(cache, scene, &given_up.pages);
        }
        if taken > 0 {
            let problem = "a step was taken after a step that was given up";
            return Err(InputError::new("the device", problem, "report this as a bug").into());
        }
        Ok(device_of(renderer)?.open_gate()?)
    }

    /// Takes over the effect of a step on its pages: bounds, dirty marks, counts.
    fn take_over(
        &mut self,
        cache: &mut SlotCache,
        scene: &mut PagedScene,
        flight: &Flight,
        done: &StepDone,
    ) -> StepOutcome {
        let mut outcome = StepOutcome {
            loss: done.loss,
            rows: done.rows as usize,
            pages: flight.pages.len(),
            batches: 1,
            ..StepOutcome::default()
        };
        for (page, result) in flight.pages.iter().zip(&done.pages) {
            let Some((pinned, _)) = self.pages.get_mut(page) else { continue };
            outcome.rows_pinned += pinned.meta.rows as usize;
            outcome.updated += u64::from(result.updated);
            outcome.rows_skipped += u64::from(result.skipped);
            outcome.drawn += u64::from(result.drawn);
            if let Some(bounds) = result.bounds() {
                (pinned.meta.bounds, pinned.dirty) = (bounds, true);
                scene.pager.note_meta(pinned);
                cache.changed(*page);
            }
        }
        outcome.drawn = if outcome.updated == 0 { outcome.drawn } else { 0 };
        outcome
    }

    /// Ends a step in flight: pages that no other step in flight uses are held or released.
    fn release_flight(&mut self, cache: &mut SlotCache, scene: &mut PagedScene, pages: &[PageNo]) {
        let mut done = Vec::new();
        for page in pages {
            let Some((_, users)) = self.pages.get_mut(page) else { continue };
            *users -= 1;
            if *users == 0 {
                done.extend(self.pages.remove(page).map(|(pinned, _)| pinned));
            }
        }
        cache.release(scene, done);
    }

    /// Fails if the next step in flight lacks a page that its view needs.
    fn check_list_behind(&self, scene: &PagedScene) -> Result<(), TrainError> {
        let Some(behind) = self.steps.front() else { return Ok(()) };
        let needed = scene.pager.pages_of_view(&behind.camera);
        if needed.iter().all(|page| behind.pages.contains(page)) {
            return Ok(());
        }
        let problem = "a step moved the bounds of a page farther than an update can";
        Err(TrainError::torn(InputError::new("the pages on the device", problem, "report this as a bug")))
    }
}
