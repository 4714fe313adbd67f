//! Refined poses of training photos (`--refine-poses`): a small rigid motion of each photo's camera, trained beside the scene.
//!
//! A motion of the camera is the opposite motion of all Gaussians, so it is derived from the gradients of the rows, and no stage
//! of the renderer knows of it. With p the mean of a row less the centre of the camera, a shift s of the camera moves p by -s, and a
//! turn w about its centre moves p by p x w and the quaternion q by (0, -w) q / 2. The colour of a row follows the direction of p in
//! the axes of the world, which a turn does not change. So the part of the gradient of the mean that comes from its colour counts
//! for the shift only.
//!
//! A motion follows Adam at the steps that see its photo, with one second moment for its shift and one for its turn, so that
//! the axes of the scene do not matter. Lengths are shares of the scene's scale, which is about the distance of cameras from what
//! they see, and angles radians: one rate fits both. A scene that moves as a whole, with all of its cameras, gives the same pictures,
//! and held-out photos keep their poses. So what acts on a photo is its motion less the mean over the photos seen.
//!
//! Invariants: 1. motions and sums are fixed-point numbers, so threads, batches and the order of rows change no bit, and sums over
//! photos are exact; 2. arithmetic is f64 without functions of the platform's math library; 3. what acts is within [`MOST`], and no
//! value that is not finite is stored; 4. a camera without a motion keeps its bits.

use super::PhotoOptions;
use super::parameter::{
    Encoded, Finding, Kind, PastViews, PhotoOutcome, PhotoParameter, PhotoStep, ValuesError, views_by_name,
    write_values,
};
use crate::base::error::InputResult;
use crate::dataset::loader::Dataset;
use crate::kernels::project_fwd::View;
use crate::kernels::sh_bwd::direction_vjp;
use crate::page::format::encoding::EncodingError;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use crate::scene::rotation::Rotation;
use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// A motion in the axes of the local frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// By how much the centre of the camera moves, local units.
    pub shift: [f64; 3],
    /// The turn of the camera about its own centre: the direction is the axis, the length the angle in radians. The
    /// angle that acts is 2 atan(length / 2), which is less by about a twelfth of the cube of the length.
    pub turn: [f64; 3],
}

impl Motion {
    pub fn applied_to(&self, camera: &Camera) -> Camera {
        if *self == Motion::default() {
            return *camera;
        }
        let [x, y, z] = self.turn.map(|half| half / 2.0);
        let norm = (1.0 + x * x + y * y + z * z).sqrt();
        let turned = Rotation::from_quaternion([1.0, x, y, z].map(|q| q / norm)).unwrap_or(Rotation::IDENTITY);
        let m = camera.viewmat.map(|row| row.map(f64::from));
        let centre: [f64; 3] =
            std::array::from_fn(|i| self.shift[i] - (m[0][i] * m[0][3] + m[1][i] * m[1][3] + m[2][i] * m[2][3]));
        // A row of the matrix is an axis of the camera in the world.
        let viewmat = m.map(|[x, y, z, _]| {
            let [x, y, z] = turned.apply([x, y, z]);
            [x, y, z, -(x * centre[0] + y * centre[1] + z * centre[2])].map(|x| x as f32)
        });
        Camera { viewmat, ..*camera }
    }
}

/// Fixed-point numbers per unit of gradient: the mean over pixels of a loss makes gradients of rows small.
const SUM_PER_UNIT: f64 = (1u64 << 60) as f64;
/// Largest magnitude of what one row adds.
const ROW_MOST: f64 = (1u64 << 30) as f64;
const ROWS_PER_TASK: usize = 4096;

/// Sums over the rows of a view, fixed-point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MotionSum {
    /// By shift along x, y, z, and by turn about x, y, z.
    sums: [i128; 6],
}

