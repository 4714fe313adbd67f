//! Finds the photos of all readers: by the name that the model states, otherwise by a name that nearly matches.
//!
//! Models are moved between machines, and photos are renamed, converted or sorted into folders behind their backs. A near match
//! differs in case, in the Unicode form of accents, in its ending or in the folders in front. It is taken if one file fits and no other
//! view has it. A name that lies outside of the scene (absolute, climbing) stands for its longest end that is a file inside.
//!
//! Invariants: 1. no file outside of the scene's folder is opened or listed, except through links in it; 2. near matches are never
//! silent; 3. folders are listed only if a name is not found as it is written; 4. a view keeps the name that its model states.

use super::model::{RawView, ReadOptions};
use super::name_index::{NameIndex, PictureFile, folded, split_ending, split_folder};
use super::paths::{StatedName, read_name};
use crate::base::text::{as_windows_1252, has_raw_bytes, raw_byte, raw_bytes};
use rayon::prelude::*;
use std::cell::{RefCell, RefMut};
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Endings appended to a name in turn: Blender's exporter omits `.png`.
const ENDINGS: [&str; 7] = ["", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG"];
/// Folders of a scene that hold its photos, folded.
const PHOTO_FOLDERS: [&str; 8] = ["images", "image", "photos", "rgbs", "rgb", "input", "train", "test"];
/// First letters of folders, folded, that hold other pictures of the same names.
const OTHER_PICTURES: [&str; 8] = ["mask", "_mask", ".", "depth", "normal", "thumb", "seg", "sparse"];
/// Near matches and near misses that a message shows.
const SHOWN: usize = 3;
/// Stands for characters that are not ASCII.
const OTHERS: char = '\u{1}';

/// A photo named by a model.
pub(super) struct Photo {
    /// Name of the view: the stated one, with its ending.
    pub name: String,
    pub path: PathBuf,
    pub exists: bool,
}

pub(super) struct PhotoFiles {
    root: PathBuf,
    /// Folders that names are relative to.
    bases: Vec<PathBuf>,
    /// Whether the first folder of a name may be absent.
    skips_folder: bool,
    /// Whether names outside of the scene that are not found count as missing, instead of being refused.
    allow_missing: bool,
    index: RefCell<NameIndex>,
    /// First folders of names that were looked for in the index.
    listed: RefCell<BTreeSet<String>>,
    /// By the name of the view: the stated name, and the file.
    near: RefCell<BTreeMap<String, (String, PathBuf)>>,
    /// Names of views that were stated outside of the scene, and what was stated.
    outside: RefCell<BTreeMap<String, String>>,
    code_page: RefCell<CodePageNames>,
    /// Files that are not proposed, with links resolved.
    taken: BTreeSet<PathBuf>,
}

impl PhotoFiles {
    /// The photos of a scene whose names are relative to `bases`.
    pub fn in_folders(root: &Path, bases: Vec<PathBuf>, allow_missing: bool) -> PhotoFiles {
        PhotoFiles {
            root: root.to_path_buf(),
            bases,
            skips_folder: false,
            allow_missing,
            index: RefCell::default(),
            listed: RefCell::default(),
            near: RefCell::default(),
            outside: RefCell::default(),
            code_page: RefCell::default(),
            taken: BTreeSet::new(),
        }
    }

    /// Keeps [`PhotoFiles::near_misses`] from proposing the photos of other views: renamed, they would stand for the wrong view.
    pub fn without<'a>(mut self, photos: impl Iterator<Item = &'a Path>) -> PhotoFiles {
        self.taken.extend(photos.filter_map(|path| path.canonicalize().ok()));
        self
    }

    fn is_free(&self, file: &PictureFile) -> bool {
        self.taken.is_empty() || !file.path.canonicalize().is_ok_and(|path| self.taken.contains(&path))
    }

    /// The photos of a scene whose names include their folder: in `root` and, if the image folder is `images` (many programs'
    /// default), in `root/images` too. Any other image folder replaces these, with and without the first folder of the name.
    pub fn with_folders(root: &Path, images: Option<&str>, options: &ReadOptions) -> PhotoFiles {
        let bases = match images {
            None => vec![root.to_path_buf()],
            Some("images") => vec![root.to_path_buf(), root.join("images")],
            Some(images) => vec![root.join(images)],
        };
        let skips_folder = !matches!(images, None | Some("images"));
        PhotoFiles { skips_folder, ..PhotoFiles::in_folders(root, bases, options.allow_missing) }
    }

    /// The photo `stated`. If it is not found: the first place, with `.png` if the name has no ending. Refusals are returned as
    /// text.
    pub fn find(&self, stated: &str) -> Result<Photo, String> {
        let read = read_name("", stated)?;
        let missing_ending = if Path::new(&read.name).extension().is_some() { "" } else { ".png" };
        self.find_at(stated, read, missing_ending, &|path| {
            let (at, ending) = ENDINGS.into_iter().map(|e| (with_ending(path, e), e)).find(|(at, _)| at.is_file())?;
            Some((at, ending.to_string()))
        })
    }

    /// As [`PhotoFiles::find`] for a name that was read; `look` returns the file at a place and the ending that it adds.
    pub fn find_at(
        &self,
        stated: &str,
        read: StatedName,
        missing_ending: &str,
        look: &dyn Fn(&Path) -> Option<(PathBuf, String)>,
    ) -> Result<Photo, String> {
        let is_outside = read.outside.is_some();
        let written = read.tails().flat_map(|tail| self.places(tail, is_outside)).find_map(|place| look(&place));
        let bases = || self.bases.iter().chain([&self.root]);
        let of_bytes =
            || Some((bases().find_map(|base| self.code_page.borrow_mut().find(base, &read.name))?, String::new()));
        let found = written.or_else(of_bytes);
        let name = read.name.clone() + found.as_ref().map_or(missing_ending, |(_, ending)| ending);
        if is_outside {
            self.outside.borrow_mut().insert(name.clone(), stated.to_string());
        }
        let is_near = is_outside || found.is_none();
        let path = found.map(|(path, _)| path).or_else(|| match self.index(&read.name).find(&read.name)[..] {
            [entry] => Some(entry.path.clone()),
            _ => None,
        });
        match (path, read.outside) {
            (Some(path), _) => {
                if is_near {
                    self.near.borrow_mut().insert(name.clone(), (stated.to_string(), path.clone()));
                }
                Ok(Photo { name, path, exists: true })
            }
            (None, Some(problem)) if !self.allow_missing => {
                Err(format!("{problem}, and no photo of the scene has the end of this name"))
            }
            (None, _) => Ok(Photo { path: self.bases[0].join(&name), name, exists: false }),
        }
    }

    /// As [`PhotoFiles::find`], without a look whether a photo inside of the scene is there: [`PhotoFiles::complete`] looks later.
    pub fn place(&self, stated: &str) -> Result<Photo, String> {
        let read = read_name("", stated)?;
        if read.outside.is_some() {
            return self.find_at(stated, read, "", &as_it_is);
        }
        Ok(Photo { path: self.bases[0].join(&read.name), name: read.name, exists: false })
    }

    /// Finds the photos of views that are not at their place; the loader reports those that stay missing.
    pub fn complete(&self, views: &mut [RawView]) {
        let exists: Vec<bool> = views.par_iter().map(|view| view.image_path.is_file()).collect();
        for (view, _) in views.iter_mut().zip(exists).filter(|(_, exists)| !exists) {
            let read = StatedName { name: view.name.clone(), outside: None };
            if let Ok(photo) = self.find_at(&view.name, read, "", &as_it_is) {
                view.image_path = photo.path;
            }
        }
    }

    fn places(&self, name: &str, is_outside: bool) -> Vec<PathBuf> {
        let rest = name.split_once('/').map(|(_, rest)| rest).filter(|_| self.skips_folder);
        let bases = is_outside.then_some(&self.root).into_iter().chain(&self.bases);
        bases.flat_map(|base| [Some(name), rest].into_iter().flatten().map(|name| base.join(name))).collect()
    }

    /// The index, with the folders in which `name` may lie.
    fn index(&self, name: &str) -> RefMut<'_, NameIndex> {
        let mut index = self.index.borrow_mut();
        let is_picture = |name: &str| split_ending(name).1.is_some();
        let holds_photos = |name: &str| is_picture(name) || !OTHER_PICTURES.iter().any(|other| name.starts_with(other));
        let first = folded(name.split_once('/').map_or("", |(first, _)| first));
        if !self.listed.borrow_mut().insert(first.clone()) {
            return index;
        }
        for base in self.bases.iter().filter(|base| **base != self.root) {
            index.add(base, "", &holds_photos);
        }
        // A scene's own folder also holds results and smaller copies of the photos: not everything below it counts.
        index.add(&self.root, "", &is_picture);
        if self.bases.contains(&self.root) || self.bases.iter().all(|base| !base.is_dir()) {
            for folder in std::fs::read_dir(&self.root).into_iter().flatten().flatten().map(|entry| entry.path()) {
                let own = folded(&folder.file_name().unwrap_or_default().to_string_lossy());
                if PHOTO_FOLDERS.contains(&own.as_str()) || own == first {
                    index.add(&folder, &format!("{own}/"), &holds_photos);
                }
            }
        }
        index
    }

    /// Takes back near matches whose file another view has, says which were made, and shortens names of views that were outside
    /// of the scene. The caller sorts the views afterwards.
    pub fn finish(&self, views: &mut [RawView], warnings: &mut Vec<String>) {
        let mut near = self.near.borrow_mut();
        let mut uses: BTreeMap<&Path, usize> = BTreeMap::new();
        for view in views.iter() {
            *uses.entry(&view.image_path).or_default() += 1;
        }
        let shared: BTreeSet<PathBuf> =
            uses.into_iter().filter(|(_, n)| *n > 1).map(|(path, _)| path.to_path_buf()).collect();
        for view in views.iter_mut().filter(|view| shared.contains(&view.image_path)) {
            if near.remove(&view.name).is_some() {
                view.image_path = self.bases[0].join(&view.name);
            }
        }
        let inside = |path: &Path| path.strip_prefix(&self.root).unwrap_or(path).display().to_string();
        if let Some((stated, path)) = near.values().next() {
            warnings.push(format!(
                "{} of {} photos have other names than the model states, and are used: {} for {stated:?}{}",
                near.len(),
                views.len(),
                inside(path),
                if near.len() > 1 { ", and so on" } else { "" },
            ));
        }
        let outside = self.outside.borrow();
        let folder = common_folder(outside.keys().map(|name| split_folder(name).0));
        let names: BTreeSet<String> =
            views.iter().filter(|view| !outside.contains_key(&view.name)).map(|v| v.name.clone()).collect();
        let short = |name: &str| name[folder.len()..].trim_start_matches('/').to_string();
        if outside.keys().any(|name| names.contains(&short(name))) {
            return;
        }
        views.iter_mut().filter(|view| outside.contains_key(&view.name)).for_each(|view| view.name = short(&view.name));
    }

    /// What may help to find photos with these names of views: files with nearly the same name, and links that lead nowhere.
    /// Empty, or begins with a separator.
    pub fn near_misses(&self, missing: &[&str]) -> String {
        let places = || missing.iter().flat_map(|name| self.bases.iter().map(move |base| base.join(name)));
        let leads_nowhere = |path: &PathBuf| {
            path.is_symlink() && path.metadata().is_err_and(|error| error.kind() == std::io::ErrorKind::NotFound)
        };
        let links = places().filter(leads_nowhere).count();
        if links > 0 {
            let links = if links == 1 { "1 of them is a link".into() } else { format!("{links} of them are links") };
            return format!("; {links} whose target is not on this machine: fetch it first (git annex get, dvc pull)");
        }
        // A folder, a pipe, or a link to itself.
        if let Some(other) = places().find(|path| path.symlink_metadata().is_ok()) {
            return match other.is_file() {
                true => {
                    format!("; {} is in the scene: names with their folders are read with --images .", other.display())
                }
                false => format!("; {} is there, but is no file that can be read", other.display()),
            };
        }
        let mut shown = Vec::new();
        for name in missing {
            let index = self.index(name);
            let stem = folded(split_folder(name).1);
            let paths = index
                .with_stem(split_ending(&stem).0)
                .filter(|file| self.is_free(file))
                .map(|e| e.path.strip_prefix(&self.root).unwrap_or(&e.path).display());
            let paths: Vec<String> = paths.take(SHOWN).map(|path| path.to_string()).collect();
            shown.extend((!paths.is_empty()).then(|| format!("'{name}' may be {}", paths.join(" or "))));
            if shown.len() == SHOWN {
                break;
            }
        }
        if !shown.is_empty() {
            return format!("; {}: rename the files or the entries of the model", shown.join("; "));
        }
        let index = self.index("");
        let others: Vec<String> = index
            .entries()
            .filter(|e| e.is_readable() && self.is_free(e))
            .map(|e| e.path.display().to_string())
            .collect();
        others.first().map_or(String::new(), |one| {
            format!("; the scene holds {} pictures of other names, such as {one}", others.len())
        })
    }
}

