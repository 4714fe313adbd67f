//! Masks: finds the mask of each photo. [`super::photo`] decodes the pixels to keep.
//!
//! A mask is a picture of the photo's shape: white (128 and above) is kept, black is excluded from loss and metrics. A
//! transparent mask pixel counts as black. Masks are in `masks/` beside (or inside) the image folder, under the photo's
//! relative name: the same name, the name with `.png` appended, or with another picture extension.
//!
//! Other programs write masks under other names, also beside the photos, and in folders of other names: what fits one photo and
//! nothing else is used, and the form of the name is said (`FORMS`).
//!
//! Invariants: 1. a folder is listed once; links in it are followed, as for photos; 2. a mask's size may differ from the
//! photo's, its shape may not; 3. nothing is listed outside of the scene, except through links in it; 4. a picture is the mask of
//! one photo at most, unless it has the plain name for several.

use super::name_index::{NameIndex, PictureFile, folded, split_ending, split_folder};
use super::photo_header::PhotoHeader;
use crate::base::error::InputResult;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
/// Folders of masks, folded.
pub(crate) const FOLDERS: [&str; 5] = ["masks", "mask", "_mask", "_masks", ".mask"];
/// What stands before and after the photo's name, with or without its ending, and whether white is left out: RealityScan's,
/// Metashape's, OpenMVG's and OpenDroneMap's, instant-ngp's. The first is for folders of masks alone.
const FORMS: [(&str, &str, bool); 6] = [
    ("", "", false),
    ("", ".mask", false),
    ("", "_mask", false),
    ("", "-mask", false),
    ("mask_", "", false),
    ("dynamic_mask_", "", true),
];
const SHOWN: usize = 3;

#[derive(Debug, Clone, PartialEq)]
pub struct MaskSource {
    pub path: PathBuf,
    pub header: PhotoHeader,
    /// Whether black is kept instead of white.
    pub invert: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct FoundMask {
    pub path: PathBuf,
    /// Whether the form of its name says that white is left out.
    pub inverted: bool,
}

#[derive(Debug, Default)]
pub(super) struct MaskIndex {
    root: PathBuf,
    /// Files of the folders that are called `masks`, by relative name.
    exact: BTreeMap<String, PathBuf>,
    in_folders: NameIndex,
    beside_photos: NameIndex,
}

impl MaskIndex {
    /// Lists the folders of masks in the scene's folder, beside the image folder if that is deeper, and inside the image folder;
    /// the first match wins. Missing folders count as empty.
    /// Errors: a folder of masks cannot be listed.
    pub fn scan(root: &Path, image_folder: &Path) -> InputResult<Self> {
        let mut index = MaskIndex { root: root.to_path_buf(), ..MaskIndex::default() };
        let beside = image_folder.parent().filter(|parent| parent.starts_with(root));
        for place in [Some(root), beside, Some(image_folder)].into_iter().flatten() {
            for folder in mask_folders(place) {
                index.in_folders.add(&folder, "", &|_| true);
                if !folder.ends_with("masks") {
                    continue;
                }
                for entry in index.in_folders.entries().filter(|entry| entry.is_readable()) {
                    let Ok(name) = entry.path.strip_prefix(&folder) else { continue };
                    let name = normalised(&name.to_string_lossy().replace('\\', "/"));
                    index.exact.entry(name).or_insert_with(|| entry.path.clone());
                }
            }
        }
        if let Some(error) = index.in_folders.unlisted.take() {
            return Err(error);
        }
        let is_flat = image_folder == root;
        index.beside_photos.add(image_folder, "", &|name| match split_ending(name).1 {
            Some(_) => name.contains("mask"),
            None => !is_flat && !FOLDERS.contains(&name),
        });
        Ok(index)
    }

    /// Whether there are no folders of masks with files in them.
    pub fn is_empty(&self) -> bool {
        self.in_folders.is_empty()
    }

