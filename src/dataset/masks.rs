//! Masks: finds the mask of each photo. [`super::photo`] decodes the pixels to keep.
//!
//! A mask is a picture of the photo's shape: white (128 and above; 1 in a file of zeros and ones) is kept, black is excluded
//! from loss and metrics. A transparent mask pixel counts as black. Masks are in `masks/` or `mask/` in the scene, beside or
//! inside the image folder, under one of the names of [`Pattern`]; those with "mask" in the name may lie beside the photos.
//! Names are compared case-insensitively where only one file matches.
//!
//! Invariants: 1. each folder is listed once; links are followed, since they belong to the user, but no folder is entered
//! twice; 2. a mask's size may differ from the photo's, its shape may not; 3. files that look like masks and are not used are
//! named in a warning.

use super::photo_header::PhotoHeader;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
/// Pictures that are not read.
const OTHER_EXTENSIONS: [&str; 6] = ["tif", "tiff", "bmp", "webp", "gif", "npy"];
const DEEPEST: usize = 16;

/// How a mask is named after its photo.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pattern {
    /// `X.jpg` or, with another picture extension, `X.png`.
    Same,
    /// `X.jpg.png`: COLMAP, Nerfstudio.
    Appended,
    /// `X.jpg.mask.png`.
    AppendedMask,
    /// `X.mask.png`: Agisoft.
    DotMask,
    /// `X_mask.jpg`, `X-mask.png`: OpenDroneMap.
    UnderscoreMask,
    /// `dynamic_mask_X.png`: instant-ngp. White is what moves, and is left out.
    DynamicMask,
    /// The dataset names the file.
    Named,
}

impl Pattern {
    /// In the order of preference.
    const ALL: [Pattern; 6] = [
        Pattern::Same,
        Pattern::Appended,
        Pattern::AppendedMask,
        Pattern::DotMask,
        Pattern::UnderscoreMask,
        Pattern::DynamicMask,
    ];

    /// Names of the mask of the photo `base`, with stem `stem`, in lower case.
    fn names(self, base: &str, stem: &str) -> Vec<String> {
        let with_extensions = |stem: String| EXTENSIONS.map(|e| format!("{stem}.{e}")).to_vec();
        match self {
            Pattern::Same => [vec![base.to_string()], with_extensions(stem.to_string())].concat(),
            Pattern::Appended => vec![format!("{base}.png")],
            Pattern::AppendedMask => with_extensions(format!("{base}.mask")),
            Pattern::DotMask => with_extensions(format!("{stem}.mask")),
            Pattern::UnderscoreMask => {
                [with_extensions(format!("{stem}_mask")), with_extensions(format!("{stem}-mask"))].concat()
            }
            Pattern::DynamicMask => with_extensions(format!("dynamic_mask_{stem}")),
            Pattern::Named => Vec::new(),
        }
    }

    /// An example, where the name deserves a word.
    fn example(self) -> Option<&'static str> {
        match self {
            Pattern::Same | Pattern::Appended | Pattern::Named => None,
            Pattern::AppendedMask => Some("X.jpg.mask.png"),
            Pattern::DotMask => Some("X.mask.png"),
            Pattern::UnderscoreMask => Some("X_mask.png"),
            Pattern::DynamicMask => Some("dynamic_mask_X.png, where white is left out"),
        }
    }

    /// Whether white is left out.
    pub fn is_inverted(self) -> bool {
        self == Pattern::DynamicMask
    }
}

/// The mask of a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskSource {
    /// The mask's file.
    pub path: PathBuf,
    /// Its header.
    pub header: PhotoHeader,
    /// Whether black is kept instead of white.
    pub invert: bool,
    /// How it is named.
    pub pattern: Pattern,
}

/// Files of one name in lower case: the name as it is, and the path.
type SameName = Vec<(String, PathBuf)>;

/// Mask files by relative name in lower case.
#[derive(Debug, Clone, Default)]
pub struct MaskIndex {
    in_folders: BTreeMap<String, SameName>,
    beside_photos: BTreeMap<String, SameName>,
    /// Pictures in the folders of masks that are of no readable kind.
    unreadable: Vec<PathBuf>,
}

