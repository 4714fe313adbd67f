//! The rows of a run as pages: first pages, what all of them share (optimizer, event log, statistics, counts), and
//! bringing pages to now.
//!
//! Invariants: 1. events reach a page when a training step pins it, and only then; everything else applies them to a
//! copy. So what is applied when does not depend on frames, cadences of evaluation or saves; 2. after
//! [`PagedScene::apply_pending`] every pinned page is stored with the degree in use; 3. `rows_bound` is at least the
//! number of rows that there would be if every page had applied every event.

use super::catch_up::{evaluate_all, gather, visible_rows};
use super::error::TrainError;
use super::error::not_stored;
use super::working_set::WorkingSet;
use crate::base::ids::{PageId, PageNo};
use crate::base::room;
use crate::config::limits::RunOptions;
use crate::dataset::import::{ImportOptions, PointSource, import_points};
use crate::densify::replay::{PageEdit, PendingEvents, Replay};
use crate::densify::stats::GradHistogram;
use crate::densify::strategy::{Effect, Strategy, effect_of};
use crate::optim::bounds::SplitLimits;
use crate::optim::deferred::DeferredAdam;
use crate::optim::method::Method;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::paging::error::PagingError;
use crate::paging::pager::Pager;
use crate::paging::pinned::PinnedPage;
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::events::{Event, EventKind, EventLog};
use crate::scene::page_layout::{read_page, write_page};
use crate::scene::page_meta::{PageBounds, PageMeta};
use crate::scene::page_split::SplitTooDeep;
use crate::scene::partition::{first_fill, partition};
use crate::scene::rows::{Rows, RowsNow};
use crate::scene::state::SceneState;
use rayon::prelude::*;
use std::sync::Arc;

/// Pages that are brought to now together: their copies are in memory at once.
pub(super) const PAGES_PER_BATCH: usize = 32;

/// What all pages share.
pub struct PageRules {
    /// The optimizer.
    pub adam: DeferredAdam,
    events: EventLog,
    seed: u64,
    page_rows: usize,
    /// What steps collect, and when rounds follow.
    pub(super) strategy: Arc<dyn Strategy>,
    /// When rows may split before they are seen again.
    splits: SplitLimits,
    sh_degree: u8,
}

/// Gets the rows of some pages, numbered through.
pub(super) type Visitor<'v, E> = dyn FnMut(&PageRules, &[Rows<'_>]) -> Result<(), E> + 'v;

/// The pages of a run and what they share.
pub struct PagedScene {
    /// Where the pages are.
    pub pager: Pager,
    /// What they share.
    pub rules: PageRules,
    /// Statistics of rows since the last round.
    pub histogram: GradHistogram,
    rows: u64,
    rows_bound: u64,
}

impl PageRules {
    pub(super) fn new(options: &RunOptions) -> PageRules {
        let adam = DeferredAdam::new(options.rates, options.adam, options.render.simd).with_moments(options.moments);
        PageRules {
            adam: if options.optimizer == Method::Sparse { adam.without_catch_up() } else { adam },
            events: EventLog::default(),
            seed: options.seed,
            page_rows: options.page_rows,
            strategy: options.strategy.clone(),
            splits: options.strategy.split_limits(options.scene_scale),
            sh_degree: options.sh_degree_at(0),
        }
    }

    /// Degree in use, as the events raised it.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Rows that a page holds at most.
    pub(super) fn page_rows(&self) -> usize {
        self.page_rows
    }

    /// Bounds of rows that were changed, for the index.
    pub(super) fn bounds(&self, rows: &Rows<'_>) -> PageBounds {
        self.adam.page_bounds(rows, &self.splits)
    }

