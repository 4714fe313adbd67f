//! Turns a [`RawScene`] into a checked [`Dataset`]: checks every photo's header and end, scales intrinsics to training
//! size, removes offset and scale, and assigns each view to a set.
//!
//! Not here: reading models (the readers), checking the files of photos (`photo_checks`) and pixels ([`super::photo`], [`super::target_cache`]).
//!
//! Invariants: 1. every view of a dataset has a photo whose header and end marker exist and whose shape matches its
//! camera; 2. frame, scene scale and split depend on the views registered in the model, so dropping a photo with
//! `allow_missing` changes none of them; 3. everything dropped or repaired is in `warnings`.

use super::frame::{Extent, Frame, usable};
use super::import::{Cloud, LocalCloud};
use super::load_options::LoadOptions;
use super::model::{PointCloud, RawScene, RawView, Split};
use super::name_index::is_photo;
use super::photo::{PhotoSource, intrinsics_at};
use super::photo_checks::check_photos;
use super::photo_files::PhotoFiles;
use crate::base::error::{InputError, InputResult};
use crate::scene::camera::Camera;
use glam::DVec3;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const NAMES_LISTED: usize = 20;

/// Far plane, local units.
const FAR_PLANE: f32 = 1e10;

#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// Views, sorted by name.
    pub views: Vec<View>,
    /// Points, local frame, finite.
    pub points: Vec<[f32; 3]>,
    /// sRGB, one per point.
    pub colors: Vec<[u8; 3]>,
    pub frame: Frame,
    /// 1.1 times the largest camera distance from the mean of the cameras, without outliers; local units, > 0.
    pub scene_scale: f32,
    /// Everything dropped or repaired, one sentence each: the reader's, then the loader's.
    pub warnings: Vec<String>,
    /// Folder that the views' names are relative to.
    pub image_folder: PathBuf,
}

#[derive(Debug, Clone, PartialEq)]
pub struct View {
    pub name: String,
    pub split: Split,
    /// Pose and intrinsics in the local frame, without distortion, at training size.
    pub camera: Camera,
    pub photo: PhotoSource,
}

impl Dataset {
    /// Indices of the training views, ascending; never empty.
    pub fn train_views(&self) -> Vec<usize> {
        self.views_of(Split::Train)
    }

    pub fn test_views(&self) -> Vec<usize> {
        self.views_of(Split::Test)
    }

    fn views_of(&self, split: Split) -> Vec<usize> {
        (0..self.views.len()).filter(|&i| self.views[i].split == split).collect()
    }
}

/// Checks photos and converts a scene to the local frame.
/// Errors: options out of range, no usable view, no training view; missing photos (listed by name) unless
/// `allow_missing`; photos or masks that are empty, cut short, not JPEG or PNG, or whose shape does not match the
/// camera.
pub fn load_dataset(mut raw: RawScene, options: &LoadOptions) -> InputResult<Dataset> {
    let PointCloud { positions, colors } = std::mem::take(&mut raw.points);
    let measure = |centres: &[DVec3]| Ok(Extent::measure(centres, &positions));
    let (mut dataset, extent) = load_views(raw, options, measure)?;
    dataset.points.reserve_exact(positions.len());
    dataset.colors.reserve_exact(positions.len());
    let mut dropped = BTreeMap::new();
    for (position, color) in positions.into_iter().zip(colors) {
        let position = DVec3::from_array(position);
        if is_kept(position, &extent, &mut dropped) {
            dataset.points.push(dataset.frame.to_local(position).as_vec3().to_array());
            dataset.colors.push(color);
        }
    }
    warn_about_dropped(dropped, &mut dataset.warnings);
    Ok(dataset)
}

/// As [`load_dataset`], for points that may exceed memory: the dataset has no points, the source streams them.
/// Errors: as [`load_dataset`]; or the cloud's file cannot be read.
pub fn load_dataset_with_cloud<'c>(
    raw: RawScene,
    cloud: &'c Cloud,
    options: &LoadOptions,
) -> InputResult<(Dataset, LocalCloud<'c>)> {
    let measure = |centres: &[DVec3]| Extent::measure_by(centres, |centre| cloud.median_distance(centre));
    let (mut dataset, extent) = load_views(raw, options, measure)?;
    let local = LocalCloud { cloud, extent, frame: dataset.frame };
    let mut dropped = BTreeMap::new();
    cloud.for_each(|position, _| {
        is_kept(position, &extent, &mut dropped);
        Ok(())
    })?;
    warn_about_dropped(dropped, &mut dataset.warnings);
    Ok((dataset, local))
}

