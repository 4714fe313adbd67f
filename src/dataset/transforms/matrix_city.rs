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

use super::read_files;
use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::Gathered;
use crate::dataset::model::{RawScene, ReadOptions, Split};
use crate::dataset::paths::read_name;
use crate::dataset::photo_files::{Photo, PhotoFiles};
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
/// Errors: as [`super::read_transforms`]; or a path leaves `folder`.
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
        files.extend(of_set.into_iter().map(|file| (file, Some(split))));
    }
    // Names are relative to the scene, and the image folder lies inside those of the blocks.
    let gathered = Gathered::new(PhotoFiles::with_folders(folder, None, options), options);
    let mut scene = RawScene::default();
    read_files(&files, gathered, Some(folder), &mut scene)?;
    scene.points_path = CLOUDS.iter().map(|name| folder.join(name)).find(|path| path.is_file());
    Ok(scene)
}

/// The photo at `stated`, relative to the folder `base` of the scene; its name is relative to the scene.
pub(super) fn find_photo(photos: &PhotoFiles, base: &str, images: Option<&str>, stated: &str) -> Result<Photo, String> {
    photos.find_at(stated, read_name(base, stated)?, "", &|place| {
        let block = place.parent().unwrap_or(place);
        let (file, own) = (place.file_name()?, block.file_name().map(|name| name.to_string_lossy()));
        let inside = INSIDE_BLOCK.into_iter().chain(own.as_deref());
        let places: Vec<PathBuf> = match images {
            Some(images) => vec![block.join(images).join(file)],
            None => std::iter::once(place.to_path_buf()).chain(inside.map(|sub| block.join(sub).join(file))).collect(),
        };
        places.into_iter().find(|path| path.is_file()).map(|path| (path, String::new()))
    })
}
