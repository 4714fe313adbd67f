//! Chooses the reader for a path.

use crate::base::error::{InputError, InputResult};
use crate::dataset::model::RawScene;
pub use crate::dataset::model::ReadOptions;
use crate::dataset::{colmap, mega_nerf, opensfm, photos_only, reality_capture, transforms};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Reads a scene: a folder with a COLMAP model, with a model for each of `train` and `val`, with `transforms*.json`, in
/// MatrixCity's or in Mega-NeRF's layout, with OpenSfM's `reconstruction.json` or RealityCapture's CSV, or such a JSON or CSV
/// file. If a folder matches several, the first of these applies.
///
/// # Errors
/// Any problem with the files; if nothing matches, the error lists what was searched for.
pub fn read_scene(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let facts = std::fs::metadata(path).map_err(|e| InputError::io(path, "opening the scene", &e))?;
    let root = if facts.is_file() { path.parent().unwrap_or(Path::new("")) } else { path };
    let scene = read_kind(path, facts.is_file(), options)?;
    let is_above = !scene.root.as_os_str().is_empty();
    Ok(if is_above { scene } else { RawScene { root: root.to_path_buf(), ..scene } })
}

fn read_kind(path: &Path, is_file: bool, options: &ReadOptions) -> InputResult<RawScene> {
    if is_file {
        let ends_with = |ending: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
        return match () {
            () if ends_with("json") && is_a_list(path) => opensfm::read_opensfm(path, options),
            () if ends_with("json") => transforms::read_transforms(path, options),
            () if ends_with("csv") => reality_capture::read_reality_capture(path, options),
            () => {
                let problem =
                    "a scene is a folder, a transforms.json, a reconstruction.json or a CSV of RealityCapture";
                Err(InputError::new(path, problem, "give the folder that holds it"))
            }
        };
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
    if opensfm::looks_like_opensfm(path) {
        return opensfm::read_opensfm(path, options);
    }
    if reality_capture::looks_like_reality_capture(path) {
        return reality_capture::read_reality_capture(path, options);
    }
    if let Err(e) = std::fs::metadata(path)
        .and_then(|found| if found.is_dir() { std::fs::read_dir(path).map(|_| ()) } else { Ok(()) })
    {
        return Err(InputError::io(path, "reading the scene", &e));
    }
    if let Some((above, images)) = photos_only::scene_above(path) {
        let images = options.images.clone().or(Some(images));
        let mut scene = read_scene(&above, &ReadOptions { images, ..options.clone() })?;
        let (photos, above) = (path.display(), above.display());
        scene.warnings.insert(
            0,
            format!("{photos} holds photos without poses: the scene is read from the folder above, {above}"),
        );
        return Ok(scene);
    }
    if let Some(error) = photos_only::error(path) {
        return Err(error);
    }
    Err(InputError::new(
        path,
        format!(
            "no scene here; looked for {}, for the same in train and val, for transforms_train.json and transforms.json, for \
             MatrixCity's pose/block_all, for Mega-NeRF's coordinates.pt, for reconstruction.json and opensfm/reconstruction.json, \
             and for a CSV of RealityCapture",
            colmap::LOOKED_FOR
        ),
        "give the folder that holds 'sparse' and 'images' or a transforms.json",
    ))
}

/// Whether a JSON file holds a list, as OpenSfM's does, and not an object.
fn is_a_list(path: &Path) -> bool {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|file| file.take(4096).read_to_end(&mut head));
    read.is_ok() && head.iter().find(|byte| !byte.is_ascii_whitespace()) == Some(&b'[')
}
