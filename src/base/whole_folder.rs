//! Folders that appear as a whole: files go to a temporary folder beside the target, which then gets the target's name.
//!
//! Not here: single files ([`super::whole_file`]), the folders of runs and stores.
//!
//! Invariants: 1. the target holds either its old files or all new ones; between two renames it is missing for a moment, and its
//! old files then stand beside it; 2. a folder with a file that `is_ours` rejects is neither replaced nor removed;
//! 3. files are durable before the folder gets its name; 4. dropping a folder that is being written removes it; 5. one writer at a time has
//! the temporary folder of a target, as far as the file system has locks: `.NAME.lock` beside it.

use super::error::{InputError, InputResult};
use super::whole_file::{LockedFile, folder_of, hidden_beside, rename, sync_folder};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Whether the writer of a folder makes a file of this path inside the folder. Such a file is called ours; every other one is foreign.
pub type IsOurs = fn(&Path) -> bool;

#[derive(Debug)]
pub struct PartFolder {
    path: PathBuf,
    old: PathBuf,
    target: PathBuf,
    is_ours: IsOurs,
    bytes: u64,
    _lock: LockedFile,
}

impl PartFolder {
    /// Begins to write the folder `target`: creates `.NAME.part` beside it.
    /// Errors: the folder cannot be written, `target` names no folder, the folder exists and holds foreign files, or another process
    /// writes it.
    pub fn create(target: &Path, is_ours: IsOurs) -> InputResult<PartFolder> {
        let no_name = || InputError::new(target, "this path names no folder", "name a new folder");
        let beside = |ending: &str| hidden_beside(target, ending).ok_or_else(no_name);
        let (path, old) = (beside(".part")?, beside(".old")?);
        check_ours(target, is_ours)?;
        let lock = LockedFile::open(beside(".lock")?, target, Duration::ZERO)?;
        // A process that was killed between the two renames left `.old`; one that was killed earlier left `.part`.
        if old.is_dir() && !target.exists() {
            rename(&old, target).map_err(|e| InputError::io(target, "restoring the older folder", &e))?;
        }
        remove_ours(&path, is_ours)?;
        std::fs::create_dir(&path).map_err(|e| InputError::io(target, "creating the folder", &e))?;
        Ok(PartFolder { path, old, target: target.to_path_buf(), is_ours, bytes: 0, _lock: lock })
    }

    /// Writes a file at this path inside the folder, durably. Errors: the disk fails.
    pub fn write(&mut self, inside: &Path, bytes: &[u8]) -> InputResult<()> {
        debug_assert!((self.is_ours)(inside), "{}", inside.display());
        let path = self.path.join(inside);
        let write = || {
            std::fs::create_dir_all(folder_of(&path))?;
            let mut file = File::create(&path)?;
            file.write_all(bytes)?;
            file.sync_all()
        };
        write().map_err(|e| InputError::io(self.target.join(inside), "writing", &e))?;
        self.bytes += bytes.len() as u64;
        Ok(())
    }

    /// The temporary folder, for writers of files with their own protocol. What they write there must be ours.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes of the files so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Gives the folder its name, in place of an older one.
    /// Errors: the drive fails, or the target now holds foreign files.
    pub fn finish(self) -> InputResult<()> {
        let io = |doing: &str, e: &std::io::Error| InputError::io(&self.target, doing, e);
        check_ours(&self.target, self.is_ours)?;
        remove_ours(&self.old, self.is_ours)?;
        let is_replaced = self.target.is_dir();
        if is_replaced {
            rename(&self.target, &self.old).map_err(|e| io("moving the older folder away", &e))?;
        }
        if let Err(e) = rename(&self.path, &self.target) {
            if is_replaced {
                let _ = rename(&self.old, &self.target);
            }
            return Err(io("giving the folder its name", &e));
        }
        // Some file systems cannot sync folders; the files themselves are durable.
        let _ = sync_folder(folder_of(&self.target));
        remove_ours(&self.old, self.is_ours)
    }
}

