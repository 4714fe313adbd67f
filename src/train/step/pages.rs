//! The pages of a run and their shared state (optimizer, event log, statistics, counts): creates the first pages,
//! applies events, and evaluates pages at a step.
//!
//! Invariants: 1. a stored page applies events only when a training step pins it; evaluation and export apply events to
//! copies. The step at which a page applies an event therefore does not depend on frames, evaluation or saves; 2. after
//! [`PagedScene::apply_pending`] every pinned page is stored with the current SH degree; 3. `rows_bound` is at least
//! the number of rows that the scene would have if every page had applied every event.

use super::catch_up::{evaluate_all, gather, visible_rows};
use crate::base::ids::{PageId, PageNo};
use crate::base::room;
use crate::checkpoint::run_state::RunState;
use crate::config::limits::RunOptions;
use crate::densify::replay::{PageEdit, PageReplay, PendingEvents};
use crate::densify::stats::GradHistogram;
use crate::densify::strategy::{Effect, Strategy, effect_of};
use crate::optim::bounds::{SplitLimits, page_bounds};
use crate::optim::deferred::DeferredAdam;
use crate::optim::method::{Method, OptimizerPlace};
use crate::page::format::slot_header::HEADER_BYTES;
use crate::page::map::commit::CommitError;
use crate::paging::error::PagingError;
use crate::paging::pager::Pager;
use crate::paging::pinned::PinnedPage;
use crate::render::Gradients;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns, row_width};
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::log_scales::LogScaleRange;
use crate::scene::page_layout::{read_page, write_page};
use crate::scene::page_meta::{PageBounds, PageMeta};
use crate::scene::page_split::SplitTooDeep;
use crate::scene::partition::{first_fill, partition};
use crate::scene::rows::{Rows, RowsNow};
use crate::scene::state::SceneState;
use crate::train::error::TrainError;
use rayon::prelude::*;
use std::sync::Arc;

/// Pages evaluated together; copies of all of them are in memory at once.
pub(crate) const PAGES_PER_BATCH: usize = 32;

/// State shared by all pages.
pub struct SceneRules {
    pub adam: DeferredAdam,
    events: EventLog,
    seed: u64,
    /// Capacity of a page, rows.
    pub(crate) page_rows: usize,
    pub(crate) strategy: Arc<dyn Strategy>,
    /// Limits within which an unseen row may split; used by page bounds.
    pub(crate) splits: SplitLimits,
    /// As raised by events so far.
    pub sh_degree: u8,
    /// Pages whose statistics are cleared keep their bounds, which stay valid: a device that clears them finds no new ones.
    keeps_bounds: bool,
}

/// Receives the rows of some pages as tables with consecutive row numbers.
pub(super) type Visitor<'v, E> = dyn FnMut(&SceneRules, &[Rows<'_>]) -> Result<(), E> + 'v;

/// The pages of a run and their shared state.
pub struct PagedScene {
    /// Cache and storage of the pages.
    pub pager: Pager,
    /// State shared by all pages.
    pub rules: SceneRules,
    /// Gradient statistics of rows since the last densification round.
    pub histogram: GradHistogram,
    rows: u64,
    rows_bound: u64,
}

impl SceneRules {
    pub(crate) fn new(options: &RunOptions) -> SceneRules {
        let adam = DeferredAdam::new(options.rates, options.adam, options.render.simd)
            .with_moments(options.moments)
            .with_log_scales(LogScaleRange::of_scene(options.scene_scale));
        SceneRules {
            adam: if options.optimizer == Method::Sparse { adam.without_catch_up() } else { adam },
            events: EventLog::default(),
            seed: options.seed,
            page_rows: options.page_rows,
            strategy: options.strategy.clone(),
            splits: options.strategy.split_limits(options.scene_scale),
            sh_degree: options.sh_degree_at(0),
            keeps_bounds: options.optimizer_on == OptimizerPlace::Device,
        }
    }

