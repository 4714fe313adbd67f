//! Converts names from files to names that stay inside a folder. Nothing here accesses the disk.
//!
//! A name that lies outside of its folder (absolute, on another drive, climbing) is told apart and keeps its components: models
//! are moved between machines, and the end of such a name may lie inside (`photo_files`).
//!
//! Invariants: 1. a name that is returned is relative and has no `..` component, drive letter or control character, and at
//! most [`MAX_NAME_BYTES`] bytes; 2. both `/` and `\` separate components, on every platform, so that a name means the
//! same file everywhere. Links inside the folder belong to the user and are followed.

/// Longest name accepted, bytes: the usual limit of a path.
pub const MAX_NAME_BYTES: usize = 4096;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatedName {
    /// Its components with `/` between them: relative, without root, drive letter, `.` and `..`.
    pub name: String,
    /// Why the stated name lies outside of its folder, if it does; `name` then is the part of it that may be looked for inside.
    pub outside: Option<String>,
}

impl StatedName {
    /// The name, then its ends with one component less each. Only the name itself if it lies inside of its folder.
    pub fn tails(&self) -> impl Iterator<Item = &str> {
        let starts = self.name.match_indices('/').map(|(at, _)| at + 1).filter(|_| self.outside.is_some());
        std::iter::once(0).chain(starts).map(|at| &self.name[at..])
    }
}

/// Reads a name that is relative to the folder `base` (itself relative, possibly empty), or the reason for refusal.
pub fn read_name(base: &str, stated: &str) -> Result<StatedName, String> {
    if stated.len() > MAX_NAME_BYTES {
        return Err(format!("a name of {} bytes is longer than {MAX_NAME_BYTES}", stated.len()));
    }
    // {:?} keeps control characters of a hostile name out of the terminal.
    if stated.chars().any(char::is_control) {
        return Err(format!("the name {stated:?} holds control characters"));
    }
    let mut parts: Vec<&str> = base.split(['/', '\\']).filter(|part| !part.is_empty()).collect();
    let mut outside = None;
    if stated.starts_with(['/', '\\']) {
        parts.clear();
        outside = Some(format!("the name {stated:?} is an absolute path"));
    }
    let mut last = "";
    for part in stated.split(['/', '\\']) {
        last = part;
        let mut part = part;
        while let [letter, b':', ..] = part.as_bytes()
            && letter.is_ascii_alphabetic()
        {
            part = &part[2..];
            parts.clear();
            outside.get_or_insert_with(|| format!("the name {stated:?} holds a drive letter"));
        }
        match part {
            "" | "." => {}
            ".." if parts.pop().is_none() => {
                outside.get_or_insert_with(|| format!("the name {stated:?} climbs out of its folder with '..'"));
            }
            ".." => {}
            part => parts.push(part),
        }
    }
    if parts.is_empty() || matches!(last, "." | "..") {
        return Err(format!("the name {stated:?} is not a file name"));
    }
    Ok(StatedName { name: parts.join("/"), outside })
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
            ("sparse/../images/a.jpg", "images/a.jpg"),
        ] {
            assert_eq!(read_name("", given).map(|n| (n.name, n.outside)), Ok((clean.into(), None)));
        }
    }

    #[test]
    fn names_outside_give_their_ends_and_never_leave() {
        let tails = |base: &str, stated: &str| {
            let read = read_name(base, stated).unwrap_or_else(|e| panic!("{e}"));
            assert!(read.outside.is_some(), "{stated}");
            read.tails().map(String::from).collect::<Vec<_>>()
        };
        assert_eq!(tails("", "/p/images/a.jpg"), ["p/images/a.jpg", "images/a.jpg", "a.jpg"]);
        assert_eq!(tails("", "C:\\p\\a.jpg"), ["p/a.jpg", "a.jpg"]);
        assert_eq!(tails("x", "../../p/../a.jpg"), ["a.jpg"]);
        assert_eq!(tails("x", "D:a.jpg"), ["a.jpg"]);
        assert_eq!(tails("", "\\\\host\\share\\a.jpg"), ["host/share/a.jpg", "share/a.jpg", "a.jpg"]);
        assert_eq!(
            read_name("pose/all", "../../train/a.png").map(|n| (n.name, n.outside)),
            Ok(("train/a.png".into(), None))
        );
        for bad in ["", ".", "..", "/", "a/..", "C:", "a\n", &"a".repeat(MAX_NAME_BYTES + 1)] {
            assert!(read_name("", bad).is_err(), "{bad:?}");
        }
    }
}
