//! Turns a [`RawScene`] into a checked [`Dataset`]: checks every photo's header, shape and mask, scales intrinsics to training
//! size, removes offset and scale, and assigns each view to a set.
//!
//! Not here: reading models (the readers), where masks are found ([`super::masks`]) and pixels ([`super::photo`],
//! [`super::target_cache`]).
//!
//! Invariants: 1. every view of a dataset has a photo whose header and end marker exist and whose shape matches its
//! camera; 2. frame, scene scale and split depend on the views registered in the model, so dropping a photo with
//! `allow_missing` or a views file changes none of them; 3. everything dropped or repaired is in `warnings`. The list of a views file, which drops most views, is no repair.

use super::frame::{Extent, Frame, usable};
use super::import::{Cloud, LocalCloud};
use super::masks::{FoundMask, MaskIndex, MaskSource};
use super::model::{Intrinsics, PointCloud, RawScene, RawView, Split};
use super::name_index::is_photo;
use super::photo::{Alpha, PhotoSource, holds_0_and_1, intrinsics_at};
use super::photo_files::PhotoFiles;
use super::photo_header::read_header;
use super::resize::{Size, divided_size, is_rounded_shape, same_shape};
use super::undistort::Undistorter;
use crate::base::error::{InputError, InputResult};
use crate::base::text::read_text;
use crate::base::units::{counted, counted_are};
use crate::scene::camera::Camera;
use glam::DVec3;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const NAMES_LISTED: usize = 20;

/// Longest list of views, bytes.
const LIST_BYTES_MAX: u64 = 1 << 30;

/// Masks that are decoded before a run, to say how they are read.
const MASKS_LOOKED_AT: usize = 3;

#[derive(Debug, Clone, PartialEq)]
pub struct LoadOptions {
    /// Photos are downscaled by this factor, at least 1; each side is rounded to nearest.
    pub data_factor: f64,
    /// Limit of the longer side after `data_factor`, pixels.
    pub max_resolution: Option<u32>,
    /// Every N-th registered view, sorted by name (index % N == 0), is a test view; `None` or 0: none.
    pub test_every: Option<u32>,
    /// Registered views with index > N are test views; overrides `test_every`.
    pub test_after: Option<u32>,
    /// Whether masks are used, and the alpha of photos as a mask.
    pub masks: bool,
    /// The colour of transparent pixels where alpha is no mask, sRGB.
    pub background: [u8; 3],
    /// Keep black instead of white.
    pub invert_masks: bool,
    /// Drop views without a photo instead of failing.
    pub allow_missing: bool,
    /// Near plane in robust scene sizes, the local unit (see [`Extent::frame`]): gsplat uses 0.01 in a scene normalised
    /// to a median camera distance of 1.
    pub near_plane: f64,
    /// A file that lists the names of the views to keep, one on each line; `None` keeps all.
    pub views_file: Option<PathBuf>,
}

impl Default for LoadOptions {
    fn default() -> Self {
        LoadOptions {
            data_factor: 1.0,
            max_resolution: None,
            test_every: Some(8),
            test_after: None,
            masks: true,
            background: [0; 3],
            invert_masks: false,
            allow_missing: false,
            near_plane: 0.01,
            views_file: None,
        }
    }
}

