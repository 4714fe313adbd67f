//! The start of a run: the dataset and its first Gaussians, in memory, or points or Gaussians that are streamed into pages.
//!
//! With a spill directory, points and Gaussians in files are streamed, so the scene may exceed memory. The Gaussians of
//! a store are always streamed. Random points are made in memory.
//!
//! Invariants: 1. streamed and whole input give the same pages, bit for bit ([`crate::dataset::import`]); 2. bad input is an error
//! here, before any file is written.

use crate::base::error::{InputError, InputResult};
use crate::base::even_sample::EvenSample;
use crate::base::ids::PageId;
use crate::base::units::format_bytes;
use crate::checkpoint::run_state::{DatasetPrint, ViewPrint};
use crate::config::file::TrainConfig;
use crate::config::limits::{self, RunOptions};
use crate::dataset::colmap;
use crate::dataset::frame::Extent;
use crate::dataset::import::{Budget, Cloud, ImportOptions, LocalCloud, PointSource, import_points};
use crate::dataset::loader::{Dataset, load_dataset, load_dataset_with_cloud};
use crate::dataset::model::{PointCloud, RawScene, TakePoint};
use crate::dataset::plane_sweep;
use crate::dataset::read::{ReadOptions, read_scene};
use crate::dataset::up::estimate_up;
use crate::exchange::foreign::refuse_folder_of_sogs;
use crate::exchange::frames::file_to_local;
use crate::exchange::ply::{self, PlyContent, read_ply};
use crate::exchange::sog::{SogReader, is_tree};
use crate::paging::pager::Pager;
use crate::photos::diagnosis::{Diagnosis, POINTS_MOST, diagnose};
use crate::photos::outlier::landmarks::LANDMARKS_MOST;
use crate::scene::columns::{Columns, row_width};
use crate::scene::init::{InitOptions, gaussians_from_points, random_points_in_frusta};
use crate::scene::log_scales::LogScaleRange;
use crate::scene::partition::first_fill;
use crate::scene::state::SceneState;
use crate::train::error::{TrainError, not_stored};
use crate::train::inputs::dataset_print::{GaussiansPrint, points_print, view_print};
use crate::train::inputs::gaussian_pages::{
    GaussianFile, GaussianWriter, GaussiansRead, PositionSample, file_warnings, giants_warning, remove_giants,
    truncate_sh,
};
use crate::train::inputs::machine::folder_beside;
use crate::train::memory::check_photos_fit;
use crate::train::step::pages::{PagedScene, first_pages};
use crate::train::stores::StoredStart;
use rayon::prelude::*;
use std::path::Path;

/// Memory of an import without a budget, bytes.
const BUDGET_DEFAULT: u64 = 1 << 30;
/// The input of the first Gaussians gets 1/3 of the budget.
const BUDGET_SHARE: u64 = 3;

/// The file or store of Gaussians or points that the user gave, if any.
fn init_ply(config: &TrainConfig) -> Option<&Path> {
    Some(Path::new(&config.init_ply)).filter(|path| !path.as_os_str().is_empty())
}

/// The store from which the run begins, if it begins from one.
fn store(config: &TrainConfig) -> Option<&Path> {
    init_ply(config).filter(|path| path.is_dir())
}

/// Refuses a list of pages where the run does not begin from a store.
fn check_pages_file(config: &TrainConfig) -> InputResult<()> {
    if config.pages_file.is_empty() || !init_ply(config).is_none_or(Path::is_file) {
        return Ok(());
    }
    let problem = "it lists pages of a store, and --init-ply names none";
    Err(InputError::new("--pages-file", problem, "name the store with --init-ply, or leave it out"))
}

/// Refuses a start without Gaussians, or with more than --max-gaussians.
fn check_rows(config: &TrainConfig, from: &Path, rows: u64) -> InputResult<()> {
    if rows == 0 {
        let problem = "all first Gaussians are too far from the cameras or too large";
        return Err(InputError::new(from, problem, "give a PLY of this scene with --init-ply"));
    }
    if config.max_gaussians > 0 && rows > config.max_gaussians {
        let problem = format!("the start has {rows} Gaussians, above --max-gaussians");
        return Err(InputError::new(from, problem, "raise --max-gaussians or start from fewer"));
    }
    Ok(())
}

/// Fewest points of a plane sweep that a run begins from.
const SWEPT_LEAST: usize = 200;

