//! Poses: a small rigid motion of the camera of each training photo, trained beside the scene (`--refine-poses`).
//!
//! A motion of the camera is the opposite motion of all Gaussians. So the gradients of the rows, which a step has anyway,
//! give that of the motion ([`gradient`]), and no stage of the renderer knows of it. Rates and bounds are shares of the
//! scene's scale ([`state`]).
//!
//! Scene and poses share a freedom: a scene that moves as a whole, with all of its cameras, gives the same pictures. Held-out
//! photos keep their poses, so what acts on a photo is its motion less the mean over the photos seen.
//!
//! Invariants: 1. the bits are the same for any number of threads, and for any cut of a view into batches; 2. no value that
//! is not finite or out of bounds is stored; 3. a camera without a motion keeps its bits.
//!

pub mod gradient;
pub mod motion;
pub mod state;

use self::gradient::MotionSum;
use self::state::{PoseState, first_step, rate_at};
use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter, PhotoStep, views_by_name, write_values};
use super::saved::{Encoded, ValuesError};
use crate::base::error::InputResult;
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use glam::DVec3;
use serde::Serialize;
use std::path::Path;

/// The poses of training photos as the run leaves them.
const FILE: &str = "poses.json";

pub(super) const KIND: Kind = Kind { name: "poses", file: Some(FILE), first, check };

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
