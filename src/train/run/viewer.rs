//! `gsscale-view`: a page that shows Gaussians after training, from cameras that the person watching moves.
//!
//! The Gaussians are read like the start of a run, so a spill directory holds a scene that exceeds memory, and pictures page it in. No step is
//! taken.
//!
//! Invariants: 1. nothing is written but pages in a spill directory, which is removed at the end; 2. a picture that cannot be drawn is an
//! error of the page alone.

use super::begin::{PagedStart, page_start};
use super::live::counts;
use super::out_folder::scene_name;
use super::scene_picture::{overview, picture};
use crate::base::error::InputError;
use crate::base::units::counted_are;
use crate::checkpoint::interval::CommitEvery;
use crate::config::file::TrainConfig;
use crate::config::values::{ByteSize, Chosen};
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::densify::strategy::StrategyName;
use crate::optim::method::OptimizerPlace;
use crate::page::folder::measure::DriveRate;
use crate::page::tool::uncommitted::check_usable;
use crate::photos::exposure::AppearanceMode;
use crate::report::live::{Live, PictureKind, Status, WIDTH_MOST};
use crate::report::run_files::{METRICS_FILE, saved_ply_name, saved_step};
use crate::train::error::TrainError;
use crate::train::inputs::machine;
use crate::train::inputs::signals::StopFlag;
use crate::train::memory::host_budget;
use crate::train::preflight::forecast::plan_run;
use crate::train::start::first_scene::Start;
use crate::train::start::tiers::Tiers;
use crate::train::state::trainer::Trainer;
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
    /// The folder of the run, if it has metrics; its saved Gaussians can be shown, too.
    pub saved: Option<PathBuf>,
    pub live: Live,
}

/// The config of a run that only shows `gaussians`: nothing grows, adapts, or is kept. Spill directory and memory are those of the viewer
/// alone: the run's directory is its checkpoint, and its memory was for pages on a drive.
pub fn config_to_show(
    config: TrainConfig,
    gaussians: &Path,
    spill_dir: Option<String>,
    host_mem: Option<ByteSize>,
) -> TrainConfig {
    TrainConfig {
        init_ply: gaussians.to_string_lossy().into_owned(),
        pages_file: String::new(),
        first_appearance: String::new(),
        spill_dir: spill_dir.unwrap_or_default(),
        host_mem: host_mem.unwrap_or(ByteSize(0)),
        steps: 1,
        frames: 0,
        max_gaussians: 0,
        // No picture is wider.
        max_resolution: if config.max_resolution == 0 { WIDTH_MOST } else { config.max_resolution.min(WIDTH_MOST) },
        keep_checkpoint: false,
        commit_every: CommitEvery::Seconds(0.0),
        strategy: StrategyName::None,
        optimizer_on: Chosen(Some(OptimizerPlace::Host)),
        poor_points: Chosen(Some(false)),
        sweep_points: Chosen(Some(false)),
        appearance: Chosen(Some(AppearanceMode::Off)),
        robust_views: Chosen(Some(false)),
        robust_pixels: Chosen(Some(false)),
        refine_poses: Chosen(Some(false)),
        ..config
    }
}

/// Gaussians that are shown. The pages may lie in the tiers, so drop them after the trainer.
struct ShownScene {
    /// A step of [`Status::saved`], or 0.
    step: u32,
    dataset: Dataset,
    targets: TargetCache,
    trainer: Trainer,
    tiers: Tiers,
}

impl ShownScene {
    /// Reads Gaussians with the photos of their scene.
    /// Errors: the Gaussians or the scene cannot be used, or memory does not suffice.
    fn open(request: &ShowRequest, step: u32, quiet: bool) -> Result<ShownScene, TrainError> {
        let mut config = request.config.clone();
        if step > 0 {
            let folder = request.saved.as_deref().unwrap_or(Path::new(""));
            config.init_ply = folder.join(saved_ply_name(step)).to_string_lossy().into_owned();
        }
        let host_mem = host_budget(config.host_mem.0);
        let start = Start::read(&request.scene, &config, host_mem)?;
        let PagedStart { dataset, mut trainer, mut tiers, driver } =
            page_start(&config, quiet, false, start, host_mem)?;
        tiers.is_done = true;
        plan_run(&config, &dataset, &tiers, &mut trainer, host_mem, driver, DriveRate::COMMON)?;
        let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
        Ok(ShownScene { step, dataset, targets, trainer, tiers })
    }

    /// Frees memory and the spill directory.
    fn close(mut self) {
        drop(self.trainer);
        self.tiers.close().iter().for_each(|word| crate::tell!("warning: {word}"));
    }
}

/// The steps of the files of `--save-every` in a folder, ascending.
fn saved_steps(folder: &Path) -> Vec<u32> {
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let mut steps: Vec<u32> = names.filter_map(|name| saved_step(name.to_str()?)).collect();
    steps.sort_unstable();
    steps
}

/// Shows the Gaussians until a stop is asked for (Ctrl-C). Those of another step are read when the page asks for them, in place of the
/// ones before.
/// Errors: the Gaussians or the scene cannot be used, or memory does not suffice.
pub fn show(request: &ShowRequest) -> Result<(), TrainError> {
    let ShowRequest { scene, config, live, .. } = request;
    machine::set_up(config)?;
    config.residence().spill_dir().map_or(Ok(()), check_usable)?;
    let first = ShownScene::open(request, 0, false)?;
    crate::tell!("live page: http://{}/", live.address());
    request.saved.iter().for_each(|folder| live.set_metrics(folder.join(METRICS_FILE)));
    let overview = overview(&first.trainer.scene, &first.dataset);
    let saved = request.saved.as_deref().map_or_else(Vec::new, saved_steps);
    let tell = |shown: &ShownScene| {
        live.set_status(Status {
            name: scene_name(scene),
            step: shown.step,
            overview,
            picture_percent: 100,
            saved: saved.clone(),
            ..counts(&shown.trainer, &shown.dataset)
        });
    };
    tell(&first);
    // Until here, Ctrl-C ends the program at once; the pages go at the next start.
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    crate::tell!("{} shown until Ctrl-C", counted_are(first.trainer.scene.rows(), "Gaussian"));
    let mut shown = Some(first);
    while stop.exit_code().is_none() {
        let Some((ticket, orbit)) = live.wanted() else {
            std::thread::sleep(LOOK_EVERY);
            continue;
        };
        if orbit.step > 0 && !saved.contains(&orbit.step) {
            live.show((ticket, orbit), Err(format!("no Gaussians of step {} are saved", orbit.step)));
            continue;
        }
        let is_shown = |shown: &ShownScene| shown.step == orbit.step || orbit.show == PictureKind::Photo;
        if !shown.as_ref().is_some_and(is_shown) {
            // Not both in memory.
            if let Some(before) = shown.take() {
                before.close();
            }
            match ShownScene::open(request, orbit.step, true) {
                Ok(opened) => shown = Some(opened),
                Err(error) => {
                    let what = if orbit.step == 0 { "the result".into() } else { format!("step {}", orbit.step) };
                    live.show((ticket, orbit), Err(format!("{what} cannot be shown: {error}")));
                    continue;
                }
            }
        }
        if let Some(shown) = &mut shown {
            live.show((ticket, orbit), picture(&mut shown.trainer, &shown.dataset, &shown.targets, orbit));
            tell(shown);
        }
    }
    if let Some(last) = shown {
        last.close();
    }
    Ok(())
}