impl MaskIndex {
    /// Lists the folders of masks in the scene's folder, beside the image folder if that is deeper, and inside the image
    /// folder, and files beside the photos whose names hold "mask"; the first match wins. Searches nothing outside the
    /// scene; missing folders count as empty.
    pub fn scan(root: &Path, image_folder: &Path) -> Self {
        let mut index = MaskIndex::default();
        let mut entered = BTreeSet::new();
        let above = image_folder.parent().filter(|p| p.starts_with(root));
        for folder in [Some(root), above, Some(image_folder)].into_iter().flatten() {
            for name in ["masks", "mask", "Masks", "Mask"] {
                index.add_folder(&folder.join(name), "", 0, &mut entered);
            }
        }
        index.add_beside_photos(image_folder, "", 0, &mut entered);
        index
    }

    /// The mask of the photo with this `/`-separated relative name, and how it is named. A leading `images/` of the name is
    /// optional in the mask folder.
    pub fn find(&self, name: &str) -> Option<(&Path, Pattern)> {
        let short = name.strip_prefix("images/");
        [Some(name), short].into_iter().flatten().find_map(|name| self.find_exact(name))
    }

    fn find_exact(&self, name: &str) -> Option<(&Path, Pattern)> {
        let (folder, base) = name.rsplit_once('/').map_or(("", name), |(folder, base)| (folder, base));
        let stem = base.rsplit_once('.').map_or(base, |(stem, _)| stem);
        Pattern::ALL.into_iter().find_map(|pattern| {
            let names = pattern.names(base, stem);
            let names = names.into_iter().map(|mask| if folder.is_empty() { mask } else { format!("{folder}/{mask}") });
            let places = [Some(&self.in_folders), Some(&self.beside_photos).filter(|_| pattern.example().is_some())];
            let mut found = names.flat_map(|mask| places.map(|files| only(files?.get(&mask.to_lowercase())?, &mask)));
            found.find_map(|path| path).map(|path| (path.as_path(), pattern))
        })
    }

    /// What the user should know of the masks of `total` photos: conventions of other tools that were recognised, and files that
    /// are no photo's mask.
    pub fn warnings<'a>(&self, masks: impl Iterator<Item = &'a MaskSource>, total: usize, invert: bool) -> Vec<String> {
        let masks: Vec<&MaskSource> = masks.collect();
        let mut warnings = Vec::new();
        for pattern in Pattern::ALL {
            let count = masks.iter().filter(|mask| mask.pattern == pattern).count();
            if let Some(example) = pattern.example().filter(|_| count > 0) {
                warnings.push(format!("masks of {count} photos are used, named like {example}"));
            }
        }
        let first = self.in_folders.values().flatten().map(|(_, path)| path).chain(&self.unreadable).next();
        match first {
            Some(file) if masks.is_empty() && self.unreadable.is_empty() => warnings.push(format!(
                "none of the files in the masks folder belongs to a photo: no mask is used; the mask of X.jpg is called X.jpg.png or \
                 X.png, not {}",
                file.file_name().unwrap_or_default().display()
            )),
            _ if masks.is_empty() && invert => {
                warnings.push("--invert-masks has no effect: there is no mask".to_string());
            }
            _ if !masks.is_empty() && masks.len() < total => {
                warnings.push(format!("{} of {total} photos have no mask: all of their pixels are used", total - masks.len()));
            }
            _ => {}
        }
        if let Some(file) = self.unreadable.first() {
            warnings.push(format!(
                "{} masks are not used, because they are neither PNG nor JPEG: {}; convert them, for example with `mogrify -format png`",
                self.unreadable.len(),
                file.display()
            ));
        }
        warnings
    }

    fn add_folder(&mut self, folder: &Path, prefix: &str, depth: usize, entered: &mut BTreeSet<PathBuf>) {
        for_each_entry(folder, entered, &mut |entered, path, name, is_folder| {
            let relative = format!("{prefix}{name}");
            let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            if is_folder {
                if depth < DEEPEST {
                    self.add_folder(&path, &format!("{relative}/"), depth + 1, entered);
                }
            } else if OTHER_EXTENSIONS.contains(&extension.as_str()) {
                self.unreadable.push(path);
            } else {
                add(&mut self.in_folders, relative, path);
            }
        });
    }

    fn add_beside_photos(&mut self, folder: &Path, prefix: &str, depth: usize, entered: &mut BTreeSet<PathBuf>) {
        for_each_entry(folder, entered, &mut |entered, path, name, is_folder| {
            let relative = format!("{prefix}{name}");
            if is_folder {
                if depth < DEEPEST {
                    self.add_beside_photos(&path, &format!("{relative}/"), depth + 1, entered);
                }
            } else if is_mask_name(&path) {
                add(&mut self.beside_photos, relative, path);
            }
        });
    }
}

