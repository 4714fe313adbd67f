//! Reads scenes in Mega-NeRF's layout, in which Mill-19 and UrbanScene3D are published:
//!
//! ```text
//! coordinates.pt                  origin_drb [3], pose_scale_factor
//! train/metadata/<stem>.pt        W, H, intrinsics [4], c2w [3][4]; train/rgbs/<stem>.jpg
//! val/metadata/<stem>.pt          the same for the held-out photos; val/rgbs/<stem>.jpg
//! ```
//!
//! Poses are camera to world, with the camera's axes right-up-back (as OpenGL's) and the world's axes down-right-back.
//! Positions are `(metres - origin_drb) / pose_scale_factor`; this is undone here, so that a scene has its real size.
//! The layout has no points: if a `points.ply` in metres and in the world's axes exists beside `coordinates.pt`, it is
//! read; otherwise give points with `--init-ply`, or some are found by a sweep.
//!
//! Invariants: 1. for any file content the result is a scene or an [`InputError`] that names file and key; 2. names
//! come from the folder's listing, so none leaves the folder.

mod pickle;
mod torch_file;

use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::{Gathered, RefusalWords, checked_intrinsics};
use crate::dataset::model::{Intrinsics, Lens, Pose, RawScene, ReadOptions, Split};
use crate::dataset::photo_files::{Photo, PhotoFiles};
use crate::dataset::transforms::pose::make_pose;
use std::path::{Path, PathBuf};
use torch_file::TorchFile;

const REMEDY: &str = "fetch or write the dataset again; configs/README.md has the layout";

/// Whether [`read_mega_nerf`] would find something in this folder.
pub fn looks_like_mega_nerf(folder: &Path) -> bool {
    folder.join("coordinates.pt").is_file()
}

/// Reads a scene in Mega-NeRF's layout. `train` prescribes the training views, `val` the held-out ones.
/// Errors: a file is missing, broken or holds impossible numbers; a photo is missing (unless allowed); no view is left.
pub fn read_mega_nerf(folder: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let coordinates = TorchFile::open(&folder.join("coordinates.pt"))?;
    let origin = coordinates.numbers("origin_drb", &[&[3]])?;
    let scale = coordinates.number("pose_scale_factor")?;
    if !(scale.is_finite() && scale > 0.0 && origin.iter().all(|x| x.is_finite())) {
        let problem = format!("origin_drb {origin:?} or pose_scale_factor {scale} is impossible");
        return Err(InputError::new(folder.join("coordinates.pt"), problem, REMEDY));
    }
    let words = RefusalWords {
        photos: "",
        views: "train/metadata and val/metadata",
        photo_is_missing: "UrbanScene3D's photos are published apart from the poses: copy them into the rgbs folders; or leave \
                           the views out with --allow-missing",
        no_view: REMEDY,
    };
    let rgbs = options.images.as_deref().unwrap_or("rgbs");
    let photos = PhotoFiles::in_folders(folder, vec![folder.to_path_buf()], options.allow_missing);
    let mut gathered = Gathered::new(photos, options);
    for (part, split) in [("train", Split::Train), ("val", Split::Test)] {
        let metadata = folder.join(part).join("metadata");
        if split == Split::Test && !metadata.is_dir() {
            continue;
        }
        for file in files_with(&metadata, "pt")? {
            let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            // Mill-19 has .jpg, Sci-Art .JPG, others .png.
            let named = ["jpg", "JPG", "jpeg", "png", "PNG"]
                .map(|extension| folder.join(part).join(rgbs).join(format!("{stem}.{extension}")));
            let Some(path) = named.into_iter().find(|path| path.is_file()) else {
                gathered.missing.push(format!("{part}/{rgbs}/{stem}.*"));
                continue;
            };
            let name = format!("{part}/{rgbs}/{}", path.file_name().unwrap_or_default().to_string_lossy());
            let (intrinsics, pose) = read_metadata(&file, &origin, scale)?;
            gathered.add(Photo { name, path, exists: true }, intrinsics, pose, Some(split));
        }
    }
    let mut scene = RawScene::default();
    scene.views = gathered.finish(folder, &words, &mut scene.warnings)?;
    scene.points_path = Some(folder.join("points.ply")).filter(|path| path.is_file());
    Ok(scene)
}

/// Camera and pose of a file of metadata; no pose if it is impossible.
fn read_metadata(file: &Path, origin: &[f64], scale: f64) -> InputResult<(Intrinsics, Option<Pose>)> {
    let metadata = TorchFile::open(file)?;
    let size = |key: &str| -> InputResult<u64> {
        let n = metadata.number(key)?;
        // An invalid size becomes 0, which the check below refuses by name.
        Ok(if n.is_finite() && n >= 0.0 && n.fract() == 0.0 { n.min(1e9) as u64 } else { 0 })
    };
    let size = (size("W")?, size("H")?);
    let k = metadata.numbers("intrinsics", &[&[4]])?;
    let intrinsics = checked_intrinsics(size, [k[0], k[1]], [k[2], k[3]], Lens::Pinhole)
        .map_err(|problem| InputError::new(file, problem, REMEDY).at("key 'intrinsics'"))?;
    let c2w = metadata.numbers("c2w", &[&[3, 4], &[4, 4]])?;
    let mut matrix = [[0.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
    for ((row, from), origin) in matrix.iter_mut().zip(c2w.chunks(4)).zip(origin) {
        row.copy_from_slice(from);
        row[3] = row[3] * scale + origin;
    }
    Ok((intrinsics, make_pose(&matrix)))
}

fn files_with(folder: &Path, extension: &str) -> InputResult<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|e| InputError::io(folder, "listing the folder", &e))?;
    let mut files: Vec<PathBuf> =
        entries.flatten().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == extension)).collect();
    if let Some(other) = files.iter().find(|p| !p.is_file()) {
        // Opening a pipe would block.
        return Err(InputError::new(other, "not a regular file", REMEDY));
    }
    files.sort();
    Ok(files)
}