    /// The masks of photos, given by their `/`-separated names and their files; says which form of name was used, if not the
    /// plain one, and which files are not used.
    pub fn assign(&self, photos: &[(&str, &Path)], warnings: &mut Vec<String>) -> Vec<Option<FoundMask>> {
        let exact = |path: &Path| FoundMask { path: path.to_path_buf(), inverted: false };
        let mut masks: Vec<Option<FoundMask>> =
            photos.iter().map(|(name, _)| self.find_plain(name).map(exact)).collect();
        let mut used: BTreeSet<&Path> = photos.iter().map(|(_, path)| *path).collect();
        let plain: BTreeSet<PathBuf> = masks.iter().flatten().map(|mask| mask.path.clone()).collect();
        used.extend(plain.iter().map(PathBuf::as_path));
        let mut near: Vec<(usize, FoundMask, String)> = Vec::new();
        let mut unclear = Vec::new();
        for (i, (name, path)) in photos.iter().enumerate().filter(|(i, _)| masks[*i].is_none()) {
            let mut found = self.find_forms(name, path);
            found.retain(|mask, _| !used.contains(mask.path.as_path()));
            match found.len() {
                0 => {}
                1 => near.extend(found.into_iter().map(|(mask, form)| (i, mask, form))),
                _ => unclear.push(format!("'{name}' may have {}", self.shown(found.keys().map(|mask| &*mask.path)))),
            }
        }
        let mut uses: BTreeMap<PathBuf, usize> = BTreeMap::new();
        near.iter().for_each(|(_, mask, _)| *uses.entry(mask.path.clone()).or_default() += 1);
        let mut forms: BTreeMap<String, usize> = BTreeMap::new();
        for (i, mask, form) in near {
            if uses[&mask.path] > 1 {
                unclear.push(format!(
                    "{} may belong to '{}' and others",
                    self.shown([&*mask.path].into_iter()),
                    photos[i].0
                ));
                continue;
            }
            *forms.entry(form).or_default() += 1;
            masks[i] = Some(mask);
        }
        warnings.extend(forms.into_iter().map(|(form, count)| format!("masks: {count} of the form {form}")));
        if !unclear.is_empty() {
            let (count, some) = (unclear.len(), unclear[..SHOWN.min(unclear.len())].join("; "));
            warnings.push(format!("{count} photos have no mask, because it is not clear which: {some}"));
        }
        self.warn_of_unused(&masks, warnings);
        masks
    }

    /// The mask with the plain name. A leading `images/` of the photo's name is optional in the folder of masks.
    fn find_plain(&self, name: &str) -> Option<&Path> {
        let short = name.strip_prefix("images/");
        [Some(name), short].into_iter().flatten().find_map(|name| {
            let stem = match name.rsplit_once('.') {
                Some((stem, extension)) if !extension.contains('/') => stem,
                _ => name,
            };
            let same = std::iter::once(normalised(name));
            let appended = std::iter::once(format!("{name}.png"));
            let others = EXTENSIONS.iter().map(|e| format!("{stem}.{e}"));
            same.chain(appended).chain(others).find_map(|key| self.exact.get(&key)).map(PathBuf::as_path)
        })
    }

    /// Masks whose names have one of the forms, for the photo's name in the model or that of its file, with the form.
    fn find_forms(&self, name: &str, photo: &Path) -> BTreeMap<FoundMask, String> {
        let mut found = BTreeMap::new();
        let name = folded(name);
        let (folder, base) = split_folder(&name);
        let file = folded(&photo.file_name().unwrap_or_default().to_string_lossy());
        for base in [base, &file] {
            let stem = split_ending(base).0;
            for (before, after, inverted) in FORMS {
                let is_marked = !(before.is_empty() && after.is_empty());
                for own in [stem, base] {
                    let key = format!("{before}{own}{after}");
                    let indexes = [Some(&self.in_folders), is_marked.then_some(&self.beside_photos)];
                    let ending = if own == stem { "" } else { &base[stem.len()..] };
                    for entry in indexes.into_iter().flatten().flat_map(|index| index.find_stem(folder, &key)) {
                        let form = form(entry, before, ending, after, inverted);
                        found.entry(FoundMask { path: entry.path.clone(), inverted }).or_insert(form);
                    }
                }
            }
        }
        found
    }

    fn warn_of_unused(&self, masks: &[Option<FoundMask>], warnings: &mut Vec<String>) {
        let used: BTreeSet<&Path> = masks.iter().flatten().map(|mask| mask.path.as_path()).collect();
        let unused = |entry: &&PictureFile| !used.contains(entry.path.as_path());
        let all: Vec<&PictureFile> =
            self.in_folders.entries().chain(self.beside_photos.entries()).filter(unused).collect();
        let (unread, others): (Vec<&PictureFile>, Vec<&PictureFile>) =
            all.into_iter().partition(|entry| !entry.is_readable());
        let [unread, others] = [unread, others].map(|entries| entries.into_iter().map(|entry| &*entry.path).collect());
        let links =
            [&self.in_folders, &self.beside_photos].into_iter().flat_map(|i| &i.dangling).map(|p| &**p).collect();
        let mut say = |paths: Vec<&Path>, what: &str, remedy: &str| {
            if !paths.is_empty() {
                let (count, some) = (paths.len(), self.shown(paths.into_iter()));
                warnings.push(format!("{count} masks {what}: {some}{remedy}"));
            }
        };
        say(unread, "are neither PNG nor JPEG and are not used", "; convert them to PNG");
        let fetch = "; fetch it first (git annex get, dvc pull)";
        say(links, "are links whose target is not on this machine, and are not used", fetch);
        if !used.is_empty() && masks.contains(&None) {
            say(others, "belong to no photo", "");
        }
    }

    /// The first of these files, by their names in the scene.
    fn shown<'a>(&self, paths: impl Iterator<Item = &'a Path>) -> String {
        let names: Vec<String> =
            paths.take(SHOWN).map(|path| path.strip_prefix(&self.root).unwrap_or(path).display().to_string()).collect();
        names.join(", ")
    }
}

