//! MatrixCity's folders (`small_city/aerial`), as published:
//!
//! ```text
//! pose/block_all/transforms_train.json, transforms_test.json    positions in 100 m, file_path "../../train/block_1/0001.png"
//! train/block_1/*.png ...  test/block_1_test/*.png ...          photos, unpacked from the archives
//! train/block_1/transforms.json ...                             positions in metres, rotations times 0.01, frame_index
//! ```
//!
//! The files of `pose/block_all` are read if they exist, otherwise those of all blocks. The scale of a rotation is
//! removed from both rotation and position, so that either source gives positions in 100 m, the unit of the published
//! clouds (`point_cloud_ds20/aerial/Block_all.ply`).
//!
//! Invariant: paths may contain `..`, as those files do, but never leave the scene's folder.

use super::{Reading, json, photos};
use crate::base::error::{InputError, InputResult};
use crate::dataset::checks::sort_views;
use crate::dataset::model::{RawScene, ReadOptions, Split};
use std::path::{Path, PathBuf};

/// Photo folders inside a block's folder: as in the archive, or as unpacked by other scripts.
pub(super) const INSIDE_BLOCK: [&str; 3] = ["input", "rgb", "images"];
/// Clouds of points, the first that exists.
const CLOUDS: [&str; 3] = [
    "points.ply",
    "point_cloud_ds20/aerial/Block_all.ply",
    "small_city_pointcloud/point_cloud_ds20/aerial/Block_all.ply",
];

/// Whether [`read_matrix_city`] would find something in this folder.
pub fn looks_like_matrix_city(folder: &Path) -> bool {
    pose_file(folder, "train").is_file() || !block_files(folder, "train").is_empty()
}

fn pose_file(folder: &Path, set: &str) -> PathBuf {
    folder.join("pose/block_all").join(format!("transforms_{set}.json"))
}

/// `<set>/*/transforms.json`, sorted.
fn block_files(folder: &Path, set: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder.join(set)).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> =
        entries.map(|e| e.path().join("transforms.json")).filter(|path| path.is_file()).collect();
    files.sort();
    files
}

/// Reads MatrixCity's folders. `train` and `test` prescribe the split.
///
/// # Errors
/// As [`super::read_transforms`]; or a path leaves `folder`.
pub fn read_matrix_city(folder: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let mut files = Vec::new();
    for (set, split) in [("train", Split::Train), ("test", Split::Test)] {
        let pose = pose_file(folder, set);
        let of_set = if pose_file(folder, "train").is_file() { vec![pose] } else { block_files(folder, set) };
        if of_set.is_empty() || !of_set[0].is_file() {
            let problem = format!("the poses of the {set} photos are missing");
            let at = of_set.into_iter().next().unwrap_or_else(|| folder.join(set));
            return Err(InputError::new(at, problem, "fetch small_city/aerial again, with its folder pose"));
        }
        files.extend(of_set.into_iter().map(|file| (file, split)));
    }
    let mut reading = Reading::new(options);
    reading.root = Some(folder.to_path_buf());
    let mut scene = RawScene::default();
    for (file, split) in &files {
        reading.add_file(file, &json::load(file)?, Some(*split), &mut scene)?;
    }
    reading.report(&files[0].0, &mut scene.warnings)?;
    scene.views = reading.views;
    scene.points_path = CLOUDS.iter().map(|name| folder.join(name)).find(|path| path.is_file());
    sort_views(folder, &mut scene.views)?;
    Ok(scene)
}

/// The photo at `stated`, relative to `folder`, a folder inside `root`; its name is relative to `root`.
pub(super) fn find_photo(
    root: &Path,
    folder: &Path,
    images: Option<&str>,
    stated: &str,
) -> Result<photos::Photo, String> {
    let base = folder.strip_prefix(root).unwrap_or(Path::new(""));
    let name = resolved(&base.to_string_lossy(), stated)?;
    let (block, file) = name.rsplit_once('/').unwrap_or(("", &name));
    let block = root.join(block);
    let own = block.file_name().map(|n| n.to_string_lossy().into_owned());
    let inside = match images {
        Some(images) => vec![images],
        None => INSIDE_BLOCK.into_iter().chain(own.as_deref()).collect(),
    };
    let places = std::iter::once(block.join(file)).chain(inside.into_iter().map(|sub| block.join(sub).join(file)));
    let found = places.into_iter().find(|path| path.is_file());
    let exists = found.is_some();
    Ok(photos::Photo { path: found.unwrap_or_else(|| root.join(&name)), name, exists })
}

/// `stated` relative to `base`, both with `/`, without `..`; refused if it leaves the folder that `base` is relative
/// to.
fn resolved(base: &str, stated: &str) -> Result<String, String> {
    let climbs = || format!("the name {stated:?} climbs out of the scene's folder with '..'");
    let mut parts: Vec<&str> = base.split(['/', '\\']).filter(|p| !p.is_empty()).collect();
    let mut rest = stated;
    while let Some(up) = rest.strip_prefix("../").or_else(|| rest.strip_prefix("./")) {
        if rest.starts_with("..") {
            parts.pop().ok_or_else(climbs)?;
        }
        rest = up;
    }
    // Further `..`, and everything else that names must not contain, is refused as elsewhere.
    let rest = crate::dataset::paths::clean_name(rest)?;
    parts.push(&rest);
    Ok(parts.join("/"))
}