impl LoadOptions {
    /// Refuses a value out of range.
    fn check(&self) -> InputResult<()> {
        let (factor, near) = (self.data_factor, self.near_plane);
        let (flag, problem, remedy) = if !(1.0..=1e4).contains(&factor) {
            ("--data-factor", format!("{factor} is not between 1 and 10000"), "give 1 to 10000, such as 2")
        } else if self.max_resolution == Some(0) {
            ("--max-resolution", "0 leaves no pixel".to_string(), "give the longer side in pixels")
        } else if !(near > 0.0 && near <= 1e3) {
            ("--near-plane", format!("{near} is not between 0 and 1000"), "the usual value is 0.01")
        } else {
            return Ok(());
        };
        Err(InputError::new(flag, problem, remedy))
    }
}

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
    /// Folder of the scene.
    pub root: PathBuf,
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
    #[cfg(test)]
    pub(crate) fn without_views() -> Dataset {
        Dataset {
            views: Vec::new(),
            points: Vec::new(),
            colors: Vec::new(),
            frame: Frame { origin: DVec3::ZERO, scale: 1.0 },
            scene_scale: 1.0,
            warnings: Vec::new(),
            image_folder: PathBuf::new(),
            root: PathBuf::new(),
        }
    }

    /// Indices of the training views, ascending; never empty.
    pub fn train_views(&self) -> Vec<usize> {
        self.views_of(Split::Train)
    }

    pub fn test_views(&self) -> Vec<usize> {
        self.views_of(Split::Test)
    }

    /// The cameras of the training views, in their order.
    pub fn train_cameras(&self) -> Vec<Camera> {
        self.train_views().into_iter().map(|view| self.views[view].camera).collect()
    }

    /// The photo folder that is `path` or holds it, if any; `path` need not exist. A photo folder that holds the whole scene counts only
    /// as `path` itself, since results may lie in the scene.
    pub fn photo_folder_around(&self, path: &Path) -> Option<PathBuf> {
        let (path, root) = (resolved(path), resolved(&self.root));
        let folders: BTreeSet<&Path> = self.views.iter().filter_map(|view| view.photo.image_path.parent()).collect();
        let mut folders = folders.into_iter().chain([self.image_folder.as_path()]).map(resolved);
        folders.find(|folder| path == *folder || path.starts_with(folder) && !root.starts_with(folder))
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
    let image_folder = image_folder_of(&raw.views);
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
    let posed = match &options.views_file {
        Some(file) => keep_listed(posed, file)?,
        None => posed,
    };
    let present = drop_missing(posed, options, (root, &image_folder), &mut warnings)?;
    let photos = check_photos(&present, options, (root, &image_folder), &mut warnings)?;
    if options.views_file.is_none() {
        warn_about_extra_photos(&photos, &mut warnings);
    }
    let view = |((raw, split), photo): ((RawView, Split), PhotoSource)| {
        let k = intrinsics_at(&photo.intrinsics, photo.target);
        let pinhole = [k.fx, k.fy, k.cx, k.cy].map(|x| x as f32);
        let camera = Camera::pinhole(frame.viewmat(&raw.pose), pinhole, [k.width, k.height]);
        let camera = Camera { near_plane: options.near_plane as f32, ..camera };
        View { name: raw.name, split, camera, photo }
    };
    let views: Vec<View> = present.into_iter().zip(photos).map(view).collect();
    if !views.iter().any(|v| v.split == Split::Train) {
        let remedy = "check the split of the dataset, --test-every and --test-after";
        return Err(InputError::new(image_folder, "no view is left for training", remedy));
    }
    let shows_any = |View { photo: PhotoSource { intrinsics, .. }, .. }: &View| {
        !intrinsics.lens.distorts() || Undistorter::new(*intrinsics).shows_any()
    };
    if !views.iter().any(shows_any) {
        let problem = "no photo has a pixel left without its lens distortion";
        return Err(InputError::new(image_folder, problem, "correct the distortion of the cameras (k1, k2 and so on)"));
    }
    let scene_scale = (scene_scale / frame.scale) as f32;
    let (points, colors) = (Vec::new(), Vec::new());
    let root = root.to_path_buf();
    Ok((Dataset { views, points, colors, frame, scene_scale, warnings, image_folder, root }, extent))
}

