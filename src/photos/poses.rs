//! Refined poses of training photos (`--refine-poses`): [`crate::poses`] in the steps of a run.
//!
//! Not here: how a motion is derived and learnt.

use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter, PhotoStep, views_by_name, write_values};
use super::saved::{Encoded, ValuesError};
use crate::base::error::InputResult;
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::poses::gradient::MotionSum;
use crate::poses::state::{PoseState, first_step, rate_at};
use crate::report::html::Page;
use crate::report::run_report::read_json;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use glam::DVec3;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// The poses of training photos as the run leaves them.
const FILE: &str = "poses.json";

pub(super) const KIND: Kind = Kind { name: "poses", file: Some(FILE), first, check, section };

struct Poses {
    state: PoseState,
    steps: u32,
    train_views: usize,
    scene_scale: f32,
    /// The derivative of the loss with respect to the motion of the camera, where the step is to find it.
    sum: Option<MotionSum>,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    options.refine_poses.then(|| -> Box<dyn PhotoParameter> {
        Box::new(Poses {
            state: PoseState::new(dataset.views.len()),
            steps: options.steps,
            train_views: dataset.train_views().len(),
            scene_scale: options.scene_scale,
            sum: None,
        })
    })
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    saved.decoded(PoseState::check).map(drop)
}

impl PhotoParameter for Poses {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded) -> Result<(), ValuesError> {
        saved.restore(&mut self.state, PoseState::check, PoseState::has_same_counts)
    }

    fn camera(&self, view: usize, camera: Camera) -> Camera {
        self.state.motion(view, self.scene_scale).applied_to(&camera)
    }

    fn begin_step(&mut self, step: &PhotoStep<'_>) {
        let is_begun = step.step >= first_step(self.steps, self.train_views);
        self.sum = (is_begun && !step.is_left_out && !step.is_rehearsal).then(MotionSum::default);
    }

    fn row_gradients(&mut self, rows: &Columns, gradients: &Columns, camera: &Camera, sh_degree: u8) {
        if let Some(sum) = &mut self.sum {
            sum.add(rows, gradients, camera, sh_degree);
        }
    }

    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        if let (Some(sum), true) = (self.sum.take(), outcome.has_trained()) {
            let rate = rate_at(outcome.step, self.steps, self.train_views);
            self.state.learn(outcome.view, &sum.gradient(), self.scene_scale, rate);
        }
        Vec::new()
    }

    fn write_file(&self, folder: &Path, dataset: &Dataset) -> InputResult<()> {
        let images: Vec<RefinedPose> =
            views_by_name(dataset).into_iter().map(|view| self.refined(dataset, view)).collect();
        let seen = || images.iter().filter(|image| image.sightings > 0);
        let file = PosesFile {
            refined: seen().count(),
            shift: Spread::of(seen().map(|image| image.shift)),
            turn_degrees: Spread::of(seen().map(|image| image.turn_degrees)),
            scene_scale: f64::from(dataset.scene_scale) * dataset.frame.scale,
            images,
        };
        write_values(&folder.join(FILE), &file)
    }
}

impl Poses {
    fn refined(&self, dataset: &Dataset, view: usize) -> RefinedPose {
        let camera = self.camera(view, dataset.views[view].camera);
        let motion = self.state.motion(view, self.scene_scale);
        let length = |v: [f64; 3]| DVec3::from(v).length();
        RefinedPose {
            name: dataset.views[view].name.clone(),
            centre: dataset.frame.to_world(DVec3::from(camera.centre().map(f64::from))).to_array(),
            rotation: camera.viewmat.map(|[x, y, z, _]| [x, y, z].map(f64::from)),
            shift: length(motion.shift) * dataset.frame.scale,
            turn_degrees: length(motion.turn).to_degrees(),
            sightings: self.state.sightings(view),
        }
    }
}

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

/// How far the run has moved the cameras of its photos, if it refines poses.
fn section(page: &mut Page, folder: &Path, _: &Value) {
    let file = read_json(&folder.join(FILE)).unwrap_or(Value::Null);
    let of = |what: &str, which: &str| file[what][which].as_f64();
    let (Some(median), Some(largest), Some(scale)) =
        (of("shift", "median"), of("shift", "largest"), file["scene_scale"].as_f64())
    else {
        return;
    };
    let [turn, most] = ["median", "largest"].map(|which| of("turn_degrees", which).unwrap_or_default());
    page.heading("Poses");
    page.paragraph(&format!(
        "The run has refined the poses of {} training photos (--refine-poses): against the dataset their cameras moved by {:.2} % \
         of the scene's scale (median; {:.2} % at most) and turned by {turn:.2} degrees ({most:.2} at most). poses.json has the \
         refined poses.",
        file["refined"],
        100.0 * median / scale,
        100.0 * largest / scale,
    ));
}