/// The file that a name in a file of `folder` means, if it is inside of it: the stated one, otherwise the longest end of a name
/// that lies outside. The name is returned too; refusals as text.
pub(super) fn file_inside(folder: &Path, stated: &str) -> Result<(String, PathBuf), String> {
    let read = read_name("", stated)?;
    let found = read.tails().find(|tail| folder.join(tail).is_file()).map(String::from);
    match (found, read.outside) {
        (Some(name), _) => Ok((name.clone(), folder.join(name))),
        (None, None) => Ok((read.name.clone(), folder.join(read.name))),
        (None, Some(problem)) => Err(format!("{problem}, and no file of the scene has the end of this name")),
    }
}

/// The folders, with `/` between them, that all of these begin with.
fn common_folder<'a>(mut folders: impl Iterator<Item = &'a str>) -> String {
    let mut common: Vec<&str> = folders.next().unwrap_or_default().split('/').collect();
    for folder in folders {
        common.truncate(folder.split('/').zip(&common).take_while(|(a, b)| a == *b).count());
    }
    common.join("/")
}

fn as_it_is(path: &Path) -> Option<(PathBuf, String)> {
    path.is_file().then(|| (path.to_path_buf(), String::new()))
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut path = path.as_os_str().to_os_string();
    path.push(ending);
    PathBuf::from(path)
}

