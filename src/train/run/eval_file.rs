//! Evaluation of a file of Gaussians on the held-out photos of a scene: a PLY, or every level of a folder of SOGs.
//!
//! Not here: the figures of a view ([`crate::train::state::eval`]).

use crate::base::count::Count;
use crate::base::error::{InputError, InputResult};
use crate::base::text::read_text;
use crate::base::whole_file::write_whole;
use crate::config::file::TrainConfig;
use crate::config::limits::{self, RunOptions};
use crate::dataset::loader::{Dataset, load_dataset};
use crate::dataset::read::read_scene;
use crate::dataset::target_cache::TargetCache;
use crate::exchange::frames::file_to_local;
use crate::exchange::meta::SceneMeta;
use crate::exchange::ply::{PlyContent, gaussians_header, read_ply, stated_rows};
use crate::exchange::sog::{SogReader, is_tree};
use crate::paging::pager::{Pager, PagerConfig};
use crate::photos::exposure::{AppearanceMode, read_values};
use crate::photos::{PhotoOptions, PhotoParameters, first_parameters};
use crate::render::lpips::weights::read_lpips;
use crate::render::lpips::{InputRange, Lpips};
use crate::render::{RenderOptions, Renderer};
use crate::report::run_files::VIEWS_FILE;
use crate::scene::columns::Columns;
use crate::train::error::TrainError;
use crate::train::inputs::gaussian_pages::{PositionSample, file_warnings};
use crate::train::inputs::machine::{self, OpenedDevice};
use crate::train::log::report::TestMetrics;
use crate::train::memory::{check_evaluation_fits, check_gaussians_alone_fit, check_photos_fit, host_budget};
use crate::train::state::eval::{EvalRequest, evaluate};
use crate::train::step::pages::{PagedScene, WorkingSet};
use crate::train::step::view::SceneNow;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct EvalReport {
    /// The PLY, or the `lod-meta.json` of SOGs.
    pub ply: PathBuf,
    pub scene: PathBuf,
    /// Gaussians in the file; of the finest level.
    pub gaussians: u64,
    pub ssim_variant: String,
    /// Network and input range of LPIPS (`alex, signed`), if measured.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub lpips_variant: Option<String>,
    /// Means over the held-out views; `None` without held-out views. Of the finest level.
    pub test: Option<TestMetrics>,
    /// Each level of detail, the finest first; none of a PLY.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub levels: Vec<LevelReport>,
}

/// Size limit of a file of figures, bytes.
const FIGURES_BYTES_MAX: u64 = 64 << 20;

/// The JSON in a file of figures; null of every other file.
fn figures_in(file: &Path) -> Value {
    let text = read_text(file, FIGURES_BYTES_MAX, "").unwrap_or_default();
    serde_json::from_str(&text).unwrap_or_default()
}

impl EvalReport {
    /// Whether a file holds such a report, perhaps that of another version.
    pub fn is_in(file: &Path) -> bool {
        let report = figures_in(file);
        report["ply"].is_string() && report["scene"].is_string() && report["gaussians"].is_u64()
    }
}

/// The figures of some Gaussians.
#[derive(Debug, Clone, Copy, serde::Serialize, serde::Deserialize)]
pub struct EvalFigures {
    /// Gaussians that were drawn.
    pub gaussians: u64,
    /// Means over the held-out views; `None` without held-out views.
    pub test: Option<TestMetrics>,
}

/// The evaluation of one level of detail, shown everywhere with the Gaussians that are always shown.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct LevelReport {
    /// Number of the level; the finest is 0.
    pub level: u32,
    #[serde(flatten)]
    pub figures: EvalFigures,
}

/// Optional outputs of the evaluation of a file.
#[derive(Debug, Clone, Copy, Default)]
pub struct EvalExtras<'a> {
    /// Folder for pictures; those of levels have folders in it (`level_0`).
    pub pictures: Option<&'a Path>,
    /// LPIPS weights and the input range of the network.
    pub lpips: Option<(&'a Path, InputRange)>,
    /// The `appearance.json` of the run that made the Gaussians: from it follow the exposures of held-out photos.
    pub appearance: Option<&'a Path>,
}

