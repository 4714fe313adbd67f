//! A small rigid motion of a camera.
//!
//! Invariants: 1. arithmetic is f64 without functions of the platform's math library, so the bits are the same everywhere;
//! 2. a motion of zero leaves a camera as it is.

use crate::scene::camera::Camera;
use crate::scene::rotation::Rotation;

/// A motion in the axes of the local frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// By how much the centre of the camera moves, local units.
    pub shift: [f64; 3],
    /// About which axis, and by which angle in radians as its length, the camera turns about its own centre. The angle that
    /// acts is 2 atan(length / 2), which is the length but for a twelfth of its cube.
    pub turn: [f64; 3],
}

impl Motion {
    /// The camera after the motion.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_moves_and_turns_about_its_centre() {
        let camera = Camera {
            viewmat: [[0.0, 1.0, 0.0, 2.0], [0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 4.0]],
            fx: 50.0,
            fy: 60.0,
            cx: 32.0,
            cy: 24.0,
            width: 64,
            height: 48,
            near_plane: 0.1,
            far_plane: 100.0,
        };
        assert_eq!(Motion::default().applied_to(&camera), camera);
        let motion = Motion { shift: [0.25, -0.5, 0.125], turn: [0.0, 0.0, 0.02] };
        let moved = motion.applied_to(&camera);
        let by: [f32; 3] = std::array::from_fn(|i| moved.centre()[i] - camera.centre()[i]);
        assert!(by.iter().zip(motion.shift).all(|(is, due)| (f64::from(*is) - due).abs() < 1e-6), "{by:?}");
        // About the z of the world from x to y: what looked along -x looks along -x, -y.
        let [x, y, z, _] = moved.viewmat[2];
        let angle = f64::from(y).atan2(f64::from(x)) - std::f64::consts::PI;
        assert!((angle.rem_euclid(std::f64::consts::TAU) - 0.02).abs() < 1e-6 && z == 0.0, "{angle}");
    }
}