/// Whether a file beside photos is named like a mask.
pub fn is_mask_name(path: &Path) -> bool {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    stem.ends_with(".mask") || stem.ends_with("_mask") || stem.ends_with("-mask") || stem.starts_with("dynamic_mask_")
}

/// The one file of a name, or the one that is spelled like it but for the case of its extension.
fn only<'f>(found: &'f SameName, mask: &str) -> Option<&'f PathBuf> {
    let with_low_extension = |name: &str| match name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem}.{}", extension.to_ascii_lowercase()),
        None => name.to_string(),
    };
    let is_same = |(name, _): &&(String, PathBuf)| with_low_extension(name) == with_low_extension(mask);
    let spelled = found.iter().find(is_same);
    spelled.or(found.first().filter(|_| found.len() == 1)).map(|(_, path)| path)
}

fn add(files: &mut BTreeMap<String, SameName>, name: String, path: PathBuf) {
    let same = files.entry(name.to_lowercase()).or_default();
    // The same name in a later folder.
    if same.iter().all(|(known, _)| *known != name) {
        same.push((name, path));
    }
}

/// Takes a set of entered folders, an entry's path, its name, and whether it is a folder.
type TakeEntry<'t> = dyn FnMut(&mut BTreeSet<PathBuf>, PathBuf, String, bool) + 't;

/// Calls `take` for each file and folder in `folder`, in the order of names, links followed. A folder that was entered before, or cannot
/// be read, counts as empty.
fn for_each_entry(folder: &Path, entered: &mut BTreeSet<PathBuf>, take: &mut TakeEntry<'_>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    if !std::fs::canonicalize(folder).is_ok_and(|folder| entered.insert(folder)) {
        return;
    }
    let mut paths: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    paths.sort();
    for path in paths {
        let (Ok(facts), Some(name)) = (std::fs::metadata(&path), path.file_name().and_then(|name| name.to_str()))
        else {
            continue;
        };
        if facts.is_dir() || facts.is_file() {
            let name = name.to_string();
            take(entered, path, name, facts.is_dir());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(names: &[&str], beside: &[&str]) -> MaskIndex {
        let mut index = MaskIndex::default();
        names.iter().for_each(|n| add(&mut index.in_folders, n.to_string(), PathBuf::from(n)));
        beside.iter().for_each(|n| add(&mut index.beside_photos, n.to_string(), PathBuf::from(n)));
        index
    }

    #[test]
    fn masks_are_found_under_every_usual_name() {
        let masks = index(
            &[
                "a.PNG",
                "b.JPG.png",
                "c.jpg",
                "left/d.png",
                "E.png",
                "f.jpg.mask.png",
                "g.mask.png",
                "h_mask.png",
                "i.png",
                "I.png",
            ],
            &["k_mask.JPG", "sub/dynamic_mask_l.png", "m.png"],
        );
        let found = |name: &str| masks.find(name).map(|(path, pattern)| (path.to_string_lossy().into_owned(), pattern));
        let is = |file: &str, pattern: Pattern| Some((file.to_string(), pattern));
        assert_eq!(found("a.JPG"), is("a.PNG", Pattern::Same));
        assert_eq!(found("b.JPG"), is("b.JPG.png", Pattern::Appended));
        assert_eq!(found("c.JPG"), is("c.jpg", Pattern::Same));
        assert_eq!(found("left/d.jpeg"), is("left/d.png", Pattern::Same));
        assert_eq!(found("images/left/d.jpeg"), is("left/d.png", Pattern::Same));
        assert_eq!(found("d.jpeg"), None);
        assert_eq!(found("e.jpg"), is("E.png", Pattern::Same), "the only one but for its case");
        assert_eq!((found("i.jpg"), found("I.jpg")), (is("i.png", Pattern::Same), is("I.png", Pattern::Same)));
        assert_eq!(found("f.jpg"), is("f.jpg.mask.png", Pattern::AppendedMask));
        assert_eq!(found("g.jpg"), is("g.mask.png", Pattern::DotMask));
        assert_eq!(found("h.jpg"), is("h_mask.png", Pattern::UnderscoreMask));
        assert_eq!(found("k.JPG"), is("k_mask.JPG", Pattern::UnderscoreMask));
        assert_eq!(found("sub/l.jpg"), is("sub/dynamic_mask_l.png", Pattern::DynamicMask));
        assert_eq!(found("m.jpg"), None, "a photo beside a photo is no mask");
        assert_eq!(found("v1.2/noext"), None);
    }
}
