//! The motions of all photos of a run: what a commit holds of poses.
//!
//! A motion follows Adam at the steps that see its photo, with one second moment for its shift and one for its turn, so that
//! the axes of the scene do not matter. Lengths are shares of the scene's scale, angles radians; the scene's scale is about
//! the distance of cameras from what they see, so one rate fits both.
//!
//! Motions are fixed-point numbers, and their sums over the photos seen are kept beside them, so that the mean is known at
//! every step without a sweep and has the same bits whatever the order.
//!
//! Invariants: 1. the sums are exactly those of the motions of the photos seen; 2. what acts is within [`MOST`]; 3. a gradient
//! that is not finite changes nothing.

use super::gradient::MotionGradient;
use super::motion::Motion;
use serde::{Deserialize, Serialize};

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

/// The motion of a photo.
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
    /// By view of the dataset.
    views: Vec<ViewPose>,
    /// Sums of the motions of the photos seen.
    sums: [i64; 6],
    /// Photos seen.
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
        PoseState { views: vec![ViewPose::default(); views], ..PoseState::default() }
    }

    /// Whether the motions are of as many photos as `other`.
    pub fn has_same_counts(&self, other: &PoseState) -> bool {
        self.views.len() == other.views.len()
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

    /// Steps that have refined the pose of a view.
    pub fn sightings(&self, view: usize) -> u32 {
        self.views.get(view).map_or(0, |pose| pose.sightings)
    }

    /// Moves a pose against its gradient, by about `rate` ([`rate_at`]).
    pub fn learn(&mut self, view: usize, gradient: &MotionGradient, scene_scale: f32, rate: f64) {
        let (acting, seen, sums) = (self.acting(view), f64::from(self.seen.max(1)), self.sums);
        let Some(pose) = self.views.get_mut(view) else { return };
        let MotionGradient { shift, turn } = gradient;
        let scale = f64::from(scene_scale);
        let gradient: [f64; 6] = std::array::from_fn(|k| if k < 3 { shift[k] * scale } else { turn[k - 3] });
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

    /// Checks values from a file.
    ///
    /// # Errors
    /// Names what no run can have written.
    pub fn check(&self) -> Result<(), &'static str> {
        let is_stored = |pose: &ViewPose| pose.values.iter().all(|x| x.unsigned_abs() as f64 <= STORED_MOST * PER_UNIT);
        if !self.views.iter().all(is_stored) {
            return Err("the motion of a photo is out of bounds");
        }
        let seen = || self.views.iter().filter(|pose| pose.sightings > 0);
        let sums: [i64; 6] = std::array::from_fn(|k| seen().map(|pose| pose.values[k]).sum());
        if self.sums != sums || self.seen as usize != seen().count() {
            return Err("the sums of its motions are not those of its photos");
        }
        let is_moment = |pose: &ViewPose| {
            let is_square = |x: &f64| x.is_finite() && *x >= 0.0;
            pose.exp_avg.iter().all(|x| x.is_finite()) && pose.exp_avg_sq.iter().all(is_square)
        };
        if self.views.iter().all(is_moment) { Ok(()) } else { Err("a moment of the motion of a photo is invalid") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 1e-3;

    fn along_x(x: f64) -> MotionGradient {
        MotionGradient { shift: [x, 0.0, 0.0], turn: [0.0; 3] }
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
