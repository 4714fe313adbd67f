//! Reads OpenSfM's `reconstruction.json`, which OpenDroneMap writes as `opensfm/reconstruction.json`. The photos lie in
//! `images/` beside it, in OpenDroneMap's case in `images/` of the project.
//!
//! Conventions of the file: a pose is world to camera, as axis times angle and translation, with the camera's axes
//! right-down-forward. Focal lengths and the principal point are in units of the longer side of the picture, the principal
//! point counts from its centre. The lens models `perspective`, `simple_radial`, `radial` and `brown` are cases of
//! OpenCV's; `fisheye` and `fisheye_opencv` are cases of OpenCV's fisheye.
//!
//! A file may hold several reconstructions, whose frames have nothing in common: the one with the most photos is read,
//! the others are left out with a warning.
//!
//! Invariant: for any content of the file the result is a scene or an [`InputError`] that names file and place.

mod json;

use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::{Gathered, MAX_COORDINATE, PUT_THEM_THERE, RefusalWords, checked_intrinsics};
use crate::dataset::model::{Intrinsics, Lens, Pose, RawScene, ReadOptions};
use crate::dataset::photo_files::PhotoFiles;
use crate::dataset::photo_header::read_size;
use glam::{DMat3, DVec3};
use json::{LensCamera, PosedShot, Reconstruction};
use std::path::{Path, PathBuf};

const FILE: &str = "reconstruction.json";
/// Folder in which OpenDroneMap keeps it.
const FOLDER_OF_ODM: &str = "opensfm";
const EXPORT_AGAIN: &str = "copy the file again, or let OpenSfM or OpenDroneMap write it again";
const NO_LENS: &str = "undistort the photos, or use the lens model brown, radial, perspective or fisheye_opencv";

/// The reconstruction of a scene folder, if it has one.
fn file_in(folder: &Path) -> Option<PathBuf> {
    [folder.join(FILE), folder.join(FOLDER_OF_ODM).join(FILE)].into_iter().find(|file| file.is_file())
}

/// Whether [`read_opensfm`] would find something in this folder.
pub fn looks_like_opensfm(folder: &Path) -> bool {
    file_in(folder).is_some()
}

/// Reads a project folder, or a `reconstruction.json`.
/// Errors: the file is missing, broken or holds impossible numbers or an unsupported lens; a photo is missing (unless allowed); no
/// view is left.
pub fn read_opensfm(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let file = match path.is_file() {
        true => path.to_path_buf(),
        false => file_in(path).ok_or_else(|| InputError::new(path, format!("no {FILE} here"), EXPORT_AGAIN))?,
    };
    let folder = file.parent().unwrap_or(Path::new(""));
    let project = if folder.ends_with(FOLDER_OF_ODM) { folder.parent().unwrap_or(Path::new("")) } else { folder };
    let mut scene = RawScene::default();
    let reconstruction = largest(&file, json::load(&file)?, &mut scene.warnings)?;
    let photos = PhotoFiles::with_folders(project, options.images.as_deref().or(Some("images")), options);
    let mut gathered = Gathered::new(photos, options);
    for (name, shot) in &reconstruction.shots {
        let stays = |problem: String| InputError::new(&file, problem, EXPORT_AGAIN).at(format!("shot {name:?}"));
        let camera = reconstruction.cameras.get(&shot.camera);
        let camera = camera.ok_or_else(|| stays(format!("its camera {:?} is not in the file", shot.camera)))?;
        let photo = gathered.photos.find(name).map_err(stays)?;
        let size = match (camera.width, camera.height) {
            (0.0, 0.0) if photo.exists => read_size(&photo.path)?,
            (0.0, 0.0) => {
                gathered.missing.push(photo.name);
                continue;
            }
            (width, height) => (pixels(width), pixels(height)),
        };
        let refused = |(problem, remedy): (String, &str)| {
            InputError::new(&file, problem, remedy).at(format!("camera {:?}", shot.camera))
        };
        let intrinsics = intrinsics_of(camera, size).map_err(refused)?;
        gathered.add(photo, intrinsics, pose_of(shot), None);
    }
    let words = RefusalWords { photos: "", views: "", photo_is_missing: PUT_THEM_THERE, no_view: EXPORT_AGAIN };
    scene.views = gathered.finish(&file, &words, &mut scene.warnings)?;
    let dropped = reconstruction.points.dropped;
    if dropped > 0 {
        let said = format!("{}: {dropped} points are not finite or farther away than 1e15, dropped", file.display());
        scene.warnings.push(said);
    }
    scene.points = reconstruction.points.cloud;
    Ok(scene)
}