fn load_views(
    raw: RawScene,
    options: &LoadOptions,
    measure: impl FnOnce(&[DVec3]) -> InputResult<Extent>,
) -> InputResult<(Dataset, Extent)> {
    options.check()?;
    let mut warnings = raw.warnings;
    let image_folder = options.image_folder.clone().unwrap_or_else(|| image_folder_of(&raw.views));
    let root = match raw.root.as_os_str().is_empty() {
        true => image_folder.parent().unwrap_or(&image_folder),
        false => &raw.root,
    };
    if raw.views.is_empty() {
        return Err(InputError::new(image_folder, "the scene has no registered view", "give a model with photos"));
    }
    let splits = split_views(&raw.views, options, &mut warnings)?;
    let registered: Vec<(RawView, Split)> = raw.views.into_iter().zip(splits).collect();
    let extent = measure(&registered.iter().map(|(view, _)| view.pose.centre()).collect::<Vec<DVec3>>())?;
    let frame = extent.frame();
    let posed = drop_unusable_poses(registered, &extent, &mut warnings);
    let (scene_scale, outliers) =
        extent.scene_scale(&posed.iter().map(|(view, _)| view.pose.centre()).collect::<Vec<DVec3>>());
    if !outliers.is_empty() {
        let names = list_names(outliers.iter().map(|&i| posed[i].0.name.as_str()));
        let count = outliers.len();
        warnings
            .push(format!("{count} cameras are far from all others and do not count for the scene's size: {names}"));
    }
    let present = drop_missing(posed, options, (root, &image_folder), &mut warnings)?;
    let photos = check_photos(&present, options, (root, &image_folder), &mut warnings)?;
    warn_about_extra_photos(&photos, &mut warnings);
    let view = |((raw, split), photo): ((RawView, Split), PhotoSource)| {
        let k = intrinsics_at(&photo.intrinsics, photo.target);
        let camera = Camera {
            viewmat: frame.viewmat(&raw.pose),
            fx: k.fx as f32,
            fy: k.fy as f32,
            cx: k.cx as f32,
            cy: k.cy as f32,
            width: k.width,
            height: k.height,
            near_plane: options.near_plane as f32,
            far_plane: FAR_PLANE,
        };
        View { name: raw.name, split, camera, photo }
    };
    let views: Vec<View> = present.into_iter().zip(photos).map(view).collect();
    if !views.iter().any(|v| v.split == Split::Train) {
        let remedy = "check the split of the dataset, --test-every and --test-after";
        return Err(InputError::new(image_folder, "no view is left for training", remedy));
    }
    let scene_scale = (scene_scale / frame.scale) as f32;
    let (points, colors) = (Vec::new(), Vec::new());
    Ok((Dataset { views, points, colors, frame, scene_scale, warnings, image_folder }, extent))
}

/// The folder such that folder / name is the first view's path; that path's parent if there is none.
fn image_folder_of(views: &[RawView]) -> PathBuf {
    let Some(view) = views.first() else { return PathBuf::from(".") };
    let up = if view.image_path.ends_with(&view.name) { Path::new(&view.name).components().count() } else { 1 };
    view.image_path.ancestors().nth(up).unwrap_or(Path::new(".")).to_path_buf()
}

/// The set of every registered view: the dataset's own, otherwise by index in the sorted list of registered views
/// (including views without a photo, whose absence must not shift the others).
fn split_views(views: &[RawView], options: &LoadOptions, warnings: &mut Vec<String>) -> InputResult<Vec<Split>> {
    let by_index = |index: usize| {
        let is_test = match (options.test_after, options.test_every) {
            (Some(after), _) => index as u64 > u64::from(after),
            (None, Some(every)) if every > 0 => index.is_multiple_of(every as usize),
            _ => false,
        };
        if is_test { Split::Test } else { Split::Train }
    };
    let splits: Vec<Split> = views.iter().enumerate().map(|(i, v)| v.split.unwrap_or_else(|| by_index(i))).collect();
    if splits.contains(&Split::Train) {
        return Ok(splits);
    }
    if views.len() == 1 && views[0].split.is_none() {
        warnings.push("there is only one view: it is used for training, none is held out".to_string());
        return Ok(vec![Split::Train]);
    }
    if views.iter().all(|v| v.split == Some(Split::Test)) {
        let problem = "the dataset's own split has no training view";
        return Err(InputError::new(image_folder_of(views), problem, "add views to its training set"));
    }
    let problem = format!("every one of the {} views would be a test view", views.len());
    Err(InputError::new("--test-every", problem, "give 2 or more, or 0 to hold none out"))
}