/// A dataset and the source of its first Gaussians.
pub struct Start {
    /// Views and frame.
    pub dataset: Dataset,
    /// SH degree of the first step.
    pub sh_degree_start: u8,
    /// Number of first Gaussians; an upper bound for point clouds.
    pub rows: u64,
    /// As `rows`, of the scene's own points, also where the run begins from others. The print of the dataset has it.
    pub own_rows: u64,
    /// Digest of the scene's own points or Gaussians; the same for streamed and whole input.
    pub points: u64,
    from: FirstRows,
}

enum FirstRows {
    /// `is_random`: at random places, since the scene has neither points nor Gaussians.
    Columns {
        columns: Columns,
        is_random: bool,
    },
    Points {
        cloud: Cloud,
        extent: Extent,
        init: InitOptions,
    },
    Gaussians(GaussianFile),
    Store(Box<StoredStart>),
}

impl Start {
    /// Reads the scene. Points that can be streamed take no more memory than `host_mem` allows.
    /// Errors: as [`prepare`].
    pub fn read(scene: &Path, config: &TrainConfig, host_mem: Option<u64>) -> InputResult<Start> {
        check_pages_file(config)?;
        if config.residence().spill_dir().is_none() && store(config).is_none() {
            return Start::in_memory(scene, config, host_mem)?.with_photos_that_fit(host_mem);
        }
        Start::look(scene, config, &folder_beside(Path::new(&config.spill_dir)), host_mem)
    }

    /// As [`Start::read`], for inspection of a run's start: avoids creating Gaussians. `folder` holds unnamed temporary
    /// files for data that exceeds memory.
    /// Errors: as [`prepare`].
    pub fn look(scene: &Path, config: &TrainConfig, folder: &Path, host_mem: Option<u64>) -> InputResult<Start> {
        check_pages_file(config)?;
        let start = match store(config) {
            Some(store) => Start::of_store(scene, config, store, host_mem)?,
            None if init_ply(config).is_some_and(is_tree) => Start::in_memory(scene, config, host_mem)?,
            None => match Start::stream(scene, config, &budget(folder, host_mem))? {
                Some(start) => start,
                None => Start::in_memory(scene, config, host_mem)?,
            },
        };
        start.with_photos_that_fit(host_mem)
    }

    /// Refused where a photo cannot be decoded in `host_mem`.
    fn with_photos_that_fit(self, host_mem: Option<u64>) -> InputResult<Start> {
        check_photos_fit(&self.dataset, host_mem)?;
        Ok(self)
    }

    fn in_memory(scene: &Path, config: &TrainConfig, host_mem: Option<u64>) -> InputResult<Start> {
        check_gaussians_fit(config, host_mem)?;
        let Prepared { dataset, columns, sh_degree_start, is_random } = prepare_silently(scene, config)?;
        let points = match dataset.points.as_slice() {
            [] => {
                let mut print = GaussiansPrint::default();
                print.add(&columns);
                print.digest()
            }
            points => points_print(&(points, dataset.colors.as_slice()))?.0,
        };
        let rows = columns.rows() as u64;
        let from = FirstRows::Columns { columns, is_random };
        Ok(Start { dataset, sh_degree_start, rows, own_rows: rows, points, from })
    }

    /// From the Gaussians of a store.
    fn of_store(scene: &Path, config: &TrainConfig, folder: &Path, host_mem: Option<u64>) -> InputResult<Start> {
        refuse_folder_of_sogs(folder)?;
        let memory = host_mem.unwrap_or(BUDGET_DEFAULT);
        let mut store = StoredStart::open(folder, memory, BUDGET_SHARE).map_err(|error| match error {
            TrainError::Input(error) => error,
            other => InputError::new(folder, other.to_string(), "see the cause"),
        })?;
        if !config.pages_file.is_empty() {
            store.keep_listed(Path::new(&config.pages_file))?;
        }
        let mut raw = read_scene(scene, &limits::read_options(config))?;
        raw.points = PointCloud::default();
        let dataset = load_dataset(raw, &limits::load_options(config))?;
        check_train_views(scene, &dataset)?;
        let rows = store.rows_at_most();
        check_rows(config, folder, rows)?;
        let sh_degree_start = store.sh_degree().max(limits::first_sh_degree(config));
        let points = store.digest()?;
        let from = FirstRows::Store(Box::new(store));
        Ok(Start { dataset, sh_degree_start, rows, own_rows: rows, points, from })
    }

