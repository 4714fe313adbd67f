//! poses.json: the refined poses of the training photos, as plain numbers for people and other programs.
//!
//! Not here: how poses are refined ([`crate::poses`]).

use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::dataset::loader::Dataset;
use crate::train::state::trainer::Trainer;
use glam::DVec3;
use serde::Serialize;
use std::path::Path;

/// The file. Lengths and axes are those of the dataset.
#[derive(Debug, Serialize)]
struct PosesFile {
    /// Training photos whose pose was refined.
    refined: usize,
    /// How far their cameras stand from where the dataset says.
    shift: Spread,
    /// By how much they look elsewhere, degrees.
    turn_degrees: Spread,
    /// Scale of the scene, of which a shift may be 2 %.
    scene_scale: f64,
    /// The training photos, in the order of their names.
    images: Vec<RefinedPose>,
}

#[derive(Debug, Default, Serialize)]
struct Spread {
    median: f64,
    largest: f64,
}

#[derive(Debug, Serialize)]
struct RefinedPose {
    name: String,
    /// Position of the camera.
    centre: [f64; 3],
    /// World to camera, row-major, OpenCV axes: `p_cam = rotation (p - centre)`.
    rotation: [[f64; 3]; 3],
    /// Distance from the position in the dataset.
    shift: f64,
    /// Angle from the direction in the dataset, degrees.
    turn_degrees: f64,
    /// Steps that have refined the pose.
    sightings: u32,
}

impl Spread {
    fn of(values: impl Iterator<Item = f64>) -> Spread {
        let mut values: Vec<f64> = values.collect();
        values.sort_unstable_by(f64::total_cmp);
        let at = |i: usize| values.get(i).copied().unwrap_or_default();
        Spread { median: at(values.len() / 2), largest: at(values.len().saturating_sub(1)) }
    }
}

/// Writes the poses as steps see them; nothing for a run that refines none.
///
/// # Errors
/// The folder cannot be written.
pub(super) fn write_poses(path: &Path, dataset: &Dataset, trainer: &Trainer) -> InputResult<()> {
    if !trainer.options().refine_poses {
        return Ok(());
    }
    let mut views = dataset.train_views();
    views.sort_by(|&a, &b| dataset.views[a].name.cmp(&dataset.views[b].name));
    let images: Vec<RefinedPose> = views.into_iter().map(|view| refined(dataset, trainer, view)).collect();
    let seen = || images.iter().filter(|image| image.sightings > 0);
    let file = PosesFile {
        refined: seen().count(),
        shift: Spread::of(seen().map(|image| image.shift)),
        turn_degrees: Spread::of(seen().map(|image| image.turn_degrees)),
        scene_scale: f64::from(dataset.scene_scale) * dataset.frame.scale,
        images,
    };
    let text = serde_json::to_string_pretty(&file).map_err(|e| InputError::io(path, "writing", &e.into()))?;
    write_whole(path, (text + "\n").as_bytes())
}

fn refined(dataset: &Dataset, trainer: &Trainer, view: usize) -> RefinedPose {
    let camera = trainer.camera(dataset, view);
    let motion = trainer.poses().motion(view, dataset.scene_scale);
    let length = |v: [f64; 3]| DVec3::from(v).length();
    RefinedPose {
        name: dataset.views[view].name.clone(),
        centre: dataset.frame.to_world(DVec3::from(camera.centre().map(f64::from))).to_array(),
        rotation: camera.viewmat.map(|[x, y, z, _]| [x, y, z].map(f64::from)),
        shift: length(motion.shift) * dataset.frame.scale,
        turn_degrees: length(motion.turn).to_degrees(),
        sightings: trainer.poses().sightings(view),
    }
}
