//! The local frame: the offset and scale removed from a dataset before anything is converted to f32, and the size of
//! the scene.
//!
//! Here: medians of cameras and points, conversion of positions and poses between frames. Not here: photos, and the
//! choice of views.
//!
//! Invariants: 1. the origin is subtracted in f64, so a map-projection offset of 5e5 m changes local values by less
//! than f32 rounding; 2. the scale is finite and positive for any input; 3. only medians decide origin and scale, so a
//! minority of bad cameras or points cannot move them far.

use super::model::Pose;
use glam::DVec3;

/// Larger coordinates are treated as non-finite: their squares would overflow.
pub const LARGEST_COORDINATE: f64 = 1e100;

/// A length below this fraction of the distance to the points (or 1e-12 of the coordinates) counts as zero.
const NEGLIGIBLE: f64 = 1e-6;

/// Farthest plausible position, in robust extents.
const ABSURD: f64 = 1e6;

/// Local = (world - origin) / scale, axes unchanged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// World position of the local origin.
    pub origin: DVec3,
    /// World length of one local unit; finite and positive.
    pub scale: f64,
}

impl Frame {
    pub fn to_local(&self, world: DVec3) -> DVec3 {
        (world - self.origin) / self.scale
    }

    pub fn to_world(&self, local: DVec3) -> DVec3 {
        self.origin + local * self.scale
    }

    /// Converts a world-to-camera pose to the local-to-camera matrix `[R | t]`, row-major, with camera lengths in local
    /// units.
    ///
    /// From `R (origin + scale p) + t`, divided by the scale: the rotation stays and t becomes `(R origin + t) /
    /// scale`.
    pub fn viewmat(&self, pose: &Pose) -> [[f32; 4]; 3] {
        let translation = (pose.rotation * self.origin + pose.translation) / self.scale;
        std::array::from_fn(|i| {
            let row = pose.rotation.row(i);
            [row.x as f32, row.y as f32, row.z as f32, translation[i] as f32]
        })
    }
}

/// Robust measures of a scene, world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// Coordinate-wise median of the camera positions.
    pub centre: DVec3,
    /// Median distance of the cameras from `centre`; 0 if negligible (one camera, or all in one place).
    pub camera_radius: f64,
    /// Median distance of the points from `centre`; 0 without points.
    pub point_distance: f64,
}

impl Extent {
    /// Measures cameras and points. Positions that are not [`usable`] are ignored.
    pub fn measure(centres: &[DVec3], points: &[[f64; 3]]) -> Self {
        let points = points.iter().map(|&p| DVec3::from_array(p)).filter(|&p| usable(p));
        let centre = median_position(centres);
        Extent::of(centres, centre, median(points.map(|p| p.distance(centre)).collect()))
    }

    /// As [`Extent::measure`], with `point_distance` giving the median distance of the usable points from a position, or its error.
    pub fn measure_by<E>(centres: &[DVec3], point_distance: impl FnOnce(DVec3) -> Result<f64, E>) -> Result<Self, E> {
        let centre = median_position(centres);
        Ok(Extent::of(centres, centre, point_distance(centre)?))
    }

    fn of(centres: &[DVec3], centre: DVec3, point_distance: f64) -> Self {
        let radius = median(centres.iter().filter(|&&c| usable(c)).map(|c| c.distance(centre)).collect());
        let camera_radius = if radius <= negligible(point_distance, centre) { 0.0 } else { radius };
        Extent { centre, camera_radius, point_distance }
    }

    /// The local frame: the origin is the median camera; one unit is the median distance of the cameras from it, so
    /// that half of the cameras are within 1 and `scene_scale` of an ordinary flight is about 2. If all cameras are in
    /// one place, the unit is the median distance to the points; without points it is the world's unit.
    pub fn frame(&self) -> Frame {
        let scale = [self.camera_radius, self.point_distance].into_iter().find(|&s| s > 0.0).unwrap_or(1.0);
        Frame { origin: self.centre, scale }
    }

    /// Whether a position is finite and not farther than 1e6 robust extents from the cameras.
    pub fn is_plausible(&self, position: DVec3) -> bool {
        let extent = self.camera_radius.max(self.point_distance);
        usable(position) && (extent == 0.0 || position.distance(self.centre) <= ABSURD * extent)
    }

