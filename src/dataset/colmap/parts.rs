//! Scenes with photos in a training and a held-out folder, such as Mill-19 and UrbanScene3D with the COLMAP models that
//! the CityGaussian line publishes:
//!
//! ```text
//! train/sparse/0/  train/rgbs/      val/sparse/0/  val/rgbs/
//! ```
//!
//! or with one model of all photos in `sparse/0/`. They are read as if the folders were merged, without copying: a view
//! keeps its own name, so that order and split by index equal those of the merged folder.
//!
//! Invariants: 1. a photo name that both folders have is resolved without guessing: with two models the folder's name
//! distinguishes the views, with one model it is an error; 2. with two models the folders prescribe the split.

use super::read_model;
use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::sort_views;
use crate::dataset::model::{RawScene, RawView, ReadOptions, Split};
use crate::dataset::name_index::{folded, photos_in};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Photo folders inside a part: CityGaussian's name, Mega-NeRF's, and that of COLMAP's scripts.
const PHOTOS: [&str; 3] = ["images", "rgbs", "input"];
const HELD_OUT: [&str; 2] = ["val", "test"];

pub(in crate::dataset) fn photo_folder(part: &Path) -> Option<PathBuf> {
    PHOTOS.iter().map(|name| part.join(name)).find(|path| path.is_dir())
}

/// Folders of a training and a held-out part, each with a model.
fn parts(scene: &Path) -> Option<[PathBuf; 2]> {
    let with_model = |name: &str| Some(scene.join(name)).filter(|part| super::looks_like_colmap(part));
    Some([with_model("train")?, HELD_OUT.into_iter().find_map(with_model)?])
}

/// Whether [`read_parts`] would find something in this folder.
pub fn looks_like_parts(scene: &Path) -> bool {
    parts(scene).is_some()
}

/// Reads both parts; the points are those of the training part.
/// Errors: as [`super::read_colmap`] for either part; or a part has no photos.
pub fn read_parts(scene: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let Some(folders) = parts(scene) else {
        return Err(InputError::new(scene, "no models in train/sparse and val/sparse", "put them there"));
    };
    let mut all = RawScene::default();
    let mut names = BTreeSet::new();
    let mut shared = false;
    for (folder, split) in folders.iter().zip([Split::Train, Split::Test]) {
        let photos = match &options.images {
            Some(images) => Some(folder.join(images)).filter(|photos| photos.is_dir()),
            None => photo_folder(folder),
        };
        let photos = photos.ok_or_else(|| {
            let places = options.images.clone().unwrap_or_else(|| PHOTOS.join(", "));
            let problem = format!("no photos here; looked for {places}");
            InputError::new(folder, problem, "put them into rgbs or images, or name their folder with --images")
        })?;
        let points = (split == Split::Train).then_some(options.points_later);
        let RawScene { views, points, points_path, warnings, .. } =
            read_model((folder, options), vec![photos], points, Vec::new())?;
        all.warnings.extend(warnings);
        if split == Split::Train {
            (all.points, all.points_path) = (points, points_path);
        }
        for view in views {
            shared |= !names.insert(view.name.clone());
            all.views.push(RawView { split: Some(split), ..view });
        }
    }
    if shared {
        for view in &mut all.views {
            let part = if view.split == Some(Split::Train) { &folders[0] } else { &folders[1] };
            view.name = format!("{}/{}", part.file_name().unwrap_or_default().to_string_lossy(), view.name);
        }
    }
    sort_views(scene, &mut all.views)?;
    Ok(all)
}

/// The folders of the photos of one model: the named one or `images`; otherwise those of the parts, a folder in the scene with
/// another usual name, or the scene itself.
pub(super) fn image_folders(
    scene: &Path,
    options: &ReadOptions,
    warnings: &mut Vec<String>,
) -> InputResult<Vec<PathBuf>> {
    let stated = scene.join(options.images.as_deref().unwrap_or("images"));
    if stated.is_dir() {
        return Ok(vec![stated]);
    }
    let in_part = |part: &&str| match &options.images {
        Some(images) => Some(scene.join(part).join(images)).filter(|photos| photos.is_dir()),
        None => photo_folder(&scene.join(part)),
    };
    let apart: Vec<PathBuf> = ["train", "val", "test"].iter().filter_map(in_part).collect();
    if !apart.is_empty() {
        return Ok(apart);
    }
    let entries = std::fs::read_dir(scene).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut folders: Vec<PathBuf> = entries.filter(|path| path.is_dir() && photos_in(path) > 0).collect();
    folders.sort();
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let same = |path: &&PathBuf| folded(&name(path)) == folded(&name(&stated));
    let other = match options.images {
        Some(_) => folders.iter().find(same).cloned(),
        None => folders.iter().find(same).cloned().or_else(|| photo_folder(scene)),
    };
    if let Some(found) = other {
        warnings.push(format!("{} does not exist: the photos are read from {}", stated.display(), found.display()));
        return Ok(vec![found]);
    }
    // As `gsscale-poses` leaves a flat folder of photos.
    if options.images.is_none() && photos_in(scene) > 0 {
        return Ok(vec![scene.to_path_buf()]);
    }
    let found = folders.iter().map(|path| name(path)).collect::<Vec<_>>().join(", ");
    // The model was made of all of them: its names begin with the folders.
    if options.images.is_none() && folders.len() > 1 {
        warnings.push(format!("{} does not exist: the photos are read from {found}", stated.display()));
        return Ok(vec![scene.to_path_buf()]);
    }
    let problem = match folders.is_empty() {
        true => String::from("the image folder does not exist"),
        false => format!("the image folder does not exist; these hold pictures: {found}"),
    };
    Err(InputError::new(&stated, problem, "name the folder of the photos, relative to the scene, with --images"))
}

/// For one model of all photos without a common folder: finds each view's photo in one of `folders`.
pub(super) fn find_photos(views: &mut [RawView], folders: &[PathBuf]) -> InputResult<()> {
    if folders.len() < 2 {
        return Ok(());
    }
    for view in views {
        let found: Vec<PathBuf> = folders.iter().map(|f| f.join(&view.name)).filter(|path| path.is_file()).collect();
        match &found[..] {
            // Looked for under near names, then reported by the loader.
            [] => {}
            [path] => view.image_path.clone_from(path),
            _ => {
                let problem = format!("the model's photo '{}' is in {} folders", view.name, found.len());
                let places = found.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ");
                let remedy =
                    "use one model for each folder (train/sparse/0, val/sparse/0), or merge the photos into images";
                return Err(InputError::new(&found[0], problem, remedy).at(places));
            }
        }
    }
    Ok(())
}