    /// From the Gaussians of a file, which are read once here to know that all of them can be.
    fn of_gaussians(scene: &Path, config: &TrainConfig, mut raw: RawScene, file: &Path) -> InputResult<Start> {
        raw.points = PointCloud::default();
        let mut dataset = load_dataset(raw, &limits::load_options(config))?;
        check_train_views(scene, &dataset)?;
        let frame = (dataset.frame.origin.to_array(), dataset.frame.scale);
        let range = LogScaleRange::of_scene(dataset.scene_scale);
        let gaussians = GaussianFile::open(file, config.sh_degree, frame, range)?;
        let (mut print, mut rows) = (GaussiansPrint::default(), 0);
        let GaussiansRead { meta, far, giants } = gaussians.read(&mut |columns| {
            print.add(columns);
            rows += columns.rows() as u64;
            Ok(())
        })?;
        dataset.warnings.extend(file_warnings(file, &meta, far));
        dataset.warnings.extend(giants_warning(file, giants));
        check_rows(config, file, rows)?;
        let sh_degree_start = gaussians.sh_degree.max(limits::first_sh_degree(config));
        let from = FirstRows::Gaussians(gaussians);
        Ok(Start { dataset, sh_degree_start, rows, own_rows: rows, points: print.digest(), from })
    }

    /// `None` where neither points nor Gaussians are in a file.
    fn stream(scene: &Path, config: &TrainConfig, budget: &Budget<'_>) -> InputResult<Option<Start>> {
        let mut raw = read_scene(scene, &ReadOptions { points_later: true, ..limits::read_options(config) })?;
        let given = init_ply(config).map(Path::to_path_buf);
        let Some(file) = given.or_else(|| raw.points_path.take()) else { return Ok(None) };
        if is_ply(&file) && ply::holds_gaussians(&file)? {
            return Start::of_gaussians(scene, config, raw, &file).map(Some);
        }
        let mut warnings = Vec::new();
        let cloud = Cloud::gather(budget, |take| read_points(&file, &mut warnings, take))?;
        if cloud.is_empty() {
            return Ok(None);
        }
        raw.warnings.append(&mut warnings);
        let (dataset, local) = load_dataset_with_cloud(raw, &cloud, &limits::load_options(config))?;
        check_train_views(scene, &dataset)?;
        let extent = local.extent;
        let (points, rows) = points_print(&local)?;
        if rows == 0 {
            return Ok(None);
        }
        let init = InitOptions { scene_scale: dataset.scene_scale, ..limits::init_options(config) };
        let rows = init.max_gaussians.map_or(rows, |most| rows.min(most as u64));
        let from = FirstRows::Points { cloud, extent, init };
        Ok(Some(Start {
            dataset,
            sh_degree_start: limits::first_sh_degree(config),
            rows,
            own_rows: rows,
            points,
            from,
        }))
    }

    /// The direction of the dataset that is up, by its cameras and points; `None` without cameras. The same for streamed and
    /// whole input.
    /// Errors: the points cannot be read.
    pub(crate) fn up(&self) -> InputResult<Option<[f64; 3]>> {
        let cameras = self.dataset.views.iter().map(|view| &view.camera);
        estimate_up(cameras, |take| self.for_each_point(&mut |position, _| take(position)))
    }

    /// Passes the first points with their colours to `take`; none where the run starts from Gaussians.
    /// Errors: the points cannot be read.
    fn for_each_point(&self, take: &mut dyn FnMut([f32; 3], [u8; 3])) -> InputResult<()> {
        if let FirstRows::Points { cloud, extent, .. } = &self.from {
            let points = LocalCloud { cloud, extent: *extent, frame: self.dataset.frame };
            return points.read(&mut |position, color| {
                take(position, color);
                Ok(())
            });
        }
        let (points, colors) = (&self.dataset.points, &self.dataset.colors);
        points.iter().zip(colors).for_each(|(&position, &color)| take(position, color));
        Ok(())
    }

    /// What the training photos say before training; `None` where the run starts from Gaussians or random points.
    /// Errors: the points or a photo cannot be read.
    pub(crate) fn diagnose(&self) -> InputResult<Option<Diagnosis>> {
        let mut points = EvenSample::new(POINTS_MOST);
        self.for_each_point(&mut |position, color| points.add((position, color)))?;
        (points.seen > 0).then(|| diagnose(&self.dataset, &points.kept, points.seen)).transpose()
    }

