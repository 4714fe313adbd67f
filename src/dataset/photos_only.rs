//! A folder of photos without poses: the scene in the folder above, or the error that says how to get poses.
//!
//! Not here: the folder of a model without photos, which the readers refuse.

use super::name_index::photos_in;
use super::{colmap, opensfm, reality_capture, transforms};
use crate::base::error::InputError;
use std::path::{Path, PathBuf};

/// The folder above, if it holds poses, and the name in it of `folder`, if that holds photos.
pub(super) fn scene_above(folder: &Path) -> Option<(PathBuf, String)> {
    // The name as it was given is kept where it says what is above.
    let resolved = folder.canonicalize().ok()?;
    let given = folder.parent().filter(|above| !above.as_os_str().is_empty() && folder.file_name().is_some());
    let above = given.or(resolved.parent())?;
    let name = folder.file_name().or(resolved.file_name())?.to_str()?.to_string();
    let has_poses = colmap::looks_like_colmap(above)
        || transforms::looks_like_transforms(above)
        || opensfm::looks_like_opensfm(above)
        || reality_capture::looks_like_reality_capture(above);
    (has_poses && photos_in(folder) > 0).then(|| (above.to_path_buf(), name))
}

/// The error for `folder` if it, or `images/` in it, holds photos; it must hold no model that a reader knows.
pub(super) fn error(folder: &Path) -> Option<InputError> {
    let images = folder.join("images");
    let (photos, count) = [images.as_path(), folder].into_iter().map(|f| (f, photos_in(f))).find(|(_, n)| *n > 0)?;
    let (place, photos) = (folder.display(), photos.display());
    let problem = format!("{count} photos, but no camera poses");
    let remedy = format!(
        "recover the poses first, and name this folder again:\n  \
         COLMAP (free):  colmap feature_extractor --database_path {place}/colmap.db --image_path {photos}\n                  \
         colmap exhaustive_matcher --database_path {place}/colmap.db\n                  \
         mkdir -p {place}/sparse\n                  \
         colmap mapper --database_path {place}/colmap.db --image_path {photos} --output_path {place}/sparse\n  \
         OpenDroneMap:   its project folder (with opensfm/reconstruction.json and images/) is read as it is\n  \
         RealityScan, RealityCapture:  export 'Internal/External camera parameters' (CSV) into {place}\n  \
         Metashape:      File > Export > Export Cameras, as COLMAP, into {place}\n\
         photos outside images/ need --images; tools/POSES.md says more"
    );
    Some(InputError::new(folder, problem, remedy))
}
