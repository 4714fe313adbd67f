//! The direction that is up in a scene, from its cameras and its points.
//!
//! Structure from motion leaves the axes of a scene arbitrary, so up is estimated. Four observations count, in the order
//! of their weight:
//!
//! 1. photos are taken level: the horizontal axis of a picture is horizontal in the world, whether the camera looks ahead or
//!    down;
//! 2. the places of the cameras (a walk, an orbit, a flight) extend less in height than along the ground;
//! 3. so do the points;
//! 4. the top of a picture is up.
//!
//! Each is a matrix. Up is the direction in which their weighted sum is smallest. The second and the third decide where
//! all pictures share one horizontal axis, as in a flight along parallel lines; the fourth where there is nothing else. The
//! sign follows from the cameras: they stand upright, or look down.
//!
//! Not here: turning anything.
//!
//! Invariants: 1. the result is a function of the cameras and the points in their order, in f64; 2. a few bad cameras or
//! points do not move it far: those far from the middle weigh little.

use crate::base::error::InputResult;
use crate::scene::camera::Camera;
use glam::{DMat3, DVec3};

/// Weights of the places of the cameras, the points and the tops of pictures, when that of the level axes is 1. Small,
/// because ground may slope by some degrees and photos are level to one or two; large enough to decide where level axes
/// leave a direction open.
const WEIGHT_CAMERAS: f64 = 0.02;
const WEIGHT_POINTS: f64 = 0.005;
const WEIGHT_TOPS: f64 = 0.001;

/// A result within this angle of an axis of the dataset is that axis: many datasets have exact axes, and arbitrary ones lie
/// this close by chance in one case of 500. Its cosine is that of 2 degrees.
const COS_OF_AXIS: f64 = 0.999_39;

/// Passes of Jacobi's method; it converges in four or five for 3x3.
const JACOBI_PASSES: usize = 16;

/// Positions, weighted less the farther they are: sums of w, w p and w p p^T with w = 1 / (1 + |p|^2)^2. The local
/// frame puts the middle of the cameras at 0, and half of the cameras within 1.
#[derive(Default)]
struct Scatter {
    weight: f64,
    sum: DVec3,
    squares: DMat3,
}

impl Scatter {
    fn add(&mut self, position: [f32; 3]) {
        let p = DVec3::from_array(position.map(f64::from));
        let weight = (1.0 + p.length_squared()).powi(-2);
        if !(weight > 0.0 && p.is_finite()) {
            return;
        }
        self.weight += weight;
        self.sum += weight * p;
        self.squares += outer(p) * weight;
    }

    /// The covariance, divided by its trace; zero where all positions are one.
    fn shape(&self) -> DMat3 {
        if self.weight <= 0.0 {
            return DMat3::ZERO;
        }
        let covariance = self.squares * (1.0 / self.weight) - outer(self.sum / self.weight);
        let trace = covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z;
        // Below this the difference above is rounding.
        if trace > 1e-12 { covariance * (1.0 / trace) } else { DMat3::ZERO }
    }
}

fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// The unit vector that is up, in the axes of the dataset; `None` without cameras. `points` passes the positions of the
/// points, local frame, to its argument.
/// Errors: those of `points`.
pub fn estimate_up<'a>(
    cameras: impl Iterator<Item = &'a Camera>,
    points: impl FnOnce(&mut dyn FnMut([f32; 3])) -> InputResult<()>,
) -> InputResult<Option<[f64; 3]>> {
    let (mut count, mut level, mut tops, mut backs) = (0.0, DMat3::ZERO, DVec3::ZERO, DVec3::ZERO);
    let (mut places, mut ground) = (Scatter::default(), Scatter::default());
    for camera in cameras {
        let axis = |row: usize| {
            let [x, y, z, _] = camera.viewmat[row].map(f64::from);
            DVec3::new(x, y, z)
        };
        level += outer(axis(0));
        tops -= axis(1);
        backs -= axis(2);
        places.add(camera.centre());
        count += 1.0;
    }
    if count == 0.0 {
        return Ok(None);
    }
    points(&mut |position| ground.add(position))?;
    let across_tops = DMat3::IDENTITY - outer(tops / count);
    let observed = places.shape() * WEIGHT_CAMERAS + ground.shape() * WEIGHT_POINTS + across_tops * WEIGHT_TOPS;
    let up = smallest_direction(level * (1.0 / count) + observed);
    // The back of a camera that looks down is up.
    let up = if up.dot(tops + backs) < 0.0 { -up } else { up };
    let mut axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]);
    Ok(Some(axes.find(|axis| axis.dot(up) >= COS_OF_AXIS).unwrap_or(up).to_array()))
}

