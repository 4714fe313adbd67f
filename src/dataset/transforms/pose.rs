//! Converts camera-to-world matrices in OpenGL axes (x right, y up, z backward) to poses.

use super::json::{FIX_KEY, JsonNode};
use crate::base::error::InputResult;
use crate::dataset::gathered::MAX_COORDINATE;
use crate::dataset::loose_json::is_no_number;
use crate::dataset::model::Pose;
use glam::{DMat3, DVec3};
use serde_json::Value;

/// Largest relative difference of column lengths, and largest cosine between columns, of a rounded rotation. Exporters
/// print 6 digits or more; hand-held trackers are off by about 1e-3.
const TOLERANCE: f64 = 1e-2;
/// Shortest column accepted before scaling (MatrixCity has 0.01).
const MIN_SCALE: f64 = 1e-9;

/// Reads the matrix of `transform_matrix`, or MatrixCity's `rot_mat`: 3 or 4 rows of 4 numbers, row-major; `null`,
/// which some writers use for NaN, becomes NaN, and so does a word such as Infinity.
pub(super) fn read_matrix(frame: &JsonNode<'_>) -> InputResult<[[f64; 4]; 4]> {
    let key = if frame.get("transform_matrix").is_none() && frame.get("rot_mat").is_some() {
        "rot_mat"
    } else {
        "transform_matrix"
    };
    let wrong = || frame.error(key, "not a matrix of 4 x 4 (or 3 x 4) numbers", FIX_KEY);
    let rows = frame.array(key)?.ok_or_else(|| frame.error(key, "the key is missing", FIX_KEY))?;
    if rows.len() != 3 && rows.len() != 4 {
        return Err(wrong());
    }
    let mut matrix = [[0.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
    for (to, row) in matrix.iter_mut().zip(rows) {
        let row = row.as_array().filter(|r| r.len() == 4).ok_or_else(wrong)?;
        for (to, value) in to.iter_mut().zip(row) {
            *to = match value {
                Value::Null => f64::NAN,
                Value::String(word) if is_no_number(word) => f64::NAN,
                value => value.as_f64().ok_or_else(wrong)?,
            };
        }
    }
    Ok(matrix)
}

/// Multiplies the position by the scale of the rotation as well: MatrixCity's rotations times 0.01 come with positions in
/// metres, its plain rotations with positions in 100 m.
pub(super) fn scale_position(m: &mut [[f64; 4]; 4]) {
    let scale = (0..3).map(|c| DVec3::new(m[0][c], m[1][c], m[2][c]).length()).sum::<f64>() / 3.0;
    for row in m.iter_mut().take(3) {
        row[3] *= scale;
    }
}

/// The pose of a camera-to-world matrix whose rotation may have a common scale; `None` if it is not finite or not a
/// proper rotation.
pub(in crate::dataset) fn make_pose(m: &[[f64; 4]; 4]) -> Option<Pose> {
    if !m.iter().flatten().all(|x| x.abs() <= MAX_COORDINATE) {
        return None;
    }
    let last_row_off = m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6);
    let columns: [DVec3; 3] = std::array::from_fn(|c| DVec3::new(m[0][c], m[1][c], m[2][c]));
    let scale = columns.iter().map(|c| c.length()).sum::<f64>() / 3.0;
    if last_row_off || scale < MIN_SCALE {
        return None;
    }
    let mut rotation = DMat3::from_cols(columns[0] / scale, columns[1] / scale, columns[2] / scale);
    let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
    if gram.to_cols_array().iter().any(|x| x.abs() > 2.0 * TOLERANCE) || rotation.determinant() < 0.0 {
        return None;
    }
    // Newton's iteration to the nearest rotation (Higham 1986, "Computing the polar decomposition"): the error is
    // squared each time, so 1e-2 is below the last bit after four.
    for _ in 0..4 {
        rotation = (rotation + rotation.inverse().transpose()) * 0.5;
    }
    let centre = DVec3::new(m[0][3], m[1][3], m[2][3]);
    let opencv = DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis);
    let rotation = opencv.transpose();
    Some(Pose { rotation, translation: -(rotation * centre) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rounded_rotation_is_made_exact_and_other_matrices_are_refused() {
        let (c, s) = (0.866, 0.5);
        let pose = make_pose(&[[c, -s, 0., 0.], [s, c, 0., 0.], [0., 0., 1., 0.], [0., 0., 0., 1.]]).unwrap();
        let gram = pose.rotation * pose.rotation.transpose();
        // 1e-14: the identity to a few roundings.
        assert!((gram - DMat3::IDENTITY).to_cols_array().iter().all(|x| x.abs() < 1e-14), "{gram}");
        let good = [[1., 0., 0., 1.], [0., 1., 0., 2.], [0., 0., 1., 3.], [0., 0., 0., 1.]];
        for (row, column, value) in
            [(0, 0, -1.0), (0, 0, 0.5), (0, 1, 0.5), (1, 3, f64::NAN), (2, 2, f64::INFINITY), (3, 0, 1.0), (3, 3, 2.0)]
        {
            let mut bad = good;
            bad[row][column] = value;
            assert!(make_pose(&bad).is_none(), "{bad:?}");
        }
        assert!(make_pose(&[[0.; 4], [0.; 4], [0.; 4], [0., 0., 0., 1.]]).is_none() && make_pose(&good).is_some());
    }
}
