//! From places on the globe to metres, and from a model without scale to these metres.
//!
//! Sources: "World Geodetic System 1984" for the ellipsoid; Horn, "Closed-form solution of absolute orientation using unit
//! quaternions" (1987) for the similarity.
//!
//! Invariants: 1. results depend on the positions and their order alone; 2. a similarity has a finite positive scale and a proper
//! rotation.

use crate::dataset::exif::GpsPlace;
use glam::{DMat3, DMat4, DQuat, DVec3};

/// Semi-major axis (metres) and squared eccentricity of the ellipsoid.
const AXIS: f64 = 6_378_137.0;
const ECCENTRICITY_2: f64 = 6.694_379_990_141_316e-3;

/// Rounds of new weights. The weights settle in about ten.
const ROUNDS: usize = 50;
/// Positions whose second direction has less than this part of the spread of the first lie on a line: no rotation follows.
const LINE: f64 = 0.02;
/// The cameras' spread across their main direction must be this many times the median distance from GPS. Otherwise the rotation about that
/// direction follows the noise of GPS. Simulated with 100 photos and 3 m of noise (6 m in height), a straight walk of 200 m has .3 times, and
/// up is wrong by as much as 144 degrees.
const ACROSS_LEAST: f64 = 2.0;
/// Least error of GPS that counts, metres: below it, positions weigh alike.
const LEAST_ERROR: f64 = 0.05;

/// Earth-centred position, metres.
fn earth_centred(place: &GpsPlace) -> DVec3 {
    let ((sin, cos), (sin_east, cos_east)) =
        (place.latitude.to_radians().sin_cos(), place.longitude.to_radians().sin_cos());
    let normal = AXIS / (1.0 - ECCENTRICITY_2 * sin * sin).sqrt();
    let height = place.altitude.unwrap_or(0.0);
    let across = (normal + height) * cos;
    DVec3::new(across * cos_east, across * sin_east, (normal * (1.0 - ECCENTRICITY_2) + height) * sin)
}

/// Metres east, north and up of `origin`, on the plane that touches the ellipsoid there.
pub fn metres_from(origin: &GpsPlace, place: &GpsPlace) -> DVec3 {
    let ((sin, cos), (sin_east, cos_east)) =
        (origin.latitude.to_radians().sin_cos(), origin.longitude.to_radians().sin_cos());
    let east = DVec3::new(-sin_east, cos_east, 0.0);
    let north = DVec3::new(-sin * cos_east, -sin * sin_east, cos);
    let offset = earth_centred(place) - earth_centred(origin);
    DVec3::new(east.dot(offset), north.dot(offset), east.cross(north).dot(offset))
}

/// `x -> scale * rotation * x + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    pub scale: f64,
    pub rotation: DMat3,
    pub translation: DVec3,
}

