//! Chooses the reader for a path.

use crate::base::error::{InputError, InputResult};
use crate::dataset::model::RawScene;
pub use crate::dataset::model::ReadOptions;
use crate::dataset::{colmap, mega_nerf, transforms};
use std::path::Path;

/// Reads a scene: a folder with a COLMAP model, with a model for each of `train` and `val`, with `transforms*.json`, in
/// MatrixCity's or in Mega-NeRF's layout, or such a JSON file. If a folder matches several, the first of these applies.
///
/// # Errors
/// Any problem with the files; if nothing matches, the error lists what was searched for.
pub fn read_scene(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let facts = std::fs::metadata(path).map_err(|e| InputError::io(path, "opening the scene", &e))?;
    let root = if facts.is_file() { path.parent().unwrap_or(Path::new("")) } else { path };
    Ok(RawScene { root: root.to_path_buf(), ..read_kind(path, facts.is_file(), options)? })
}

fn read_kind(path: &Path, is_file: bool, options: &ReadOptions) -> InputResult<RawScene> {
    if is_file {
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
            return transforms::read_transforms(path, options);
        }
        return Err(InputError::new(path, "a scene is a folder or a transforms.json", "give the folder that holds it"));
    }
    if colmap::looks_like_colmap(path) {
        return colmap::read_colmap(path, options);
    }
    if colmap::parts::looks_like_parts(path) {
        return colmap::parts::read_parts(path, options);
    }
    if transforms::looks_like_transforms(path) {
        return transforms::read_transforms(path, options);
    }
    if transforms::looks_like_matrix_city(path) {
        return transforms::read_matrix_city(path, options);
    }
    if mega_nerf::looks_like_mega_nerf(path) {
        return mega_nerf::read_mega_nerf(path, options);
    }
    Err(InputError::new(
        path,
        format!(
            "no scene here; looked for {}, for the same in train and val, for transforms_train.json and transforms.json, for \
             MatrixCity's pose/block_all and for Mega-NeRF's coordinates.pt",
            colmap::LOOKED_FOR
        ),
        "give the folder that holds 'sparse' and 'images' or a transforms.json",
    ))
}