impl MotionSum {
    /// Adds rows of a view with their gradients. `sh_degree` is the highest band that is drawn.
    pub fn add(&mut self, rows: &Columns, gradients: &Columns, camera: &Camera, sh_degree: u8) {
        let view = View::new(camera, 0.0);
        let of_task = |task: usize| {
            let mut sum = MotionSum::default();
            let all = task * ROWS_PER_TASK..((task + 1) * ROWS_PER_TASK).min(rows.rows());
            all.for_each(|row| sum.add_row(rows, gradients, row, (&view, sh_degree)));
            sum
        };
        let tasks = rows.rows().div_ceil(ROWS_PER_TASK);
        let sum = (0..tasks).into_par_iter().map(of_task).reduce(MotionSum::default, MotionSum::and);
        *self = self.and(sum);
    }

    fn and(self, other: MotionSum) -> MotionSum {
        MotionSum { sums: std::array::from_fn(|k| self.sums[k].saturating_add(other.sums[k])) }
    }

    /// Adds a row, unless its gradient is zero, or one of its numbers is not finite.
    fn add_row(&mut self, rows: &Columns, gradients: &Columns, row: usize, (view, degree): (&View, u8)) {
        let of = |columns: &[f32]| -> [f64; 3] { std::array::from_fn(|i| f64::from(columns[3 * row + i])) };
        let (mean, v_mean) = (of(&rows.means), of(&gradients.means));
        if v_mean == [0.0; 3] {
            return;
        }
        let p: [f64; 3] = std::array::from_fn(|i| mean[i] - f64::from(view.centre[i]));
        let by_colour = direction_vjp(degree, rows, gradients, row, view);
        let v_place: [f64; 3] = std::array::from_fn(|i| v_mean[i] - f64::from(by_colour[i]));
        let quat = |columns: &[f32]| -> [f64; 4] { std::array::from_fn(|i| f64::from(columns[4 * row + i])) };
        let ([w, x, y, z], [vw, vx, vy, vz]) = (quat(&rows.quats), quat(&gradients.quats));
        // (0, e_i) q for the three axes, times the gradient.
        let of_quat = [
            -x * vw + w * vx - z * vy + y * vz,
            -y * vw + z * vx + w * vy - x * vz,
            -z * vw - y * vx + x * vy + w * vz,
        ];
        let of_place = DVec3::from(p).cross(v_place.into());
        let turn: [f64; 3] = std::array::from_fn(|i| -of_place[i] - of_quat[i] / 2.0);
        let all = [-v_mean[0], -v_mean[1], -v_mean[2], turn[0], turn[1], turn[2]];
        if all.iter().all(|x| x.is_finite()) {
            for (sum, x) in self.sums.iter_mut().zip(all) {
                *sum += (x.clamp(-ROW_MOST, ROW_MOST) * SUM_PER_UNIT) as i128;
            }
        }
    }

    /// The derivative of a loss with respect to a motion of its camera: by its shift, per local unit, then by its turn, per radian.
    pub fn gradient(&self) -> [f64; 6] {
        self.sums.map(|sum| sum as f64 / SUM_PER_UNIT)
    }
}

/// Fixed-point numbers per unit.
const PER_UNIT: f64 = (1u64 << 40) as f64;
/// Largest stored magnitude, units: far more than acts, since a mean is in it.
const STORED_MOST: f64 = 1.0;
/// Largest shift, as a share of the scene's scale, and largest turn, radians.
pub const MOST: f64 = 0.02;
/// Total length of the steps of a pose at the first rate: the largest motion, and a margin for changes of direction.
const PATH_LENGTH: f64 = 0.032;
/// Largest first rate. With fewer than eight visits, a pose cannot cover [`PATH_LENGTH`].
const RATE_MOST: f64 = 4e-3;
/// The last rate, as a share of the first.
const RATE_LAST: f64 = 0.1;
/// Adam's decay of the gradient and of its square.
const BETAS: [f64; 2] = [0.8, 0.95];
/// Share of a run, and passes over the photos, before poses are refined: an untrained scene gives motions that fit noise.
const BEGIN_SHARE: u32 = 10;
const BEGIN_PASSES: u32 = 2;

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ViewPose {
    /// Shift and turn, fixed-point, with the mean in them.
    values: [i64; 6],
    /// First moments.
    exp_avg: [f64; 6],
    /// Second moments of shift and turn.
    exp_avg_sq: [f64; 2],
    /// Steps that have refined the pose.
    pub sightings: u32,
}

