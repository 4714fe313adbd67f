//! The views that a reader gathers, and the names of those that it leaves out.
//!
//! Invariant: only a bad pose or, when allowed, a missing photo drops a view, with a warning that names it.

use super::checks::{left_out, listed, sort_views};
use super::model::{Intrinsics, Pose, RawView, ReadOptions, Split};
use super::photo_files::{Photo, PhotoFiles};
use crate::base::error::{InputError, InputResult};
use std::path::Path;

/// What errors about left-out views say: places in the file, and remedies.
pub(super) struct Words {
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
    pub fn finish(mut self, file: &Path, words: &Words, warnings: &mut Vec<String>) -> InputResult<Vec<RawView>> {
        self.photos.finish(&mut self.views, warnings);
        if !self.missing.is_empty() && !self.options.allow_missing {
            let near = self.photos.near_misses(&self.missing.iter().map(String::as_str).collect::<Vec<_>>());
            let problem = format!("{} photo(s) are missing: {}{near}", self.missing.len(), listed(&self.missing));
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
