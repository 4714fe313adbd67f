//! The photos of a folder, as far as the search for poses needs to know them: sizes, cameras, places. Decodes none.
//!
//! Invariants: 1. photos are in the order of their names, as a camera numbers them: digits compare as numbers; 2. links to
//! folders are not followed, and nothing outside of the folder is listed.

use crate::base::error::{InputError, InputResult};
use crate::base::units::{counted, counted_are};
use crate::dataset::exif::{GpsPlace, camera_and_place};
use crate::dataset::masks::FOLDERS as MASK_FOLDERS;
use crate::dataset::photo_header::{PhotoHeader, read_header};
use crate::dataset::read::{CONVERT_PHOTOS, PICTURES_OF_VIDEO, SEARCH_FOLDER, SEARCH_STATE};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// Folders that hold no photos of the scene, whatever pictures are in them.
const OTHERS: [&str; 3] = ["sparse", "renders", super::WORK_FOLDER];
const DEEPEST: usize = 8;
/// What stands around the stem of a photo in the name of its mask.
const MASK_ENDS: [&str; 3] = [".mask", "_mask", "-mask"];
const MASK_STARTS: [&str; 2] = ["mask_", "dynamic_mask_"];

#[derive(Debug, Clone)]
pub struct FoundPhoto {
    /// Below the folder of the photos, `/`-separated.
    pub name: String,
    pub path: PathBuf,
    pub bytes: u64,
    /// When its file was changed, nanoseconds since 1970; 0 where the drive does not say.
    pub modified: u64,
    pub header: PhotoHeader,
    /// Camera, lens and zoom as the EXIF data name them; empty if they do not.
    pub camera: String,
    pub place: Option<GpsPlace>,
}

/// The photos in `folder` and below it but not in `scene` below it, whose photos are links, and one sentence for each that cannot be used.
/// Errors: the folder cannot be listed, or holds fewer than three photos that can be read.
pub fn list_photos(folder: &Path, scene: &Path) -> InputResult<(Vec<FoundPhoto>, Vec<String>)> {
    if folder.is_file() {
        return Err(InputError::new(folder, "this is a file, not a folder of photos", PICTURES_OF_VIDEO));
    }
    let mut names = Vec::new();
    let scene = scene.canonicalize().ok().filter(|scene| folder.canonicalize().is_ok_and(|folder| folder != *scene));
    let mut others = 0;
    add_names(folder, scene.as_deref(), "", &mut names, &mut others)?;
    drop_masks(&mut names);
    names.sort_by_cached_key(|name| natural_order(name));
    let read = |name: &String| {
        let path = folder.join(name);
        let header = read_header(&path).map_err(|e| format!("{name} is left out: {}", e.problem))?;
        let facts = std::fs::metadata(&path).ok();
        let bytes = facts.as_ref().map_or(0, |facts| facts.len());
        let modified = facts.as_ref().map_or(0, modified_at);
        // Without readable EXIF data, a photo is as one of an unknown camera at an unknown place.
        let facts = header.exif.and_then(|exif| camera_and_place(&path, exif).ok());
        let (camera, place) = facts.unwrap_or_default();
        Ok(FoundPhoto { name: name.clone(), path, bytes, modified, header, camera, place })
    };
    let read: Vec<Result<FoundPhoto, String>> = names.par_iter().map(read).collect();
    let (mut photos, mut said) = (Vec::new(), Vec::new());
    if others > 0 {
        said.push(format!(
            "{others} files are left out: pictures that are neither JPEG nor PNG (convert them), or names that are not UTF-8"
        ));
    }
    for photo in read {
        match photo {
            Ok(photo) => photos.push(photo),
            Err(why) => said.push(why),
        }
    }
    if photos.len() < 3 {
        let problem = match said.first() {
            Some(first) => format!("{} can be read ({first})", counted(photos.len() as u64, "photo")),
            None => format!("{} here (JPEG or PNG)", counted_are(photos.len() as u64, "photo")),
        };
        let remedy = if others > 0 { CONVERT_PHOTOS } else { PICTURES_OF_VIDEO };
        return Err(InputError::new(folder, problem, remedy));
    }
    Ok((photos, said))
}

