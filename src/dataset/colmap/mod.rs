//! Reads a COLMAP scene: chooses the model folder, parses its files, and makes views. Opens no photo.
//!
//! Invariants: 1. for any file content the result is a scene or an [`InputError`] with file, place and remedy; 2.
//! memory grows with the kept views and points, not with tracks or 2D points; 3. only a bad pose drops a view, with a
//! warning that names it; anything that makes the rest of a file doubtful is an error.
//!
//! Camera models 0 to 6, 8 and 9 are supported (table in `models`). Rigs and frames files are ignored, because the
//! images file holds every pose. Image and point ids are ignored: views are identified by name.

mod binary;
mod models;
pub mod parts;
mod text;

use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::{Gathered, MAX_COORDINATE, PUT_THEM_THERE, RefusalWords};
pub use crate::dataset::model::ReadOptions;
use crate::dataset::model::{Intrinsics, PointCloud, Pose, RawScene, TakePoint};
use crate::dataset::photo_files::PhotoFiles;
use glam::{DMat3, DQuat, DVec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Places that are searched for a model, for messages.
pub(super) const LOOKED_FOR: &str = "COLMAP's cameras and images files (.bin or .txt) in sparse/*, sparse, colmap/sparse/*, colmap/sparse and the folder itself";
/// Remedy for a file that COLMAP cannot have written.
const DAMAGED: &str = "the file is damaged or cut short: copy it again or export the model again";
/// Remedy for intrinsics that no lens has. COLMAP writes such where a reconstruction fails.
const NO_LENS: &str = "the file is damaged, or the reconstruction of this camera failed (too few photos, or all from one line or in one \
     direction): copy it again, or find the poses again with gsscale-poses";
const STAY_INSIDE: &str = "image names must be relative to the image folder and stay inside it";
const WORDS: RefusalWords = RefusalWords {
    photos: "",
    views: "",
    photo_is_missing: PUT_THEM_THERE,
    no_view: "export the model again; its rotations and translations must be finite numbers",
};
/// A quaternion with a smaller largest component has no direction.
const MIN_QUAT: f64 = 1e-6;

type Cameras = BTreeMap<u32, Intrinsics>;

struct ImageRecord {
    /// Byte or line where the entry starts.
    position: u64,
    camera_id: u32,
    /// w, x, y, z as in the file, world to camera.
    quat: [f64; 4],
    translation: [f64; 3],
    name: String,
}

/// A folder with cameras and images in one of the two formats.
struct ModelFolder {
    folder: PathBuf,
    is_binary: bool,
}

impl ModelFolder {
    fn of(folder: PathBuf) -> Option<ModelFolder> {
        let both = |ext: &str| ["cameras", "images"].iter().all(|n| folder.join(format!("{n}.{ext}")).is_file());
        let is_binary = both("bin");
        (is_binary || both("txt")).then_some(ModelFolder { folder, is_binary })
    }

    fn file(&self, stem: &str) -> PathBuf {
        self.folder.join(format!("{stem}.{}", if self.is_binary { "bin" } else { "txt" }))
    }

    fn count_images(&self) -> InputResult<u64> {
        let path = self.file("images");
        if self.is_binary { binary::count_images(&path) } else { text::count_images(&path) }
    }
}

/// Whether [`read_colmap`] would find a COLMAP model.
pub fn looks_like_colmap(scene: &Path) -> bool {
    !find_models(scene).is_empty()
}

/// Reads the COLMAP model of a scene folder. Views are sorted by name; `image_path` is `scene/<images>/<name>`.
/// Non-finite points are dropped and counted. If there is no image folder, other places are
/// searched ([`parts`]).
/// Errors: no model, no image folder, files that are truncated, contradict themselves or have more than 1 % non-finite points,
/// names that would leave the image folder or occur twice, unsupported cameras.
pub fn read_colmap(scene: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    if !looks_like_colmap(scene) {
        let problem = format!("no COLMAP model here; looked for {LOOKED_FOR}");
        return Err(InputError::new(scene, problem, "give the folder that holds 'sparse' and 'images'"));
    }
    let mut warnings = Vec::new();
    let folders = parts::image_folders(scene, options, &mut warnings)?;
    read_model((scene, options), folders, Some(options.points_later), warnings)
}

/// Reads the model of a folder whose photos are in `image_folders`. `points_later`: whether the caller reads the points
/// later; `None` leaves them out. The scene's warnings begin with these.
fn read_model(
    (folder, options): (&Path, &ReadOptions),
    image_folders: Vec<PathBuf>,
    points_later: Option<bool>,
    mut warnings: Vec<String>,
) -> InputResult<RawScene> {
    let model = choose_model(folder, &mut warnings)?;
    let cameras_path = model.file("cameras");
    let images_path = model.file("images");
    let (cameras, images) = if model.is_binary {
        (binary::read_cameras(&cameras_path, &mut warnings)?, binary::read_images(&images_path, &mut warnings)?)
    } else {
        (text::read_cameras(&cameras_path, &mut warnings)?, text::read_images(&images_path, &mut warnings)?)
    };
    let unit = if model.is_binary { "byte" } else { "line" };
    if images.is_empty() {
        let remedy = "check that COLMAP registered any photo";
        return Err(InputError::new(images_path, "the model holds no images", remedy));
    }
    let photos = PhotoFiles::in_folders(folder, image_folders.clone(), options.allow_missing);
    let mut gathered = Gathered::new(photos, options);
    for image in images {
        let place = format!("{unit} {}", image.position);
        let refused = |problem: String| InputError::new(&images_path, problem, STAY_INSIDE).at(&place);
        let photo = gathered.photos.place(&image.name).map_err(refused)?;
        let intrinsics = *cameras.get(&image.camera_id).ok_or_else(|| {
            let problem = format!("camera {} is not in the cameras file", image.camera_id);
            InputError::new(&images_path, problem, DAMAGED).at(format!("{place}, image '{}'", photo.name))
        })?;
        gathered.add(photo, intrinsics, make_pose(image.quat, image.translation), None);
    }
    parts::find_photos(&mut gathered.views, &image_folders)?;
    gathered.photos.complete(&mut gathered.views);
    let views = gathered.finish(&images_path, &WORDS, &mut warnings)?;
    let (points, points_path) = match points_later {
        None => (PointCloud::default(), None),
        Some(later) => read_points(&model, later, &mut warnings)?,
    };
    Ok(RawScene { views, points, points_path, warnings, ..RawScene::default() })
}

fn find_models(scene: &Path) -> Vec<ModelFolder> {
    let mut folders = Vec::new();
    for parent in ["sparse", "colmap/sparse"] {
        let parent = scene.join(parent);
        let mut inside: Vec<PathBuf> =
            std::fs::read_dir(&parent).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        inside.sort();
        folders.extend(inside);
        folders.push(parent);
    }
    folders.push(scene.to_path_buf());
    folders.into_iter().filter_map(ModelFolder::of).collect()
}

/// The model with the most images; the first among equals.
fn choose_model(scene: &Path, warnings: &mut Vec<String>) -> InputResult<ModelFolder> {
    let mut models = find_models(scene);
    if models.len() == 1 {
        return Ok(models.remove(0));
    }
    let total = models.len();
    let mut best: Option<(u64, ModelFolder)> = None;
    let mut first_error = None;
    for model in models {
        match model.count_images() {
            Ok(count) if best.as_ref().is_none_or(|(most, _)| count > *most) => best = Some((count, model)),
            Ok(_) => {}
            Err(error) => {
                warnings.push(format!("{}: this model is skipped: {}", model.folder.display(), error.problem));
                first_error.get_or_insert(error);
            }
        }
    }
    match (best, first_error) {
        (Some((count, model)), _) => {
            let folder = model.folder.display();
            warnings.push(format!("{total} COLMAP models found; {folder} has the most images ({count}) and is used"));
            Ok(model)
        }
        (None, Some(error)) => Err(error),
        (None, None) => Err(InputError::new(scene, "no COLMAP model can be read", DAMAGED)),
    }
}

/// The pose of a w-first quaternion of any length and a translation; `None` if they are unusable.
fn make_pose(quat: [f64; 4], translation: [f64; 3]) -> Option<Pose> {
    let largest = quat.iter().fold(0.0f64, |m, q| m.max(q.abs()));
    let finite = quat.iter().all(|q| q.is_finite()) && translation.iter().all(|t| t.abs() <= MAX_COORDINATE);
    if !finite || largest < MIN_QUAT {
        return None;
    }
    // Divided by the largest component first, so that squares stay finite.
    let [w, x, y, z] = quat.map(|q| q / largest);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    Some(Pose { rotation, translation: DVec3::from_array(translation) })
}

/// Streams every point of a `points3D.bin` or `points3D.txt` to `take`, in file order; skips tracks, drops non-finite
/// points and counts them in a warning.
/// Errors: the file is damaged or has more than 1 % non-finite points; or `take` failed.
pub fn stream_points(file: &Path, warnings: &mut Vec<String>, take: &mut TakePoint<'_>) -> InputResult<()> {
    let is_text = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("txt"));
    if is_text { text::read_points(file, warnings, take) } else { binary::read_points(file, warnings, take) }
}

