//! `gsscale-view`: a page that shows Gaussians after training, from cameras that the person watching moves.
//!
//! The Gaussians are read like the start of a run, so a spill directory holds a scene that exceeds memory, and pictures page it in. No step is
//! taken.
//!
//! Invariants: 1. nothing is written but pages in a spill directory, which is removed at the end; 2. a picture that cannot be drawn is an
//! error of the page alone.

use super::begin::{PagedStart, page_start};
use super::out_folder::scene_name;
use super::scene_picture::{overview, picture};
use crate::base::error::InputError;
use crate::base::units::format_grouped;
use crate::checkpoint::interval::CommitEvery;
use crate::config::file::TrainConfig;
use crate::config::values::Chosen;
use crate::dataset::target_cache::TargetCache;
use crate::densify::strategy::StrategyName;
use crate::optim::method::OptimizerPlace;
use crate::page::folder::measure::DriveRate;
use crate::page::tool::uncommitted::check_usable;
use crate::photos::exposure::AppearanceMode;
use crate::report::live::{Live, Status};
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::inputs::signals::StopFlag;
use crate::train::memory::host_budget;
use crate::train::preflight::forecast::plan_run;
use crate::train::start::first_scene::Start;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Time between two looks whether a picture is wanted.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// What to show, and where.
#[derive(Debug)]
pub struct ShowRequest {
    /// A PLY of Gaussians, the `lod-meta.json` of SOGs (the finest level is shown), or a store.
    pub gaussians: PathBuf,
    /// The scene with the photos.
    pub scene: PathBuf,
    /// That of the run, or the defaults; checked.
    pub config: TrainConfig,
    /// The metrics of the run, if there are any.
    pub metrics: Option<PathBuf>,
    pub live: Live,
}

/// The config of a run that only shows `gaussians`: nothing grows, adapts, or is kept. The spill directory is that of `keys` alone, since
/// that of the run is its checkpoint.
pub fn config_to_show(config: TrainConfig, gaussians: &Path, spill_dir: Option<String>) -> TrainConfig {
    TrainConfig {
        init_ply: gaussians.to_string_lossy().into_owned(),
        pages_file: String::new(),
        first_appearance: String::new(),
        spill_dir: spill_dir.unwrap_or_default(),
        steps: 1,
        frames: 0,
        max_gaussians: 0,
        keep_checkpoint: false,
        commit_every: CommitEvery::Seconds(0.0),
        strategy: StrategyName::None,
        optimizer_on: Chosen(Some(OptimizerPlace::Host)),
        poor_points: Chosen(Some(false)),
        appearance: Chosen(Some(AppearanceMode::Off)),
        robust_views: Chosen(Some(false)),
        robust_pixels: Chosen(Some(false)),
        refine_poses: Chosen(Some(false)),
        ..config
    }
}

/// Shows the Gaussians until a stop is asked for (Ctrl-C).
/// Errors: the Gaussians or the scene cannot be used, or memory does not suffice.
pub fn show(request: &ShowRequest) -> Result<(), TrainError> {
    let ShowRequest { scene, config, live, .. } = request;
    machine::set_up(config)?;
    config.residence().spill_dir().map_or(Ok(()), |spill_dir| check_usable(spill_dir, false))?;
    let host_mem = host_budget(config.host_mem.0);
    let start = Start::read(scene, config, host_mem)?;
    let PagedStart { dataset, mut trainer, mut tiers, driver } = page_start(config, false, false, start, host_mem)?;
    tiers.is_done = true;
    plan_run(config, &dataset, &tiers, &mut trainer, host_mem, driver, DriveRate::COMMON)?;
    let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
    let rows = trainer.scene.rows();
    request.metrics.iter().for_each(|metrics| live.set_metrics(metrics.clone()));
    live.set_status(Status {
        name: scene_name(scene),
        overview: overview(&trainer.scene, &dataset),
        gaussians: rows,
        views: dataset.train_views().len() as u32,
        picture_percent: 100,
        ..Status::default()
    });
    // Until here, Ctrl-C ends the program at once; the pages go at the next start.
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    crate::tell!("{} Gaussians are shown until Ctrl-C", format_grouped(rows));
    while stop.exit_code().is_none() {
        match live.wanted() {
            Some((ticket, orbit)) => live.show((ticket, orbit), picture(&mut trainer, &dataset, &targets, orbit)),
            None => std::thread::sleep(LOOK_EVERY),
        }
    }
    drop(trainer);
    tiers.close().iter().for_each(|word| crate::tell!("warning: {word}"));
    Ok(())
}
