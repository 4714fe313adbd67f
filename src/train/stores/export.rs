//! The Gaussians of a generation, page by page: as a PLY, SPZ or SOG with the writers of the trainer and the file of its transform, or as
//! the start of a new run, in its local frame, without moments, statistics and events.
//!
//! Invariants: 1. without selection the file equals, byte for byte, the trainer's PLY of all rows (`--export-clean off`, which needs
//! the photos' cameras) after the generation's step; 2.
//! memory is bounded by the budget for any size of scene; 3. the file is written whole or not at all; 4. the selection
//! depends on the rows alone.

use super::{StorePlace, find_store, options_of, run_state_of};
use crate::base::error::{InputError, InputResult};
use crate::base::ids::{PageId, PageNo};
use crate::base::machine::host_bytes_peak;
use crate::base::math::exp32;
use crate::base::text::read_text;
use crate::base::units::{format_bytes, format_bytes_up};
use crate::checkpoint::run_state::RunState;
use crate::config::limits::RunOptions;
use crate::exchange::format::ExportFormat;
use crate::exchange::frames::to_local;
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::sink::LEVELS_MAX;
use crate::optim::drift::STEP_BYTES;
use crate::page::tool::new_store::refuse_inside_store;
use crate::page::tool::reading::{Access, StoreReader};
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::pager::{Pager, PagerConfig};
use crate::paging::prefetch::Transfers;
use crate::scene::columns::{Column, Columns};
use crate::scene::partition::GiantCut;
use crate::scene::rotation::Rotation;
use crate::scene::select::RankSearch;
use crate::scene::state::SceneState;
use crate::train::error::TrainError;
use crate::train::inputs::gaussian_pages::truncate_sh;
use crate::train::inputs::signals::StopFlag;
use crate::train::step::catch_up::evaluate_all;
use crate::train::step::pages::PagedScene;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// Most pages in memory; one pass needs no more.
const FRAMES_MAX: usize = 64;
/// Copies of a page in memory: the frame, the copy with pending events, the evaluated rows, the engine's buffer.
const COPIES: u64 = 4;
const READERS: usize = 4;
/// Bytes of an entry of the map in memory: version, page, index.
const ENTRY_BYTES: u64 = 512;
/// Other memory of the program, bytes.
const FIXED_BYTES: u64 = 32 << 20;

#[derive(Debug, Clone)]
pub struct ExportRequest {
    /// Number or name of the generation; `None` for the latest.
    pub generation: Option<String>,
    /// The file; its name says the format.
    pub out: PathBuf,
    /// Memory, bytes.
    pub host_mem: u64,
    /// Number of Gaussians to keep, most visible first.
    pub max_gaussians: Option<u64>,
    /// Keep Gaussians with means in this box: lower, then upper corner, dataset coordinates (also for an upright PLY).
    pub crop: Option<[f64; 6]>,
    /// Highest SH degree to keep.
    pub sh_degree: Option<u8>,
    /// The frame of the file; `None` for that of the run.
    pub frame: Option<ExportFrame>,
}

#[derive(Debug, Clone, Serialize)]
pub struct Exported {
    pub file: PathBuf,
    pub generation: u64,
    pub step: u32,
    pub gaussians: u64,
    /// Dropped Gaussians with non-finite values.
    pub skipped: u64,
    /// Bytes of the file, or of all files of a folder.
    pub bytes: u64,
    /// Gaussians by level, the finest first, if the format has levels.
    pub levels: Option<[u64; LEVELS_MAX]>,
    /// Gaussians that viewers show beside any level.
    pub always_shown: u64,
    /// Whether the file holds local coordinates because f32 cannot hold the dataset's.
    pub is_local: bool,
    /// What the format changes of the Gaussians.
    pub warnings: Vec<String>,
    pub bytes_read: u64,
    /// Peak memory of the process, bytes.
    pub host_bytes_peak: u64,
}

