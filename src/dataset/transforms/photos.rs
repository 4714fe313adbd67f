//! From a frame's `file_path` to the photo's file.

use crate::base::error::InputResult;
use crate::dataset::paths::clean_name;
use crate::dataset::photo_header::read_header;
use std::path::{Path, PathBuf};

/// Endings tried after the name as it stands: Blender's exporter leaves `.png` out.
const ENDINGS: [&str; 7] = ["", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG"];

/// A photo as a frame names it.
pub(super) struct Photo {
    /// Cleaned name with its ending.
    pub name: String,
    pub path: PathBuf,
    pub exists: bool,
}

/// Where the photo that `stated` names may be: in `folder`, and in `folder/images` too when that folder is asked for,
/// since it is what programs ask for by default; any other image folder is meant instead, with and without the first
/// folder of the name.
fn places(folder: &Path, images: Option<&str>, name: &str) -> Vec<PathBuf> {
    match images {
        None => vec![folder.join(name)],
        Some("images") => vec![folder.join(name), folder.join("images").join(name)],
        Some(images) => {
            let root = folder.join(images);
            let rest = name.split_once('/').map(|(_, rest)| root.join(rest));
            [Some(root.join(name)), rest].into_iter().flatten().collect()
        }
    }
}

/// Looks for the photo that `stated` names. Not found: the first place, with `.png` when the name has no ending.
/// Refused names come back as text.
pub(super) fn find_photo(folder: &Path, images: Option<&str>, stated: &str) -> Result<Photo, String> {
    let name = clean_name(stated)?;
    let places = places(folder, images, &name);
    for place in &places {
        for ending in ENDINGS {
            let path = with_ending(place, ending);
            if path.is_file() {
                return Ok(Photo { name: name + ending, path, exists: true });
            }
        }
    }
    let ending = if Path::new(&name).extension().is_some() { "" } else { ".png" };
    let path = with_ending(&places[0], ending);
    Ok(Photo { name: name + ending, path, exists: false })
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut path = path.as_os_str().to_os_string();
    path.push(ending);
    PathBuf::from(path)
}

/// Width and height from the photo's header; nothing is decoded.
pub(super) fn read_size(path: &Path) -> InputResult<(u64, u64)> {
    let header = read_header(path).map_err(|mut error| {
        error.problem.insert_str(0, "the photo's size cannot be read: ");
        error
    })?;
    Ok((u64::from(header.width), u64::from(header.height)))
}