    /// Some of the first points; none where the run starts from Gaussians or random points.
    /// Errors: the points cannot be read.
    pub(crate) fn landmarks(&self) -> InputResult<Vec<[f32; 3]>> {
        let mut landmarks = EvenSample::new(LANDMARKS_MOST);
        self.for_each_point(&mut |position, _| landmarks.add(position))?;
        Ok(landmarks.kept)
    }

    /// Returns a start from points on which the photos agree ([`plane_sweep`]) and true, or this start and false if there are
    /// too few such points. The print stays that of the scene's own points, so that a resumed run need not search again.
    /// Errors: as [`prepare`].
    pub(crate) fn with_swept_points(mut self, scene: &Path, config: &TrainConfig) -> InputResult<(Start, bool)> {
        let (points, colors) = plane_sweep::sweep(&self.dataset, config.seed);
        if points.len() < SWEPT_LEAST {
            return Ok((self, false));
        }
        // Not both in memory.
        self.from = FirstRows::Columns { columns: Columns::default(), is_random: false };
        (self.dataset.points, self.dataset.colors) = (points, colors);
        let columns = first_gaussians(scene, &self.dataset, config)?;
        let rows = columns.rows() as u64;
        check_rows(config, scene, rows)?;
        Ok((Start { rows, from: FirstRows::Columns { columns, is_random: false }, ..self }, true))
    }

    /// Whether the scene has neither Gaussians nor points.
    pub(crate) fn is_of_random_points(&self) -> bool {
        matches!(self.from, FirstRows::Columns { is_random: true, .. })
    }

    /// The dataset alone, for a run that has its Gaussians already. Drops their source: columns, a spool, or a store
    /// with its lock.
    pub(crate) fn into_dataset(self) -> Dataset {
        self.dataset
    }

    /// The dataset, and the first Gaussians as pages in `pager`.
    /// Errors: the source cannot be read again, or a page could not be stored.
    pub fn into_pages(
        mut self,
        pager: Pager,
        options: &RunOptions,
        config: &TrainConfig,
        host_mem: Option<u64>,
    ) -> Result<(Dataset, PagedScene), TrainError> {
        let mut scene = PagedScene::empty(pager, options);
        let folder = folder_beside(Path::new(&config.spill_dir));
        let mut sample = PositionSample::default();
        let insert = &mut |id, state: SceneState| {
            sample.add(&state.columns.means);
            Ok(scene.insert_first_page(id, &state)?)
        };
        let moved = self.for_each_page(options, &folder, host_mem, insert)?;
        let source = if config.init_ply.is_empty() { "the points of the scene" } else { &config.init_ply };
        // The pages of a cell reach beyond what its cameras see.
        let is_whole = config.pages_file.is_empty();
        if let Some(warning) = sample.warning(Path::new(source), &self.dataset.views).filter(|_| is_whole) {
            crate::tell!("warning: {warning}");
        }
        if moved > 0 {
            crate::tell!(
                "warning: {moved} log-scales of the first Gaussians are too small or large for this scene and are moved \
                 into its range"
            );
        }
        Ok((self.dataset, scene))
    }