/// Exports a generation.
/// Errors: the store cannot be opened or is damaged, the budget is too small, no Gaussian is left, the file cannot
/// be written, or `stop` was asked for.
pub fn export(place: &StorePlace, request: &ExportRequest, stop: &StopFlag) -> Result<Exported, TrainError> {
    let format = ExportFormat::of_path(&request.out)?;
    format.check_replaceable("--out", &request.out)?;
    refuse_inside_store(&request.out)?;
    let store = place.open(Access::Pages)?;
    let generation = store.find(request.generation.as_deref())?;
    let state = run_state_of(&store, generation)?;
    let (_, options) = options_of(&place.folder, &state)?;
    let mut scene =
        scene_at(&store, generation, &state, &options, (request.host_mem, 1), format.memory_bytes(state.rows_bound))?;
    let mut choice = RowChoice::new(&state, request);
    let pages = choice.pages(&scene);
    choice.find_cut(&mut scene, &pages, state.trainer.step)?;
    let sh_degree = request.sh_degree.map_or(options.sh_degree, |degree| degree.min(options.sh_degree));
    let meta = meta_of(&state, &options, request.frame);
    let mut sink = format.create(&request.out, sh_degree, state.rows_bound, &meta)?;
    let mut given = 0;
    scene.for_rows_of(&pages, state.trainer.step, &mut |rows| {
        stop.check()?;
        let chosen = choice.chosen(rows, sh_degree);
        given += chosen.rows() as u64;
        Ok::<(), TrainError>(sink.write(&chosen)?)
    })?;
    if given == 0 && request.crop.is_some() {
        let problem = "no Gaussian lies in this box";
        return Err(
            InputError::new("--crop", problem, "the box is minx,miny,minz,maxx,maxy,maxz in dataset units").into()
        );
    }
    let written = sink.finish()?;
    format.write_transform(&request.out, &meta, written.frame)?;
    Ok(Exported {
        file: request.out.clone(),
        generation,
        step: state.trainer.step,
        gaussians: written.rows,
        skipped: written.skipped,
        bytes: written.bytes,
        levels: written.levels.map(|levels| levels.rows),
        always_shown: written.levels.map_or(0, |levels| levels.always_shown),
        is_local: written.frame == ExportFrame::Local,
        warnings: written.warnings,
        bytes_read: scene.pager.stats().bytes_read,
        host_bytes_peak: host_bytes_peak().unwrap_or(0),
    })
}

/// The PLY comments, as the trainer writes them.
fn meta_of(state: &RunState, options: &RunOptions, frame: Option<ExportFrame>) -> SceneMeta {
    let print = &state.origin.dataset;
    SceneMeta {
        step: Some(u64::from(state.trainer.step)),
        origin: print.origin,
        scale: print.scale,
        scene_radius: f64::from(print.scene_scale) * print.scale,
        frame: frame.unwrap_or(options.export_frame),
        upright: options.up.and_then(Rotation::upright),
        ..SceneMeta::default()
    }
}

/// The scene of a generation, with the frames that 1/`share` of the budget allows beside `others` bytes.
pub(super) fn scene_at(
    store: &StoreReader,
    generation: u64,
    state: &RunState,
    options: &RunOptions,
    (host_mem, share): (u64, u64),
    others: u64,
) -> Result<PagedScene, TrainError> {
    let pages = store.pages_at(generation)?;
    let frame = PagerConfig::in_memory(options.page_rows, options.sh_degree).frame_bytes() as u64;
    let tables = STEP_BYTES * u64::from(options.rates.steps);
    let fixed = FIXED_BYTES + others + tables + (store.entries() + pages.len()) as u64 * ENTRY_BYTES;
    let frames = (host_mem / share).saturating_sub(fixed) / (frame * COPIES);
    if frames == 0 {
        let least = format_bytes_up((fixed + frame * COPIES) * share);
        let problem = format!("{} is not enough for this store", format_bytes(host_mem));
        return Err(InputError::new("--host-mem", problem, format!("give at least {least}")).into());
    }
    let config = PagerConfig {
        page_rows: options.page_rows,
        sh_degree: options.sh_degree,
        frames: (frames as usize).min(FRAMES_MAX),
        policy: EvictPolicy::default(),
        prefetch_bytes: frame as usize,
        plan_bytes: 0,
        transfers: Transfers::Overlap,
    };
    let pager = Pager::open(config, store.paged_store(&pages, READERS)?, &pages, state.events.len())?;
    Ok(PagedScene::restore(pager, options, state)?)
}

