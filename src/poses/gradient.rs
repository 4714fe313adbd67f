//! The derivative of a loss with respect to the motion of a camera, from the gradients of all rows of its view.
//!
//! With p the mean of a row less the centre of the camera, a shift s of the camera moves p by -s, and a turn w about its
//! centre moves p by p x w and the quaternion q by (0, -w) q / 2. The colour of a row follows the direction of p in the axes of
//! the world, and a turn of the camera does not change that direction. So the part of the gradient of the mean that comes
//! from its colour counts for the shift only.
//!
//! Invariant: sums are fixed-point integers, so the order of the rows, and so threads and batches, change no bit.

use crate::kernels::sh_bwd::direction_vjp;
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use rayon::prelude::*;

/// Fixed-point numbers per unit of gradient: the mean over pixels of a loss makes gradients of rows small.
const PER_UNIT: f64 = (1u64 << 60) as f64;
/// Largest magnitude of what one row adds.
const ROW_MOST: f64 = (1u64 << 30) as f64;
/// Rows of a task.
const ROWS_PER_TASK: usize = 4096;

/// Sums over the rows of a view, fixed-point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MotionSum {
    /// By shift along x, y, z, and by turn about x, y, z.
    sums: [i128; 6],
}

/// The derivative of a loss with respect to a motion of its camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionGradient {
    /// Per local unit.
    pub shift: [f64; 3],
    /// Per radian.
    pub turn: [f64; 3],
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl MotionSum {
    /// Adds rows of a view with their gradients. `sh_degree` is the highest band that is drawn.
    pub fn add(&mut self, rows: &Columns, gradients: &Columns, camera: &Camera, sh_degree: u8) {
        let centre = camera.centre();
        let of_task = |task: usize| {
            let mut sum = MotionSum::default();
            let all = task * ROWS_PER_TASK..((task + 1) * ROWS_PER_TASK).min(rows.rows());
            all.for_each(|row| sum.add_row(rows, gradients, row, (centre, sh_degree)));
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
    fn add_row(&mut self, rows: &Columns, gradients: &Columns, row: usize, (centre, degree): ([f32; 3], u8)) {
        let of = |columns: &[f32]| -> [f64; 3] { std::array::from_fn(|i| f64::from(columns[3 * row + i])) };
        let (mean, v_mean) = (of(&rows.means), of(&gradients.means));
        if v_mean == [0.0; 3] {
            return;
        }
        let p: [f64; 3] = std::array::from_fn(|i| mean[i] - f64::from(centre[i]));
        let by_colour = direction_vjp(degree, rows, gradients, row, centre);
        let v_place: [f64; 3] = std::array::from_fn(|i| v_mean[i] - f64::from(by_colour[i]));
        let quat = |columns: &[f32]| -> [f64; 4] { std::array::from_fn(|i| f64::from(columns[4 * row + i])) };
        let ([w, x, y, z], [vw, vx, vy, vz]) = (quat(&rows.quats), quat(&gradients.quats));
        // (0, e_i) q for the three axes, times the gradient.
        let of_quat = [
            -x * vw + w * vx - z * vy + y * vz,
            -y * vw + z * vx + w * vy - x * vz,
            -z * vw - y * vx + x * vy + w * vz,
        ];
        let of_place = cross(p, v_place);
        let turn: [f64; 3] = std::array::from_fn(|i| -of_place[i] - of_quat[i] / 2.0);
        let all = [-v_mean[0], -v_mean[1], -v_mean[2], turn[0], turn[1], turn[2]];
        if all.iter().all(|x| x.is_finite()) {
            for (sum, x) in self.sums.iter_mut().zip(all) {
                *sum += (x.clamp(-ROW_MOST, ROW_MOST) * PER_UNIT) as i128;
            }
        }
    }

    /// The derivative.
    pub fn gradient(&self) -> MotionGradient {
        let of = |k: usize| self.sums[k] as f64 / PER_UNIT;
        MotionGradient { shift: [of(0), of(1), of(2)], turn: [of(3), of(4), of(5)] }
    }
}