impl Similarity {
    pub const IDENTITY: Similarity = Similarity { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    pub fn apply(&self, x: DVec3) -> DVec3 {
        self.scale * (self.rotation * x) + self.translation
    }
}

/// The similarity that takes `from` to `to`, and the median distance that remains. Positions that disagree with most others hardly
/// count.
/// Errors: fewer than three positions, or those of `from`, which have little noise, lie on a line; or what they have across it is
/// lost in what remains, which the error has.
pub fn robust_similarity(from: &[DVec3], to: &[DVec3]) -> Result<(Similarity, f64), Option<f64>> {
    let mut weights = vec![1.0; from.len()];
    let mut found = None;
    for round in 0..ROUNDS {
        let similarity = weighted_similarity(from, to, &weights).ok_or(None)?;
        let errors: Vec<f64> = from.iter().zip(to).map(|(&x, &y)| similarity.apply(x).distance(y)).collect();
        let mut sorted = errors.clone();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        let width = median.max(LEAST_ERROR);
        // First the sum of distances, which outliers cannot pull far; then these no longer count at all.
        let weight = |error: f64| match round < ROUNDS / 2 {
            true => 1.0 / error.max(0.1 * width),
            false => (1.0 + (error / (3.0 * width)).powi(2)).powi(-2),
        };
        weights = errors.iter().map(|&error| weight(error)).collect();
        found = Some((similarity, median));
    }
    let (similarity, rest) = found.ok_or(None)?;
    let [_, across] = spread_of(from, &vec![1.0; from.len()]);
    if similarity.scale * across > ACROSS_LEAST * rest { Ok((similarity, rest)) } else { Err(Some(rest)) }
}

/// The weighted standard deviations of positions along their main direction and across it.
fn spread_of(at: &[DVec3], weights: &[f64]) -> [f64; 2] {
    let total: f64 = weights.iter().sum();
    let middle = at.iter().zip(weights).map(|(&x, &w)| w * x).sum::<DVec3>() / total;
    let mut spread = DMat3::ZERO;
    for (&x, &w) in at.iter().zip(weights) {
        let x = x - middle;
        spread += DMat3::from_cols(x * x.x, x * x.y, x * x.z) * (w / total);
    }
    let main = dominant_direction(DMat4::from_mat3(spread) - DMat4::from_cols_array_2d(&CORNER)).truncate();
    let along = (main.dot(spread * main) / main.length_squared()).max(0.0);
    let whole = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
    [along, (whole - along).max(0.0)].map(f64::sqrt)
}

/// The similarity with the least weighted sum of squared distances.
fn weighted_similarity(from: &[DVec3], to: &[DVec3], weights: &[f64]) -> Option<Similarity> {
    let total: f64 = weights.iter().sum();
    let middle = |at: &[DVec3]| at.iter().zip(weights).map(|(&x, &w)| w * x).sum::<DVec3>() / total;
    let (middle_from, middle_to) = (middle(from), middle(to));
    let (mut s, mut square) = (DMat3::ZERO, 0.0);
    for ((&x, &y), &w) in from.iter().zip(to).zip(weights) {
        let (x, y) = (x - middle_from, y - middle_to);
        s += DMat3::from_cols(x * y.x, x * y.y, x * y.z) * w;
        square += w * x.length_squared();
    }
    let [along, across] = spread_of(from, weights);
    if from.len() < 3 || !(square > 0.0 && across > LINE * along) {
        return None;
    }
    let [xx, xy, xz] = s.row(0).to_array();
    let [yx, yy, yz] = s.row(1).to_array();
    let [zx, zy, zz] = s.row(2).to_array();
    let n = DMat4::from_cols_array_2d(&[
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]);
    // Of the largest eigenvalue, not of the largest magnitude: the shift makes all positive.
    let shift = n.to_cols_array().iter().map(|x| x * x).sum::<f64>().sqrt();
    let q = dominant_direction(n + DMat4::IDENTITY * shift);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(q.y, q.z, q.w, q.x).normalize());
    let turned: f64 =
        (0..from.len()).map(|i| weights[i] * (rotation * (from[i] - middle_from)).dot(to[i] - middle_to)).sum();
    let scale = turned / square;
    let translation = middle_to - scale * (rotation * middle_from);
    (scale > 0.0 && scale.is_finite() && translation.is_finite()).then_some(Similarity { scale, rotation, translation })
}

/// `from_mat3` puts a 1 here.
const CORNER: [[f64; 4]; 4] = [[0.0; 4], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];