/// Selection of the rows for the file.
struct RowChoice {
    /// Box in the local frame, rounded outwards for pages; rows are compared in dataset coordinates.
    crop: Option<[f64; 6]>,
    origin: [f64; 3],
    scale: f64,
    most: Option<u64>,
    /// The least visible row to keep.
    cut: Option<GiantCut>,
    /// Number of the next row among those inside the box.
    next: u32,
}

impl RowChoice {
    fn new(state: &RunState, request: &ExportRequest) -> RowChoice {
        let (origin, scale) = (state.origin.dataset.origin, state.origin.dataset.scale);
        RowChoice { crop: request.crop, origin, scale, most: request.max_gaussians, cut: None, next: 0 }
    }

    /// Pages that may hold a row inside the box, in the order of their ids.
    fn pages(&self, scene: &PagedScene) -> Vec<PageNo> {
        let mut pages = scene.pages_with_rows();
        let Some(crop) = self.crop else { return pages };
        pages.retain(|p| {
            let bounds = &scene.pager.index()[p.index()].bounds;
            // Slightly wider than the box, because the conversion to dataset coordinates rounds.
            let slack = |x: f64| x.abs() * 1e-6 + 1e-9;
            (0..3).all(|i| {
                let at = |x: f32| f64::from(x) * self.scale + self.origin[i];
                let (lo, hi) = (at(bounds.lo[i]), at(bounds.hi[i]));
                hi + slack(hi) >= crop[i] && lo - slack(lo) <= crop[3 + i]
            })
        });
        pages
    }

    /// Finds the least visible row to keep, in passes over the pages.
    fn find_cut(&mut self, scene: &mut PagedScene, pages: &[PageNo], step: u32) -> Result<(), TrainError> {
        let Some(most) = self.most else { return Ok(()) };
        let mut count = 0u64;
        scene.for_rows_of(pages, step, &mut |rows| {
            count += (0..rows.rows()).filter(|&row| self.is_inside(rows, row)).count() as u64;
            Ok::<(), TrainError>(())
        })?;
        if count <= most {
            return Ok(());
        }
        let mut search = RankSearch::new(count - most, count);
        while !search.is_done() {
            let mut next = 0;
            scene.for_rows_of(pages, step, &mut |rows| {
                for row in (0..rows.rows()).filter(|&row| self.is_inside(rows, row)) {
                    search.count(GiantCut::key(visibility(rows, row), next));
                    next += 1;
                }
                Ok::<(), TrainError>(())
            })?;
            search.next_pass();
        }
        self.cut = Some(GiantCut::found(&search));
        Ok(())
    }

    /// The selected rows, with at most `sh_degree`.
    fn chosen(&mut self, rows: &Columns, sh_degree: u8) -> Columns {
        let mut chosen = Columns::zeros(0, rows.sh_degree);
        if self.crop.is_none() && self.cut.is_none() {
            chosen = rows.clone();
        } else {
            for row in 0..rows.rows() {
                if !self.is_inside(rows, row) {
                    continue;
                }
                self.next += 1;
                if self.cut.is_none_or(|cut| cut.is_giant(visibility(rows, row), self.next - 1)) {
                    Column::ALL.into_iter().for_each(|c| chosen.column_mut(c).extend_from_slice(rows.row(c, row)));
                }
            }
        }
        truncate_sh(chosen, sh_degree)
    }

    fn is_inside(&self, rows: &Columns, row: usize) -> bool {
        let Some(crop) = self.crop else { return true };
        let mean = rows.row(Column::Means, row);
        (0..3).all(|i| {
            let x = f64::from(mean[i]) * self.scale + self.origin[i];
            x >= crop[i] && x <= crop[3 + i]
        })
    }
}

