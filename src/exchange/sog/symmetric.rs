//! Symmetric 3x3 matrices: covariances.
//!
//! Invariant: all arithmetic is f64 in a fixed order.

use crate::scene::rotation::{Rotation, quaternion_product};

/// Sweeps of Jacobi's method; each squares the error.
const SWEEPS: usize = 8;

/// The entries xx, xy, xz, yy, yz, zz.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Symmetric([f64; 6]);

impl Symmetric {
    /// R diag(values) R^T with the rotation of a quaternion of about unit length, w first.
    pub fn turned(q: [f64; 4], values: [f64; 3]) -> Symmetric {
        let length = libm::sqrt(q.iter().map(|v| v * v).sum());
        let r = Rotation::from_quaternion(q.map(|v| v / length)).unwrap_or(Rotation::IDENTITY).matrix();
        let at = |i: usize, j: usize| (0..3).map(|k| r[i][k] * values[k] * r[j][k]).sum();
        Symmetric([at(0, 0), at(0, 1), at(0, 2), at(1, 1), at(1, 2), at(2, 2)])
    }

    /// This matrix plus `value` times the identity.
    #[must_use]
    pub fn plus(&self, value: f64) -> Symmetric {
        let [a, b, c, d, e, f] = self.0;
        Symmetric([a + value, b, c, d + value, e, f + value])
    }

    /// `share` times this matrix plus (1 - `share`) times `other`.
    #[must_use]
    pub fn mixed(&self, other: &Symmetric, share: f64) -> Symmetric {
        Symmetric(std::array::from_fn(|i| share * self.0[i] + (1.0 - share) * other.0[i]))
    }

    /// This matrix plus `factor` times v v^T.
    #[must_use]
    pub fn with_offset(&self, [x, y, z]: [f64; 3], factor: f64) -> Symmetric {
        let outer = [x * x, x * y, x * z, y * y, y * z, z * z];
        Symmetric(std::array::from_fn(|i| self.0[i] + factor * outer[i]))
    }

    pub fn diagonal(&self) -> [f64; 3] {
        [self.0[0], self.0[3], self.0[5]]
    }

    /// Logarithm of the determinant of a positive matrix.
    pub fn log_det(&self) -> f64 {
        let [a, b, c, d, e, f] = self.0;
        let det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d);
        libm::log(det.max(f64::MIN_POSITIVE))
    }

    /// Eigenvalues, and the rotation (unit quaternion, w first) whose columns are their vectors.
    pub fn axes(&self) -> ([f64; 3], [f64; 4]) {
        let [a, b, c, d, e, f] = self.0;
        let mut m = [[a, b, c], [b, d, e], [c, e, f]];
        let mut q = [1.0, 0.0, 0.0, 0.0];
        for _ in 0..SWEEPS {
            for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
                if m[i][j] == 0.0 {
                    continue;
                }
                // The angle that makes m[i][j] zero: tan(2 angle) = 2 m_ij / (m_ii - m_jj).
                let theta = (m[j][j] - m[i][i]) / (2.0 * m[i][j]);
                let sign = if theta < 0.0 { -1.0 } else { 1.0 };
                let tan = sign / (theta.abs() + libm::sqrt(theta * theta + 1.0));
                let cos = 1.0 / libm::sqrt(tan * tan + 1.0);
                let sin = tan * cos;
                let (ii, jj, ij) = (m[i][i], m[j][j], m[i][j]);
                m[i][i] = ii - tan * ij;
                m[j][j] = jj + tan * ij;
                let (ik, jk) = (cos * m[i][k] - sin * m[j][k], sin * m[i][k] + cos * m[j][k]);
                (m[i][j], m[j][i]) = (0.0, 0.0);
                (m[i][k], m[k][i], m[j][k], m[k][j]) = (ik, ik, jk, jk);
                q = about(q, k, cos, sin);
            }
        }
        ([m[0][0], m[1][1], m[2][2]], q)
    }
}

/// The quaternion followed by a turn about its own axis `k` by the angle of this negative sine.
fn about(q: [f64; 4], k: usize, cos: f64, sin: f64) -> [f64; 4] {
    // Half of the angle; |angle| is at most a quarter of pi.
    let half_cos = libm::sqrt((1.0 + cos) / 2.0);
    let half_sin = -sin / (2.0 * half_cos);
    let mut turn = [half_cos, 0.0, 0.0, 0.0];
    turn[1 + k] = half_sin;
    let product = quaternion_product(q, turn);
    let length = libm::sqrt(product.iter().map(|v| v * v).sum());
    product.map(|v| v / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::mix64;

    #[test]
    fn axes_give_the_matrix_back() {
        let random = |i: u64| (mix64(i) >> 11) as f64 / (1u64 << 52) as f64 - 1.0;
        for n in 0..500 {
            let q: [f64; 4] = std::array::from_fn(|i| random(7 * n + i as u64));
            let values = [4, 5, 6].map(|i| libm::exp(8.0 * random(7 * n + i)));
            let values = if n % 5 == 0 { [values[0], values[0], values[1]] } else { values };
            let matrix = Symmetric::turned(q, values);
            let (found, q) = matrix.axes();
            let again = Symmetric::turned(q, found);
            let largest = values.iter().fold(0.0f64, |a, &b| a.max(b));
            let off = matrix.0.iter().zip(again.0).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-13 * largest, "{off} of {largest}");
            let det: f64 = values.iter().product();
            assert!((matrix.log_det() - libm::log(det)).abs() < 1e-5, "{values:?}");
        }
    }
}