/// The reconstruction with the most photos; the first among equals.
fn largest(file: &Path, all: Vec<Reconstruction>, warnings: &mut Vec<String>) -> InputResult<Reconstruction> {
    let (parts, shots) = (all.len(), all.iter().map(|part| part.shots.len()).sum::<usize>());
    let largest = all.into_iter().rev().max_by_key(|part| part.shots.len());
    let largest = largest.filter(|part| !part.shots.is_empty());
    let largest = largest.ok_or_else(|| {
        let remedy = "the reconstruction failed: see the log of OpenSfM or OpenDroneMap";
        InputError::new(file, "it holds no photo with a pose", remedy)
    })?;
    if parts > 1 {
        warnings.push(format!(
            "{}: {parts} reconstructions that do not belong together; the largest is read, {} of {shots} photos",
            file.display(),
            largest.shots.len()
        ));
    }
    Ok(largest)
}

/// A number of pixels; 0, which the check of intrinsics refuses, where it is none.
fn pixels(number: f64) -> u64 {
    if number.fract() == 0.0 && (1.0..1e9).contains(&number) { number as u64 } else { 0 }
}

/// Intrinsics in pixels, or the problem with its remedy.
fn intrinsics_of(camera: &LensCamera, size: (u64, u64)) -> Result<Intrinsics, (String, &'static str)> {
    let c = camera;
    let (of_x, centre) = ([c.focal_x, c.focal_y], [c.c_x, c.c_y]);
    let beyond_fisheye = [c.k5, c.k6, c.p1, c.p2, c.s0, c.s1, c.s2, c.s3];
    let (focal, centre, lens) = match c.projection_type.as_str() {
        "" | "perspective" => ([c.focal; 2], [0.0; 2], Lens::Radial([c.k1, c.k2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])),
        "simple_radial" | "radial" | "brown" => {
            (of_x, centre, Lens::Radial([c.k1, c.k2, c.p1, c.p2, c.k3, 0.0, 0.0, 0.0]))
        }
        "fisheye" => ([c.focal; 2], [0.0; 2], Lens::Fisheye([c.k1, c.k2, 0.0, 0.0])),
        "fisheye_opencv" => (of_x, centre, Lens::Fisheye([c.k1, c.k2, c.k3, c.k4])),
        "fisheye62" | "fisheye624" if beyond_fisheye == [0.0; 8] => {
            (of_x, centre, Lens::Fisheye([c.k1, c.k2, c.k3, c.k4]))
        }
        other => return Err((format!("the lens model {other:?} is not supported"), NO_LENS)),
    };
    let side = size.0.max(size.1) as f64;
    let middle = [size.0 as f64 / 2.0, size.1 as f64 / 2.0];
    let centre = [middle[0] + centre[0] * side, middle[1] + centre[1] * side];
    checked_intrinsics(size, focal.map(|f| f * side), centre, lens).map_err(|problem| (problem, EXPORT_AGAIN))
}

/// The pose of a shot; `None` if it is impossible.
fn pose_of(shot: &PosedShot) -> Option<Pose> {
    let [axis, translation] = [shot.rotation, shot.translation].map(|v| v.map(|x| x.0));
    if !axis.iter().chain(&translation).all(|x| x.abs() <= MAX_COORDINATE) {
        return None;
    }
    let (axis, translation) = (DVec3::from_array(axis), DVec3::from_array(translation));
    Some(Pose { rotation: rotation_of(axis), translation })
}

/// The rotation about an axis by an angle in radians, given as their product (Rodrigues' formula).
fn rotation_of(axis: DVec3) -> DMat3 {
    let angle = axis.length();
    if angle == 0.0 {
        return DMat3::IDENTITY;
    }
    let n = axis / angle;
    let (sin, cos) = (libm::sin(angle), libm::cos(angle));
    let cross = DMat3::from_cols(DVec3::new(0.0, n.z, -n.y), DVec3::new(-n.z, 0.0, n.x), DVec3::new(n.y, -n.x, 0.0));
    let along = DMat3::from_cols(n * n.x, n * n.y, n * n.z);
    DMat3::IDENTITY * cos + cross * sin + along * (1.0 - cos)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let turn = rotation_of(DVec3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        assert!((turn * DVec3::X - DVec3::Y).length() < 1e-15);
        // Angles beyond a turn and tiny ones stay rotations, to a few roundings.
        for length in [1e-300, 1e-9, 3.0, 7.0, 1e6] {
            let turn = rotation_of(DVec3::new(0.6, 0.0, -0.8) * length);
            assert!((turn.determinant() - 1.0).abs() < 1e-14, "{length}");
        }
    }
}