/// The path without links, as far as it exists.
fn resolved(path: &Path) -> PathBuf {
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let of = |above: &Path| Some(above.canonicalize().ok()?.join(whole.strip_prefix(above).ok()?));
    whole.ancestors().find_map(of).unwrap_or_else(|| whole.clone())
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

/// Keeps the views that a file lists by name.
/// Errors: the file cannot be read, or lists a view that the scene lacks.
fn keep_listed(views: Vec<(RawView, Split)>, file: &Path) -> InputResult<Vec<(RawView, Split)>> {
    let text = read_text(file, LIST_BYTES_MAX, "give a file with the name of a photo on each line")?;
    let listed: BTreeSet<&str> = text.lines().filter(|line| !line.is_empty()).collect();
    let kept: Vec<_> = views.into_iter().filter(|(view, _)| listed.contains(view.name.as_str())).collect();
    let found: BTreeSet<&str> = kept.iter().map(|(view, _)| view.name.as_str()).collect();
    let lacking: Vec<&str> = listed.difference(&found).copied().collect();
    if lacking.is_empty() && !kept.is_empty() {
        return Ok(kept);
    }
    let (count, total, names) = (lacking.len(), listed.len(), list_names(lacking.into_iter()));
    let problem = match total {
        0 => "it lists no photo".to_string(),
        _ => format!("{count} of its {total} photos are not in the scene, or have no usable pose: {names}"),
    };
    Err(InputError::new(file, problem, "list names as the model of the scene has them, at least one"))
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
        let (are, names) = (counted_are(extra.len() as u64, "photo"), names.join(", "));
        let more = if extra.len() > 3 { ", ..." } else { "" };
        warnings.push(format!("{are} not in the model and not used: {names}{more}"));
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
    let refused = |((view, _), _): &((RawView, Split), bool)| {
        std::fs::metadata(&view.image_path).err().filter(|e| e.kind() == std::io::ErrorKind::PermissionDenied)
    };
    if let Some(error) = missing.iter().find_map(refused).filter(|_| !options.allow_missing) {
        return Err(InputError::io(image_folder, "looking for the photos", &error));
    }
    let names: Vec<&str> = missing.iter().map(|((view, _), _)| view.name.as_str()).collect();
    let are = if names.len() == 1 { "is" } else { "are" };
    let mut problem = format!("{} of {total} photos {are} missing: {}", names.len(), list_names(names.iter().copied()));
    if !options.allow_missing || present.is_empty() {
        let photos = PhotoFiles::in_folders(root, vec![image_folder.to_path_buf()], true)
            .without(present.iter().map(|(view, _)| view.image_path.as_path()));
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

/// The first of the errors of photos of these names, with the names of the other photos.
pub fn first_error(errors: Vec<(&str, InputError)>) -> Option<InputError> {
    let (mut names, mut first) = (Vec::new(), None);
    for (name, error) in errors {
        match first {
            None => first = Some(error),
            Some(_) => names.push(name),
        }
    }
    first.map(|mut error| {
        if !names.is_empty() {
            let others = counted(names.len() as u64, "other photo");
            error.problem.push_str(&format!(", and {others} cannot be used either: {}", list_names(names.into_iter())));
        }
        error
    })
}

/// Checks headers, shapes and masks of all views, in parallel; returns the first error in view order.
fn check_photos(
    views: &[(RawView, Split)],
    options: &LoadOptions,
    (root, image_folder): (&Path, &Path),
    warnings: &mut Vec<String>,
) -> InputResult<Vec<PhotoSource>> {
    let index = if options.masks { MaskIndex::scan(root, image_folder)? } else { MaskIndex::default() };
    let named: Vec<(&str, &Path)> =
        views.iter().map(|(view, _)| (view.name.as_str(), view.image_path.as_path())).collect();
    let found = index.assign(&named, warnings);
    let checked: Vec<InputResult<PhotoSource>> =
        views.par_iter().zip(found).map(|((view, _), mask)| check_photo(view, mask, options)).collect();
    let mut photos = Vec::with_capacity(checked.len());
    let mut errors = Vec::new();
    for ((view, _), photo) in views.iter().zip(checked) {
        match photo {
            Ok(photo) => photos.push(photo),
            Err(error) => errors.push((view.name.as_str(), error)),
        }
    }
    if let Some(error) = first_error(errors) {
        return Err(error);
    }
    warn_about_shapes(views, &photos, warnings);
    let transparent = photos.iter().filter(|p| p.is_masked_by_alpha()).count();
    if transparent > 0 {
        let have = if transparent == 1 { "photo has" } else { "photos have" };
        warnings.push(format!(
            "{transparent} {have} an alpha channel: pixels that are less than half opaque do not count, as under a mask \
             (--masks=false shows --background there)"
        ));
    }
    let masked = photos.iter().filter(|p| p.mask.is_some()).count();
    if masked == 0 && !index.is_empty() {
        warnings.push("none of the files in the masks folder belongs to a photo: no mask is used".to_string());
    } else if masked == 0 && options.invert_masks {
        warnings.push("--invert-masks has no effect: there is no mask".to_string());
    } else if let Some(path) = masks_of_0_and_1(&photos)? {
        warnings.push(format!("masks such as {} hold 0 and 1 instead of 0 and 255: 1 counts as white", path.display()));
    }
    if masked > 0 && masked < photos.len() {
        let (without, total) = (photos.len() - masked, photos.len());
        warnings.push(format!("{without} of {total} photos have no mask: all of their pixels are used"));
    }
    Ok(photos)
}

/// Warns of photos whose shape differs from their camera's by more than rounding. Photos that were undistorted or cropped after the model was
/// made have such shapes.
fn warn_about_shapes(views: &[(RawView, Split)], photos: &[PhotoSource], warnings: &mut Vec<String>) {
    let sizes = |view: &RawView, photo: &PhotoSource| {
        [(photo.header.width, photo.header.height), (view.intrinsics.width, view.intrinsics.height)]
    };
    let pairs = views.iter().zip(photos).map(|((view, _), photo)| (view, sizes(view, photo)));
    let mut odd = pairs.filter(|(_, [photo, stated])| !is_rounded_shape(*photo, *stated));
    if let Some((view, [photo, stated])) = odd.next() {
        let have = counted(1 + odd.count() as u64, "photo");
        warnings.push(format!(
            "{have} of another shape than the camera, such as {} ({} x {}, its camera {} x {}): a model of other photos, for instance from \
             before undistortion or cropping, gives wrong pictures",
            view.name, photo.0, photo.1, stated.0, stated.1
        ));
    }
}

/// A mask of 0 and 1, if the first ones are such.
fn masks_of_0_and_1(photos: &[PhotoSource]) -> InputResult<Option<&Path>> {
    for mask in photos.iter().filter_map(|photo| photo.mask.as_ref()).take(MASKS_LOOKED_AT) {
        if holds_0_and_1(mask)? {
            return Ok(Some(&mask.path));
        }
    }
    Ok(None)
}

fn check_photo(view: &RawView, found: Option<FoundMask>, options: &LoadOptions) -> InputResult<PhotoSource> {
    let header = read_header(&view.image_path)?;
    let size = (header.width, header.height);
    check_shape(view, size)?;
    let stated = view.mask_path.clone().filter(|_| options.masks).map(|path| FoundMask { path, inverted: false });
    let mask = stated.or(found);
    let checked_mask = |FoundMask { path, inverted }: FoundMask| {
        let header = read_header(&path).map_err(|error| of_mask(error, view))?;
        if same_shape((header.width, header.height), size) {
            return Ok(MaskSource { path, header, invert: inverted != options.invert_masks });
        }
        let problem = format!(
            "the mask is {} x {}, its photo {} x {}: their shapes differ",
            header.width, header.height, size.0, size.1
        );
        Err(InputError::new(path, problem, "make the mask again for this photo, or remove it"))
    };
    let mask = mask.map(checked_mask).transpose()?;
    let stated = Intrinsics { lens: view.intrinsics.lens.simplified(), ..view.intrinsics };
    Ok(PhotoSource {
        image_path: view.image_path.clone(),
        header,
        intrinsics: intrinsics_at(&stated, size),
        target: target_size(size, options.data_factor, options.max_resolution),
        mask,
        alpha: if options.masks { Alpha::Mask } else { Alpha::Over(options.background) },
    })
}

/// The error for a mask instead of a photo.
fn of_mask(error: InputError, view: &RawView) -> InputError {
    let is_stated = view.mask_path.as_ref() == Some(&error.file);
    if is_stated && error.kind == Some(std::io::ErrorKind::NotFound) {
        let remedy = "put it there, remove the key, or use --masks=false";
        return InputError::new(error.file, "there is no such mask", remedy)
            .at(format!("mask_path of view '{}'", view.name));
    }
    let problem = error.problem.replace("photo", "mask");
    match error.kind {
        Some(_) => InputError { problem, ..error },
        None => {
            let remedy = "make the mask again for this photo, or remove it".to_string();
            InputError { problem, remedy, ..error }
        }
    }
}

/// Size of the target: the photo's divided by `data_factor`; if the longer side then exceeds `max_resolution`, the
/// photo's scaled to that limit instead (one rounding, from the full size).
pub fn target_size(photo: Size, data_factor: f64, max_resolution: Option<u32>) -> Size {
    let size = divided_size(photo, data_factor);
    let longest = photo.0.max(photo.1);
    match max_resolution {
        Some(limit) if size.0.max(size.1) > limit => divided_size(photo, f64::from(longest) / f64::from(limit)),
        _ => size,
    }
}

fn check_shape(view: &RawView, size: Size) -> InputResult<()> {
    let stated = (view.intrinsics.width, view.intrinsics.height);
    if stated.0 > 0 && stated.1 > 0 && same_shape(size, stated) {
        return Ok(());
    }
    let problem = format!(
        "the photo is {} x {}, its camera {} x {}: a photo of this shape cannot belong to this camera",
        size.0, size.1, stated.0, stated.1
    );
    let turned = stated.0 > 0 && stated.1 > 0 && same_shape((size.1, size.0), stated);
    let remedy = if turned {
        "the photo is turned by 90 degrees against its camera, as viewers do when they apply EXIF orientation: \
         use the photos that the model was made from, stored the same way up"
    } else {
        "use the photos that the model was made from (other sizes are fine, cropped photos are not)"
    };
    Err(InputError::new(&view.image_path, problem, remedy).at(format!("view {}", view.name)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn targets_round_once_from_the_full_size() {
        let with = |factor: f64, limit: Option<u32>| target_size((4608, 3456), factor, limit);
        assert_eq!(with(1.0, None), (4608, 3456));
        assert_eq!(with(3.4175, None), (1348, 1011));
        assert_eq!(with(1.0, Some(1600)), (1600, 1200));
        assert_eq!(with(4.0, Some(1600)), (1152, 864));
        assert_eq!(with(2.0, Some(1000)), (1000, 750));
    }

    #[test]
    fn folders_beside_the_photos_are_apart_from_them() {
        let folder = tempfile::tempdir().unwrap();
        let (root, images) = (folder.path().to_path_buf(), folder.path().join("images"));
        std::fs::create_dir(&images).unwrap();
        let is_among = |image_folder: &Path, path: &str| {
            let dataset =
                Dataset { image_folder: image_folder.to_path_buf(), root: root.clone(), ..Dataset::without_views() };
            dataset.photo_folder_around(&root.join(path)).is_some()
        };
        let of = |image_folder: &Path| {
            ["images", "images/a/b", "images2", "runs/a", ""].map(|path| is_among(image_folder, path))
        };
        assert_eq!(of(&images), [true, true, false, false, false]);
        assert_eq!(of(&root), [false, false, false, false, true], "photos lie beside the model");
    }
}
