//! Finds the photo file for a frame's `file_path`.

use crate::base::error::InputResult;
use crate::dataset::paths::clean_name;
use crate::dataset::photo_header::read_header;
use crate::dataset::raw_names;
use std::path::{Path, PathBuf};

/// Endings appended to the name in turn: Blender's exporter omits `.png`.
const ENDINGS: [&str; 7] = ["", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG"];

/// A photo named by a frame.
pub(in crate::dataset) struct Photo {
    /// Cleaned name with its ending.
    pub name: String,
    pub path: PathBuf,
    pub exists: bool,
}

/// Possible places of the photo `name`: in `folder` and, if the image folder is `images` (many programs' default), in
/// `folder/images` too. Any other image folder replaces these, with and without the first folder of the name.
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

/// Searches for the photo `stated`. If not found: the first place, with `.png` if the name has no ending. Refusals are
/// returned as text.
pub(in crate::dataset) fn find_photo(folder: &Path, images: Option<&str>, stated: &str) -> Result<Photo, String> {
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
    let folders = [Some(folder.to_path_buf()), images.map(|images| folder.join(images))];
    if let Some(path) = folders.iter().flatten().find_map(|folder| raw_names::find(folder, &name)) {
        return Ok(Photo { name, path, exists: true });
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
pub(in crate::dataset) fn read_size(path: &Path) -> InputResult<(u64, u64)> {
    let header = read_header(path).map_err(|mut error| {
        error.problem.insert_str(0, "the photo's size cannot be read: ");
        error
    })?;
    Ok((u64::from(header.width), u64::from(header.height)))
}