/// Evaluates the Gaussians of `file`, a PLY or a `lod-meta.json`, on the held-out views of the scene in the folder `scene`. All rows of a
/// PLY, or of one level at a time, are in memory.
/// Errors: the file, the scene or the weights cannot be used, or a picture cannot be written.
pub fn evaluate_file(
    file: &Path,
    scene: &Path,
    config: &TrainConfig,
    extras: &EvalExtras<'_>,
) -> Result<EvalReport, TrainError> {
    machine::set_up(config)?;
    let lpips = match extras.lpips {
        None => None,
        Some((weights, range)) => Some((read_lpips(weights, limits::simd_path(config))?, range)),
    };
    // The file is opened before the photos, so that an unusable file is reported at once.
    let model = Model::open(file, host_budget(config.host_mem.0))?;
    let mut evaluator = Evaluator::open(scene, config, lpips.as_ref().map(|(lpips, range)| (lpips, *range)))?;
    if let Some(values) = extras.appearance {
        evaluator.take_exposures(values)?;
    }
    let (finest, levels) = match model {
        Model::Ply(read) => {
            let (rows, meta) = *read;
            (evaluator.evaluate(file, rows, &meta, extras.pictures)?, Vec::new())
        }
        Model::Sog(sog) => {
            let levels = evaluator.evaluate_levels(file, &sog, extras.pictures)?;
            (levels[0].figures, levels)
        }
    };
    Ok(EvalReport {
        ply: file.to_path_buf(),
        scene: scene.to_path_buf(),
        gaussians: finest.gaussians,
        ssim_variant: config.ssim_variant.to_string(),
        lpips_variant: evaluator.lpips.map(|(lpips, range)| format!("{}, {}", lpips.network().name(), range.name())),
        test: finest.test,
        levels,
    })
}

/// Gaussians in a file.
pub(crate) enum Model {
    Ply(Box<(Columns, SceneMeta)>),
    Sog(Box<SogReader>),
}

impl Model {
    /// Errors: the file cannot be read, holds points, or holds more Gaussians than can be evaluated in `budget` bytes.
    pub fn open(file: &Path, budget: Option<u64>) -> InputResult<Model> {
        if is_tree(file) {
            return Ok(Model::Sog(Box::new(SogReader::open(file)?)));
        }
        if let (Some(budget), Ok((_, sh_degree))) = (budget, gaussians_header(file)) {
            check_gaussians_alone_fit(file, stated_rows(file)?, sh_degree, budget)?;
        }
        match read_ply(file)? {
            PlyContent::Gaussians { columns, meta, .. } => Ok(Model::Ply(Box::new((columns, meta)))),
            PlyContent::Points { .. } => {
                let problem = "holds points, not Gaussians (no property f_dc_0)";
                Err(InputError::new(file, problem, "give the point_cloud.ply of a run"))
            }
        }
    }
}

/// The held-out photos of a scene, and what draws Gaussians from their places.
pub(crate) struct Evaluator<'a> {
    config: &'a TrainConfig,
    pub dataset: Dataset,
    pub targets: TargetCache,
    pub renderer: Box<dyn Renderer>,
    lpips: Option<(&'a Lpips, InputRange)>,
    /// What the run of the Gaussians has learnt of the photos, if that predicts held-out ones.
    photos: PhotoParameters,
    /// Warnings that were printed. Most levels cause the same ones.
    printed: BTreeSet<String>,
}

impl<'a> Evaluator<'a> {
    /// Errors: the scene, its photos or the device cannot be used.
    pub fn open(
        scene: &Path,
        config: &'a TrainConfig,
        lpips: Option<(&'a Lpips, InputRange)>,
    ) -> Result<Evaluator<'a>, TrainError> {
        let dataset = load_dataset(read_scene(scene, &limits::read_options(config))?, &limits::load_options(config))?;
        check_photos_fit(&dataset, host_budget(config.host_mem.0))?;
        dataset.warnings.iter().for_each(|warning| crate::tell!("warning: {warning}"));
        let targets = TargetCache::new(&dataset.views, config.image_cache.0, rayon::current_num_threads())?;
        let OpenedDevice { renderer, word, .. } = machine::renderer(config, machine::DeviceUse::Pictures)?;
        if let Some(word) = word {
            crate::tell!("{word}");
        }
        let (photos, printed) = (PhotoParameters::new(), BTreeSet::new());
        Ok(Evaluator { config, dataset, targets, renderer, lpips, photos, printed })
    }

    /// Takes exposures from the file of a run. Not of a run with `--appearance full`, whose vignetting is more than an exposure.
    fn take_exposures(&mut self, values: &Path) -> InputResult<()> {
        let run = RunOptions::new(self.config, self.dataset.scene_scale);
        if matches!(run.photos.appearance, AppearanceMode::Exposure | AppearanceMode::IfNeeded) {
            let options = PhotoOptions { first_appearance: Some(read_values(values)?), ..run.photos };
            self.photos = first_parameters(&options, &self.dataset);
            // Its warnings are those of a run that begins.
            self.photos.iter_mut().for_each(|parameter| drop(parameter.start(&self.dataset)));
        }
        Ok(())
    }

