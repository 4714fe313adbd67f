//! Masks: finds the mask of each photo. [`super::photo`] decodes the pixels to keep.
//!
//! A mask is a picture of the photo's shape: white (128 and above) is kept, black is excluded from loss and metrics. A
//! transparent mask pixel counts as black. Masks are in `masks/` beside (or inside) the image folder, under the photo's
//! relative name: the same name, the name with `.png` appended, or with another picture extension. Extensions are
//! compared case-insensitively.
//!
//! Invariants: 1. the folder is listed once, without following links out of it; 2. a mask's size may differ from the
//! photo's, its shape may not.

use super::photo_header::PhotoHeader;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
const DEEPEST: usize = 16;

/// The mask of a photo.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskSource {
    /// The mask's file.
    pub path: PathBuf,
    /// Its header.
    pub header: PhotoHeader,
    /// Whether black is kept instead of white.
    pub invert: bool,
}

/// Mask files by relative name.
#[derive(Debug, Clone, Default)]
pub struct MaskIndex {
    files: BTreeMap<String, PathBuf>,
}

impl MaskIndex {
    /// Lists `masks/` in the scene's folder, beside the image folder if that is deeper, and inside the image folder;
    /// the first match wins. Searches nothing outside the scene; missing folders count as empty.
    pub fn scan(root: &Path, image_folder: &Path) -> Self {
        let mut index = MaskIndex::default();
        index.add_folder(&root.join("masks"), "", 0);
        if let Some(parent) = image_folder.parent().filter(|p| p.starts_with(root)) {
            index.add_folder(&parent.join("masks"), "", 0);
        }
        index.add_folder(&image_folder.join("masks"), "", 0);
        index
    }

    /// Whether there are no masks.
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// The mask of the photo with this `/`-separated relative name. A leading `images/` of the name is optional in
    /// the mask folder.
    pub fn find(&self, name: &str) -> Option<&Path> {
        let short = name.strip_prefix("images/");
        [Some(name), short].into_iter().flatten().find_map(|name| self.find_exact(name))
    }

    fn find_exact(&self, name: &str) -> Option<&Path> {
        let stem = match name.rsplit_once('.') {
            Some((stem, extension)) if !extension.contains('/') => stem,
            _ => name,
        };
        let same = std::iter::once(normalised(name));
        let appended = std::iter::once(format!("{name}.png"));
        let others = EXTENSIONS.iter().map(|e| format!("{stem}.{e}"));
        same.chain(appended).chain(others).find_map(|key| self.files.get(&key)).map(PathBuf::as_path)
    }

    fn add_folder(&mut self, folder: &Path, prefix: &str, depth: usize) {
        let Ok(entries) = std::fs::read_dir(folder) else { return };
        for entry in entries.flatten() {
            let (Ok(kind), Ok(name)) = (entry.file_type(), entry.file_name().into_string()) else { continue };
            let relative = format!("{prefix}{name}");
            if kind.is_dir() && depth < DEEPEST {
                self.add_folder(&entry.path(), &format!("{relative}/"), depth + 1);
            } else if kind.is_file() {
                self.files.entry(normalised(&relative)).or_insert_with(|| entry.path());
            }
        }
    }
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

    fn index(names: &[&str]) -> MaskIndex {
        MaskIndex { files: names.iter().map(|n| (normalised(n), PathBuf::from(n))).collect() }
    }

    #[test]
    fn masks_are_found_under_every_usual_name() {
        let masks = index(&["a.PNG", "b.JPG.png", "c.jpg", "left/d.png", "E.png"]);
        let found = |name: &str| masks.find(name).map(|p| p.to_string_lossy().into_owned());
        assert_eq!(found("a.JPG").as_deref(), Some("a.PNG"));
        assert_eq!(found("b.JPG").as_deref(), Some("b.JPG.png"));
        assert_eq!(found("c.JPG").as_deref(), Some("c.jpg"));
        assert_eq!(found("left/d.jpeg").as_deref(), Some("left/d.png"));
        assert_eq!(found("images/left/d.jpeg").as_deref(), Some("left/d.png"));
        assert_eq!(found("d.jpeg"), None);
        assert_eq!(found("e.jpg"), None); // stems keep their case
        assert_eq!(found("v1.2/noext"), None);
    }
}