/// Visibility of a row: its opacity times the area of its two longest axes.
fn visibility(rows: &Columns, row: usize) -> f32 {
    let scales = rows.row(Column::Scales, row);
    let shortest = scales[0].min(scales[1]).min(scales[2]);
    let opacity = 1.0 / (1.0 + exp32(-rows.opacities[row]));
    opacity * exp32(scales[0] + scales[1] + scales[2] - shortest)
}

/// The most pages of a list have a line of this many bytes each.
const LIST_LINE_BYTES: u64 = 64;

/// A page of a store as a list of pages names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ListedPage {
    pub page: PageId,
    /// Its rows are rendered and never change.
    pub is_frozen: bool,
}

impl ListedPage {
    /// The line that names the page.
    pub fn line(&self) -> String {
        format!("{}{}\n", self.page, if self.is_frozen { " frozen" } else { "" })
    }

    fn of_line(line: &str) -> Result<ListedPage, String> {
        let (page, is_frozen) = line.strip_suffix(" frozen").map_or((line, false), |page| (page, true));
        Ok(ListedPage { page: page.parse()?, is_frozen })
    }
}

/// An opened store, or some of its pages.
pub struct StoredStart {
    folder: PathBuf,
    scene: PagedScene,
    state: RunState,
    /// In the order of the first pages of a run; `None` for all pages, none frozen.
    listed: Option<Vec<(PageNo, bool)>>,
    /// Holds the lock that excludes writers.
    _store: StoreReader,
}

impl StoredStart {
    /// Opens the last generation of the store in `dir`, which may be the output folder of a run.
    /// Errors: the store cannot be opened or is in use, or 1/`share` of the budget is too small for it.
    pub fn open(dir: &Path, host_mem: u64, share: u64) -> Result<StoredStart, TrainError> {
        let place = find_store(dir)?;
        let store = place.open(Access::Pages)?;
        let folder = place.folder;
        let generation = store.find(None)?;
        let state = run_state_of(&store, generation)?;
        let (_, options) = options_of(&folder, &state)?;
        let scene = scene_at(&store, generation, &state, &options, (host_mem, share), 0)?;
        Ok(StoredStart { folder, scene, state, listed: None, _store: store })
    }

    /// Takes only the pages that `file` lists, a line each: trained ones first, then frozen ones.
    /// Errors: the file cannot be read, lists no page to train, a page twice, or one that the store lacks.
    pub fn keep_listed(&mut self, file: &Path) -> InputResult<()> {
        let index = self.scene.pager.index();
        let remedy = "list pages of the store, each once, those with the word `frozen` last";
        let text = read_text(file, (index.len() as u64 + 1) * LIST_LINE_BYTES, remedy)?;
        let mut open: BTreeMap<PageId, PageNo> = (0..).map(PageNo).zip(index).map(|(no, meta)| (meta.id, no)).collect();
        let mut listed: Vec<(PageNo, bool)> = Vec::new();
        for (number, line) in text.lines().enumerate() {
            let refuse = |problem: String| InputError::new(file, problem, remedy).at(format!("line {}", number + 1));
            let ListedPage { page, is_frozen } = ListedPage::of_line(line).map_err(refuse)?;
            let no = open.remove(&page).ok_or_else(|| refuse(format!("the store has no further page {page}")))?;
            if !is_frozen && listed.last().is_some_and(|(_, is_frozen)| *is_frozen) {
                return Err(refuse("a page to train follows a frozen one".to_string()));
            }
            listed.push((no, is_frozen));
        }
        if listed.first().is_none_or(|(_, is_frozen)| *is_frozen) {
            return Err(InputError::new(file, "it lists no page to train", remedy));
        }
        self.listed = Some(listed);
        Ok(())
    }

