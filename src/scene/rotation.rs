//! Rotations of Gaussians: means, quaternions and spherical harmonics (SH) into turned axes.
//!
//! Not here: which way is up (`dataset`), when a scene is turned (`exchange`).
//!
//! Invariants: 1. all arithmetic is f64 in a fixed order, without functions of the platform's math library, so results
//! have the same bits everywhere; 2. [`Rotation::IDENTITY`] leaves positions and quaternions unchanged, bit for bit.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// The direction that splat viewers show as up: they take the axes of a camera, whose y points down.
pub const VIEWER_UP: [f64; 3] = [0.0, -1.0, 0.0];

/// Largest deviation of the squared length of a quaternion from 1 that counts as rounding of the file that holds it.
const UNIT_TOLERANCE: f64 = 1e-9;

/// A rotation: a unit quaternion, w first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rotation([f64; 4]);

impl Rotation {
    pub const IDENTITY: Rotation = Rotation([1.0, 0.0, 0.0, 0.0]);

    /// Half a turn about x: y and z change their signs.
    pub const HALF_TURN_ABOUT_X: Rotation = Rotation([0.0, 1.0, 0.0, 0.0]);

    /// The rotation of a quaternion (w, x, y, z); `None` unless its length is 1.
    pub fn from_quaternion(q: [f64; 4]) -> Option<Rotation> {
        let is_unit = (q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() <= UNIT_TOLERANCE;
        is_unit.then_some(Rotation(q))
    }

    /// The smallest rotation that turns `up` to [`VIEWER_UP`]; `None` if `up` is zero or not finite.
    ///
    /// The quaternion of the smallest rotation from a to b is (1 + a.b, a x b) at unit length. Opposite directions have
    /// no smallest rotation: half a turn about x is taken.
    pub fn upright(up: [f64; 3]) -> Option<Rotation> {
        // Divided by the largest first, so that squares neither overflow nor vanish.
        let largest = up.iter().fold(0.0f64, |most, x| most.max(x.abs()));
        if !up.iter().all(|x| x.is_finite()) || largest == 0.0 {
            return None;
        }
        let up = up.map(|x| x / largest);
        let length = dot(up, up).sqrt();
        let [x, y, z] = up.map(|x| x / length);
        // a x (0, -1, 0) = (z, 0, -x).
        // 1 - y, without the digits that the difference loses where up is nearly +y.
        let w = if y > 0.0 { (x * x + z * z) / (1.0 + y) } else { 1.0 - y };
        let q = [w, z, 0.0, -x];
        let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm < 1e-9 {
            return Some(Rotation::HALF_TURN_ABOUT_X);
        }
        // Written so that no -0 appears.
        Some(Rotation(q.map(|x| x / norm + 0.0)))
    }

    pub fn quaternion(&self) -> [f64; 4] {
        self.0
    }

    #[must_use]
    pub fn inverse(&self) -> Rotation {
        let [w, x, y, z] = self.0;
        Rotation([w, -x, -y, -z])
    }

    /// This rotation after `first`.
    #[must_use]
    pub fn after(&self, first: &Rotation) -> Rotation {
        Rotation(quaternion_product(self.0, first.0))
    }

    /// The matrix, row-major.
    pub fn matrix(&self) -> [[f64; 3]; 3] {
        let [w, x, y, z] = self.0;
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    }

    pub fn apply(&self, v: [f64; 3]) -> [f64; 3] {
        self.matrix().map(|row| dot(row, v))
    }
}

/// The product of two quaternions, w first.
pub fn quaternion_product([w, x, y, z]: [f64; 4], [a, b, c, d]: [f64; 4]) -> [f64; 4] {
    [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// A [`Rotation`] with its matrices, for many Gaussians.
#[derive(Debug, Clone)]
pub struct GaussianRotation {
    rotation: Rotation,
    matrix: [[f64; 3]; 3],
    /// Row-major matrices of bands 1, 2 and 3, with 3, 5 and 7 rows.
    bands: [Vec<f64>; 3],
}

impl GaussianRotation {
    pub fn new(rotation: Rotation) -> Self {
        GaussianRotation {
            rotation,
            matrix: rotation.matrix(),
            bands: [1, 2, 3].map(|band| band_matrix(band, rotation)),
        }
    }

    pub fn is_identity(&self) -> bool {
        self.rotation == Rotation::IDENTITY
    }

    pub fn position(&self, v: [f64; 3]) -> [f64; 3] {
        if self.is_identity() { v } else { self.matrix.map(|row| dot(row, v)) }
    }

    /// A turned orientation (w first), of the same length but for rounding.
    pub fn orientation(&self, q: [f32; 4]) -> [f32; 4] {
        if self.is_identity() { q } else { self.rotation.after(&Rotation(q.map(f64::from))).0.map(|x| x as f32) }
    }

    /// Turns the SH coefficients of bands 1 and above, `[coefficient][channel]`: 0, 9, 24 or 45 values.
    pub fn harmonics(&self, sh_n: &mut [f32]) {
        if self.is_identity() {
            return;
        }
        let mut rest = sh_n;
        for (band, matrix) in (1..).zip(&self.bands) {
            let size = 2 * band + 1;
            if rest.len() < 3 * size {
                return;
            }
            let (coefficients, higher) = rest.split_at_mut(3 * size);
            let mut before = [0.0f64; 3 * 7];
            before.iter_mut().zip(&*coefficients).for_each(|(to, &from)| *to = f64::from(from));
            for (row, turned) in matrix.chunks_exact(size).zip(coefficients.chunks_exact_mut(3)) {
                for (channel, value) in turned.iter_mut().enumerate() {
                    *value = row.iter().enumerate().map(|(k, m)| m * before[3 * k + channel]).sum::<f64>() as f32;
                }
            }
            rest = higher;
        }
    }
}

/// Nodes and weights of the Gauss-Legendre rule with 4 nodes, exact for polynomials of degree 7 (Abramowitz and Stegun,
/// table 25.4).
const LEGENDRE: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];

/// Eight directions on the unit circle, which sum trigonometric polynomials of degree 7 exactly.
const CIRCLE: [[f64; 2]; 8] = [
    [1.0, 0.0],
    [FRAC_1_SQRT_2, FRAC_1_SQRT_2],
    [0.0, 1.0],
    [-FRAC_1_SQRT_2, FRAC_1_SQRT_2],
    [-1.0, 0.0],
    [-FRAC_1_SQRT_2, -FRAC_1_SQRT_2],
    [0.0, -1.0],
    [FRAC_1_SQRT_2, -FRAC_1_SQRT_2],
];

/// The matrix D that turns the coefficients of a band (1, 2 or 3), row-major.
///
/// The turned function has at direction d the value that the function has at R^-1 d. The basis is orthonormal, so D[m][n]
/// is the integral of Y_m(d) Y_n(R^-1 d) over the sphere. The product is a polynomial of degree 2 * band at most, which
/// the rule of [`LEGENDRE`] times [`CIRCLE`] integrates exactly.
fn band_matrix(band: usize, rotation: Rotation) -> Vec<f64> {
    let (size, first) = (2 * band + 1, band * band);
    let back = rotation.inverse();
    let mut matrix = vec![0.0; size * size];
    for (z, weight) in LEGENDRE {
        let radius = (1.0 - z * z).sqrt();
        for [cos, sin] in CIRCLE {
            let direction = [radius * cos, radius * sin, z];
            let (there, here) = (sh_basis64(direction), sh_basis64(back.apply(direction)));
            for (m, row) in matrix.chunks_exact_mut(size).enumerate() {
                for (n, value) in row.iter_mut().enumerate() {
                    *value += weight * (PI / 4.0) * there[first + m] * here[first + n];
                }
            }
        }
    }
    matrix
}

/// The 16 real spherical harmonics of degree 0 to 3 at a unit direction, in the order and with the signs of the 3DGS
/// code (Condon-Shortley). The renderer's basis in f32 is a stage of its own; a test compares the two.
pub fn sh_basis64([x, y, z]: [f64; 3]) -> [f64; 16] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let root = |numerator: f64, denominator: f64| (numerator / (denominator * PI)).sqrt();
    let band1 = root(3.0, 4.0);
    let band2 = [root(15.0, 4.0), root(5.0, 16.0), root(15.0, 16.0)];
    let band3 = [root(35.0, 32.0), root(105.0, 4.0), root(21.0, 32.0), root(7.0, 16.0), root(105.0, 16.0)];
    [
        root(1.0, 4.0),
        -band1 * y,
        band1 * z,
        -band1 * x,
        band2[0] * x * y,
        -band2[0] * y * z,
        band2[1] * (2.0 * zz - xx - yy),
        -band2[0] * x * z,
        band2[2] * (xx - yy),
        -band3[0] * y * (3.0 * xx - yy),
        band3[1] * x * y * z,
        -band3[2] * y * (4.0 * zz - xx - yy),
        band3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -band3[2] * x * (4.0 * zz - xx - yy),
        band3[4] * z * (xx - yy),
        -band3[0] * x * (xx - 3.0 * yy),
    ]
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    /// Directions in all octants.
    fn directions() -> Vec<[f64; 3]> {
        let mut out = Vec::new();
        for i in 0..5 {
            for j in 0..7 {
                let (theta, phi) = (0.2 + 0.6 * f64::from(i), 0.1 + 0.9 * f64::from(j));
                out.push([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()]);
            }
        }
        out
    }

    #[test]
    fn up_becomes_the_up_of_viewers() {
        for up in
            directions().into_iter().chain([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 3e200], [1e-200, 0.0, 0.0]])
        {
            let rotation = Rotation::upright(up).unwrap();
            let largest = up.iter().fold(0.0f64, |most, x| most.max(x.abs()));
            let length = up.iter().map(|x| (x / largest) * (x / largest)).sum::<f64>().sqrt();
            let turned = rotation.apply(up.map(|x| x / largest / length));
            // A few roundings of values up to 1.
            assert!(turned.iter().zip(VIEWER_UP).all(|(a, b)| (a - b).abs() < 1e-15 * 8.0), "{up:?} {turned:?}");
            assert_eq!(Rotation::from_quaternion(rotation.quaternion()), Some(rotation));
            let [x, y, z] = rotation.inverse().apply(rotation.apply([1.0, 2.0, 3.0]));
            // Ten roundings of values up to 4, twice.
            assert!((x - 1.0).abs() + (y - 2.0).abs() + (z - 3.0).abs() < 2e-14);
        }
        // The turn that is found again from what it makes of the viewers' up, also for one of nearly half a turn.
        for tilt in [1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-3] {
            let turn = Rotation::upright([tilt, 1.0, -0.3 * tilt]).unwrap();
            let again = Rotation::upright(turn.inverse().apply(VIEWER_UP)).unwrap();
            let gap = turn.quaternion().iter().zip(again.quaternion()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            // The direction of a tilt of 1e-12 keeps some four digits; what files hold is compared to 1e-6.
            assert!(gap < 1e-15 / tilt * 8.0 + 1e-14, "{tilt}: {gap}");
        }
        assert_eq!(Rotation::upright(VIEWER_UP), Some(Rotation::IDENTITY));
        assert!(
            [[0.0; 3], [f64::NAN, 1.0, 0.0], [f64::INFINITY, 0.0, 0.0]]
                .into_iter()
                .all(|up| Rotation::upright(up).is_none())
        );
        assert!(Rotation::from_quaternion([1.0, 0.1, 0.0, 0.0]).is_none());
    }

    #[test]
    fn turned_harmonics_are_the_function_in_turned_directions() {
        for up in [[0.0, 0.0, 1.0], [0.3, -0.5, 0.8], [0.0, 1.0, 0.0], [-0.9, 0.1, -0.2]] {
            let rotation = Rotation::upright(up).unwrap();
            let turning = GaussianRotation::new(rotation);
            for degree in 1..=3usize {
                let coefficients = (degree + 1) * (degree + 1) - 1;
                let before: Vec<f32> = (0..3 * coefficients).map(|i| (i as f32 * 0.7).sin()).collect();
                let mut after = before.clone();
                turning.harmonics(&mut after);
                let value = |sh: &[f32], direction, channel: usize| -> f64 {
                    let basis = sh_basis64(direction);
                    sh.iter().skip(channel).step_by(3).zip(&basis[1..]).map(|(&c, b)| f64::from(c) * b).sum()
                };
                for direction in directions() {
                    for channel in 0..3 {
                        let there = value(&after, rotation.apply(direction), channel);
                        let here = value(&before, direction, channel);
                        // Each of up to 15 coefficients below 4 is rounded to f32 once; the basis is below 1.5.
                        assert!((there - here).abs() < 15.0 * 1.5 * 2.4e-7, "degree {degree}: {there} {here}");
                    }
                }
            }
        }
    }

    #[test]
    fn no_rotation_changes_no_bit() {
        let none = GaussianRotation::new(Rotation::IDENTITY);
        let mut sh = [0.1f32, -0.0, 3e-39, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        none.harmonics(&mut sh);
        assert_eq!(sh.map(f32::to_bits), [0.1f32, -0.0, 3e-39, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0].map(f32::to_bits));
    }
}