/// When a file was changed, nanoseconds since 1970; 0 where the drive does not say.
pub(super) fn modified_at(file: &Metadata) -> u64 {
    let since = file.modified().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |since| since.as_nanos() as u64)
}

/// Refuses a folder of the scene that lies among the searched photos and holds photos of its own. Links that an earlier search has put
/// there do not count.
fn refuse_photos_in(scene: &Path) -> InputResult<()> {
    let mut names = Vec::new();
    if !scene.join(SEARCH_FOLDER).join(SEARCH_STATE).is_file() {
        add_names(scene, None, "", &mut names, &mut 0)?;
    }
    if names.is_empty() {
        return Ok(());
    }
    let problem = format!("its {} would be left out", counted(names.len() as u64, "photo"));
    Err(InputError::new(scene, problem, "name a folder without photos with --out"))
}

/// Adds the names of photos in `folder`; counts pictures that are not used. `scene` is left out.
fn add_names(
    folder: &Path,
    scene: Option<&Path>,
    prefix: &str,
    names: &mut Vec<String>,
    others: &mut usize,
) -> InputResult<()> {
    let io = |e: &std::io::Error| InputError::io(folder, "listing the photos", e);
    for entry in std::fs::read_dir(folder).map_err(|e| io(&e))? {
        let entry = entry.map_err(|e| io(&e))?;
        let (path, kind) = (entry.path(), entry.file_type().map_err(|e| io(&e))?);
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase());
        let is_photo = matches!(ending.as_deref(), Some("jpg" | "jpeg" | "png")) && path.is_file();
        let Ok(name) = entry.file_name().into_string() else {
            *others += usize::from(is_photo);
            continue;
        };
        let folded = name.to_ascii_lowercase();
        let is_deep = prefix.matches('/').count() >= DEEPEST;
        if name.starts_with('.') {
            continue;
        } else if kind.is_dir() {
            let is_scene = || scene.is_some_and(|scene| path.canonicalize().is_ok_and(|path| path == scene));
            if is_deep || OTHERS.contains(&folded.as_str()) || MASK_FOLDERS.contains(&folded.as_str()) {
                continue;
            } else if is_scene() {
                refuse_photos_in(&path)?;
            } else {
                add_names(&path, scene, &format!("{prefix}{name}/"), names, others)?;
            }
        } else if is_photo {
            names.push(format!("{prefix}{name}"));
        } else if matches!(ending.as_deref(), Some("heic" | "heif" | "tif" | "tiff" | "dng" | "webp" | "avif")) {
            // Drones write a DNG beside each JPEG.
            let has_twin = ["jpg", "JPG", "jpeg", "png"].iter().any(|end| path.with_extension(end).is_file());
            *others += usize::from(!has_twin);
        }
    }
    Ok(())
}