/// All motions; empty for a run that refines no poses.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseState {
    views: Vec<ViewPose>,
    sums: [i64; 6],
    seen: u32,
}

/// The first 0-based step that refines poses, in a run of `steps` steps over `views` training photos.
pub fn first_step(steps: u32, views: usize) -> u32 {
    (steps / BEGIN_SHARE).max(BEGIN_PASSES.saturating_mul(views as u32))
}

/// The length of a step of a pose at 0-based `step`: the fewer visits a photo has in a run, the longer is each step.
pub fn rate_at(step: u32, steps: u32, views: usize) -> f64 {
    let left = steps.saturating_sub(first_step(steps, views)).max(1);
    let first = (PATH_LENGTH * views as f64 / f64::from(left)).min(RATE_MOST);
    let progress = f64::from(step) / f64::from(steps.max(1));
    first * (1.0 + (RATE_LAST - 1.0) * progress.min(1.0))
}

fn length(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Shift and turn, each shortened to [`MOST`].
fn bounded(values: [f64; 6]) -> [f64; 6] {
    let [shift, turn] = [0, 3].map(|at| MOST / length(&values[at..at + 3]).max(MOST));
    std::array::from_fn(|k| values[k] * if k < 3 { shift } else { turn })
}

impl PoseState {
    /// The motions of a run that has seen nothing: none.
    pub fn new(views: usize) -> PoseState {
        PoseState::of_views(vec![ViewPose::default(); views])
    }

    fn of_views(views: Vec<ViewPose>) -> PoseState {
        let seen = || views.iter().filter(|pose| pose.sightings > 0);
        let sums = std::array::from_fn(|k| seen().map(|pose| pose.values[k]).sum());
        PoseState { sums, seen: seen().count() as u32, views }
    }

    fn acting(&self, view: usize) -> [f64; 6] {
        let Some(pose) = self.views.get(view).filter(|pose| pose.sightings > 0) else { return [0.0; 6] };
        let of = |k: usize| (pose.values[k] as f64 - self.sums[k] as f64 / f64::from(self.seen.max(1))) / PER_UNIT;
        bounded(std::array::from_fn(of))
    }

    /// What acts on the camera of a view, in a scene of this scale (local units): its motion less the mean.
    pub fn motion(&self, view: usize, scene_scale: f32) -> Motion {
        let [x, y, z, a, b, c] = self.acting(view);
        Motion { shift: [x, y, z].map(|share| share * f64::from(scene_scale)), turn: [a, b, c] }
    }

    /// Moves a pose against its gradient ([`MotionSum::gradient`]), by about `rate` ([`rate_at`]).
    pub fn learn(&mut self, view: usize, gradient: &[f64; 6], scene_scale: f32, rate: f64) {
        let (acting, seen, sums) = (self.acting(view), f64::from(self.seen.max(1)), self.sums);
        let Some(pose) = self.views.get_mut(view) else { return };
        let scale = f64::from(scene_scale);
        let gradient: [f64; 6] = std::array::from_fn(|k| if k < 3 { gradient[k] * scale } else { gradient[k] });
        let squares = [0, 3].map(|at| gradient[at..at + 3].iter().map(|x| x * x).sum::<f64>());
        if !squares.iter().all(|x| x.is_finite()) {
            return;
        }
        let is_new = pose.sightings == 0;
        pose.sightings = pose.sightings.saturating_add(1);
        let [unbiased, unbiased_sq] = BETAS.map(|beta| 1.0 - libm::pow(beta, f64::from(pose.sightings)));
        for (mean, square) in pose.exp_avg_sq.iter_mut().zip(squares) {
            *mean = BETAS[1] * *mean + (1.0 - BETAS[1]) * square;
        }
        let mut next = acting;
        for k in 0..6 {
            pose.exp_avg[k] = BETAS[0] * pose.exp_avg[k] + (1.0 - BETAS[0]) * gradient[k];
            let size = (pose.exp_avg_sq[k / 3] / unbiased_sq).sqrt();
            if size > 0.0 {
                next[k] -= rate * pose.exp_avg[k] / unbiased / size;
            }
        }
        for (k, next) in bounded(next).into_iter().enumerate() {
            let next = (sums[k] as f64 / seen + next * PER_UNIT).clamp(-STORED_MOST * PER_UNIT, STORED_MOST * PER_UNIT);
            let next = next.round() as i64;
            self.sums[k] += next - if is_new { 0 } else { pose.values[k] };
            pose.values[k] = next;
        }
        self.seen += u32::from(is_new);
    }

    /// Checks values from a file. Errors: names what no run can have written.
    pub fn check(&self) -> Result<(), &'static str> {
        let is_stored = |pose: &ViewPose| pose.values.iter().all(|x| x.unsigned_abs() as f64 <= STORED_MOST * PER_UNIT);
        if !self.views.iter().all(is_stored) {
            return Err("the motion of a photo is out of bounds");
        }
        let PoseState { sums, seen, .. } = PoseState::of_views(self.views.clone());
        if (self.sums, self.seen) != (sums, seen) {
            return Err("the sums of its motions are not those of its photos");
        }
        let is_moment = |pose: &ViewPose| {
            let is_square = |x: &f64| x.is_finite() && *x >= 0.0;
            pose.exp_avg.iter().all(|x| x.is_finite()) && pose.exp_avg_sq.iter().all(is_square)
        };
        if self.views.iter().all(is_moment) { Ok(()) } else { Err("a moment of the motion of a photo is invalid") }
    }
}