    /// Passes the first pages to `take` in the order of their ids, with the SH degree of the first step and log-scales
    /// within the range of the scene. Returns how many log-scales were moved into it. `folder` holds temporary files for
    /// data that exceeds memory. May be called repeatedly.
    /// Errors: the source cannot be read again, or `take` failed.
    pub(crate) fn for_each_page(
        &mut self,
        options: &RunOptions,
        folder: &Path,
        host_mem: Option<u64>,
        take: &mut dyn FnMut(PageId, SceneState) -> Result<(), TrainError>,
    ) -> Result<u64, TrainError> {
        let (range, mut moved) = (LogScaleRange::of_scene(options.scene_scale), 0);
        let (sh_degree, budget) = (options.sh_degree_at(0), budget(folder, host_mem));
        let fill = first_fill(options.page_rows, options.strategy.grows());
        let frame = self.dataset.frame;
        let mut failed = None;
        // Keep the error of `take` itself: the import would wrap it.
        let mut take_state = |id, mut state: SceneState| {
            state.raise_sh_degree(sh_degree);
            moved += range.clamp_all(&mut state.columns.scales);
            take(id, state).map_err(|error| not_stored(failed.insert(error)))
        };
        let done = match &mut self.from {
            FirstRows::Columns { columns, .. } => first_pages(columns, fill, sh_degree, &mut take_state),
            FirstRows::Points { cloud, extent, init } => {
                let import = ImportOptions { init, fill, budget };
                let source = LocalCloud { cloud, extent: *extent, frame };
                let taken = import_points(&source, &import, &mut |page| take_state(page.id, page.into_state()));
                taken.map(|_| ())
            }
            FirstRows::Gaussians(file) => {
                let mut rows = GaussianWriter::new(&file.path, budget);
                let read = file.read(&mut |columns| rows.push_all(columns));
                read.and_then(|_| rows.finish()).and_then(|rows| rows.for_each_page(fill, &mut take_state))
            }
            FirstRows::Store(store) => {
                let (frame, sizes) = ((frame.origin.to_array(), frame.scale), (options.page_rows, sh_degree));
                let mut number = 0;
                store.for_each_page(frame, sizes, &mut |is_frozen, mut state| {
                    moved += range.clamp_all(&mut state.columns.scales);
                    take(if is_frozen { PageId::frozen(number) } else { PageId::initial(number) }, state)?;
                    number += 1;
                    Ok(())
                })?;
                return Ok(moved);
            }
        };
        match failed {
            Some(error) => Err(error),
            None => {
                done?;
                Ok(moved)
            }
        }
    }
}

/// A dataset with the Gaussians that training starts from.
pub struct Prepared {
    /// Views and frame.
    pub dataset: Dataset,
    /// First Gaussians in the local frame. SH bands above the current degree may be missing.
    pub columns: Columns,
    /// SH degree of the first step: that of the given Gaussians or of the config, whichever is higher.
    pub sh_degree_start: u8,
    /// Whether the Gaussians are at random places, since the scene has neither points nor Gaussians.
    pub is_random: bool,
}

/// Reads the scene and creates the first Gaussians.
/// Errors: the scene or the PLY is invalid.
pub fn prepare(scene: &Path, config: &TrainConfig) -> InputResult<Prepared> {
    let mut prepared = prepare_silently(scene, config)?;
    prepared.dataset.warnings.extend(prepared.is_random.then(|| random_points_warning(config)));
    Ok(prepared)
}

/// What a user is told of a start from random points.
pub(crate) fn random_points_warning(config: &TrainConfig) -> String {
    let remedy = if config.poor_points.is_on() { "" } else { "; --poor-points --init-scale 1 suits them" };
    format!(
        "the dataset has no points: starting from {} random points in the views' frusta{remedy}",
        config.init_points
    )
}

/// As [`prepare`], without the warning of random points.
fn prepare_silently(scene: &Path, config: &TrainConfig) -> InputResult<Prepared> {
    let mut raw = read_scene(scene, &limits::read_options(config))?;
    let mut gaussians = None;
    let mut dropped = None;
    if let Some(path) = init_ply(config).map(Path::to_path_buf).or(raw.points_path.clone()) {
        let content = if is_tree(&path) { None } else { Some(read_ply(&path)?) };
        match content {
            None => {
                let sog = SogReader::open(&path)?;
                raw.points = PointCloud::default();
                gaussians = Some((sog.rows(0)?, sog.meta().clone(), path));
            }
            Some(PlyContent::Gaussians { columns, meta, .. }) => {
                raw.points = PointCloud::default();
                gaussians = Some((columns, meta, path));
            }
            Some(PlyContent::Points { positions, colors, dropped: count }) => {
                raw.points = PointCloud { positions, colors };
                dropped = (count > 0).then(|| format!("{}: {count} points are not finite, dropped", path.display()));
            }
        }
    }
    raw.warnings.extend(dropped);
    let mut dataset = load_dataset(raw, &limits::load_options(config))?;
    check_train_views(scene, &dataset)?;
    let mut from = scene.to_path_buf();
    let is_random = gaussians.is_none() && dataset.points.is_empty();
    let (columns, sh_degree_start) = match gaussians {
        Some((mut columns, meta, ply)) => {
            from.clone_from(&ply);
            let far = file_to_local(&mut columns, &meta, dataset.frame.origin.to_array(), dataset.frame.scale);
            let giants = remove_giants(&mut columns, LogScaleRange::of_scene(dataset.scene_scale));
            dataset.warnings.extend(file_warnings(&ply, &meta, far));
            dataset.warnings.extend(giants_warning(&ply, giants));
            let in_use = columns.sh_degree.max(limits::first_sh_degree(config));
            (truncate_sh(columns, config.sh_degree), in_use)
        }
        None => (first_gaussians(scene, &dataset, config)?, limits::first_sh_degree(config)),
    };
    check_rows(config, &from, columns.rows() as u64)?;
    Ok(Prepared { dataset, columns, sh_degree_start, is_random })
}

