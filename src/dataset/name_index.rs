//! An index of the pictures in folders, for names that are not found as they are written.
//!
//! Names are compared without case, without the Unicode form of accents, and without the ending; the folders in front decide
//! among equal ones. Links are followed, as they are wherever photos are opened; a folder that links lead to twice is listed once.
//!
//! Invariants: 1. nothing is listed outside of the folders that are added, except through links in them; 2. what is found does not
//! depend on the order in which the system lists files.

use crate::base::error::InputError;
use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Endings of pictures, as models and masks have them. Of these, only the first three can be read.
const ENDINGS: [&str; 24] = [
    "jpg", "jpeg", "png", "tif", "tiff", "bmp", "webp", "gif", "heic", "heif", "avif", "jxl", "jp2", "exr", "dng",
    "arw", "cr2", "cr3", "nef", "raf", "rw2", "orf", "raw", "tga",
];
const READABLE: [&str; 3] = ["jpg", "jpeg", "png"];
const DEEPEST: usize = 16;
/// Most files that are listed, so that a link to a whole drive ends.
const FILES_MAX: usize = 1 << 20;

/// The name as it is compared: accents composed, small letters, `.jpeg` as `.jpg`.
pub(super) fn folded(name: &str) -> String {
    name.nfc().flat_map(char::to_lowercase).collect::<String>().replace(".jpeg", ".jpg")
}

/// A name without the ending of a picture, and that ending in small letters.
pub(super) fn split_ending(name: &str) -> (&str, Option<String>) {
    let parts = name.rsplit_once('.').map(|(stem, ending)| (stem, ending.to_ascii_lowercase()));
    match parts {
        Some((stem, ending)) if ENDINGS.contains(&ending.as_str()) && !stem.is_empty() => (stem, Some(ending)),
        _ => (name, None),
    }
}

/// Whether a file has the ending of a picture that can be read.
pub(super) fn is_photo(path: &Path) -> bool {
    let ending = path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase());
    ending.is_some_and(|ending| READABLE.contains(&ending.as_str()))
}

pub(super) fn photos_in(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.take(FILES_MAX).filter(|entry| is_photo(&entry.path())).count()
}

/// The same, with folders in it and theirs; links to folders are not followed.
pub(super) fn photos_below(folder: &Path, deepest: usize) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().take(FILES_MAX);
    let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()) && deepest > 0);
    photos_in(folder) + folders.map(|entry| photos_below(&entry.path(), deepest - 1)).sum::<usize>()
}

/// Pictures in a folder, in folders in it and theirs, that cannot be read.
pub(super) fn unreadable_below(folder: &Path, deepest: usize) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().take(FILES_MAX);
    let count = |entry: std::fs::DirEntry| match entry.file_type() {
        Ok(kind) if kind.is_dir() && deepest > 0 => unreadable_below(&entry.path(), deepest - 1),
        Ok(kind) if kind.is_dir() => 0,
        _ => {
            let name = entry.file_name().to_string_lossy().into_owned();
            usize::from(split_ending(&name).1.is_some_and(|ending| !READABLE.contains(&ending.as_str())))
        }
    };
    entries.map(count).sum()
}

/// The folders in front of a name, and its last component.
pub(super) fn split_folder(name: &str) -> (&str, &str) {
    name.rsplit_once('/').unwrap_or(("", name))
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PictureFile {
    /// Folders below the one that was added, folded.
    folder: String,
    /// Folded.
    base: String,
    pub path: PathBuf,
}

/// Files of folders by their folded names without ending.
#[derive(Debug, Default)]
pub(super) struct NameIndex {
    files: BTreeMap<String, Vec<PictureFile>>,
    /// Listed folders, with links resolved.
    seen: BTreeSet<PathBuf>,
    count: usize,
    /// Links to files that are not there.
    pub dangling: Vec<PathBuf>,
    /// The first folder that is there and cannot be listed.
    pub unlisted: Option<InputError>,
}

impl NameIndex {
    /// Adds the pictures in `folder` and in those below it, as far as `wants` accepts the folded names of pictures and folders.
    /// `prefix` is the folder by which the index knows it, empty or with a `/` at its end.
    pub fn add(&mut self, folder: &Path, prefix: &str, wants: &dyn Fn(&str) -> bool) {
        self.add_at(folder, prefix, wants, 0);
    }

    fn add_at(&mut self, folder: &Path, prefix: &str, wants: &dyn Fn(&str) -> bool, depth: usize) {
        let entries = match std::fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(error) => {
                if error.kind() != ErrorKind::NotFound {
                    self.unlisted.get_or_insert_with(|| InputError::io(folder, "listing the folder", &error));
                }
                return;
            }
        };
        if !folder.canonicalize().is_ok_and(|own| self.seen.insert(own)) {
            return;
        }
        let mut names: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
        names.sort();
        for path in names {
            let Some(base) = path.file_name().map(|name| folded(&name.to_string_lossy())) else { continue };
            let (stem, ending) = split_ending(&base);
            if !wants(&base) {
                continue;
            }
            // `is_dir` and `is_file` follow links.
            if ending.is_some() && path.is_file() {
                if self.count < FILES_MAX {
                    let (stem, folder) = (stem.to_string(), prefix.trim_end_matches('/').to_string());
                    self.files.entry(stem).or_default().push(PictureFile { folder, base, path });
                }
                self.count += 1;
            } else if depth < DEEPEST && path.is_dir() {
                self.add_at(&path, &format!("{prefix}{base}/"), wants, depth + 1);
            } else if ending.is_some() && path.is_symlink() {
                self.dangling.push(path);
            }
        }
    }

    pub fn is_empty(&self) -> bool {
        self.files.is_empty() && self.dangling.is_empty()
    }

    /// The files that fit a name equally well: with the same ending, otherwise with any ending that can be read. The folders of one
    /// must be the last folders of the other; those with the fewest other folders in front are taken.
    pub fn find(&self, name: &str) -> Vec<&PictureFile> {
        let name = folded(name);
        let (folder, base) = split_folder(&name);
        let stem = split_ending(base).0;
        let same_ending = best(self.all(stem).filter(|entry| entry.base == base), folder);
        if same_ending.is_empty() { self.find_stem(folder, stem) } else { same_ending }
    }

    /// As [`NameIndex::find`], for a folded stem and its folded folder.
    pub fn find_stem(&self, folder: &str, stem: &str) -> Vec<&PictureFile> {
        best(self.with_stem(stem), folder)
    }

    /// Readable files with this folded name without ending, in any folder.
    pub fn with_stem(&self, stem: &str) -> impl Iterator<Item = &PictureFile> {
        self.all(stem).filter(|entry| entry.is_readable())
    }

    fn all(&self, stem: &str) -> impl Iterator<Item = &PictureFile> {
        self.files.get(stem).into_iter().flatten()
    }

    pub fn entries(&self) -> impl Iterator<Item = &PictureFile> {
        self.files.values().flatten()
    }
}

