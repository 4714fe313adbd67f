//! Converts names from files to paths that stay inside a folder. Nothing here accesses the disk.
//!
//! Invariants: 1. an accepted name is relative and has no `..` component, drive letter or control character, and at
//! most [`MAX_NAME_BYTES`] bytes; 2. both `/` and `\` separate components, on every platform, so that a name means the
//! same file everywhere. Links inside the folder belong to the user and are followed.

use std::path::{Path, PathBuf};

/// Longest name accepted, bytes: the usual limit of a path.
pub const MAX_NAME_BYTES: usize = 4096;

/// The name with `/` between its components and without `.` and empty ones, or the reason for refusal.
pub fn clean_name(name: &str) -> Result<String, String> {
    if name.len() > MAX_NAME_BYTES {
        return Err(format!("a name of {} bytes is longer than {MAX_NAME_BYTES}", name.len()));
    }
    // {:?} keeps control characters of a hostile name out of the terminal.
    if name.chars().any(char::is_control) {
        return Err(format!("the name {name:?} holds control characters"));
    }
    if name.starts_with(['/', '\\']) {
        return Err(format!("the name {name:?} is an absolute path"));
    }
    let mut parts = Vec::new();
    for part in name.split(['/', '\\']) {
        let bytes = part.as_bytes();
        match part {
            "" | "." => {}
            ".." => return Err(format!("the name {name:?} climbs out of its folder with '..'")),
            _ if bytes.len() >= 2 && bytes[0].is_ascii_alphabetic() && bytes[1] == b':' => {
                return Err(format!("the name {name:?} holds a drive letter"));
            }
            _ => parts.push(part),
        }
    }
    if parts.is_empty() {
        return Err(format!("the name {name:?} is not a file name"));
    }
    Ok(parts.join("/"))
}

/// `folder` joined with a name from a file: the cleaned name and the path, or the reason for refusal.
pub fn safe_join(folder: &Path, name: &str) -> Result<(String, PathBuf), String> {
    let name = clean_name(name)?;
    let path = folder.join(&name);
    Ok((name, path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_inside_the_folder_are_accepted() {
        for (given, clean) in [
            ("a.jpg", "a.jpg"),
            ("./images/a b.jpg", "images/a b.jpg"),
            ("cam1//x/./0001.png", "cam1/x/0001.png"),
            ("cam\\0001.png", "cam/0001.png"),
            ("..a/b..png", "..a/b..png"),
            ("straße/é.png", "straße/é.png"),
            ("12:30.jpg", "12:30.jpg"),
        ] {
            assert_eq!(clean_name(given).as_deref(), Ok(clean));
        }
        let (name, path) = safe_join(Path::new("scene"), "./x/y.png").unwrap_or_default();
        assert_eq!((name.as_str(), path.as_path()), ("x/y.png", Path::new("scene/x/y.png")));
    }
}
