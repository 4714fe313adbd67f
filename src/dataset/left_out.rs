//! Views that a reader leaves out, and whether that is allowed.

use super::checks::{left_out, listed};
use super::model::ReadOptions;
use super::photo_files::PhotoFiles;
use crate::base::error::{InputError, InputResult};
use std::path::Path;

/// Names of views that cannot be used.
#[derive(Debug, Default)]
pub(super) struct LeftOut {
    /// Their photo is needed and is not there.
    pub missing: Vec<String>,
    /// Their pose is impossible.
    pub bad_poses: Vec<String>,
}

impl LeftOut {
    /// Warns about the views that `file` names and that are left out; `kept` views remain.
    ///
    /// # Errors
    /// A photo is missing, and missing photos are not allowed; no view is left.
    pub fn report(
        &self,
        file: &Path,
        (options, photos): (&ReadOptions, &PhotoFiles),
        kept: usize,
        warnings: &mut Vec<String>,
    ) -> InputResult<()> {
        if !self.missing.is_empty() && !options.allow_missing {
            let near = photos.near_misses(&self.missing.iter().map(String::as_str).collect::<Vec<_>>());
            let problem = format!("{} photo(s) are missing: {}{near}", self.missing.len(), listed(&self.missing));
            let remedy =
                "put them into images/, name their folder with --images, or leave them out with --allow-missing";
            return Err(InputError::new(file, problem, remedy));
        }
        for (names, why) in
            [(&self.missing, "their photo is missing"), (&self.bad_poses, "their pose is not finite or not a rotation")]
        {
            warnings.extend((!names.is_empty()).then(|| left_out(file, names, why)));
        }
        if kept == 0 {
            let problem = format!("no view is left: {} without a usable pose", self.bad_poses.len());
            return Err(InputError::new(file, problem, "export the poses again"));
        }
        Ok(())
    }
}
