//! The transform file of an export: maps its coordinates to those of the dataset and back, for programs that do
//! not read the comments of a PLY, and for a PLY that lost them because an editor saved it.
//!
//! Invariant: the matrices are those that [`super::frames`] applies.

use super::meta::{ExportFrame, SceneMeta};
use crate::base::error::{InputError, InputResult};
use crate::base::text::read_text;
use crate::base::whole_file::{folder_of, write_whole};
use crate::scene::rotation::Rotation;
use serde::Deserialize;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Ending of the file beside a file: in place of `.ply`, and after any other ending. In an exported folder, its whole name.
pub const TRANSFORM_ENDING: &str = "transform.json";

/// Largest deviation of the transform from a rotation and a scale, over the scale.
const TOLERANCE: f64 = 1e-9;
/// Longest file read, bytes; one has some 700.
const BYTES_MAX: u64 = 1 << 16;
const REMEDY: &str =
    "copy the file again, export the Gaussians again, or remove it if they are in the dataset's coordinates";

#[derive(Debug, Deserialize)]
pub struct Transform {
    /// Name of the file of Gaussians.
    #[serde(default)]
    file: Option<String>,
    up_in_dataset: Option<[f64; 3]>,
    file_to_dataset: [[f64; 4]; 4],
}

impl Transform {
    /// Frame and axes of Gaussians with this transform, which was read from `path`.
    /// Errors: it is not what this program writes.
    pub fn meta(&self, path: &Path) -> InputResult<SceneMeta> {
        let matrix = self.file_to_dataset;
        let upright = self.up_in_dataset.and_then(Rotation::upright);
        let squares = matrix[..3].iter().flat_map(|row| &row[..3]).map(|x| x * x).sum::<f64>();
        let scale = libm::sqrt(squares / 3.0);
        let back = upright.unwrap_or(Rotation::IDENTITY).inverse().matrix();
        let off = |i: usize, j: usize| (matrix[i][j] - scale * back[i][j]).abs() / scale;
        let is_known = (0..9).all(|k| off(k / 3, k % 3) <= TOLERANCE);
        let origin = [0, 1, 2].map(|i| matrix[i][3]);
        if !is_known || !origin.iter().all(|x| x.is_finite()) {
            let problem = "is no scale, offset and turn to the direction that points up";
            return Err(InputError::new(path, problem, REMEDY).at("file_to_dataset"));
        }
        Ok(SceneMeta { origin, scale, frame: ExportFrame::Local, upright, scene_radius: scale, ..SceneMeta::default() })
    }
}

/// Whether a file is a transform as this program writes it.
pub fn is_transform(path: &Path) -> bool {
    read(path).is_ok()
}

/// Frame and axes of a PLY that does not state them, from the transform file beside it; `None` without one. An editor may have
/// saved the PLY under another name: then the only transform of a PLY in the folder counts.
/// Errors: the file cannot be read, or is not what this program writes.
pub fn meta_beside(ply: &Path) -> InputResult<Option<SceneMeta>> {
    let own = transform_path(ply);
    let found = if own.is_file() { Some((own.clone(), read(&own)?)) } else { only_one_beside(ply) };
    let Some((path, transform)) = found else { return Ok(None) };
    let meta = transform.meta(&path)?;
    // In the dataset's frame nothing but the axes differs.
    let frame = if meta.origin == [0.0; 3] && (meta.scale - 1.0).abs() < TOLERANCE {
        SceneMeta { scale: 1.0, scene_radius: 1.0, frame: ExportFrame::Dataset, ..meta }
    } else {
        meta
    };
    Ok(Some(SceneMeta { transform: Some(path), ..frame }))
}

fn only_one_beside(ply: &Path) -> Option<(PathBuf, Transform)> {
    let entries = std::fs::read_dir(folder_of(ply)).ok()?.flatten().map(|entry| entry.path());
    let is_transform = |path: &PathBuf| {
        path.file_name().is_some_and(|name| name.to_string_lossy().ends_with(&format!(".{TRANSFORM_ENDING}")))
    };
    let of_ply = |t: &Transform| t.file.as_ref().is_some_and(|name| name.to_ascii_lowercase().ends_with(".ply"));
    let mut found = entries.filter(is_transform).filter_map(|path| read(&path).ok().filter(of_ply).map(|t| (path, t)));
    found.next().filter(|_| found.next().is_none())
}

fn read(path: &Path) -> InputResult<Transform> {
    let text = read_text(path, BYTES_MAX, REMEDY)?;
    serde_json::from_str(&text).map_err(|e| InputError::new(path, format!("cannot be parsed: {e}"), REMEDY))
}

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
/// Errors: the folder cannot be written.
pub fn write_transform(file: &Path, meta: &SceneMeta, frame: ExportFrame, up: Option<[f64; 3]>) -> InputResult<()> {
    write_whole(&transform_path(file), transform_text(file, meta, frame, up)?.as_bytes())
}

/// The text of the transform: two 4x4 matrices, row-major, for column vectors.
/// Errors: a number is not finite.
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
mod tests {
    use super::*;
    use crate::scene::rotation::VIEWER_UP;

    #[test]
    fn the_matrices_lead_there_and_back() {
        let folder = tempfile::tempdir().unwrap();
        #[cfg(not(target_os = "linux"))]
        let ply = folder.path().join("a.b.ply");
        // A folder of any name.
        #[cfg(target_os = "linux")]
        let ply = {
            use std::os::unix::ffi::OsStrExt;
            let odd = folder.path().join(std::ffi::OsStr::from_bytes(b"n\xff"));
            std::fs::create_dir(&odd).unwrap();
            odd.join("a.b.ply")
        };
        let upright = Rotation::upright([0.2, 0.3, 0.9]);
        let meta = SceneMeta { upright, origin: [5.0, -6.0, 7.0], scale: 2.0, ..SceneMeta::default() };
        for frame in [ExportFrame::Dataset, ExportFrame::Local] {
            write_transform(&ply, &meta, frame, Some(VIEWER_UP)).unwrap();
            let text = std::fs::read_to_string(ply.with_file_name("a.b.transform.json")).unwrap();
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
