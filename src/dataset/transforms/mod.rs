//! Reads `transforms.json` scenes: nerfstudio's and instant-ngp's single file, Blender's
//! `transforms_train/val/test.json`, and MatrixCity's folders of such files (`matrix_city`). A photo is opened only for
//! its size, and only if the JSON does not state it.
//!
//! Invariants: 1. for any JSON content the result is a scene or an [`InputError`] that names file and key; 2. only a
//! bad pose, lists of names that lack the view or, when allowed, a missing photo drop a view, with a warning that names it.
//!
//! Files: a folder with `transforms_train.json` is a split scene. Its test set is `transforms_test.json`, or without it
//! `transforms_val.json`, whose views are dropped otherwise, with a warning. Any other folder is read from `transforms.json`, whose
//! `train_filenames`, `val_filenames` and `test_filenames` apply in the same way. A JSON given by its path prescribes no split.
//!
//! Poses are used as they are: `applied_transform` and `applied_scale` only document their origin, and `ply_file_path`
//! is in the same frame.
//!
//! Memory: at most 16 times the size of the files (measured: up to 11), plus the names in their folders, for any
//! content. Frames are read one at a time, and the first incomplete one is refused (`json`).

mod intrinsics;
mod json;
mod matrix_city;
pub(in crate::dataset) mod pose;

use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::{Gathered, RefusalWords, left_out};
use crate::dataset::model::{RawScene, RawView, ReadOptions, Split};
use crate::dataset::paths::read_name;
use crate::dataset::photo_files::{Photo, PhotoFiles, file_inside};
use crate::dataset::photo_header::read_size;
use intrinsics::Levels;
use json::{FIX_KEY, JsonFile, JsonNode, LISTS, Names, STAY_INSIDE};
pub use matrix_city::{looks_like_matrix_city, read_matrix_city};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Whether [`read_transforms`] would find something in this folder.
pub fn looks_like_transforms(folder: &Path) -> bool {
    ["transforms_train.json", "transforms.json"].iter().any(|n| folder.join(n).is_file())
}

/// Reads a folder with `transforms*.json` or one such file. Paths in it are relative to its folder and must stay
/// inside. `points_path` is set if `ply_file_path` names an existing file.
/// Errors: no JSON, broken JSON, keys of the wrong kind, unsupported cameras, names that leave the folder or occur twice, no
/// view left, missing photos whose size is needed.
pub fn read_transforms(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let mut scene = RawScene::default();
    let files = choose_files(path, &mut scene.warnings)?;
    let folder = files[0].0.parent().unwrap_or(Path::new(""));
    let photos = PhotoFiles::with_folders(folder, options.images.as_deref(), options);
    read_files(&files, Gathered::new(photos, options), None, &mut scene)?;
    Ok(scene)
}

/// The files to read and the split that each prescribes; never empty.
fn choose_files(path: &Path, warnings: &mut Vec<String>) -> InputResult<Vec<(PathBuf, Option<Split>)>> {
    if path.is_file() {
        return Ok(vec![(path.to_path_buf(), None)]);
    }
    let [single, train, val, test] =
        ["transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json"]
            .map(|n| Some(path.join(n)).filter(|p| p.is_file()));
    let Some(train) = train else {
        let none = "neither transforms_train.json nor transforms.json is here";
        let remedy = "give the folder that holds one of them, or the JSON itself";
        return single.map(|file| vec![(file, None)]).ok_or_else(|| InputError::new(path, none, remedy));
    };
    if let Some(single) = single {
        warnings.push(format!("{}: not read, because transforms_train.json exists beside it", single.display()));
    }
    if let (Some(_), Some(val)) = (&test, &val) {
        warnings.push(format!("{}: not read; transforms_test.json is the test set", val.display()));
    }
    let held_out = test.or(val).map(|file| (file, Some(Split::Test)));
    Ok([Some((train, Some(Split::Train))), held_out].into_iter().flatten().collect())
}

const WORDS: RefusalWords = RefusalWords {
    photos: "file_path",
    views: "frames",
    photo_is_missing: "put them there, name their folder with --images, or leave them out with --allow-missing",
    no_view: "write the file again",
};

/// Reads the frames of files into `scene`. `matrix_city` is MatrixCity's folder, if they are its files.
fn read_files(
    files: &[(PathBuf, Option<Split>)],
    gathered: Gathered<'_>,
    matrix_city: Option<&Path>,
    scene: &mut RawScene,
) -> InputResult<()> {
    let mut reading = Reading { gathered, unlisted: Vec::new(), matrix_city };
    for (file, split) in files {
        reading.add_file(file, &json::load(file)?, *split, scene)?;
    }
    let (file, names) = (&files[0].0, &reading.unlisted);
    let why = "neither train_filenames nor the held-out list has them";
    scene.warnings.extend((!names.is_empty()).then(|| left_out(file, names, why)));
    scene.views = reading.gathered.finish(file, &WORDS, &mut scene.warnings)?;
    Ok(())
}

/// The names of the photos of each set.
type PrescribedNames<'j> = [(Split, Option<&'j BTreeSet<String>>); 2];

struct Reading<'a> {
    gathered: Gathered<'a>,
    /// Frames that none of the used lists of file names contains.
    unlisted: Vec<String>,
    matrix_city: Option<&'a Path>,
}