impl Drop for PartFolder {
    fn drop(&mut self) {
        // After the rename the folder no longer exists.
        let _ = remove_ours(&self.path, self.is_ours);
    }
}

/// Removes a folder without foreign files, if it exists.
/// Errors: the folder holds foreign files (then every file stays), or the drive fails.
pub fn remove_ours(folder: &Path, is_ours: IsOurs) -> InputResult<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    check_ours(folder, is_ours)?;
    std::fs::remove_dir_all(folder).map_err(|e| InputError::io(folder, "removing the older folder", &e))
}

/// Checks that a folder holds no foreign file, if it exists.
/// Errors: the folder holds a foreign file, or cannot be listed.
pub fn check_ours(folder: &Path, is_ours: IsOurs) -> InputResult<()> {
    match first_other(folder, Path::new(""), is_ours) {
        Ok(None) => Ok(()),
        Ok(Some(other)) => {
            let problem = format!(
                "this folder would be replaced, but it holds {}, which is not part of what is written",
                other.display()
            );
            Err(InputError::new(folder, problem, "name a new folder, or move the file away"))
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(InputError::io(folder, "listing the folder", &e)),
    }
}

/// A foreign file below `folder`, by its path inside the root. Links are foreign and are not followed.
fn first_other(folder: &Path, inside: &Path, is_ours: IsOurs) -> std::io::Result<Option<PathBuf>> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let (name, kind) = (inside.join(entry.file_name()), entry.file_type()?);
        let other = match () {
            () if kind.is_dir() => first_other(&entry.path(), &name, is_ours)?,
            () if kind.is_file() && is_ours(&name) => None,
            () => Some(name),
        };
        if other.is_some() {
            return Ok(other);
        }
    }
    Ok(None)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use std::path::MAIN_SEPARATOR;

    fn is_text(path: &Path) -> bool {
        path.extension().is_some_and(|e| e == "txt")
    }

    #[test]
    fn a_folder_is_replaced_as_a_whole_or_not_at_all() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("a");
        let begin = |text: &str| {
            let mut part = PartFolder::create(&target, is_text).unwrap();
            part.write(Path::new("b/c.txt"), text.as_bytes()).unwrap();
            part
        };
        let content = || std::fs::read_to_string(target.join("b/c.txt")).unwrap();
        let part = begin("old");
        assert!(!target.exists());
        part.finish().unwrap();
        drop(begin("dropped"));
        assert_eq!(content(), "old");
        // What a killed process left goes with the next one.
        std::fs::rename(&target, root.path().join(".a.old")).unwrap();
        std::fs::create_dir(root.path().join(".a.part")).unwrap();
        std::fs::write(root.path().join(".a.part/d.txt"), b"left").unwrap();
        let part = begin("new");
        assert_eq!(content(), "old");
        // As another process would: the folder under way stays.
        let refused = PartFolder::create(&target, is_text).unwrap_err();
        assert!(refused.problem.contains("another process is writing") && part.path().join("b/c.txt").exists());
        part.finish().unwrap();
        assert_eq!(content(), "new");
        assert!(!target.join("d.txt").exists());
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 1, "no temporary folder is left");
    }

    #[test]
    fn a_folder_with_files_of_others_stays() {
        let root = tempfile::tempdir().unwrap();
        let target = root.path().join("a");
        let part = PartFolder::create(&target, is_text).unwrap();
        std::fs::create_dir_all(target.join("photos")).unwrap();
        std::fs::write(target.join("photos/1.jpg"), b"").unwrap();
        let names_it = |error: InputError| error.problem.replace(MAIN_SEPARATOR, "/").contains("photos/1.jpg");
        assert!(names_it(part.finish().unwrap_err()));
        assert!(names_it(PartFolder::create(&target, is_text).unwrap_err()));
        assert!(target.join("photos/1.jpg").exists());
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 1, "no temporary folder is left");
        assert!(PartFolder::create(Path::new(".."), is_text).unwrap_err().problem.contains("names no folder"));
    }
}