/// Leaves out masks that lie beside their photos: `a.mask.png`, `a_mask.png` and so on beside `a.jpg`.
fn drop_masks(names: &mut Vec<String>) {
    let stem = |name: &str| name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_string();
    let stems: BTreeSet<String> = names.iter().map(|name| stem(name)).collect();
    let is_mask = |name: &String| {
        let own = stem(name);
        let (folder, file) =
            own.rsplit_once('/').map_or(("", own.as_str()), |(folder, file)| (&own[..=folder.len()], file));
        let of = |photo: &str| stems.contains(&format!("{folder}{photo}"));
        MASK_ENDS.iter().any(|end| file.strip_suffix(end).is_some_and(|photo| of(photo) || of(&stem(photo))))
            || MASK_STARTS.iter().any(|start| file.strip_prefix(start).is_some_and(of))
    };
    let kept: Vec<String> = names.iter().filter(|name| !is_mask(name)).cloned().collect();
    *names = kept;
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
/// share them if they have one size and lie in one folder.
pub fn camera_groups(photos: &[FoundPhoto]) -> Vec<Vec<usize>> {
    let mut groups: BTreeMap<(&str, &str, u32, u32), Vec<usize>> = BTreeMap::new();
    for (i, photo) in photos.iter().enumerate() {
        let folder = photo.name.rsplit_once('/').map_or("", |(folder, _)| folder);
        let folder = if photo.camera.is_empty() { folder } else { "" };
        groups.entry((&photo.camera, folder, photo.header.width, photo.header.height)).or_default().push(i);
    }
    groups.into_values().collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::dataset::photo_header::PhotoFormat;

    /// A photo without a file.
    pub(in crate::poses) fn photo(name: &str) -> FoundPhoto {
        let (name, path, format) = (name.to_string(), PathBuf::new(), PhotoFormat::Jpeg);
        let header = PhotoHeader { format, width: 4, height: 3, decode_bytes: 0, has_alpha: false, exif: None };
        FoundPhoto { name, path, bytes: 0, modified: 0, header, camera: String::new(), place: None }
    }

    /// A file that counts as a photo, whatever is in it.
    pub(in crate::poses) fn photo_at(folder: &Path, name: &str) -> FoundPhoto {
        let path = folder.join(name);
        FoundPhoto { bytes: std::fs::metadata(&path).unwrap().len(), path, ..photo(name) }
    }

    #[test]
    fn names_are_in_the_order_of_a_cameras_numbers() {
        let mut names = ["b/2.jpg", "a10.jpg", "a9.jpg", "a009b.jpg", "a.jpg", "b/10.jpg"];
        names.sort_by_cached_key(|name| natural_order(name));
        assert_eq!(names, ["a.jpg", "a9.jpg", "a009b.jpg", "a10.jpg", "b/2.jpg", "b/10.jpg"]);
    }

    #[test]
    fn masks_beside_photos_are_no_photos() {
        let names = [
            "a.jpg",
            "a.mask.png",
            "a.jpg.mask.png",
            "b/c.png",
            "b/c_mask.png",
            "b/mask_c.png",
            "mask_d.jpg",
            "c_mask.png",
        ];
        let mut names = names.map(String::from).to_vec();
        drop_masks(&mut names);
        assert_eq!(names, ["a.jpg", "b/c.png", "mask_d.jpg", "c_mask.png"], "without their photo they are photos");
    }

    #[test]
    fn folders_of_masks_and_the_scene_are_left_out() {
        let root = tempfile::tempdir().unwrap();
        let state = "out/poses/state.json";
        for name in ["x/1.jpg", "x/2.JPG", "_masks/1.jpg", "out/images/1.jpg", state, "x/3.heic", "x/1.dng"] {
            std::fs::create_dir_all(root.path().join(name).parent().unwrap()).unwrap();
            std::fs::write(root.path().join(name), b"").unwrap();
        }
        let (mut names, mut others) = (Vec::new(), 0);
        let scene = root.path().join("out").canonicalize().unwrap();
        add_names(root.path(), Some(&scene), "", &mut names, &mut others).unwrap();
        names.sort();
        assert_eq!((names, others), (vec!["x/1.jpg".to_string(), "x/2.JPG".to_string()], 1));
        // Photos that no search has put there.
        std::fs::remove_file(root.path().join(state)).unwrap();
        let error = add_names(root.path(), Some(&scene), "", &mut Vec::new(), &mut 0).unwrap_err();
        assert_eq!(error.problem, "its 1 photo would be left out");
    }

    #[test]
    fn photos_of_one_camera_one_zoom_and_one_size_are_a_group() {
        let photo_in = |folder: &str, camera: &str, width| {
            let of = photo(&format!("{folder}/a.jpg"));
            FoundPhoto { camera: camera.to_string(), header: PhotoHeader { width, ..of.header }, ..of }
        };
        let photo = |camera, width| photo_in("x", camera, width);
        let photos = [photo("A 24 mm", 4), photo("A 35 mm", 4), photo("A 24 mm", 4), photo("", 4), photo("A 24 mm", 5)];
        assert_eq!(camera_groups(&photos), [vec![3], vec![0, 2], vec![4], vec![1]]);
        // Front and rear cameras of a car have the sizes of each other, and their folders.
        let videos =
            [photo_in("front", "", 4), photo_in("rear", "", 4), photo_in("rear", "A", 4), photo_in("front", "A", 4)];
        assert_eq!(camera_groups(&videos), [vec![0], vec![1], vec![2, 3]]);
    }
}