/// Finds files by names with bytes of a code page (Windows-1252, GBK, Shift-JIS). Each folder is listed once.
#[derive(Default)]
struct CodePageNames {
    /// The entries of folders by their names without characters beyond ASCII ([`ascii_of`]).
    entries: BTreeMap<PathBuf, BTreeMap<String, Vec<String>>>,
}

impl CodePageNames {
    /// The file inside `folder` that a cleaned name means; `None` if there is none, or if several may be meant, or if the name has no such
    /// bytes. The name on the drive decides: it has the same bytes, or it is the name in Windows-1252, or it is the only one that agrees in
    /// all ASCII characters.
    fn find(&mut self, folder: &Path, name: &str) -> Option<PathBuf> {
        if !has_raw_bytes(name) {
            return None;
        }
        let part_in = |folder: PathBuf, part| {
            if has_raw_bytes(part) { self.entry(&folder, part) } else { Some(folder.join(part)) }
        };
        let path = name.split('/').try_fold(folder.to_path_buf(), part_in)?;
        path.is_file().then_some(path)
    }

    /// The entry of a folder that a part of a name means.
    fn entry(&mut self, folder: &Path, part: &str) -> Option<PathBuf> {
        let known = [os_name(raw_bytes(part)), Some(as_windows_1252(part).into())];
        let mut known = known.into_iter().flatten().map(|name| folder.join(name));
        if let Some(path) = known.find(|path| path.exists()) {
            return Some(path);
        }
        let entries = self.entries.entry(folder.to_path_buf()).or_insert_with(|| {
            let mut by_ascii: BTreeMap<String, Vec<String>> = BTreeMap::new();
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                let Ok(name) = entry.file_name().into_string() else { continue };
                by_ascii.entry(ascii_of(&name, false)).or_default().push(name);
            }
            by_ascii
        });
        [false, true].into_iter().find_map(|in_pairs| match entries.get(&ascii_of(part, in_pairs)).map(Vec::as_slice) {
            Some([only]) => Some(folder.join(only)),
            _ => None,
        })
    }
}

/// A name with one mark for each run of characters that are not ASCII. In GBK and Shift-JIS the second byte of a character
/// may be that of an ASCII character: with `in_pairs` it belongs to the run.
fn ascii_of(name: &str, in_pairs: bool) -> String {
    let (mut text, mut chars) = (String::new(), name.chars().peekable());
    while let Some(c) = chars.next() {
        if c.is_ascii() {
            text.push(c);
            continue;
        }
        if !text.ends_with(OTHERS) {
            text.push(OTHERS);
        }
        if in_pairs {
            chars.next_if(|&c| raw_byte(c).is_some() || ('\x40'..='\x7e').contains(&c));
        }
    }
    text
}

#[cfg(unix)]
fn os_name(bytes: Vec<u8>) -> Option<OsString> {
    Some(std::os::unix::ffi::OsStringExt::from_vec(bytes))
}

#[cfg(not(unix))]
fn os_name(_: Vec<u8>) -> Option<OsString> {
    None
}