    fn pending(&self) -> PendingEvents<'_> {
        PendingEvents::new(&self.adam, self.seed, self.page_rows, &self.events)
    }

    fn is_behind(&self, meta: &PageMeta) -> bool {
        (meta.events_applied as usize) < self.events.len()
    }

    /// The entry of a page that was rewritten with these rows.
    pub(super) fn meta(&self, id: PageId, state: &SceneState) -> PageMeta {
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
    /// Pages of first Gaussians. Each row keeps its number in `columns` as its identity.
    ///
    /// # Errors
    /// A page could not be stored.
    pub fn new(columns: &Columns, pager: Pager, options: &RunOptions) -> Result<PagedScene, PagingError> {
        let mut scene = PagedScene::empty(pager, options);
        let fill = first_fill(options.page_rows, options.strategy.grows());
        first_pages(columns, fill, scene.rules.sh_degree, &mut |id, state| scene.insert_first_page(id, &state))?;
        Ok(scene)
    }

    /// Pages of the first Gaussians of points that need not fit in memory: those of [`PagedScene::new`] for the same
    /// points.
    ///
    /// # Errors
    /// The points cannot be read, or a page could not be stored.
    pub fn import(
        source: &dyn PointSource,
        import: &ImportOptions<'_>,
        pager: Pager,
        options: &RunOptions,
    ) -> Result<PagedScene, TrainError> {
        let mut scene = PagedScene::empty(pager, options);
        let mut failed = None;
        let imported = import_points(source, import, &mut |page| {
            let id = page.id;
            let mut state = page.into_state();
            state.raise_sh_degree(scene.rules.sh_degree);
            scene.insert_first_page(id, &state).map_err(|error| not_stored(failed.insert(error)))
        });
        match failed {
            Some(error) => Err(error.into()),
            None => Ok(imported.map(|_| scene)?),
        }
    }

    /// No pages yet.
    pub(super) fn empty(pager: Pager, options: &RunOptions) -> PagedScene {
        let (rules, histogram) = (PageRules::new(options), GradHistogram::default());
        PagedScene { pager, rules, histogram, rows: 0, rows_bound: 0 }
    }

    /// Pages that a checkpoint brought back, with what all of them share.
    pub(super) fn restore(
        pager: Pager,
        options: &RunOptions,
        events: EventLog,
        histogram: GradHistogram,
        [rows, rows_bound]: [u64; 2],
    ) -> PagedScene {
        let mut rules = PageRules::new(options);
        // Not what keys would begin with now, which may have changed since.
        rules.sh_degree = options.sh_degree_start.min(options.sh_degree);
        for event in events.events() {
            if let EventKind::RaiseShDegree { degree } = event.kind {
                rules.sh_degree = degree;
            }
        }
        rules.events = events;
        PagedScene { pager, rules, histogram, rows, rows_bound }
    }

    /// Adds a page of first Gaussians.
    pub(super) fn insert_first_page(&mut self, id: PageId, state: &SceneState) -> Result<(), PagingError> {
        let meta = self.rules.meta(id, state);
        self.pager.insert(meta, |payload| {
            write_page(state, payload);
        })?;
        self.rows += state.rows() as u64;
        self.rows_bound += state.rows() as u64;
        Ok(())
    }

    /// Rows in the pages as they are stored: late events are not counted.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// No fewer than the rows that there would be if every page had applied every event.
    pub fn rows_bound(&self) -> u64 {
        self.rows_bound
    }

    /// The events so far.
    pub fn events(&self) -> &EventLog {
        &self.rules.events
    }

    /// Logs an event: pages apply it when they are next pinned by a step. A round is promised the growth of all rows
    /// that may grow in it, and clears the statistics.
    pub fn log_event(&mut self, event: Event) {
        self.rules.events.push(event);
        match effect_of(&event.kind) {
            Effect::RaiseShDegree { degree } => self.rules.sh_degree = degree,
            Effect::Round(round) => {
                self.rows_bound += round.promised(self.rows_bound, &self.histogram);
                self.histogram.clear();
            }
            Effect::ResetOpacity { .. } => {}
        }
    }

    /// Applies the events that the pinned pages miss. Pages that outgrow their capacity split, which takes frames; the
    /// list stays ascending by id.
    ///
    /// # Errors
    /// No frame could be had for a split, or a page cannot be split; it keeps its rows then.
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
            let replays: Vec<Result<Replay, SplitTooDeep>> = behind
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

    /// Takes over what became of a page; the parts that it split into but the first go to `added`.
    fn store_replay(
        &mut self,
        page: &mut PinnedPage,
        replay: Replay,
        added: &mut Vec<PinnedPage>,
    ) -> Result<(), TrainError> {
        let Replay { edit, rounds, .. } = replay;
        if let PageEdit::Replaced(parts) = &edit {
            self.store_parts(page, parts, added)?;
        } else {
            page.meta.events_applied = self.rules.events.len() as u32;
            if edit == PageEdit::InPlace {
                page.meta.bounds = self.rules.bounds(&page.rows(0));
            }
        }
        page.dirty = true;
        for round in rounds {
            self.rows = self.rows.saturating_add_signed(round.rows_change);
            // Pages whose statistics are not those of the round take back more than was promised for them.
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

    /// Brings every page to `now`, the number of steps done, by the rules that it was trained by, and goes on by those of
    /// `options`: rows take the steps that they missed at the old rates, and bounds are renewed. Reads and rewrites every
    /// page, once, and counts the histogram anew on the way; says whether it was another than the one that came with the
    /// pages, as it is after a salvage that had to leave statistics out.
    ///
    /// # Errors
    /// Pages could not be had.
    pub(super) fn change_rules(&mut self, options: &RunOptions, now: u32) -> Result<bool, TrainError> {
        let mut rules = PageRules::new(options);
        rules.events = self.rules.events.clone();
        rules.sh_degree = self.rules.sh_degree;
        let batch = (self.pager.frames_max() / 2).clamp(1, PAGES_PER_BATCH);
        let pages: Vec<PageNo> = (0..self.pager.index().len() as u32).map(PageNo).collect();
        let mut histogram = GradHistogram::default();
        for pages in pages.chunks(batch) {
            let mut pinned = self.pager.acquire_pages(pages)?;
            let applied = self.apply_pending(&mut pinned);
            if applied.is_ok() {
                // Parts of pages that split are pinned too, so that every row is counted.
                pinned.iter().for_each(|page| histogram.add_rows(&page.rows(0)));
                let at = self.rules.adam.at(now);
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
        self.rules = rules;
        let is_other = histogram != self.histogram;
        self.histogram = histogram;
        Ok(is_other)
    }

    /// Collects into `working` the rows of these pages that `camera` may draw after `now` steps, as though the pages had been
    /// touched then; stores nothing.
    ///
    /// # Errors
    /// Pages could not be had.
    pub fn gather_pages(
        &mut self,
        pages: &[PageNo],
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
        self.visit(pages, &mut |rules, tables| {
            visible_rows(tables, &rules.adam, now, camera, row_from_working);
            gather(tables, rules.sh_degree, &rules.adam, now, row_from_working, &mut part);
            append(columns, &part);
            Ok::<(), PagingError>(())
        })
    }

    /// Hands all rows as they are after `now` steps to `each`, part by part in the order of page ids; stores nothing.
    ///
    /// # Errors
    /// Pages could not be had, or `each` failed.
    pub fn for_all_rows<E: From<PagingError>>(
        &mut self,
        now: u32,
        each: &mut dyn FnMut(&Columns) -> Result<(), E>,
    ) -> Result<(), E> {
        let index = self.pager.index();
        let mut pages: Vec<PageNo> = (0..index.len() as u32).map(PageNo).collect();
        pages.retain(|p| index[p.index()].rows > 0);
        pages.sort_unstable_by_key(|p| index[p.index()].id);
        self.for_rows_of(&pages, now, each)
    }

    /// As [`PagedScene::for_all_rows`], of these pages alone.
    ///
    /// # Errors
    /// Pages could not be had, or `each` failed.
    pub fn for_rows_of<E: From<PagingError>>(
        &mut self,
        pages: &[PageNo],
        now: u32,
        each: &mut dyn FnMut(&Columns) -> Result<(), E>,
    ) -> Result<(), E> {
        self.visit(pages, &mut |rules, tables| each(&evaluate_all(tables, rules.sh_degree, &rules.adam, now)))
    }

    /// Pins the pages batch by batch and hands their rows to `each`, with pending events applied to copies.
    pub(super) fn visit<E: From<PagingError>>(&mut self, pages: &[PageNo], each: &mut Visitor<'_, E>) -> Result<(), E> {
        let batch = PAGES_PER_BATCH.min(self.pager.frames_max()).max(1);
        for pages in pages.chunks(batch) {
            let pinned = self.pager.acquire_pages(pages)?;
            let rules = &self.rules;
            let pending = rules.pending();
            let copies: Vec<Option<SceneState>> = pinned
                .par_iter()
                .map(|page| {
                    let mut state = rules.is_behind(&page.meta).then(|| read_page(&page.rows(0)))?;
                    pending.apply_to_table(page.meta.events_applied as usize, &mut state);
                    Some(state)
                })
                .collect();
            let tables = pinned.iter().zip(&copies);
            let mut tables: Vec<Rows<'_>> =
                tables.map(|(page, copy)| copy.as_ref().map_or_else(|| page.rows(0), SceneState::view)).collect();
            let mut first_row = 0;
            for table in &mut tables {
                table.first_row = first_row;
                first_row += table.rows();
            }
            let done = each(rules, &tables);
            drop(tables);
            self.pager.release(pinned);
            done?;
        }
        Ok(())
    }
}

/// The rows of the pages, numbered through.
pub fn numbered(pages: &[PinnedPage]) -> Vec<Rows<'_>> {
    let mut first_row = 0;
    let mut tables = Vec::with_capacity(pages.len());
    for page in pages {
        tables.push(page.rows(first_row));
        first_row += page.meta.rows as usize;
    }
    tables
}

/// Hands out the first pages of Gaussians that are in memory, at most `fill` rows each, with the bands up to `sh_degree`.
/// Each row keeps its number in `columns` as its identity.
///
/// # Errors
/// Those of `take`.
pub(super) fn first_pages<E>(
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

/// The listed rows of `columns` as fresh rows with their numbers as identities, stored with `sh_degree`: bands above it
/// are left out.
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