    /// Bounds of a page with these rows, for the index.
    pub(crate) fn bounds(&self, rows: &Rows<'_>) -> PageBounds {
        page_bounds(&self.adam, rows, &self.splits)
    }

    pub(super) fn pending(&self) -> PendingEvents<'_> {
        PendingEvents::new(&self.adam, self.seed, self.page_rows, &self.events)
    }

    /// Whether a page has not applied all events that act on it.
    pub(super) fn is_behind(&self, meta: &PageMeta) -> bool {
        match meta.id.is_frozen() {
            true => meta.sh_degree < self.sh_degree,
            false => (meta.events_applied as usize) < self.events.len(),
        }
    }

    /// The index entry of a page that holds `state` with all events applied.
    pub(crate) fn meta(&self, id: PageId, state: &SceneState) -> PageMeta {
        PageMeta {
            id,
            rows: state.rows() as u32,
            sh_degree: state.sh_degree(),
            events_applied: self.events.len() as u32,
            bounds: self.bounds(&state.view()),
        }
    }
}

impl PagedScene {
    /// Creates the pages of the first Gaussians. The uid of a row is its row number in `columns`.
    /// Errors: a page could not be stored.
    pub fn new(columns: &Columns, pager: Pager, options: &RunOptions) -> Result<PagedScene, PagingError> {
        let mut scene = PagedScene::empty(pager, options);
        let fill = first_fill(options.page_rows, options.strategy.grows());
        first_pages(columns, fill, scene.rules.sh_degree, &mut |id, state| scene.insert_first_page(id, &state))?;
        Ok(scene)
    }

    pub fn empty(pager: Pager, options: &RunOptions) -> PagedScene {
        let (rules, histogram) = (SceneRules::new(options), GradHistogram::default());
        PagedScene { pager, rules, histogram, rows: 0, rows_bound: 0 }
    }

    /// A scene from the pages and the state of a commit.
    /// Errors: no run can have written the state; those of a decoded state are checked.
    pub(crate) fn restore(pager: Pager, options: &RunOptions, state: &RunState) -> Result<PagedScene, CommitError> {
        let mut rules = SceneRules::new(options);
        rules.events = state.event_log().map_err(CommitError::Contradiction)?;
        // Replay the logged raises: the configured schedule, and its first degree, may have changed since.
        rules.sh_degree = state.origin.sh_degree_start.min(options.sh_degree);
        for event in rules.events.events() {
            if let EventKind::RaiseShDegree { degree } = event.kind {
                rules.sh_degree = degree;
            }
        }
        let histogram = GradHistogram::from_filled(&state.histogram);
        Ok(PagedScene { pager, rules, histogram, rows: state.rows, rows_bound: state.rows_bound })
    }

    /// Adds a page of first Gaussians.
    /// Errors: the page could not be stored.
    pub fn insert_first_page(&mut self, id: PageId, state: &SceneState) -> Result<(), PagingError> {
        let meta = self.rules.meta(id, state);
        self.pager.insert(meta, |payload| {
            write_page(state, payload);
        })?;
        self.rows += state.rows() as u64;
        self.rows_bound += state.rows() as u64;
        Ok(())
    }

    /// Whether all pages stay in memory.
    pub fn is_in_memory(&self) -> bool {
        self.pager.frames_max() == usize::MAX
    }

    /// Rows of the stored pages, without the effect of pending events.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Upper bound of the rows after every page has applied every event.
    pub fn rows_bound(&self) -> u64 {
        self.rows_bound
    }

    pub fn events(&self) -> &EventLog {
        &self.rules.events
    }

    /// Logs an event; each page applies it when a step next pins the page. A densification round adds the growth of all
    /// rows that may grow to `rows_bound` and clears the statistics.
    pub fn log_event(&mut self, event: Event) {
        self.rules.events.push(event);
        match effect_of(&event.kind) {
            Effect::RaiseShDegree { degree } => self.rules.sh_degree = degree,
            Effect::Round(round) => {
                self.rows_bound += round.promised(&self.histogram);
                self.histogram.clear();
            }
            Effect::ResetOpacity { .. } => {}
        }
    }