/// The eigenvector of the eigenvalue of the largest magnitude of a symmetric matrix: squaring it 40 times is as many steps of
/// the power method as count.
fn dominant_direction(mut matrix: DMat4) -> glam::DVec4 {
    for _ in 0..40 {
        let largest = matrix.to_cols_array().iter().fold(0.0f64, |most, x| most.max(x.abs()));
        if largest == 0.0 {
            break;
        }
        matrix *= 1.0 / largest;
        matrix = matrix * matrix;
    }
    let columns = [matrix.x_axis, matrix.y_axis, matrix.z_axis, matrix.w_axis];
    columns.into_iter().fold(columns[0], |best, column| if column.length() > best.length() { column } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(latitude: f64, longitude: f64, altitude: f64) -> GpsPlace {
        GpsPlace { latitude, longitude, altitude: Some(altitude) }
    }

    #[test]
    fn degrees_become_metres_east_north_and_up() {
        let origin = place(50.0, 8.0, 200.0);
        // An arc second along the meridian at 50 degrees is 30.8925 m on the ellipsoid (111,229 m a degree less the half degree's
        // change), along the parallel 19.92 m; 200 m above they are 1 / 31,900 longer.
        let north = metres_from(&origin, &place(50.0 + 1.0 / 3600.0, 8.0, 200.0));
        let east = metres_from(&origin, &place(50.0, 8.0 + 1.0 / 3600.0, 200.0));
        assert!((north - DVec3::new(0.0, 30.896, 0.0)).length() < 0.01, "{north}");
        assert!((east - DVec3::new(19.917, 0.0, 0.0)).length() < 0.01, "{east}");
        assert!((metres_from(&origin, &place(50.0, 8.0, 207.0)) - DVec3::new(0.0, 0.0, 7.0)).length() < 1e-6);
        let south_west = metres_from(&place(-33.0, -70.0, 0.0), &place(-33.001, -70.001, 0.0));
        assert!(south_west.x < -90.0 && south_west.y < -110.0, "{south_west}");
    }

    /// Positions of a flight along lines at one height.
    fn flight() -> Vec<DVec3> {
        (0..40).map(|i| DVec3::new(f64::from(i % 8), f64::from(i / 8), 0.02 * f64::from(i * i % 7))).collect()
    }

    #[test]
    fn a_similarity_is_found_among_noise_and_outliers() {
        for (k, axis) in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(0.6, -0.64, 0.48)].into_iter().enumerate() {
            let rotation = DMat3::from_axis_angle(axis, 3.0 - k as f64);
            let truth = Similarity { scale: 12.5, rotation, translation: DVec3::new(300.0, -2e5, 40.0) };
            let from = flight();
            let exact: Vec<DVec3> = from.iter().map(|&x| truth.apply(x)).collect();
            let (found, rest) = robust_similarity(&from, &exact).unwrap();
            assert!(rest < 1e-6 && (found.scale - 12.5).abs() < 1e-9, "{found:?} {rest}");
            // A metre of noise, and every seventh position far off.
            let noise = |i: usize| DVec3::new((i as f64 * 1.3).sin(), (i as f64 * 2.1).cos(), (i as f64 * 0.7).sin());
            let off = |i: usize| if i % 7 == 3 { DVec3::new(500.0, 80.0, -90.0) } else { DVec3::ZERO };
            let noisy: Vec<DVec3> = exact.iter().enumerate().map(|(i, &y)| y + noise(i) + off(i)).collect();
            let (found, rest) = robust_similarity(&from, &noisy).unwrap();
            assert!(rest < 2.0 && (found.scale / 12.5 - 1.0).abs() < 0.02, "{found:?} {rest}");
            assert!(from.iter().zip(&exact).all(|(&x, &y)| found.apply(x).distance(y) < 2.0));
        }
    }

    #[test]
    fn one_wrong_place_neither_hides_nor_turns_the_rest() {
        let from = flight();
        for wrong in [DVec3::new(20_000.0, 0.0, 0.0), DVec3::new(0.0, 0.0, 4_294.0)] {
            let mut to: Vec<DVec3> = from.iter().map(|&x| 10.0 * x).collect();
            to[5] += wrong;
            let (found, rest) = robust_similarity(&from, &to).unwrap();
            assert!(rest < 0.1 && (found.rotation * DVec3::Z).z > 0.9999, "{found:?} {rest}");
        }
    }

    #[test]
    fn a_walk_along_a_line_has_no_up_of_its_noise() {
        // 200 m, .2 m aside at most; metres of noise in what GPS says.
        let from: Vec<DVec3> =
            (0..100).map(|i| DVec3::new(2.0 * f64::from(i), 0.2 * f64::from(i).sin(), 0.0)).collect();
        let noise = |i: usize| DVec3::new((i as f64 * 1.3).sin(), (i as f64 * 2.1).cos(), 2.0 * (i as f64 * 0.7).sin());
        let to: Vec<DVec3> = from.iter().enumerate().map(|(i, &x)| x + 3.0 * noise(i)).collect();
        assert!(robust_similarity(&from, &to).is_err());
    }

    #[test]
    fn places_of_other_photos_disagree_by_metres() {
        let from = flight();
        // Each photo has the place of another one, metres away.
        let to: Vec<DVec3> = (0..40).map(|i| 10.0 * from[(7 * i + 3) % 40]).collect();
        let rest = match robust_similarity(&from, &to) {
            Ok((_, rest)) => Some(rest),
            Err(rest) => rest,
        };
        assert!(rest.is_some_and(|rest| rest > 5.0), "{rest:?}");
    }

    #[test]
    fn positions_on_a_line_or_in_one_place_fix_no_rotation() {
        let line: Vec<DVec3> = (0..9).map(|i| DVec3::new(f64::from(i), 2.0, 1.0)).collect();
        assert_eq!(robust_similarity(&line, &line), Err(None));
        assert!(robust_similarity(&[DVec3::ONE; 5], &[DVec3::X; 5]).is_err());
        assert!(robust_similarity(&line[..2], &line[..2]).is_err());
        assert!(robust_similarity(&[], &[]).is_err());
    }
}
