//! The views that a reader gathers and the names of those that it leaves out; the checks that all readers apply to the numbers
//! in a file; the wording of their warnings.
//!
//! Invariant: only a bad pose, a list of names that lacks the view or, when allowed, a missing photo drops a view, with a warning that
//! names it.

use super::model::{Intrinsics, Lens, Pose, RawView, ReadOptions, Split};
use super::photo_files::{Photo, PhotoFiles};
use crate::base::error::{InputError, InputResult};
use crate::base::units::{counted, counted_are};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest width or height accepted, pixels: the limit of JPEG.
const MAX_SIDE: u64 = 65_535;
/// Range of focal lengths accepted, in units of the longer side. Satellite views come near the upper end.
const FOCAL_RANGE: (f64, f64) = (1e-3, 1e6);
/// Farthest principal point accepted, in units of the longer side (crops are off centre, but less than this).
const MAX_CENTRE: f64 = 1e3;
/// Largest coordinate of a pose that is accepted.
pub(super) const MAX_COORDINATE: f64 = 1e15;
const LISTED: usize = 10;

/// Checks that the numbers can be a camera's intrinsics, and returns them or the problem. A radial lens without
/// distortion becomes a pinhole, which is the same mapping.
pub(super) fn checked_intrinsics(
    (width, height): (u64, u64),
    focal: [f64; 2],
    centre: [f64; 2],
    lens: Lens,
) -> Result<Intrinsics, String> {
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(format!("an image of {width} x {height} pixels (each side must be 1 to {MAX_SIDE})"));
    }
    let side = width.max(height) as f64;
    for f in focal {
        if !(FOCAL_RANGE.0 * side..=FOCAL_RANGE.1 * side).contains(&f) {
            return Err(format!("a focal length of {f} pixels for an image of {width} x {height}"));
        }
    }
    for c in centre {
        if c.is_nan() || c.abs() > MAX_CENTRE * side {
            return Err(format!("a principal point at {c} pixels for an image of {width} x {height}"));
        }
    }
    if let Some(k) = lens.coefficients().iter().find(|k| !k.is_finite()) {
        return Err(format!("a distortion coefficient of {k}"));
    }
    let ([fx, fy], [cx, cy]) = (focal, centre);
    Ok(Intrinsics { width: width as u32, height: height as u32, fx, fy, cx, cy, lens: lens.simplified() })
}

/// Sorts the views by name and refuses duplicate names and photos.
pub(super) fn sort_views(file: &Path, views: &mut [RawView]) -> InputResult<()> {
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let problem = format!("two views have the name '{}'", pair[0].name);
        return Err(InputError::new(file, problem, "every photo may be listed once: remove one of the two entries")
            .at(format!("image '{}'", pair[0].name)));
    }
    let mut by_photo = BTreeMap::new();
    for view in views.iter() {
        if let Some(other) = by_photo.insert(&view.image_path, &view.name) {
            let problem = format!("the views '{other}' and '{}' have the same photo", view.name);
            return Err(InputError::new(
                &view.image_path,
                problem,
                "name the folder with a photo for each view with --images",
            ));
        }
    }
    Ok(())
}

/// The warning about views that a reader leaves out.
pub(super) fn left_out(file: &Path, names: &[String], why: &str) -> String {
    let views = counted(names.len() as u64, "view");
    format!("{}: {views} left out, {why}: {}", file.display(), listed(names))
}

/// The first names of a list, and the number of further ones.
pub(super) fn listed(names: &[String]) -> String {
    let shown = names.iter().take(LISTED).map(|n| format!("'{n}'")).collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(LISTED) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

/// What errors about left-out views say: places in the file, and remedies.
pub(super) struct RefusalWords {
    /// Place of the names of photos; empty for the whole file.
    pub photos: &'static str,
    /// Place of the list of views.
    pub views: &'static str,
    pub photo_is_missing: &'static str,
    pub no_view: &'static str,
}

pub(super) const PUT_THEM_THERE: &str =
    "put them into images/, name their folder with --images, or leave them out with --allow-missing";

pub(super) struct Gathered<'a> {
    pub options: &'a ReadOptions,
    pub photos: PhotoFiles,
    pub views: Vec<RawView>,
    /// Names of views whose photo is needed and is not there.
    pub missing: Vec<String>,
    /// Names of views whose pose is impossible.
    pub bad_poses: Vec<String>,
}

impl<'a> Gathered<'a> {
    pub fn new(photos: PhotoFiles, options: &'a ReadOptions) -> Gathered<'a> {
        Gathered { options, photos, views: Vec::new(), missing: Vec::new(), bad_poses: Vec::new() }
    }

    /// Adds a view, or leaves it out if it has no pose.
    pub fn add(&mut self, photo: Photo, intrinsics: Intrinsics, pose: Option<Pose>, split: Option<Split>) {
        let Photo { name, path: image_path, .. } = photo;
        match pose {
            None => self.bad_poses.push(name),
            Some(pose) => {
                self.views.push(RawView { name, image_path, intrinsics, pose, mask_path: None, split });
            }
        }
    }

    /// The views, sorted by name; warns about those that `file` names and that are left out.
    /// Errors: a photo is missing, and missing photos are not allowed; no view is left; two views have one name or photo.
    pub fn finish(
        mut self,
        file: &Path,
        words: &RefusalWords,
        warnings: &mut Vec<String>,
    ) -> InputResult<Vec<RawView>> {
        self.photos.finish(&mut self.views, warnings);
        if !self.missing.is_empty() && !self.options.allow_missing {
            let photos = self.photos.without(self.views.iter().map(|view| view.image_path.as_path()));
            let near = photos.near_misses(&self.missing.iter().map(String::as_str).collect::<Vec<_>>());
            let are = counted_are(self.missing.len() as u64, "photo");
            let problem = format!("{are} missing: {}{near}", listed(&self.missing));
            return Err(InputError::new(file, problem, words.photo_is_missing).at(words.photos));
        }
        let why = "their pose is not finite or not a rotation";
        for (names, why) in [(&self.missing, "their photo is missing"), (&self.bad_poses, why)] {
            warnings.extend((!names.is_empty()).then(|| left_out(file, names, why)));
        }
        if self.views.is_empty() {
            let problem = match self.bad_poses.len() {
                0 => "no view is left".to_string(),
                n => format!("no view is left: {n} without a usable pose: {}", listed(&self.bad_poses)),
            };
            return Err(InputError::new(file, problem, words.no_view).at(words.views));
        }
        sort_views(file, &mut self.views)?;
        Ok(self.views)
    }
}