    /// Applies pending events to the pinned pages. A page that outgrows its capacity splits and takes a frame per new
    /// page; the list stays ascending by id.
    /// Errors: no frame is free for a split, or a page cannot be split; the page keeps its rows then.
    pub fn apply_pending(&mut self, pages: &mut Vec<PinnedPage>) -> Result<(), TrainError> {
        if pages.iter().all(|p| !self.rules.is_behind(&p.meta)) {
            return Ok(());
        }
        let mut added = Vec::new();
        let mut done = Ok(());
        for batch in pages.chunks_mut(PAGES_PER_BATCH) {
            let is_behind = |p: &&mut PinnedPage| self.rules.is_behind(&p.meta);
            let mut behind: Vec<&mut PinnedPage> = batch.iter_mut().filter(is_behind).collect();
            let pending = self.rules.pending();
            let replays: Vec<Result<PageReplay, SplitTooDeep>> = behind
                .par_iter_mut()
                .map(|p| pending.apply(p.meta.id, p.meta.events_applied as usize, &mut p.rows_mut(0)))
                .collect();
            for (page, replay) in behind.into_iter().zip(replays) {
                let stored = replay.map_err(TrainError::from).and_then(|r| self.store_replay(page, r, &mut added));
                done = done.and(stored);
            }
            if done.is_err() {
                break;
            }
        }
        pages.append(&mut added);
        pages.sort_unstable_by_key(|p| p.meta.id);
        done
    }

    /// Stores the result of a replay in `page`; if the page split, all parts but the first go to `added`.
    fn store_replay(
        &mut self,
        page: &mut PinnedPage,
        replay: PageReplay,
        added: &mut Vec<PinnedPage>,
    ) -> Result<(), TrainError> {
        let PageReplay { edit, rounds } = replay;
        if let PageEdit::Replaced(parts) = &edit {
            self.store_parts(page, parts, added)?;
        } else {
            page.meta.events_applied = self.rules.events.len() as u32;
            if edit == PageEdit::InPlace || (edit == PageEdit::Cleared && !self.rules.keeps_bounds) {
                page.meta.bounds = self.rules.bounds(&page.rows(0));
            }
        }
        page.dirty = true;
        for round in rounds {
            self.rows = self.rows.saturating_add_signed(round.rows_change);
            // The max matters for pages whose statistics differ from the round's: they return more than was promised.
            let promised = self.rows_bound.saturating_sub(round.promised).saturating_add_signed(round.rows_change);
            self.rows_bound = promised.max(self.rows);
        }
        Ok(())
    }

    fn store_parts(
        &mut self,
        page: &mut PinnedPage,
        parts: &[(PageId, SceneState)],
        added: &mut Vec<PinnedPage>,
    ) -> Result<(), TrainError> {
        let mut frames = Vec::new();
        for _ in 1..parts.len() {
            match self.pager.take_frame() {
                Ok(frame) => frames.push(frame),
                Err(error) => {
                    frames.into_iter().for_each(|frame| self.pager.return_frame(frame));
                    return Err(error.into());
                }
            }
        }
        let mut frames = frames.into_iter();
        for (part, (id, state)) in parts.iter().enumerate() {
            let meta = self.rules.meta(*id, state);
            if part == 0 {
                write_page(state, page.payload_mut());
                page.meta = meta;
            } else if let Some(mut frame) = frames.next() {
                write_page(state, &mut frame.as_mut_slice()[HEADER_BYTES..]);
                added.push(self.pager.add_split(meta, frame));
            }
        }
        Ok(())
    }