    /// Takes a folder for pictures. Its list of views, empty at first, shows a later evaluation that its pictures may be replaced.
    /// Errors: photos of the scene lie in the folder or around it, or it holds pictures that no evaluation wrote.
    fn claim_picture_folder(&self, folder: &Path) -> InputResult<()> {
        let refused = |problem: String| Err(InputError::new(folder, problem, "name a new folder with --renders"));
        if let Some(photos) = self.dataset.photo_folder_around(folder) {
            return refused(format!("--renders would write among the photos of the scene, in {}", photos.display()));
        }
        let list = folder.join(Path::new(VIEWS_FILE).file_name().unwrap_or_default());
        if figures_in(&list).as_array().is_some_and(|views| views.iter().all(|view| view["picture"].is_string())) {
            return Ok(());
        }
        let is_png = |path: &Path| path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
        let mut files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        if let Some(other) = files.find(|path| is_png(path) || *path == list) {
            return refused(format!("--renders would write beside {}, which no evaluation wrote", other.display()));
        }
        std::fs::create_dir_all(folder).map_err(|e| InputError::io(folder, "creating the folder for pictures", &e))?;
        write_whole(&list, b"[]")
    }

    /// Evaluates every level of a folder of SOGs, the finest first. Pictures go to a folder for each level.
    fn evaluate_levels(
        &mut self,
        file: &Path,
        sog: &SogReader,
        pictures: Option<&Path>,
    ) -> Result<Vec<LevelReport>, TrainError> {
        let mut levels = Vec::new();
        for (index, level) in sog.levels().into_iter().enumerate() {
            let folder = pictures.map(|folder| folder.join(format!("level_{level}")));
            let figures = self.evaluate(file, sog.rows(index)?, sog.meta(), folder.as_deref())?;
            levels.push(LevelReport { level, figures });
        }
        Ok(levels)
    }

    /// Gaussians that were read from `file`, in the frame of the dataset.
    /// Errors: none of them lies in it, or they do not fit in memory.
    pub fn placed(&mut self, file: &Path, mut columns: Columns, meta: &SceneMeta) -> Result<Columns, TrainError> {
        let frame = &self.dataset.frame;
        let far = file_to_local(&mut columns, meta, frame.origin.to_array(), frame.scale);
        let mut sample = PositionSample::default();
        sample.add(&columns.means);
        for warning in file_warnings(file, meta, far).into_iter().chain(sample.warning(file, &self.dataset.views)) {
            if self.printed.insert(warning.clone()) {
                crate::tell!("warning: {warning}");
            }
        }
        if columns.rows() == 0 {
            let problem = "no Gaussian lies within the coordinate range of this scene";
            return Err(InputError::new(file, problem, "give a file that was trained on this scene").into());
        }
        if let Some(budget) = host_budget(self.config.host_mem.0) {
            let (cache, network) = (self.config.image_cache.0, self.lpips.map(|(lpips, _)| lpips.network()));
            check_evaluation_fits(file, &columns, &self.dataset, budget, cache, network)?;
        }
        Ok(columns)
    }

    /// The pages of such Gaussians, and how a run draws them: with their own SH degree; that of the config is for training.
    /// Errors: they cannot be paged.
    pub fn pages(&self, columns: &Columns) -> Result<(PagedScene, RunOptions), TrainError> {
        let (sh_degree, run) = (columns.sh_degree, RunOptions::new(self.config, self.dataset.scene_scale));
        let render = RenderOptions { sh_degree, ..run.render };
        let run = RunOptions { sh_degree, sh_degree_start: sh_degree, render, ..run };
        let pager = Pager::in_memory(PagerConfig::in_memory(run.page_rows, columns.sh_degree));
        Ok((PagedScene::new(columns, pager, &run)?, run))
    }

    /// Evaluates Gaussians that were read from `file`.
    fn evaluate(
        &mut self,
        file: &Path,
        columns: Columns,
        meta: &SceneMeta,
        pictures: Option<&Path>,
    ) -> Result<EvalFigures, TrainError> {
        let columns = self.placed(file, columns, meta)?;
        pictures.map_or(Ok(()), |folder| self.claim_picture_folder(folder))?;
        let (mut pages, run) = self.pages(&columns)?;
        let gaussians = columns.rows() as u64;
        drop(columns);
        let shown = Count::new("views compared", self.dataset.test_views().len() as u32, false);
        let progress = |done: u32| shown.show(done);
        let request = EvalRequest::of_held_out(&self.dataset, &run, &self.photos, pictures, &progress);
        let request = EvalRequest { lpips: self.lpips, ..request };
        let working = &mut WorkingSet::default();
        let mut now = SceneNow { scene: &mut pages, step: 0, working, renderer: &mut *self.renderer };
        let test = evaluate(&mut now, &self.dataset, &self.targets, &run.render, &request)?;
        Ok(EvalFigures { gaussians, test })
    }
}