/// Refuses a dataset without training views.
fn check_train_views(scene: &Path, dataset: &Dataset) -> InputResult<()> {
    if !dataset.train_views().is_empty() {
        return Ok(());
    }
    let problem = "no view is left to train on";
    Err(InputError::new(scene, problem, "hold out fewer photos: see --test-every and --test-after"))
}

fn first_gaussians(scene: &Path, dataset: &Dataset, config: &TrainConfig) -> InputResult<Columns> {
    let init = InitOptions { scene_scale: dataset.scene_scale, ..limits::init_options(config) };
    if !dataset.points.is_empty() {
        return Ok(gaussians_from_points(&dataset.points, &dataset.colors, &init));
    }
    if config.init_points == 0 {
        return Err(InputError::new(
            scene,
            "the dataset has no points and --init-points is 0",
            "give points with --init-ply, or let --init-points N draw them in the views' frusta",
        ));
    }
    let cameras = dataset.train_cameras();
    let count = config.init_points as usize;
    // In aerial and object captures the subject lies within a few camera spreads of the cameras.
    let (near, far) = (0.1 * dataset.scene_scale, 3.0 * dataset.scene_scale);
    let (points, colors) = random_points_in_frusta(&cameras, count, near, far, init.seed);
    Ok(gaussians_from_points(&points, &colors, &init))
}

/// A third of the memory: frames take a share, and the system caches the files just written.
fn budget(folder: &Path, host_mem: Option<u64>) -> Budget<'_> {
    Budget { folder, bytes: (host_mem.unwrap_or(BUDGET_DEFAULT) / BUDGET_SHARE) as usize }
}

/// Refuses a PLY of Gaussians that exceeds memory, by its header: without a spill directory the file is read whole.
fn check_gaussians_fit(config: &TrainConfig, host_mem: Option<u64>) -> InputResult<()> {
    let (Some(file), Some(budget)) = (init_ply(config).filter(|file| is_ply(file)), host_mem) else {
        return Ok(());
    };
    let rows = ply::stated_rows(file)?;
    let bytes = rows.saturating_mul(row_width(config.sh_degree) as u64 * 4);
    if bytes <= budget || !ply::holds_gaussians(file)? {
        return Ok(());
    }
    let problem = format!(
        "its {rows} Gaussians take {} while they are read, above --host-mem {}",
        format_bytes(bytes),
        format_bytes(budget)
    );
    let remedy = "name a folder on a fast drive with --spill-dir: the Gaussians are then streamed into pages";
    Err(InputError::new(file, problem, remedy))
}

fn is_ply(file: &Path) -> bool {
    !is_tree(file) && !file.extension().is_some_and(|e| e.eq_ignore_ascii_case("bin") || e.eq_ignore_ascii_case("txt"))
}

fn read_points(file: &Path, warnings: &mut Vec<String>, take: &mut TakePoint<'_>) -> InputResult<()> {
    if !is_ply(file) {
        return colmap::stream_points(file, warnings, take);
    }
    let dropped = ply::stream_points(file, take)?;
    if dropped > 0 {
        warnings.push(format!("{}: {dropped} points are not finite, dropped", file.display()));
    }
    Ok(())
}

/// The dataset print of a run's start.
/// Errors: a photo or a mask cannot be read.
pub fn dataset_print(start: &Start) -> InputResult<DatasetPrint> {
    let dataset = &start.dataset;
    let views: InputResult<Vec<ViewPrint>> = dataset.views.par_iter().map(view_print).collect();
    Ok(DatasetPrint {
        views: views?,
        first_rows: start.own_rows,
        points: start.points,
        scene_scale: dataset.scene_scale,
        origin: dataset.frame.origin.to_array(),
        scale: dataset.frame.scale,
    })
}