/// The eigenvector of the smallest eigenvalue of a symmetric matrix, by Jacobi's method (Golub and Van Loan, "Matrix
/// Computations", 8.5).
fn smallest_direction(matrix: DMat3) -> DVec3 {
    let mut a = matrix.to_cols_array_2d();
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..JACOBI_PASSES {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q].abs() < f64::MIN_POSITIVE {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let cos = 1.0 / (t * t + 1.0).sqrt();
            let sin = t * cos;
            for k in 0..3 {
                (a[k][p], a[k][q]) = (cos * a[k][p] - sin * a[k][q], sin * a[k][p] + cos * a[k][q]);
            }
            for k in 0..3 {
                (a[p][k], a[q][k]) = (cos * a[p][k] - sin * a[q][k], sin * a[p][k] + cos * a[q][k]);
            }
            for row in &mut vectors {
                (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
            }
        }
    }
    let least = (1..3).fold(0, |least, i| if a[i][i] < a[least][least] { i } else { least });
    DVec3::from_array([0, 1, 2].map(|row| vectors[row][least])).normalize_or(DVec3::Z)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at `centre` that looks along `forward`, level with respect to `up` and then rolled by `roll` radians. Looking
    /// straight down, the top of the picture points to `north`.
    fn camera(centre: DVec3, forward: DVec3, (up, north): (DVec3, DVec3), roll: f64) -> Camera {
        let forward = forward.normalize();
        let right = forward.cross(if forward.cross(up).length() < 0.1 { north } else { up }).normalize();
        let down = forward.cross(right);
        let (sin, cos) = roll.sin_cos();
        let rows = [right * cos + down * sin, down * cos - right * sin, forward];
        let viewmat = rows.map(|r| [r.x as f32, r.y as f32, r.z as f32, -r.dot(centre) as f32]);
        Camera::pinhole(viewmat, [1.0, 1.0, 0.0, 0.0], [2, 2])
    }

    /// Degrees between the estimate and the truth, with the scene turned so that its up is `up`.
    fn error_of(up: DVec3, build: impl Fn(usize) -> Option<(DVec3, DVec3, f64)>, points: &[DVec3]) -> f64 {
        let turn = glam::DQuat::from_rotation_arc(DVec3::Z, up);
        let views = (0..).map_while(&build);
        let of_view = |(centre, forward, roll)| camera(turn * centre, turn * forward, (up, turn * DVec3::Y), roll);
        let cameras: Vec<Camera> = views.map(of_view).collect();
        let found = estimate_up(cameras.iter(), |take| {
            points.iter().for_each(|&p| take((turn * p).as_vec3().to_array()));
            Ok(())
        });
        DVec3::from_array(found.unwrap().unwrap()).dot(up).clamp(-1.0, 1.0).acos().to_degrees()
    }

    const UPS: [DVec3; 4] = [
        DVec3::new(0.36, -0.48, 0.8),
        DVec3::new(0.0, -1.0, 0.0),
        DVec3::new(-0.6, 0.64, -0.48),
        DVec3::new(0.0, 0.0, 1.0),
    ];

    /// A ground with a slope of 8 degrees, and a few wild points.
    fn ground() -> Vec<DVec3> {
        let at = |i: usize| (f64::from(i as u32 % 30) / 5.0 - 3.0, f64::from(i as u32 / 30) / 5.0 - 3.0);
        let mut points: Vec<DVec3> = (0..900).map(at).map(|(x, y)| DVec3::new(x, y, -1.0 + 0.14 * x)).collect();
        points.extend([DVec3::splat(900.0), DVec3::new(0.0, 0.0, -5000.0)]);
        points
    }

    #[test]
    fn walks_orbits_and_flights_have_their_up() {
        for up in UPS {
            let wobble = |i: usize| 0.03 * (i as f64 * 1.7).sin();
            let orbit = |i: usize| {
                let (sin, cos) = (i as f64 * 0.2).sin_cos();
                (i < 31).then(|| (DVec3::new(cos, sin, 0.5), DVec3::new(-cos, -sin, -0.7), wobble(i)))
            };
            // Photos are level to 1.7 degrees, and 30 of them average that out.
            assert!(error_of(up, orbit, &ground()) < 1.0);
            let street = |i: usize| {
                let (sin, cos) = (0.6 * (i as f64).sin()).sin_cos();
                (i < 40).then(|| {
                    (DVec3::new(i as f64 / 20.0 - 1.0, 0.02 * sin, 0.01 * cos), DVec3::new(cos, sin, 0.1), wobble(i))
                })
            };
            assert!(error_of(up, street, &ground()) < 2.0);
            // Straight down along parallel lines: all pictures share one horizontal axis, and the places and the ground decide.
            let flight = |i: usize| {
                let (x, y) = ((i % 8) as f64 / 4.0 - 1.0, (i / 8) as f64 / 4.0 - 1.0);
                (i < 64).then(|| (DVec3::new(x, y, 0.0), -DVec3::Z, 0.2 * wobble(i)))
            };
            // The slope of the ground of 8 degrees has a fifth of the weight of the level flight.
            assert!(error_of(up, flight, &ground()) < 3.0);
        }
    }

    #[test]
    fn a_wall_is_no_ground_and_without_evidence_nothing_is_made_up() {
        // Photos of a facade from some places along it: the points form an upright plane.
        let wall: Vec<DVec3> =
            (0..400).map(|i| DVec3::new(f64::from(i % 20) / 5.0 - 2.0, 2.0, f64::from(i / 20) / 10.0 - 0.5)).collect();
        let facade = |i: usize| {
            let (sin, cos) = (0.25 * (i as f64 * 2.1).sin()).sin_cos();
            (i < 24).then(|| {
                (DVec3::new(i as f64 / 12.0 - 1.0, 0.1 * sin, 0.02 * cos), DVec3::new(sin, cos, 0.0), 0.01 * sin)
            })
        };
        for up in UPS {
            assert!(error_of(up, facade, &wall) < 2.0);
        }
        assert_eq!(estimate_up([].iter(), |_| Ok(())).unwrap(), None);
        let one = camera(DVec3::ZERO, DVec3::Y, (DVec3::Z, DVec3::Y), 0.0);
        let up = estimate_up([one].iter(), |take| {
            take([f32::NAN; 3]);
            Ok(())
        });
        // One photo: its own top.
        assert_eq!(up.unwrap(), Some([0.0, 0.0, 1.0]));
    }
}