impl PictureFile {
    pub fn is_readable(&self) -> bool {
        is_photo(&self.path)
    }
}

fn best<'a>(entries: impl Iterator<Item = &'a PictureFile>, folder: &str) -> Vec<&'a PictureFile> {
    let mut nearest: Vec<(usize, &PictureFile)> =
        entries.filter_map(|entry| Some((folders_apart(&entry.folder, folder)?, entry))).collect();
    nearest.sort();
    let least = nearest.first().map_or(0, |(apart, _)| *apart);
    nearest.into_iter().filter(|(apart, _)| *apart == least).map(|(_, entry)| entry).collect()
}

/// By how many folders one differs from the other, if it ends with it.
fn folders_apart(a: &str, b: &str) -> Option<usize> {
    let (short, long) = if a.len() <= b.len() { (a, b) } else { (b, a) };
    let rest = long.strip_suffix(short)?;
    let is_whole = short.is_empty() || rest.is_empty() || rest.ends_with('/');
    is_whole.then(|| rest.split('/').filter(|part| !part.is_empty()).count())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(names: &[&str]) -> NameIndex {
        let mut index = NameIndex::default();
        for name in names {
            let name_folded = folded(name);
            let (folder, base) = split_folder(&name_folded);
            let entry = PictureFile { folder: folder.into(), base: base.into(), path: PathBuf::from(name) };
            index.files.entry(split_ending(base).0.to_string()).or_default().push(entry);
        }
        index
    }

    #[test]
    fn a_folder_that_cannot_be_listed_is_not_an_empty_one() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("masks");
        std::fs::write(&file, "").unwrap();
        let mut index = NameIndex::default();
        index.add(&folder.path().join("none"), "", &|_| true);
        assert!(index.unlisted.is_none());
        index.add(&file, "", &|_| true);
        assert!(index.unlisted.unwrap().problem.contains("listing the folder"));
    }

    #[test]
    fn names_are_found_under_other_cases_forms_endings_and_folders() {
        let files =
            index(&["IMG_1.JPG", "ete\u{301}.jpg", "cam1/a.jpg", "cam2/a.jpg", "b.jpg", "B.jpg", "v1.2.png", "c.tif"]);
        for (name, files_found) in [
            ("img_1.jpg", &["IMG_1.JPG"][..]),
            ("img_1.jpeg", &["IMG_1.JPG"]),
            ("images/IMG_1", &["IMG_1.JPG"]),
            ("img_1.ARW", &["IMG_1.JPG"]),
            ("\u{e9}t\u{e9}.jpg", &[]),
            ("et\u{e9}.JPG", &["ete\u{301}.jpg"]),
            ("left/cam2/a.png", &["cam2/a.jpg"]),
            ("a.jpg", &["cam1/a.jpg", "cam2/a.jpg"]),
            ("cam3/a.jpg", &[]),
            ("xcam2/a.jpg", &[]),
            ("b.JPG", &["B.jpg", "b.jpg"]),
            ("v1.2", &["v1.2.png"]),
            ("c.jpg", &[]),
        ] {
            let found: Vec<&str> = files.find(name).into_iter().filter_map(|entry| entry.path.to_str()).collect();
            assert_eq!(found, files_found, "{name}");
        }
    }
}