    /// Upper bound of its Gaussians.
    pub fn rows_at_most(&self) -> u64 {
        let index = self.scene.pager.index();
        let of_page = |(page, _): &(PageNo, bool)| u64::from(index[page.index()].rows);
        // Pages that miss events may hold more rows than they store.
        let missed = self.state.rows_bound - self.state.rows;
        let stored = self.listed.as_ref().map_or(self.state.rows, |listed| listed.iter().map(of_page).sum());
        stored + missed
    }

    /// Digest of the start: of the run state, from which the pages follow, and of the list of pages.
    /// Errors: the state cannot be encoded.
    pub fn digest(&self) -> InputResult<u64> {
        let bytes = self.state.to_bytes();
        let mut bytes = bytes.map_err(|e| InputError::new(&self.folder, e, "report this as a bug"))?;
        for (page, is_frozen) in self.listed.iter().flatten() {
            bytes.extend(self.scene.pager.index()[page.index()].id.to_bits().to_le_bytes());
            bytes.push(u8::from(*is_frozen));
        }
        Ok(xxh3_64(&bytes))
    }

    /// Its run without the pages.
    pub fn state(&self) -> &RunState {
        &self.state
    }

    /// Its pages after all steps of its run.
    pub fn scene(&mut self) -> &mut PagedScene {
        &mut self.scene
    }

    pub fn sh_degree(&self) -> u8 {
        self.scene.rules.sh_degree
    }

    /// Passes first pages to `take`, with whether they are frozen: at most `page_rows` rows each, in the local frame of `origin` and
    /// `scale`, with at most `sh_degree` and with their uids. May be called repeatedly.
    /// Errors: a page cannot be read or overflows f32 in the new frame, or `take` failed.
    pub fn for_each_page(
        &mut self,
        frame: ([f64; 3], f64),
        (page_rows, sh_degree): (usize, u8),
        take: &mut dyn FnMut(bool, SceneState) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let pages = match &self.listed {
            Some(listed) => listed.clone(),
            None => self.pages().into_iter().map(|(page, _)| (page, false)).collect(),
        };
        for (page, is_frozen) in pages {
            let (uid, columns) = self.rows_of(page, frame)?;
            let mut state = SceneState::from_columns(truncate_sh(columns, sh_degree));
            state.raise_sh_degree(sh_degree);
            state.uid = uid;
            let rows: Vec<u32> = (0..state.rows() as u32).collect();
            rows.chunks(page_rows).try_for_each(|rows| take(is_frozen, state.select(rows)))?;
        }
        Ok(())
    }

    /// All pages, in the order of their ids.
    pub fn pages(&self) -> Vec<(PageNo, PageId)> {
        let index = self.scene.pager.index();
        let mut pages: Vec<(PageNo, PageId)> = (0..).map(PageNo).zip(index.iter().map(|meta| meta.id)).collect();
        pages.sort_unstable_by_key(|(_, id)| *id);
        pages
    }

    /// The uids and the values of the rows of a page, in the local frame of `origin` and `scale`.
    /// Errors: the page cannot be read, or overflows f32 in that frame.
    pub fn rows_of(
        &mut self,
        page: PageNo,
        (origin, scale): ([f64; 3], f64),
    ) -> Result<(Vec<u64>, Columns), TrainError> {
        let print = &self.state.origin.dataset;
        let meta =
            SceneMeta { origin: print.origin, scale: print.scale, frame: ExportFrame::Local, ..SceneMeta::default() };
        let (mut uid, mut columns, now) = (Vec::new(), Columns::default(), self.state.trainer.step);
        self.scene.visit(&[page], &[], &mut |rules, tables| {
            uid = tables.iter().flat_map(|table| table.uid).copied().collect();
            columns = evaluate_all(tables, rules.sh_degree, &rules.adam, now);
            Ok::<(), TrainError>(())
        })?;
        if to_local(&mut columns, &meta, origin, scale) > 0 {
            let problem = "its Gaussians are too far from the cameras for f32";
            return Err(InputError::new(&self.folder, problem, "check that it is a scene of this dataset").into());
        }
        Ok((uid, columns))
    }
}