    /// Switches to the rules of `options` after `now` steps. Every page applies its pending events and missed steps at
    /// the old rates and gets new bounds, so every page is read and rewritten once. The histogram is recounted; returns
    /// whether the recount differs, as it does after a salvage that left statistics out.
    /// Errors: pages could not be pinned.
    pub(crate) fn change_rules(&mut self, options: &RunOptions, now: u32) -> Result<bool, TrainError> {
        let mut rules = SceneRules::new(options);
        rules.events = self.rules.events.clone();
        rules.sh_degree = self.rules.sh_degree;
        let pages: Vec<PageNo> = (0..self.pager.index().len() as u32).map(PageNo).collect();
        let mut histogram = GradHistogram::default();
        // New pages from splits are counted too.
        let count = &mut |page: &PinnedPage| histogram.add_rows(&page.rows(0));
        self.settle(&pages, now, Pager::acquire_pages, Some(&rules), count)?;
        self.rules = rules;
        let is_changed = histogram != self.histogram;
        self.histogram = histogram;
        Ok(is_changed)
    }

    /// Stores every row as evaluated after `now` steps: the step of the dense optimizer, for comparison with deferred Adam, since each
    /// step costs the whole scene in memory and on the drive. A page applies an event at the next step, on values of the event's own step,
    /// so rows and decisions equal those of the deferred run up to roundings.
    /// Errors: pages could not be pinned, or no frame was free for a split.
    pub(crate) fn settle_all(&mut self, now: u32) -> Result<(), TrainError> {
        let pages = self.pages_with_rows();
        self.settle(&pages, now, Pager::acquire_in_step, None, &mut |_| {})
    }

    /// Stores every row of these pages, with all events applied, as evaluated after `now` steps, and renews the bounds by `rules`, or by
    /// those of the scene. `see` gets every page before.
    fn settle(
        &mut self,
        pages: &[PageNo],
        now: u32,
        acquire: fn(&mut Pager, &[PageNo]) -> Result<Vec<PinnedPage>, PagingError>,
        rules: Option<&SceneRules>,
        see: &mut dyn FnMut(&PinnedPage),
    ) -> Result<(), TrainError> {
        // The other half of the frames is for pages that split.
        let batch = (self.pager.frames_max() / 2).clamp(1, PAGES_PER_BATCH);
        for pages in pages.chunks(batch) {
            let mut pinned = acquire(&mut self.pager, pages)?;
            let applied = self.apply_pending(&mut pinned);
            if applied.is_ok() {
                pinned.iter().for_each(&mut *see);
                let (at, rules) = (self.rules.adam.at(now), rules.unwrap_or(&self.rules));
                pinned.par_iter_mut().for_each(|page| {
                    let mut rows = page.rows_mut(0);
                    (0..rows.rows()).for_each(|row| at.settle_row(&mut rows, row));
                    page.meta.bounds = rules.bounds(&page.rows(0));
                    page.dirty = true;
                });
            }
            self.pager.release(pinned);
            applied?;
        }
        Ok(())
    }

    /// Pages with rows, in the order of their ids.
    pub(crate) fn pages_with_rows(&self) -> Vec<PageNo> {
        let index = self.pager.index();
        let mut pages: Vec<PageNo> = (0..index.len() as u32).map(PageNo).collect();
        pages.retain(|p| index[p.index()].rows > 0);
        pages.sort_unstable_by_key(|p| index[p.index()].id);
        pages
    }

    /// At most `most` of the pages with rows, evenly spaced in the order of their ids.
    pub fn some_pages(&self, most: usize) -> Vec<PageNo> {
        let pages = self.pages_with_rows();
        let stride = pages.len().div_ceil(most).max(1);
        pages.into_iter().step_by(stride).collect()
    }

