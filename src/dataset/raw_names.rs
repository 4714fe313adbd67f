//! Names of photos in a code page: finds the files that they mean, and the names to show.
//!
//! Programs write names in the code page of the computer (Windows-1252, GBK, Shift-JIS) without saying which. The name on the drive
//! decides: it has the same bytes, or it is the name in Windows-1252, or it is the only one that agrees in all ASCII characters.
//!
//! Not here: how bytes are kept in a name ([`crate::base::text`]).
//!
//! Invariant: names of UTF-8 are not touched.

use super::checks::{listed, sort_views};
use super::model::RawScene;
use crate::base::error::InputResult;
use crate::base::text::{as_windows_1252, has_raw_bytes, raw_byte, raw_bytes, shown};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Stands for characters that are not ASCII.
const OTHERS: char = '\u{1}';

/// The file inside `folder` that a cleaned name with bytes of a code page means; `None` if there is none, or if several may be
/// meant, or if the name has no such bytes.
pub(super) fn find(folder: &Path, name: &str) -> Option<PathBuf> {
    if !has_raw_bytes(name) {
        return None;
    }
    let part_in =
        |folder: PathBuf, part| if has_raw_bytes(part) { entry(&folder, part) } else { Some(folder.join(part)) };
    let path = name.split('/').try_fold(folder.to_path_buf(), part_in)?;
    path.is_file().then_some(path)
}

/// The entry of a folder that a part of a name means.
fn entry(folder: &Path, part: &str) -> Option<PathBuf> {
    let known = [os_name(raw_bytes(part)), Some(as_windows_1252(part).into())];
    let mut known = known.into_iter().flatten().map(|name| folder.join(name));
    if let Some(path) = known.find(|path| path.exists()) {
        return Some(path);
    }
    let entries = std::fs::read_dir(folder).ok()?.flatten();
    let entries: Vec<String> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    [false, true].into_iter().find_map(|in_pairs| {
        let wanted = ascii_of(part, in_pairs);
        let mut fitting = entries.iter().filter(|entry| ascii_of(entry, false) == wanted);
        fitting.next().filter(|_| fitting.next().is_none()).map(|entry| folder.join(entry))
    })
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

/// Gives the views whose names have bytes of a code page names to show, and says which they are.
/// Errors: two views have the same name then.
pub(super) fn make_readable(file: &Path, scene: &mut RawScene) -> InputResult<()> {
    let (mut found, mut lost) = (Vec::new(), Vec::new());
    for view in scene.views.iter_mut().filter(|view| has_raw_bytes(&view.name)) {
        let bytes = shown(&view.name);
        let parts = view.name.split('/').count();
        let components: Option<Vec<&str>> = view.image_path.iter().map(|part| part.to_str()).collect();
        let of_path = components
            .filter(|_| view.image_path.is_file())
            .map(|all| all[all.len().saturating_sub(parts)..].join("/"));
        let is_there = view.image_path.is_file();
        view.name = of_path.unwrap_or_else(|| if is_there { as_windows_1252(&view.name) } else { bytes.clone() });
        match is_there {
            true => found.push(format!("{bytes} is {}", view.name)),
            false => lost.push(bytes),
        }
    }
    if found.is_empty() && lost.is_empty() {
        return Ok(());
    }
    for (names, what) in [(&found, "matched with the photos"), (&lost, "no photo, or more than one, fits them")] {
        if !names.is_empty() {
            let (file, count, names) = (file.display(), names.len(), listed(names));
            scene.warnings.push(format!("{file}: {count} name(s) are not UTF-8 but of a code page; {what}: {names}"));
        }
    }
    sort_views(file, &mut scene.views)
}
