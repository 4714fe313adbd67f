//! The error for a folder of photos without poses: how to get poses.
//!
//! Not here: the folder of a model without photos, which the readers refuse.

use crate::base::error::InputError;
use std::path::Path;

/// Most entries of a folder that are looked at.
const ENTRIES_MAX: usize = 100_000;

/// The error for `folder` if it, or `images/` in it, holds photos; it must hold no model that a reader knows.
pub(super) fn error(folder: &Path) -> Option<InputError> {
    let images = folder.join("images");
    let (photos, count) = [images.as_path(), folder].into_iter().map(|f| (f, photos_in(f))).find(|(_, n)| *n > 0)?;
    if let Some(above) = folder.parent().filter(|above| above.join("sparse").is_dir()) {
        let problem =
            format!("{count} photos, but no camera poses, which seem to lie in {}", above.join("sparse").display());
        let remedy = format!("name the folder above: {}", above.display());
        return Some(InputError::new(folder, problem, remedy));
    }
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

/// Number of photos in a folder, by their endings.
fn photos_in(folder: &Path) -> usize {
    let is_photo = |path: &Path| {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        ["jpg", "jpeg", "png"].iter().any(|known| ending == *known)
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.take(ENTRIES_MAX).filter(|entry| is_photo(&entry.path())).count()
}