    /// Gathers into `working` the rows of these pages that `camera` may draw after `now` steps, with pending events applied to
    /// copies. Begins to read the pages `next`. Stored pages stay unchanged.
    /// Errors: pages could not be pinned.
    pub fn gather_pages(
        &mut self,
        pages: &[PageNo],
        next: &[PageNo],
        camera: &Camera,
        now: u32,
        working: &mut WorkingSet,
    ) -> Result<(), PagingError> {
        let WorkingSet { row_from_working, columns, .. } = working;
        if columns.sh_degree != self.rules.sh_degree {
            *columns = Columns::zeros(0, self.rules.sh_degree);
        }
        columns.resize(0);
        let mut part = Columns::zeros(0, self.rules.sh_degree);
        self.visit(pages, next, &mut |rules, tables| {
            visible_rows(tables, &rules.adam, now, camera, row_from_working);
            gather(tables, rules.sh_degree, &rules.adam, now, row_from_working, &mut part);
            append(columns, &part);
            Ok::<(), PagingError>(())
        })?;
        // The row numbers are those of the last part, whose pages are not pinned any more.
        row_from_working.clear();
        Ok(())
    }

    /// Passes all rows, evaluated after `now` steps, to `each` in batches, in the order of page ids. Stored pages stay
    /// unchanged.
    /// Errors: pages could not be pinned, or `each` failed.
    pub fn for_all_rows<E: From<PagingError>>(
        &mut self,
        now: u32,
        each: &mut dyn FnMut(&Columns) -> Result<(), E>,
    ) -> Result<(), E> {
        self.for_rows_of(&self.pages_with_rows(), now, each)
    }

    /// As [`PagedScene::for_all_rows`], for `pages` only.
    /// Errors: pages could not be pinned, or `each` failed.
    pub fn for_rows_of<E: From<PagingError>>(
        &mut self,
        pages: &[PageNo],
        now: u32,
        each: &mut dyn FnMut(&Columns) -> Result<(), E>,
    ) -> Result<(), E> {
        self.visit(pages, &[], &mut |rules, tables| each(&evaluate_all(tables, rules.sh_degree, &rules.adam, now)))
    }

    /// Pins the first pages of a list, `batch` at most, and returns the list of the others. Where dirty pages cannot be written,
    /// as on a full drive, too few frames may be left: `batch` is halved until the pages fit.
    fn acquire_first<'a>(
        &mut self,
        pages: &'a [PageNo],
        batch: &mut usize,
    ) -> Result<(Vec<PinnedPage>, &'a [PageNo]), PagingError> {
        loop {
            let (first, later) = pages.split_at(pages.len().min(*batch));
            match self.pager.acquire_pages(first) {
                Err(PagingError::WorkingSet { .. }) if first.len() > 1 => *batch = first.len() / 2,
                pinned => return Ok((pinned?, later)),
            }
        }
    }

    /// Pins the pages in batches and passes their rows to `each`, with pending events applied to copies, and prefetches.
    pub(crate) fn visit<E: From<PagingError>>(
        &mut self,
        pages: &[PageNo],
        next: &[PageNo],
        each: &mut Visitor<'_, E>,
    ) -> Result<(), E> {
        // The copies of a batch take as much memory as its frames.
        let mut batch = PAGES_PER_BATCH.min(self.pager.frames_max() / 2).max(1);
        let mut rest = pages;
        while !rest.is_empty() {
            let (pinned, later) = self.acquire_first(rest, &mut batch)?;
            rest = later;
            self.pager.prefetch_pages(rest.iter().chain(next).copied().take(batch));
            let rules = &self.rules;
            let pending = rules.pending();
            let copies: Vec<Option<SceneState>> = pinned
                .par_iter()
                .map(|page| {
                    let mut state = rules.is_behind(&page.meta).then(|| read_page(&page.rows(0)))?;
                    pending.apply_to_table(page.meta.id, page.meta.events_applied as usize, &mut state);
                    Some(state)
                })
                .collect();
            let tables = pinned.iter().zip(&copies);
            let tables =
                numbered(tables.map(|(page, copy)| copy.as_ref().map_or_else(|| page.rows(0), SceneState::view)));
            let done = each(rules, &tables);
            drop(tables);
            self.pager.release(pinned);
            done?;
        }
        Ok(())
    }
}