/// Drops views whose pose or intrinsics are not finite, or that are implausibly far from all others.
fn drop_unusable_poses(
    registered: Vec<(RawView, Split)>,
    extent: &Extent,
    warnings: &mut Vec<String>,
) -> Vec<(RawView, Split)> {
    let is_good = |view: &RawView| {
        let k = &view.intrinsics;
        [k.fx, k.fy, k.cx, k.cy].iter().chain(k.lens.coefficients()).all(|x| x.is_finite())
            && k.fx > 0.0
            && k.fy > 0.0
            && view.pose.rotation.is_finite()
            && usable(view.pose.translation)
            && extent.is_plausible(view.pose.centre())
    };
    let (good, bad): (Vec<_>, Vec<_>) = registered.into_iter().partition(|(view, _)| is_good(view));
    if !bad.is_empty() {
        let names = list_names(bad.iter().map(|(view, _)| view.name.as_str()));
        warnings.push(format!(
            "{} views have a pose or intrinsics that are not finite or far beyond the scene, and are left out: {names}",
            bad.len()
        ));
    }
    good
}

/// Warns about pictures in the photos' folders that no view uses.
fn warn_about_extra_photos(photos: &[PhotoSource], warnings: &mut Vec<String>) {
    let mut used: BTreeSet<&Path> = photos.iter().map(|photo| photo.image_path.as_path()).collect();
    let folders: BTreeSet<&Path> = used.iter().filter_map(|path| path.parent()).collect();
    used.extend(photos.iter().filter_map(|photo| Some(photo.mask.as_ref()?.path.as_path())));
    let mut extra = Vec::new();
    for folder in folders {
        let Ok(entries) = std::fs::read_dir(folder) else { continue };
        let photos = entries.flatten().map(|e| e.path()).filter(|path| is_photo(path));
        extra.extend(photos.filter(|path| !used.contains(path.as_path())));
    }
    if !extra.is_empty() {
        extra.sort();
        let names: Vec<_> = extra.iter().filter_map(|p| p.file_name()).take(3).map(|n| n.to_string_lossy()).collect();
        let (count, names, more) = (extra.len(), names.join(", "), if extra.len() > 3 { ", ..." } else { "" });
        warnings.push(format!("{count} photos are not in the model and are not used: {names}{more}"));
    }
}

fn drop_missing(
    views: Vec<(RawView, Split)>,
    options: &LoadOptions,
    (root, image_folder): (&Path, &Path),
    warnings: &mut Vec<String>,
) -> InputResult<Vec<(RawView, Split)>> {
    let exists: Vec<bool> = views.par_iter().map(|(view, _)| view.image_path.is_file()).collect();
    let total = views.len();
    let (present, missing): (Vec<_>, Vec<_>) = views.into_iter().zip(exists).partition(|(_, exists)| *exists);
    let present: Vec<(RawView, Split)> = present.into_iter().map(|(view, _)| view).collect();
    if missing.is_empty() {
        return Ok(present);
    }
    let names: Vec<&str> = missing.iter().map(|((view, _), _)| view.name.as_str()).collect();
    let mut problem = format!("{} of {total} photos are missing: {}", missing.len(), list_names(names.iter().copied()));
    if !options.allow_missing || present.is_empty() {
        let photos = PhotoFiles::in_folders(root, vec![image_folder.to_path_buf()], true);
        problem.push_str(&photos.near_misses(&names));
    }
    if !options.allow_missing {
        let remedy = "copy them there, give the right folder with --images, or train without them with --allow-missing";
        return Err(InputError::new(image_folder, problem, remedy));
    }
    if present.is_empty() {
        return Err(InputError::new(image_folder, problem, "give the right folder with --images"));
    }
    warnings.push(problem);
    Ok(present)
}

/// Whether a point is finite and not implausibly far; counts the others by reason.
fn is_kept(position: DVec3, extent: &Extent, dropped: &mut BTreeMap<&'static str, usize>) -> bool {
    let is_kept = extent.is_plausible(position);
    if !is_kept {
        let far = position.is_finite();
        let why = if far { "are more than a million scene sizes away" } else { "are not finite" };
        *dropped.entry(why).or_default() += 1;
    }
    is_kept
}

fn warn_about_dropped(dropped: BTreeMap<&str, usize>, warnings: &mut Vec<String>) {
    warnings.extend(dropped.into_iter().map(|(why, count)| format!("{count} points {why} and are dropped")));
}

/// Up to twenty names, then a count.
fn list_names<'a>(names: impl ExactSizeIterator<Item = &'a str>) -> String {
    let total = names.len();
    let mut text = names.take(NAMES_LISTED).collect::<Vec<_>>().join(", ");
    if total > NAMES_LISTED {
        text.push_str(&format!(", and {} more", total - NAMES_LISTED));
    }
    text
}