impl Reading<'_> {
    fn add_file(
        &mut self,
        file: &Path,
        json: &JsonFile,
        split: Option<Split>,
        scene: &mut RawScene,
    ) -> InputResult<()> {
        let top = json.top();
        let folder = file.parent().unwrap_or(Path::new(""));
        if !json.has_frames()? && split != Some(Split::Test) {
            return Err(top.error("frames", "no frames", "write the file again with its frames"));
        }
        let prescribed = prescribed(json)?;
        json.for_each_frame(&mut |frame| self.add_frame(folder, &Levels { frame, top }, split, prescribed))?;
        if scene.points_path.is_none() {
            scene.points_path = points_path(&top, folder, &mut scene.warnings)?;
        }
        Ok(())
    }

    fn add_frame(
        &mut self,
        folder: &Path,
        levels: &Levels<'_>,
        split: Option<Split>,
        prescribed: Option<PrescribedNames<'_>>,
    ) -> InputResult<()> {
        let frame = &levels.frame;
        let (key, stated) = stated_path(frame)?;
        let refused = |problem: String| frame.error(key, problem, STAY_INSIDE);
        let split = match prescribed {
            None => split,
            Some(lists) => {
                let name = read_name("", &stated).map_err(refused)?.name;
                let found = lists.iter().find(|(_, names)| names.is_some_and(|names| names.contains(&name)));
                let Some((split, _)) = found else {
                    self.unlisted.push(stated.into_owned());
                    return Ok(());
                };
                Some(*split)
            }
        };
        let mut matrix = pose::read_matrix(frame)?;
        let photos = &self.gathered.photos;
        let photo = match &self.matrix_city {
            None => photos.find(&stated),
            Some(root) => {
                let base = folder.strip_prefix(root).unwrap_or(Path::new("")).to_string_lossy();
                matrix_city::find_photo(photos, &base, self.gathered.options.images.as_deref(), &stated)
            }
        };
        let photo = photo.map_err(refused)?;
        if self.matrix_city.is_some() {
            pose::scale_position(&mut matrix);
        }
        let Some(pose) = pose::make_pose(&matrix) else {
            self.gathered.bad_poses.push(photo.name);
            return Ok(());
        };
        let size = match levels.size()? {
            Some(size) => size,
            None if photo.exists => self.size_of_pixels(folder, levels, (key, &stated), &photo.path)?,
            None => {
                self.gathered.missing.push(photo.name);
                return Ok(());
            }
        };
        let intrinsics = levels.intrinsics(size)?;
        let mask_path = match frame.text("mask_path")? {
            None => None,
            Some(mask) => Some(file_inside(folder, mask).map_err(|p| frame.error("mask_path", p, STAY_INSIDE))?.1),
        };
        let Photo { name, path: image_path, .. } = photo;
        self.gathered.views.push(RawView { name, image_path, intrinsics, pose, mask_path, split });
        Ok(())
    }

    /// The size to which the pixels of a frame without `w` and `h` refer: that of the photo that the frame names, though `--images` may
    /// choose a smaller one (`photo`).
    /// Errors: the named photo is not there, and its size matters.
    fn size_of_pixels(
        &self,
        folder: &Path,
        levels: &Levels<'_>,
        (key, stated): (&str, &str),
        photo: &Path,
    ) -> InputResult<(u64, u64)> {
        let named = file_inside(folder, stated).ok().map(|(_, named)| named).filter(|named| named.is_file());
        let is_replaced = self.gathered.options.images.as_deref().is_some_and(|images| images != "images");
        if named.is_none() && is_replaced && levels.has_pixels() {
            let problem =
                format!("w and h are missing, and the focal length is in pixels of {stated:?}, which is not here");
            return Err(levels.frame.error(key, problem, "add w and h, or leave out --images"));
        }
        read_size(named.as_deref().unwrap_or(photo))
    }
}

/// The photo's path in a frame and its key; MatrixCity's own files number the photos instead.
fn stated_path<'a>(frame: &JsonNode<'a>) -> InputResult<(&'static str, std::borrow::Cow<'a, str>)> {
    if let Some(path) = frame.text("file_path")? {
        return Ok(("file_path", path.into()));
    }
    if frame.get("rot_mat").is_some()
        && let Some(index) = frame.get("frame_index").and_then(Value::as_u64)
    {
        return Ok(("frame_index", format!("{index:04}.png").into()));
    }
    Err(frame.error("file_path", "the key is missing", FIX_KEY))
}

/// The names that nerfstudio's lists of a file put into each set, if there are any; of the held-out lists `test_filenames` is
/// preferred.
fn prescribed(json: &JsonFile) -> InputResult<Option<PrescribedNames<'_>>> {
    let names = |list: usize| match json.names(list) {
        Names::Absent => Ok(None),
        Names::Listed(names) => Ok(Some(names)),
        Names::Bad(problem, remedy) => Err(json.top().error(LISTS[list], problem, remedy)),
    };
    let Some(train) = names(0)? else { return Ok(None) };
    let held_out = match names(2)?.filter(|test| !test.is_empty()) {
        Some(test) => Some(test),
        None => names(1)?,
    };
    if let Some(name) = held_out.and_then(|names| train.intersection(names).next()) {
        let problem = format!("'{name}' is in the train and in the held-out list");
        return Err(json.top().error(LISTS[0], problem, "a photo belongs to one of them"));
    }
    Ok(Some([(Split::Train, Some(train)), (Split::Test, held_out)]))
}

/// The PLY that the file names, if it exists.
fn points_path(top: &JsonNode<'_>, folder: &Path, warnings: &mut Vec<String>) -> InputResult<Option<PathBuf>> {
    let Some(stated) = top.text("ply_file_path")? else { return Ok(None) };
    let (name, path) = file_inside(folder, stated).map_err(|p| top.error("ply_file_path", p, STAY_INSIDE))?;
    if path.is_file() {
        return Ok(Some(path));
    }
    warnings.push(format!("{}: ply_file_path names '{name}', which does not exist", top.file.display()));
    Ok(None)
}