/// The poses of training photos as the run leaves them.
pub const FILE: &str = "poses.json";

pub(super) const KIND: Kind = Kind { name: "poses", file: Some(FILE), first, check, finding };

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

/// What to say of a run that ends before it refines poses.
fn warning_of_no_refinement(steps: u32, views: usize) -> Option<String> {
    let first = first_step(steps, views);
    (first >= steps).then(|| {
        format!(
            "--refine-poses refines no pose in a run of {steps} steps: it begins after a tenth of the run and two passes over the \
             {views} training photos, at step {first}"
        )
    })
}

impl PhotoParameter for Poses {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded, past: &PastViews) -> Result<(), ValuesError> {
        self.state = PoseState::of_views(past.of(&saved.decoded(PoseState::check)?.views));
        Ok(())
    }

    fn start(&mut self, _: &Dataset) -> Vec<String> {
        warning_of_no_refinement(self.steps, self.train_views).into_iter().collect()
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
            shift: MotionSpread::of(seen().map(|image| image.shift)),
            turn_degrees: MotionSpread::of(seen().map(|image| image.turn_degrees)),
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
            sightings: self.state.views[view].sightings,
        }
    }
}

/// The file. Lengths and axes are those of the dataset.
#[derive(Debug, Serialize)]
struct PosesFile {
    /// Training photos whose pose was refined.
    refined: usize,
    /// How far their cameras stand from where the dataset says.
    shift: MotionSpread,
    /// By how much they look elsewhere, degrees.
    turn_degrees: MotionSpread,
    /// Scale of the scene, of which a shift may be 2 %.
    scene_scale: f64,
    /// The training photos, in the order of their names.
    images: Vec<RefinedPose>,
}