/// Points of the model: from either format, that of the images first. A `points3D.ply` is left to the caller by path,
/// and so is any file if points are to be read `later`.
fn read_points(
    model: &ModelFolder,
    later: bool,
    warnings: &mut Vec<String>,
) -> InputResult<(PointCloud, Option<PathBuf>)> {
    let (bin, txt) = (model.folder.join("points3D.bin"), model.folder.join("points3D.txt"));
    let prefer_bin = model.is_binary || !txt.is_file();
    let own = [(bin.is_file() && prefer_bin).then_some(bin), txt.is_file().then_some(txt)].into_iter().flatten().next();
    if let Some(file) = own {
        if later {
            return Ok((PointCloud::default(), Some(file)));
        }
        let mut cloud = PointCloud::default();
        let mut take = |position, color| {
            cloud.positions.push(position);
            cloud.colors.push(color);
            Ok(())
        };
        stream_points(&file, warnings, &mut take)?;
        return Ok((cloud, None));
    }
    let ply = model.folder.join("points3D.ply");
    if ply.is_file() {
        return Ok((PointCloud::default(), Some(ply)));
    }
    warnings.push(format!("{}: no points3D file, so there are no points to start from", model.folder.display()));
    Ok((PointCloud::default(), None))
}

/// Counts points, and the non-finite ones among them.
#[derive(Default)]
struct PointTally {
    total: u64,
    dropped: u64,
    first_dropped: u64,
}

impl PointTally {
    fn add(&mut self, position: [f64; 3], color: [u8; 3], place: u64, take: &mut TakePoint<'_>) -> InputResult<()> {
        self.total += 1;
        if position.iter().all(|x| x.is_finite()) {
            return take(position, color);
        }
        if self.dropped == 0 {
            self.first_dropped = place;
        }
        self.dropped += 1;
        Ok(())
    }

    /// Fails if more than 1 % were dropped.
    fn finish(self, path: &Path, unit: &str, warnings: &mut Vec<String>) -> InputResult<()> {
        let total = self.total;
        if self.dropped.saturating_mul(100) > total {
            let problem = format!("{} of {total} points are not finite numbers, more than 1 %", self.dropped);
            return Err(InputError::new(path, problem, DAMAGED).at(format!("{unit} {}", self.first_dropped)));
        }
        if self.dropped > 0 {
            let (file, dropped, first) = (path.display(), self.dropped, self.first_dropped);
            warnings
                .push(format!("{file}: {dropped} of {total} points are not finite (first: {unit} {first}), dropped"));
        }
        if total == 0 {
            warnings.push(format!("{}: the file holds no points", path.display()));
        }
        Ok(())
    }
}