/// The rows of the pages as tables with consecutive row numbers.
pub fn row_tables(pages: &[PinnedPage]) -> Vec<Rows<'_>> {
    numbered(pages.iter().map(|page| page.rows(0)))
}

fn numbered<'a>(tables: impl Iterator<Item = Rows<'a>>) -> Vec<Rows<'a>> {
    let mut rows = 0;
    let number = |table: Rows<'a>| {
        let first_row = rows;
        rows += table.rows();
        Rows { first_row, ..table }
    };
    tables.map(number).collect()
}

/// Partitions Gaussians in memory into first pages of at most `fill` rows, stored with `sh_degree`, and passes each to
/// `take`. The uid of a row is its row number in `columns`.
/// Errors: those of `take`.
pub(crate) fn first_pages<E>(
    columns: &Columns,
    fill: usize,
    sh_degree: u8,
    take: &mut dyn FnMut(PageId, SceneState) -> Result<(), E>,
) -> Result<(), E> {
    let pages = partition(&columns.means, &columns.scales, fill);
    (0..)
        .zip(pages.iter())
        .try_for_each(|(page, rows)| take(PageId::initial(page), first_rows(columns, rows, sh_degree)))
}

/// The listed rows of `columns` as untrained rows whose uids are their row numbers. SH bands above `sh_degree` are
/// dropped.
fn first_rows(columns: &Columns, rows: &[u32], sh_degree: u8) -> SceneState {
    let mut out = Columns::zeros(rows.len(), sh_degree);
    for column in Column::ALL {
        let width = column.width(sh_degree);
        if width == 0 {
            continue;
        }
        for (to, &row) in out.column_mut(column).chunks_exact_mut(width).zip(rows) {
            let from = columns.row(column, row as usize);
            let kept = width.min(from.len());
            to[..kept].copy_from_slice(&from[..kept]);
        }
    }
    let mut state = SceneState::from_columns(out);
    state.uid.iter_mut().zip(rows).for_each(|(uid, &row)| *uid = u64::from(row));
    state
}

fn append(to: &mut Columns, more: &Columns) {
    for column in Column::ALL {
        room::extend(to.column_mut(column), more.column(column));
    }
}

/// The rows of a batch, evaluated at one step, and their gradients. Steps reuse one working set and its allocations.
#[derive(Default)]
pub struct WorkingSet {
    /// For each row of the working set, its row number in the pinned pages (consecutive across pages); ascending. Empty for rows that
    /// [`super::pages::PagedScene::gather_pages`] has gathered, since their pages are not pinned.
    pub row_from_working: Vec<u32>,
    /// Values at this step; input of the renderer and of the update.
    pub columns: Columns,
    pub gradients: Gradients,
}

impl WorkingSet {
    /// Bytes held for rows.
    pub fn bytes(&self) -> usize {
        let columns = self.columns.bytes() + self.gradients.columns.bytes();
        let of_footprints = 16 * self.gradients.means2d.capacity() + 8 * self.gradients.weights.capacity();
        self.row_from_working.capacity() * 4 + columns + of_footprints
    }

    /// Bytes of one row that is stored with `sh_degree`: its number, values, gradients, and the footprint's gradient, radii and
    /// weights, which not every run collects.
    pub fn row_bytes(sh_degree: u8) -> usize {
        4 + 2 * 4 * row_width(sh_degree) + 24
    }

    /// Frees the memory of a working set that has room for many more than `rows` rows. Returns whether it did.
    pub fn shrink_to(&mut self, rows: usize) -> bool {
        let is_large = self.row_from_working.capacity() > rows + rows / 4;
        if is_large {
            *self = WorkingSet::default();
        }
        is_large
    }
}
