//! Reads the dataset and the first Gaussians of a scene into memory, and checks them. Streamed scenes
//! ([`crate::train::start::first_scene`]) use the same checks.
//!
//! Invariant: bad input is an error here, before any file is written.

use crate::base::error::{InputError, InputResult};
use crate::config::file::TrainConfig;
use crate::config::limits;
use crate::dataset::loader::{Dataset, load_dataset};
use crate::dataset::model::PointCloud;
use crate::dataset::read::read_scene;
use crate::exchange::frames::to_local;
use crate::exchange::meta::SceneMeta;
use crate::exchange::ply::{PlyContent, read_ply};
use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::init::{gaussians_from_points, random_points_in_frusta};
use crate::scene::log_scales::LogScaleRange;
use std::path::{Path, PathBuf};

/// A dataset with the Gaussians that training starts from.
pub struct Prepared {
    /// Views and frame.
    pub dataset: Dataset,
    /// First Gaussians in the local frame. SH bands above the current degree may be missing.
    pub columns: Columns,
    /// SH degree of the first step: that of the given Gaussians or of the config, whichever is higher.
    pub sh_degree_start: u8,
}

/// Reads the scene and creates the first Gaussians.
///
/// # Errors
/// The scene or the PLY is invalid.
pub fn prepare(scene: &Path, config: &TrainConfig) -> InputResult<Prepared> {
    let mut raw = read_scene(scene, &limits::read_options(config))?;
    let mut gaussians = None;
    let mut dropped = None;
    let points_file = match (config.init_ply.as_str(), &raw.points_path) {
        ("", path) => path.clone(),
        (path, _) => Some(PathBuf::from(path)),
    };
    if let Some(path) = points_file {
        match read_ply(&path)? {
            PlyContent::Gaussians { columns, meta, .. } => {
                raw.points = PointCloud::default();
                gaussians = Some((columns, meta, path));
            }
            PlyContent::Points { positions, colors, dropped: count } => {
                raw.points = PointCloud { positions, colors };
                dropped = (count > 0).then(|| format!("{}: {count} points are not finite, dropped", path.display()));
            }
        }
    }
    raw.warnings.extend(dropped);
    let mut dataset = load_dataset(raw, &limits::load_options(config))?;
    check_train_views(scene, &dataset)?;
    let mut from = scene.to_path_buf();
    let (columns, sh_degree_start) = match gaussians {
        Some((mut columns, meta, ply)) => {
            from.clone_from(&ply);
            let far = to_local(&mut columns, &meta, dataset.frame.origin.to_array(), dataset.frame.scale);
            let giants = remove_giants(&mut columns, LogScaleRange::of_scene(dataset.scene_scale));
            dataset.warnings.extend(file_warnings(&ply, &meta, far));
            dataset.warnings.extend(giants_warning(&ply, giants));
            let in_use = columns.sh_degree.max(limits::first_sh_degree(config));
            (truncate_sh(columns, config.sh_degree), in_use)
        }
        None => (first_gaussians(scene, &mut dataset, config)?, limits::first_sh_degree(config)),
    };
    check_first_rows(&from, config, columns.rows() as u64)?;
    Ok(Prepared { dataset, columns, sh_degree_start })
}

/// Refuses a dataset without training views.
pub(crate) fn check_train_views(scene: &Path, dataset: &Dataset) -> InputResult<()> {
    if !dataset.train_views().is_empty() {
        return Ok(());
    }
    let problem = "no view is left to train on";
    Err(InputError::new(scene, problem, "hold out fewer photos: see --test-every and --test-after"))
}

/// Refuses a start without Gaussians, or with more than --max-gaussians.
pub(crate) fn check_first_rows(from: &Path, config: &TrainConfig, rows: u64) -> InputResult<()> {
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

fn first_gaussians(scene: &Path, dataset: &mut Dataset, config: &TrainConfig) -> InputResult<Columns> {
    let mut options = limits::init_options(config);
    options.scene_scale = dataset.scene_scale;
    if !dataset.points.is_empty() {
        return Ok(gaussians_from_points(&dataset.points, &dataset.colors, &options));
    }
    if config.init_points == 0 {
        return Err(InputError::new(
            scene,
            "the dataset has no points and --init-points is 0",
            "give points with --init-ply, or let --init-points N draw them in the views' frusta",
        ));
    }
    dataset.warnings.push(format!(
        "the dataset has no points: starting from {} random points in the views' frusta{}",
        config.init_points,
        if config.poor_points { "" } else { "; --poor-points --init-scale 1 suits them" }
    ));
    let cameras: Vec<_> = dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect();
    let count = config.init_points as usize;
    // In aerial and object captures the subject lies within a few camera spreads of the cameras.
    let (near, far) = (0.1 * dataset.scene_scale, 3.0 * dataset.scene_scale);
    let (points, colors) = random_points_in_frusta(&cameras, count, near, far, config.seed);
    Ok(gaussians_from_points(&points, &colors, &options))
}

/// Drops the SH bands above `sh_degree`.
pub(crate) fn truncate_sh(columns: Columns, sh_degree: u8) -> Columns {
    if columns.sh_degree <= sh_degree {
        return columns;
    }
    let (from, to) = (sh_n_width(columns.sh_degree), sh_n_width(sh_degree));
    let sh_n = columns.sh_n.chunks_exact(from).flat_map(|row| &row[..to]).copied().collect();
    Columns { sh_degree, sh_n, ..columns }
}

/// Removes Gaussians that are larger than any of a scene can be; returns how many.
pub(super) fn remove_giants(columns: &mut Columns, range: LogScaleRange) -> u64 {
    columns.retain_rows(|columns, row| columns.row(Column::Scales, row).iter().all(|&s| s <= range.high))
}

/// The warning about `giants` Gaussians that [`remove_giants`] removed, if any.
pub(crate) fn giants_warning(ply: &Path, giants: u64) -> Option<String> {
    let problem = "Gaussians are larger than 10,000 times the spread of the cameras and are dropped";
    (giants > 0).then(|| format!("{}: {giants} {problem}", ply.display()))
}

/// Warnings about Gaussians read from `file`, of which `far` were dropped by the change of frame.
pub fn file_warnings(file: &Path, meta: &SceneMeta, far: u64) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Some(transform) = &meta.transform {
        let transform = transform.file_name().unwrap_or_default().display();
        let file = file.display();
        warnings.push(format!("{file}: it does not say its frame, which is taken from {transform} beside it"));
    }
    if meta.dropped > 0 {
        warnings.push(format!("{}: {} Gaussians are not finite and are dropped", file.display(), meta.dropped));
    }
    if meta.opacities_clamped > 0 {
        let (file, count) = (file.display(), meta.opacities_clamped);
        warnings.push(format!("{file}: {count} opacities are exactly 0 or 1, and are read as 1e-6 or 0.999999"));
    }
    if far > 0 {
        warnings.push(format!("{}: {far} Gaussians are too far from this scene and are dropped", file.display()));
    }
    if meta.antialiased {
        let file = file.display();
        warnings.push(format!("{file}: trained with opacity compensation (antialiased), which is not rendered here"));
    }
    warnings
}
