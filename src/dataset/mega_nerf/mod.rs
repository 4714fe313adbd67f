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
//! read; otherwise give points with `--init-ply`, or random ones are drawn.
//!
//! Invariants: 1. for any file content the result is a scene or an [`InputError`] that names file and key; 2. names
//! come from the folder's listing, so none leaves the folder.

mod pickle;
mod torch_file;
pub mod write;

use crate::base::error::{InputError, InputResult};
use crate::dataset::checks::{checked_intrinsics, left_out, listed, sort_views};
use crate::dataset::model::{Lens, RawScene, RawView, ReadOptions, Split};
use crate::dataset::transforms::pose::make_pose;
use std::path::{Path, PathBuf};
use torch_file::TorchFile;

const REMEDY: &str = "fetch or write the dataset again; configs/README.md has the layout";

/// Whether [`read_mega_nerf`] would find something in this folder.
pub fn looks_like_mega_nerf(folder: &Path) -> bool {
    folder.join("coordinates.pt").is_file()
}

/// Reads a scene in Mega-NeRF's layout. `train` prescribes the training views, `val` the held-out ones.
///
/// # Errors
/// A file is missing, broken or holds impossible numbers; a photo is missing (unless allowed); no view is left.
pub fn read_mega_nerf(folder: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let coordinates = TorchFile::open(&folder.join("coordinates.pt"))?;
    let origin = coordinates.numbers("origin_drb", &[&[3]])?;
    let scale = coordinates.number("pose_scale_factor")?;
    if !(scale.is_finite() && scale > 0.0 && origin.iter().all(|x| x.is_finite())) {
        let problem = format!("origin_drb {origin:?} or pose_scale_factor {scale} is impossible");
        return Err(InputError::new(folder.join("coordinates.pt"), problem, REMEDY));
    }
    let mut reading = Reading {
        options,
        origin: [origin[0], origin[1], origin[2]],
        scale,
        views: Vec::new(),
        missing: Vec::new(),
        bad_poses: Vec::new(),
    };
    for (part, split) in [("train", Split::Train), ("val", Split::Test)] {
        reading.add_part(&folder.join(part), part, split)?;
    }
    let mut scene = RawScene::default();
    reading.report(folder, &mut scene.warnings)?;
    scene.views = reading.views;
    scene.points_path = Some(folder.join("points.ply")).filter(|path| path.is_file());
    sort_views(folder, &mut scene.views)?;
    Ok(scene)
}

struct Reading<'a> {
    options: &'a ReadOptions,
    origin: [f64; 3],
    scale: f64,
    views: Vec<RawView>,
    missing: Vec<String>,
    bad_poses: Vec<String>,
}

impl Reading<'_> {
    fn add_part(&mut self, folder: &Path, part: &str, split: Split) -> InputResult<()> {
        let metadata = folder.join("metadata");
        if split == Split::Test && !metadata.is_dir() {
            return Ok(());
        }
        for file in files_with(&metadata, "pt")? {
            let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let Some(photo) = photo_of(&folder.join("rgbs"), &stem) else {
                self.missing.push(format!("{part}/rgbs/{stem}.*"));
                continue;
            };
            self.add_view(&file, photo, part, split)?;
        }
        Ok(())
    }

    fn add_view(&mut self, file: &Path, photo: PathBuf, part: &str, split: Split) -> InputResult<()> {
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
        for (row, from) in matrix.iter_mut().zip(c2w.chunks(4)).take(3) {
            row.copy_from_slice(from);
        }
        for (row, origin) in matrix.iter_mut().zip(self.origin) {
            row[3] = row[3] * self.scale + origin;
        }
        let name = photo.file_name().unwrap_or_default().to_string_lossy();
        let name = format!("{part}/rgbs/{name}");
        match make_pose(&matrix) {
            None => self.bad_poses.push(name),
            Some(pose) => self.views.push(RawView {
                name,
                image_path: photo,
                intrinsics,
                pose,
                mask_path: None,
                split: Some(split),
            }),
        }
        Ok(())
    }

    fn report(&self, folder: &Path, warnings: &mut Vec<String>) -> InputResult<()> {
        if !self.missing.is_empty() {
            let problem = format!("{} photo(s) are missing: {}", self.missing.len(), listed(&self.missing));
            if !self.options.allow_missing {
                let remedy = "UrbanScene3D's photos are published apart from the poses: copy them into the rgbs folders; or \
                              leave the views out with --allow-missing";
                return Err(InputError::new(folder, problem, remedy));
            }
            warnings.push(format!("{}: {problem}; their views are left out", folder.display()));
        }
        if !self.bad_poses.is_empty() {
            warnings.push(left_out(folder, &self.bad_poses, "their pose is not a rotation"));
        }
        if self.views.is_empty() {
            return Err(InputError::new(folder, "no view is left in train/metadata and val/metadata", REMEDY));
        }
        Ok(())
    }
}

/// Files of a folder with an extension, sorted.
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

/// The photo of a stem: Mill-19 has .jpg, Sci-Art .JPG, others .png.
fn photo_of(folder: &Path, stem: &str) -> Option<PathBuf> {
    let names = ["jpg", "JPG", "jpeg", "png", "PNG"].map(|extension| folder.join(format!("{stem}.{extension}")));
    names.into_iter().find(|path| path.is_file())
}