    /// `scene_scale` in world units: 1.1 times the largest distance of a camera from the mean of the cameras, without
    /// outliers; and the indices of these outliers.
    ///
    /// A camera is an outlier if its distance from the median camera exceeds the median of these distances by more than
    /// ten times that median and ten times their spread (1.4826 times the median absolute deviation). If all cameras
    /// are in one place the result is the median distance to the points; without points it is 1.
    pub fn scene_scale(&self, centres: &[DVec3]) -> (f64, Vec<usize>) {
        let distances: Vec<f64> = centres.iter().map(|c| c.distance(self.centre)).collect();
        let typical = median(distances.clone());
        let spread = 1.4826 * median(distances.iter().map(|d| (d - typical).abs()).collect());
        let limit = if self.camera_radius > 0.0 { typical + 10.0 * typical.max(spread) } else { f64::INFINITY };
        let (mut inliers, mut outliers) = (Vec::new(), Vec::new());
        for (i, &distance) in distances.iter().enumerate() {
            if distance <= limit { inliers.push(centres[i]) } else { outliers.push(i) }
        }
        // The offset is removed before the sum, so that the mean of large coordinates stays accurate.
        let sum = inliers.iter().fold(DVec3::ZERO, |sum, &c| sum + (c - self.centre));
        let mean = self.centre + sum / inliers.len().max(1) as f64;
        let largest = inliers.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
        if largest > negligible(self.point_distance, self.centre) {
            (1.1 * largest, outliers)
        } else if self.point_distance > 0.0 {
            (self.point_distance, outliers)
        } else {
            (1.0, outliers)
        }
    }
}

/// Whether every coordinate is finite and its square does not overflow.
pub fn usable(position: DVec3) -> bool {
    position.to_array().iter().all(|x| x.abs() <= LARGEST_COORDINATE)
}

/// Coordinate-wise median of the usable positions.
fn median_position(positions: &[DVec3]) -> DVec3 {
    let of_axis = |axis: usize| median(positions.iter().filter(|&&c| usable(c)).map(|c| c[axis]).collect());
    DVec3::from_array(std::array::from_fn(of_axis))
}

fn negligible(point_distance: f64, centre: DVec3) -> f64 {
    (NEGLIGIBLE * point_distance).max(1e-12 * centre.abs().max_element())
}

/// The median (the mean of the two middle values for an even count); 0 for an empty list.
fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let (middle, even) = (values.len() / 2, values.len().is_multiple_of(2));
    let (below, &mut upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    if even { (below.iter().copied().fold(f64::NEG_INFINITY, f64::max) + upper) / 2.0 } else { upper }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_odd_and_even_counts() {
        let medians =
            [&[][..], &[3.0], &[5.0, 1.0], &[9.0, 1.0, 2.0], &[9.0, 1.0, 2.0, 4.0]].map(|v| median(v.to_vec()));
        assert_eq!(medians, [0.0, 3.0, 3.0, 2.0, 3.0]);
    }

    #[test]
    fn degenerate_scenes_have_a_positive_scale() {
        let one = DVec3::new(1.0, 2.0, 3.0);
        let cases: [(Vec<DVec3>, Vec<[f64; 3]>); 6] = [
            (vec![one], vec![]),
            (vec![one], vec![[1.0, 2.0, 8.0]]),
            (vec![one], vec![one.to_array()]),
            (vec![one; 5], vec![[0.0; 3]; 7]),
            (vec![DVec3::splat(f64::NAN)], vec![[f64::NAN; 3]]),
            (vec![one, one + DVec3::X], vec![]),
        ];
        for (cameras, points) in cases {
            let extent = Extent::measure(&cameras, &points);
            let frame = extent.frame();
            assert!(frame.scale.is_finite() && frame.scale > 0.0 && frame.origin.is_finite(), "{frame:?}");
            let usable: Vec<DVec3> = cameras.into_iter().filter(|&c| usable(c)).collect();
            let (scale, outliers) = extent.scene_scale(&usable);
            assert!(scale.is_finite() && scale > 0.0 && outliers.is_empty());
        }
        assert_eq!(Extent::measure(&[one], &[[1.0, 2.0, 8.0]]).frame().scale, 5.0);
    }
}
