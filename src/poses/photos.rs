//! The photos of a folder, as far as the search for poses needs to know them: sizes, cameras, places. Decodes none.
//!
//! Invariants: 1. photos are in the order of their names, as a camera numbers them: digits compare as numbers; 2. links to
//! folders are not followed, and nothing outside of the folder is listed.

use crate::base::error::{InputError, InputResult};
use crate::dataset::exif::{GpsPlace, camera_and_place};
use crate::dataset::photo_header::{PhotoHeader, read_header};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Folders that hold no photos of the scene, whatever pictures are in them.
const OTHERS: [&str; 5] = ["sparse", "masks", "mask", "renders", super::WORK_FOLDER];
const DEEPEST: usize = 8;

#[derive(Debug, Clone)]
pub struct FoundPhoto {
    /// Below the folder of the photos, `/`-separated.
    pub name: String,
    pub path: PathBuf,
    pub bytes: u64,
    pub header: PhotoHeader,
    /// Camera, lens and zoom as the EXIF data name them; empty if they do not.
    pub camera: String,
    pub place: Option<GpsPlace>,
}

/// The photos in `folder` and below it, and one sentence for each that cannot be used.
/// Errors: the folder cannot be listed, or holds fewer than three photos that can be read.
pub fn list_photos(folder: &Path) -> InputResult<(Vec<FoundPhoto>, Vec<String>)> {
    let mut names = Vec::new();
    add_names(folder, "", 0, &mut names)?;
    names.sort_by_cached_key(|name| natural_order(name));
    let read = |name: &String| {
        let path = folder.join(name);
        let header = read_header(&path).map_err(|e| format!("{name} is left out: {}", e.problem))?;
        let bytes = std::fs::metadata(&path).map_or(0, |facts| facts.len());
        // Without readable EXIF data, a photo is as one of an unknown camera at an unknown place.
        let facts = header.exif.and_then(|exif| camera_and_place(&path, exif).ok());
        let (camera, place) = facts.unwrap_or_default();
        Ok(FoundPhoto { name: name.clone(), path, bytes, header, camera, place })
    };
    let read: Vec<Result<FoundPhoto, String>> = names.par_iter().map(read).collect();
    let (mut photos, mut said) = (Vec::new(), Vec::new());
    for photo in read {
        match photo {
            Ok(photo) => photos.push(photo),
            Err(why) => said.push(why),
        }
    }
    if photos.len() < 3 {
        let problem = match said.first() {
            Some(first) => format!("{} photos can be read ({first})", photos.len()),
            None => format!("{} photos (JPEG or PNG) are here", photos.len()),
        };
        return Err(InputError::new(folder, problem, "name a folder with at least three photos that overlap"));
    }
    Ok((photos, said))
}

fn add_names(folder: &Path, prefix: &str, depth: usize, names: &mut Vec<String>) -> InputResult<()> {
    let io = |e: &std::io::Error| InputError::io(folder, "listing the photos", e);
    for entry in std::fs::read_dir(folder).map_err(|e| io(&e))? {
        let entry = entry.map_err(|e| io(&e))?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        let (path, kind) = (entry.path(), entry.file_type().map_err(|e| io(&e))?);
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase());
        if name.starts_with('.') {
            continue;
        } else if kind.is_dir() && depth < DEEPEST && !OTHERS.contains(&name.to_ascii_lowercase().as_str()) {
            add_names(&path, &format!("{prefix}{name}/"), depth + 1, names)?;
        } else if matches!(ending.as_deref(), Some("jpg" | "jpeg" | "png")) && path.is_file() {
            names.push(format!("{prefix}{name}"));
        }
    }
    Ok(())
}

/// A key that puts `9.jpg` before `10.jpg`: each run of digits begins with its length.
fn natural_order(name: &str) -> (Vec<u8>, String) {
    let (mut key, mut rest) = (Vec::new(), name.as_bytes());
    while let Some(&first) = rest.first() {
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let run = rest[..digits].iter().position(|&byte| byte != b'0').map_or(&b""[..], |at| &rest[at..digits]);
        if digits > 0 {
            key.extend([b'0', run.len().min(255) as u8]);
            key.extend(run);
        } else {
            key.push(first);
        }
        rest = &rest[digits.max(1)..];
    }
    (key, name.to_string())
}

/// Photos that one camera took at one zoom, which share intrinsics; indices into the photos. Photos without a known camera
/// share them if they have one size.
pub fn camera_groups(photos: &[FoundPhoto]) -> Vec<Vec<usize>> {
    let mut groups: BTreeMap<(&str, u32, u32), Vec<usize>> = BTreeMap::new();
    for (i, photo) in photos.iter().enumerate() {
        groups.entry((&photo.camera, photo.header.width, photo.header.height)).or_default().push(i);
    }
    groups.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::photo_header::PhotoFormat;

    #[test]
    fn names_are_in_the_order_of_a_cameras_numbers() {
        let mut names = ["b/2.jpg", "a10.jpg", "a9.jpg", "a009b.jpg", "a.jpg", "b/10.jpg"];
        names.sort_by_cached_key(|name| natural_order(name));
        assert_eq!(names, ["a.jpg", "a9.jpg", "a009b.jpg", "a10.jpg", "b/2.jpg", "b/10.jpg"]);
    }

    #[test]
    fn photos_of_one_camera_one_zoom_and_one_size_are_a_group() {
        let photo = |camera: &str, width| {
            let header = PhotoHeader {
                format: PhotoFormat::Jpeg,
                width,
                height: 3,
                decode_bytes: 0,
                has_alpha: false,
                exif: None,
            };
            let (name, path, camera) = (String::new(), PathBuf::new(), camera.to_string());
            FoundPhoto { name, path, bytes: 0, header, camera, place: None }
        };
        let photos = [photo("A 24 mm", 4), photo("A 35 mm", 4), photo("A 24 mm", 4), photo("", 4), photo("A 24 mm", 5)];
        assert_eq!(camera_groups(&photos), [vec![3], vec![0, 2], vec![4], vec![1]]);
    }
}