#[derive(Debug, Default, Serialize)]
struct MotionSpread {
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

impl MotionSpread {
    fn of(values: impl Iterator<Item = f64>) -> MotionSpread {
        let mut values: Vec<f64> = values.collect();
        values.sort_unstable_by(f64::total_cmp);
        let at = |i: usize| values.get(i).copied().unwrap_or_default();
        MotionSpread { median: at(values.len() / 2), largest: at(values.len().saturating_sub(1)) }
    }
}

/// How far the run has moved the cameras of its photos, if it refines poses.
fn finding(file: &Value, _: &Value) -> Option<Finding> {
    let of = |what: &str, which: &str| file[what][which].as_f64();
    let scale = file["scene_scale"].as_f64()?;
    let [turn, most] = ["median", "largest"].map(|which| of("turn_degrees", which).unwrap_or_default());
    let text = format!(
        "The run has refined the poses of {} training photos (--refine-poses): against the dataset their cameras moved by {:.2} % \
         of the scene's scale (median; {:.2} % at most) and turned by {turn:.2} degrees ({most:.2} at most). poses.json has the \
         refined poses.",
        file["refined"],
        100.0 * of("shift", "median")? / scale,
        100.0 * of("shift", "largest")? / scale,
    );
    Some(Finding { title: "Poses", text, ..Finding::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 1e-3;

    fn along_x(x: f64) -> [f64; 6] {
        [x, 0.0, 0.0, 0.0, 0.0, 0.0]
    }

    #[test]
    fn what_acts_is_the_motion_less_the_mean_of_what_was_seen() {
        let mut state = PoseState::new(3);
        state.learn(0, &along_x(-1.0), 2.0, RATE);
        assert_eq!(state.motion(0, 2.0), Motion::default(), "one photo alone is its own mean");
        state.learn(1, &along_x(1e-9), 2.0, RATE);
        // The first step has the length of the rate whatever the gradient is: one photo to the left, one to the right.
        let [first, second, third] = [0, 1, 2].map(|view| state.motion(view, 2.0).shift[0]);
        assert!((first - RATE).abs() < 1e-9 && (second + RATE).abs() < 1e-9 && third == 0.0, "{first} {second}");
        assert_eq!(state.check(), Ok(()));
        state.sums[0] += 1;
        assert!(state.check().is_err());
    }

    #[test]
    fn a_run_that_ends_before_its_poses_are_refined_says_so() {
        let said = warning_of_no_refinement(104, 52).unwrap();
        assert!(said.contains("52 training photos, at step 104") && warning_of_no_refinement(105, 52).is_none());
    }

    #[test]
    fn motions_stay_within_bounds_and_nothing_that_is_not_finite_is_stored() {
        let mut state = PoseState::new(2);
        for _ in 0..1000 {
            state.learn(0, &along_x(4.0), 1.0, RATE);
            state.learn(1, &along_x(-4.0), 1.0, RATE);
            state.learn(1, &along_x(f64::NAN), 1.0, RATE);
        }
        assert_eq!(state.check(), Ok(()));
        let moved = state.motion(0, 1.0).shift[0];
        assert!((moved + MOST).abs() < 1e-6, "{moved}");
        let mut lost = state.clone();
        lost.views[0].exp_avg[2] = f64::INFINITY;
        assert!(lost.check().is_err());
        lost.views[0].values[0] = i64::MIN;
        assert!(lost.check().is_err());
    }

    #[test]
    fn few_visits_make_long_steps_and_rates_fall() {
        // 28 photos in 1,500 steps, and 150 in 30,000.
        assert!((rate_at(150, 1500, 28) / 6.0e-4 - 1.0).abs() < 0.05, "{}", rate_at(150, 1500, 28));
        assert!(rate_at(3000, 30_000, 150) < 2e-4 && rate_at(40, 60, 30) <= RATE_MOST);
        assert!((rate_at(1500, 1500, 28) / rate_at(0, 1500, 28) - RATE_LAST).abs() < 1e-9);
    }
}