/// The folders of masks in a folder; `masks` itself first.
fn mask_folders(place: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(place).into_iter().flatten().flatten().map(|entry| entry.path());
    let rank = |path: &Path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        FOLDERS.iter().position(|folder| *folder == folded(&name)).map(|rank| (name != "masks", rank, name))
    };
    let mut found: Vec<(_, PathBuf)> = entries.filter_map(|path| Some((rank(&path)?, path))).collect();
    found.sort();
    found.into_iter().map(|(_, path)| path).filter(|path| path.is_dir()).collect()
}

/// The form of a mask's name, in words.
fn form(entry: &PictureFile, before: &str, ending: &str, after: &str, inverted: bool) -> String {
    let own = entry.path.extension().unwrap_or_default().to_string_lossy();
    let form = format!("{before}X{ending}{after}.{own}");
    let how = match (before, after, inverted) {
        (_, _, true) => ", in which white is left out",
        ("", "", _) => ", in other case, form of accents or folder",
        _ => "",
    };
    form + how
}

/// The name with its last extension in lower case.
fn normalised(name: &str) -> String {
    match name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem}.{}", extension.to_ascii_lowercase()),
        None => name.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::MAIN_SEPARATOR;

    /// The masks of photos in `images/`, in a scene with these files.
    fn found(files: &[&str], photos: &[&str]) -> (Vec<Option<String>>, String) {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir(root.path().join("images")).unwrap();
        for file in files {
            let path = root.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, []).unwrap();
        }
        let images = root.path().join("images");
        let paths: Vec<PathBuf> = photos.iter().map(|name| images.join(name)).collect();
        let named: Vec<(&str, &Path)> = photos.iter().copied().zip(paths.iter().map(PathBuf::as_path)).collect();
        let mut warnings = Vec::new();
        let masks = MaskIndex::scan(root.path(), &images).unwrap().assign(&named, &mut warnings);
        let mark = |mask: FoundMask| {
            let path = mask.path.strip_prefix(root.path()).unwrap().to_str().unwrap().replace(MAIN_SEPARATOR, "/");
            if mask.inverted { format!("not {path}") } else { path }
        };
        (masks.into_iter().map(|mask| mask.map(mark)).collect(), warnings.join("\n").replace(MAIN_SEPARATOR, "/"))
    }

    #[test]
    fn plain_names_need_no_word_and_forms_of_other_programs_are_said() {
        for (file, photo, form) in [
            ("masks/a.PNG", "a.JPG", ""),
            ("masks/b.JPG.png", "b.JPG", ""),
            ("masks/c.jpg", "c.JPG", ""),
            ("masks/left/d.png", "left/d.jpeg", ""),
            ("masks/left/d.png", "images/left/d.jpeg", ""),
            ("images/masks/e.png", "e.jpg", ""),
            ("masks/a.jpg.mask.png", "a.jpg", "X.jpg.mask.png"),
            ("masks/a.mask.png", "a.jpg", "X.mask.png"),
            ("masks/A_mask.png", "a.jpg", "X_mask.png"),
            ("mask/a.png", "cam/a.jpg", "X.png"),
            ("Masks/a.png", "A.JPG", "X.png"),
            ("masks/ete\u{301}.png", "et\u{e9}.jpg", "X.png"),
            ("images/a_mask.JPG", "a.JPG", "X_mask.JPG"),
            ("images/a.JPG.mask.png", "a.JPG", "X.jpg.mask.png"),
            ("images/dynamic_mask_a.png", "images/a.jpg", "dynamic_mask_X.png, in which white is left out"),
            ("masks/images/a.png", "a.jpg", "X.png"),
        ] {
            let (masks, said) = found(&[file], &[photo]);
            let expected = if file.contains("dynamic") { format!("not {file}") } else { file.to_string() };
            assert_eq!(masks, [Some(expected)], "{file}: {said}");
            let is_said = said.contains(&format!("masks: 1 of the form {form}"));
            assert!(if form.is_empty() { said.is_empty() } else { is_said }, "{file}: {said}");
        }
    }

    #[test]
    fn what_is_unclear_or_cannot_be_read_is_not_used_and_named() {
        for (files, photos, words) in [
            (&["masks/a_mask.png", "masks/a.mask.png"][..], &["a.jpg"][..], "a.mask.png, masks/a_mask.png"),
            (&["mask/a.png"], &["left/a.jpg", "right/a.jpg"], "may belong to 'left/a.jpg'"),
            (&["masks/a.tif"], &["a.jpg"], "1 masks are neither PNG nor JPEG and are not used: masks/a.tif"),
            (&["masks/A.bmp"], &["a.jpg"], "masks/A.bmp"),
            (&["images/other.png", "images/a.png"], &["a.jpg"], ""),
            (&["masks/v1.2/noext.png"], &["v1.3/noext"], ""),
        ] {
            let (masks, said) = found(files, photos);
            assert!(masks.iter().all(Option::is_none) && said.contains(words), "{files:?}: {masks:?} {said}");
        }
        let (masks, said) = found(&["masks/a.png", "masks/c.png"], &["a.jpg", "b.jpg"]);
        assert!(
            masks[0].is_some() && masks[1].is_none() && said.contains("1 masks belong to no photo: masks/c.png"),
            "{said}"
        );
    }
}
