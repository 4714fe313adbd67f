//! The transform file of an export: maps its coordinates to those of the dataset and back, for programs that do
//! not read the comments of a PLY.
//!
//! Not here: reading it. gsscale reads the comments.
//!
//! Invariant: the matrices are those that [`super::frames`] applies.

use super::meta::{ExportFrame, SceneMeta};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::scene::rotation::Rotation;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Ending of the file beside a file: in place of `.ply`, and after any other ending. In an exported folder, its whole name.
pub const TRANSFORM_ENDING: &str = "transform.json";

/// The file beside the Gaussians in `file`, which is no folder.
pub fn transform_path(file: &Path) -> PathBuf {
    if file.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("ply")) {
        return file.with_extension(TRANSFORM_ENDING);
    }
    let mut name = file.file_name().unwrap_or_default().to_os_string();
    name.push(".");
    name.push(TRANSFORM_ENDING);
    file.with_file_name(name)
}

/// Writes the transform of Gaussians that were written to `file` in `frame` with `meta`, beside the file. `up` is the direction that
/// points up in the file; `None` if the Gaussians were not turned.
///
/// # Errors
/// The folder cannot be written.
pub fn write_transform(file: &Path, meta: &SceneMeta, frame: ExportFrame, up: Option<[f64; 3]>) -> InputResult<()> {
    write_whole(&transform_path(file), transform_text(file, meta, frame, up)?.as_bytes())
}

/// The text of the transform: two 4x4 matrices, row-major, for column vectors.
///
/// # Errors
/// A number is not finite.
pub fn transform_text(file: &Path, meta: &SceneMeta, frame: ExportFrame, up: Option<[f64; 3]>) -> InputResult<String> {
    let turned = meta.upright.unwrap_or(Rotation::IDENTITY);
    let (origin, scale) = match frame {
        ExportFrame::Dataset => ([0.0; 3], 1.0),
        ExportFrame::Local => (meta.origin, meta.scale),
    };
    // dataset = scale R^T file + origin, so file = R (dataset - origin) / scale.
    let back = affine(turned.inverse().matrix().map(|row| row.map(|x| x * scale)), origin);
    let shift = turned.apply(origin).map(|x| -x / scale);
    let there = affine(turned.matrix().map(|row| row.map(|x| x / scale)), shift);
    let text = json!({
        "file": file.file_name().map(|name| name.to_string_lossy()),
        "up_in_file": up,
        "up_in_dataset": up.map(|up| turned.inverse().apply(up)),
        "file_to_dataset": back,
        "dataset_to_file": there,
    });
    let text = serde_json::to_string_pretty(&text);
    text.map(|text| text + "\n").map_err(|e| InputError::io(file, "writing its transform", &e.into()))
}

/// `[A | b]` over `0 0 0 1`.
fn affine(a: [[f64; 3]; 3], b: [f64; 3]) -> [[f64; 4]; 4] {
    // Written so that no -0 appears.
    let row = |i: usize| [a[i][0] + 0.0, a[i][1] + 0.0, a[i][2] + 0.0, b[i] + 0.0];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::scene::rotation::VIEWER_UP;

    #[test]
    fn the_matrices_lead_there_and_back() {
        let folder = tempfile::tempdir().unwrap();
        let ply = folder.path().join("a.b.ply");
        let upright = Rotation::upright([0.2, 0.3, 0.9]);
        let meta = SceneMeta { upright, origin: [5.0, -6.0, 7.0], scale: 2.0, ..SceneMeta::default() };
        for frame in [ExportFrame::Dataset, ExportFrame::Local] {
            write_transform(&ply, &meta, frame, Some(VIEWER_UP)).unwrap();
            let text = std::fs::read_to_string(folder.path().join("a.b.transform.json")).unwrap();
            let value: serde_json::Value = serde_json::from_str(&text).unwrap();
            let apply = |name: &str, p: [f64; 3]| {
                let at = |i: usize, j: usize| value[name][i][j].as_f64().unwrap();
                [0, 1, 2].map(|i| at(i, 0) * p[0] + at(i, 1) * p[1] + at(i, 2) * p[2] + at(i, 3))
            };
            let there = apply("dataset_to_file", [1.0, 2.0, 3.0]);
            let back = apply("file_to_dataset", there);
            // Twenty roundings of values below 20.
            assert!(back.iter().zip([1.0, 2.0, 3.0]).all(|(a, b)| (a - b).abs() < 20.0 * 4e-15), "{back:?}");
            let local = [(1.0 - 5.0) / 2.0, (2.0 + 6.0) / 2.0, (3.0 - 7.0) / 2.0];
            let of_frame = if frame == ExportFrame::Local { local } else { [1.0, 2.0, 3.0] };
            let want = upright.unwrap().apply(of_frame);
            assert!(there.iter().zip(want).all(|(a, b)| (a - b).abs() < 20.0 * 4e-15), "{there:?} {want:?}");
        }
    }
}
