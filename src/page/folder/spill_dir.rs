//! A folder on a drive that belongs to one run: made, checked, locked, and cleaned up.
//!
//! Knows files, not pages. Invariants: 1. nothing in the folder is changed before it is certain that the folder is
//! empty or one of this program's, belongs to this user, and no other process uses it; 2. only files that this
//! program made are ever removed, told by name and by the store's identity inside; 3. no symbolic link is followed,
//! neither to the folder nor in it; 4. what is made is private to the user.

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use crate::page::engine::drive_rate;
use crate::page::engine::segment_files::{segment_from_file_name, sync_folder, with_safe_flags};
use crate::page::folder::file_system::{FileSystem, free_bytes};
use crate::page::format::slot_header::{HEADER_BYTES, SlotHeader};
use crate::page::format::spill_format::{FORMAT_BYTES, FormatError, Purpose, SpillFormat};
use crate::page::map::commit::{MAP_NAME, MAP_NEW_NAME, RESERVE_NAME, RESERVE_NEW_NAME, WITNESS_NAME};
use crate::page::versions::slots::SlotLayout;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

pub(in crate::page) const FORMAT: &str = "FORMAT";
/// The file while it is written; then it is renamed.
const FORMAT_NEW: &str = "FORMAT.new";
pub(in crate::page) const LOCK: &str = "LOCK";
/// First line of the lock's file, to tell it from somebody else's.
pub(in crate::page) const LOCK_MAGIC: &str = "gsscale spill directory\n";
const OTHER_FOLDER: &str = "name another folder";

/// A spill directory in use by this process. The lock is held until it is dropped.
#[derive(Debug)]
pub struct SpillDir {
    folder: PathBuf,
    format: SpillFormat,
    warnings: Vec<String>,
    /// Whether this process made the folder itself, and so may remove it.
    made_folder: bool,
    /// Holds the lock.
    lock: File,
}

impl SpillDir {
    /// Makes a spill directory of a folder that does not exist (its parent does) or is empty. With `allow_remote`,
    /// also on a network file system.
    ///
    /// # Errors
    /// The folder is a link, not empty, another user's, in use, left over from another run, read-only, or on a network
    /// file system.
    pub fn create(folder: &Path, purpose: Purpose, layout: SlotLayout, allow_remote: bool) -> InputResult<SpillDir> {
        let made_folder = make_folder(folder)?;
        let result = SpillDir::create_in(folder, purpose, layout, allow_remote, made_folder);
        if result.is_err() && made_folder {
            // Only if it is still empty; what is in it by now is somebody's.
            let _ = std::fs::remove_dir(folder);
        }
        result
    }

    fn create_in(
        folder: &Path,
        purpose: Purpose,
        layout: SlotLayout,
        allow_remote: bool,
        made_folder: bool,
    ) -> InputResult<SpillDir> {
        check_folder(folder)?;
        let warnings = check_file_system(folder, allow_remote)?;
        refuse_foreign_files(folder)?;
        let lock = take_lock(folder)?;
        // Again: it may have been made just now.
        match read_format(folder)? {
            None => {}
            Some(Ok(SpillFormat { purpose: Purpose::Scratch, .. })) => {
                let problem = "it holds the pages of a run that was cut off; they are of no use to another";
                let remedy = format!("remove the folder (rm -r {}) or {OTHER_FOLDER}", folder.display());
                return Err(InputError::new(folder, problem, remedy));
            }
            Some(Ok(_)) => {
                let remedy = format!(
                    "go on with that run (gsscale-train --resume with its output folder), remove the folder (rm -r {}) or \
                     {OTHER_FOLDER}",
                    folder.display()
                );
                return Err(InputError::new(folder, "it holds the checkpoint of another run", remedy));
            }
            Some(Err(error)) => return Err(bad_format(folder, &error)),
        }
        tighten(folder)?;
        sign_lock(folder, &lock)?;
        let format = SpillFormat { store: draw_identity(), purpose, layout };
        write_format(folder, &format)?;
        Ok(SpillDir { folder: folder.to_path_buf(), format, warnings, made_folder, lock })
    }

    /// Opens a spill directory that exists.
    ///
    /// # Errors
    /// As for [`SpillDir::create`], or there is none, or it is of a newer version or damaged.
    pub fn open(folder: &Path, allow_remote: bool) -> InputResult<SpillDir> {
        check_folder(folder)?;
        let warnings = check_file_system(folder, allow_remote)?;
        let read = || match read_format(folder)? {
            Some(format) => format.map_err(|error| bad_format(folder, &error)),
            None => {
                let remedy = "give the folder that was named by --spill-dir";
                Err(InputError::new(folder, "it is no spill directory: there is no FORMAT file", remedy))
            }
        };
        // Asked before the lock is made as well, so that a folder of somebody else stays as it is.
        read()?;
        let lock = take_lock(folder)?;
        let format = read()?;
        sign_lock(folder, &lock)?;
        Ok(SpillDir { folder: folder.to_path_buf(), format, warnings, made_folder: false, lock })
    }

    /// Whether there is one, of whatever version and in whatever state, without touching it.
    pub fn is_one(folder: &Path) -> bool {
        !matches!(read_format(folder), Ok(None))
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Identity and sizes.
    pub fn format(&self) -> &SpillFormat {
        &self.format
    }

    /// What the user should know about the drive.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Bytes that may still be written to the drive; `None` where the system does not tell.
    ///
    /// # Errors
    /// The folder is gone.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        free_bytes(&self.folder).map_err(|e| InputError::io(&self.folder, "asking for free space", &e))
    }

    /// Numbers of the segments that are there, ascending.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn segments(&self) -> InputResult<Vec<u32>> {
        let mut segments: Vec<u32> = names(&self.folder)?.iter().filter_map(|n| segment_from_file_name(n)).collect();
        segments.sort_unstable();
        Ok(segments)
    }

    /// Refuses a folder whose lock or FORMAT file is no longer the one that this process holds: somebody removed the store
    /// and made another one under the same path.
    fn check_identity(&self) -> InputResult<()> {
        let is_same_lock = is_still_there(&self.folder.join(LOCK), &self.lock);
        let is_same_store = matches!(read_format(&self.folder)?, Some(Ok(format)) if format.store == self.format.store);
        if is_same_lock && is_same_store {
            return Ok(());
        }
        let problem = "the store in it is not the one that this run used, so nothing in it is removed";
        let remedy = format!("see what it holds: gsscale-ckpt ls {}", self.folder.display());
        Err(InputError::new(&self.folder, problem, remedy))
    }

    /// Removes the files of this store, and the folder if this process made it. Gives the names of files that stay
    /// because they are not this store's.
    ///
    /// # Errors
    /// Another store has taken the place of this one (nothing is removed), or a file cannot be removed.
    pub fn remove(self) -> InputResult<Vec<String>> {
        self.check_identity()?;
        let mut foreign = Vec::new();
        let mut ours = [
            MAP_NAME,
            MAP_NEW_NAME,
            WITNESS_NAME,
            RESERVE_NAME,
            RESERVE_NEW_NAME,
            FORMAT_NEW,
            FORMAT,
            LOCK,
            drive_rate::FILE_NAME,
        ]
        .map(str::to_string)
        .to_vec();
        for name in names(&self.folder)? {
            if segment_from_file_name(&name).is_some() && self.is_our_segment(&self.folder.join(&name)) {
                ours.insert(0, name);
            } else if !ours.contains(&name) {
                foreign.push(name);
            }
        }
        for name in ours {
            let path = self.folder.join(name);
            match std::fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(InputError::io(path, "removing", &error));
                }
                _ => {}
            }
        }
        if self.made_folder && foreign.is_empty() {
            std::fs::remove_dir(&self.folder).map_err(|e| InputError::io(&self.folder, "removing", &e))?;
        }
        Ok(foreign)
    }

    /// Whether a segment's first slot is of this store or was never written (also where the process ended while the
    /// segment was made).
    fn is_our_segment(&self, path: &Path) -> bool {
        let mut header = Vec::new();
        let file = with_safe_flags(OpenOptions::new().read(true)).open(path);
        let bytes = file.and_then(|file| {
            let metadata = file.metadata()?;
            file.take(HEADER_BYTES as u64).read_to_end(&mut header)?;
            Ok(if metadata.is_file() { metadata.len() } else { 0 })
        });
        let slot = header.first_chunk().map(SlotHeader::decode);
        match (bytes, slot) {
            (Err(_) | Ok(0), _) => false,
            (Ok(_), Some(Ok(slot))) => slot.store == self.format.store,
            (Ok(bytes), _) => bytes <= self.format.layout.segment_bytes() && header.iter().all(|&b| b == 0),
        }
    }
}

/// Makes the folder, private, if there is nothing of that name. Tells whether it did.
fn make_folder(folder: &Path) -> InputResult<bool> {
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::DirBuilderExt;
        builder.mode(0o700);
    }
    match builder.create(folder) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
        Err(error) => Err(InputError::io(folder, "making the spill directory", &error)),
    }
}

/// The folder itself: not a link, this user's, not writable by others.
fn check_folder(folder: &Path) -> InputResult<()> {
    let there = std::fs::symlink_metadata(folder).map_err(|e| InputError::io(folder, "looking at it", &e))?;
    if there.is_symlink() {
        let remedy = "name the folder that it leads to";
        return Err(InputError::new(folder, "the spill directory is a symbolic link", remedy));
    }
    if !there.is_dir() {
        return Err(InputError::new(folder, "the spill directory is not a folder", OTHER_FOLDER));
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        check_owner(folder, there.uid(), rustix::process::geteuid().as_raw())?;
        let is_empty = names(folder)?.is_empty();
        if there.mode() & 0o022 != 0 && !is_empty {
            let remedy = format!("take the right from them: chmod go-w {}", folder.display());
            return Err(InputError::new(folder, "other users may write to it", remedy));
        }
    }
    Ok(())
}

#[cfg(unix)]
fn check_owner(folder: &Path, owner: u32, user: u32) -> InputResult<()> {
    if owner == user {
        return Ok(());
    }
    let problem = format!("it belongs to another user (number {owner}; this process has {user})");
    Err(InputError::new(folder, problem, "name a folder of your own"))
}

/// An empty folder becomes private.
fn tighten(folder: &Path) -> InputResult<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let private = std::fs::Permissions::from_mode(0o700);
        std::fs::set_permissions(folder, private).map_err(|e| InputError::io(folder, "making it private", &e))?;
    }
    let _ = folder;
    Ok(())
}

fn check_file_system(folder: &Path, allow_remote: bool) -> InputResult<Vec<String>> {
    let kind = FileSystem::of(folder).map_err(|e| InputError::io(folder, "asking for its file system", &e))?;
    warnings_for(folder, kind, allow_remote)
}

/// What to say about a kind of file system.
fn warnings_for(folder: &Path, kind: FileSystem, allow_remote: bool) -> InputResult<Vec<String>> {
    let name = folder.display();
    match kind {
        FileSystem::Local => Ok(Vec::new()),
        FileSystem::Memory => Ok(vec![format!("{name} is on tmpfs: pages that are spilled there take memory")]),
        FileSystem::Overlay => {
            Ok(vec![format!("{name} is on overlayfs, the file system of a container: a mounted drive is faster")])
        }
        FileSystem::Remote(what) if allow_remote => {
            Ok(vec![format!("{name} is on {what}: locks and syncs may not hold what they promise there")])
        }
        FileSystem::Remote(what) => {
            let remedy = "name a folder on a drive of this machine";
            Err(InputError::new(folder, format!("the spill directory is on {what}"), remedy))
        }
    }
}

/// Refuses a folder with files that are not a spill directory's.
fn refuse_foreign_files(folder: &Path) -> InputResult<()> {
    match read_format(folder)? {
        Some(Ok(_)) => return Ok(()),
        Some(Err(error)) => return Err(bad_format(folder, &error)),
        None => {}
    }
    let names = names(folder)?;
    // A run that was cut off before its FORMAT file was there leaves these.
    match names.iter().find(|n| ![LOCK, FORMAT_NEW].contains(&n.as_str())) {
        None => Ok(()),
        Some(foreign) => {
            let problem = format!("it is not empty (there is {foreign:?}) and no spill directory");
            Err(InputError::new(folder, problem, "name an empty folder, or one that does not exist"))
        }
    }
}

/// Names in the folder, sorted. Names that are not UTF-8 are kept readable; no file of this program has one.
fn names(folder: &Path) -> InputResult<Vec<String>> {
    let failed = |e: io::Error| InputError::io(folder, "reading the folder", &e);
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        names.push(entry.map_err(failed)?.file_name().to_string_lossy().into_owned());
    }
    names.sort_unstable();
    Ok(names)
}

/// Locks the folder for the life of the process.
fn take_lock(folder: &Path) -> InputResult<File> {
    let path = folder.join(LOCK);
    let failed = |e: io::Error| InputError::io(&path, "locking the spill directory", &e);
    // A process that ends may remove the file between our opening and locking it; then there is a new one to lock.
    for _ in 0..16 {
        let mut options = OpenOptions::new();
        let file = with_safe_flags(options.read(true).write(true).create(true).truncate(false)).open(&path);
        let mut file = file.map_err(failed)?;
        let mut content = String::new();
        // A foreign file may be anything, of any length.
        let is_file = file.metadata().is_ok_and(|m| m.is_file());
        let is_text = is_file && Read::by_ref(&mut file).take(512).read_to_string(&mut content).is_ok();
        if !is_text || !(content.is_empty() || content.starts_with(LOCK_MAGIC)) {
            return Err(InputError::new(path, "it is a file of something else", OTHER_FOLDER));
        }
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let who = content.strip_prefix(LOCK_MAGIC).unwrap_or("").trim().replace('\n', ", ");
                let who = if who.is_empty() { String::new() } else { format!(" ({who})") };
                let remedy = format!("wait for it to end, stop it, or {OTHER_FOLDER}");
                return Err(InputError::new(folder, format!("another process uses the spill directory{who}"), remedy));
            }
            Err(TryLockError::Error(error)) => return Err(failed(error)),
        }
        if is_still_there(&path, &file) {
            return Ok(file);
        }
    }
    Err(InputError::new(path, "it is removed again and again", "see which other process uses the folder"))
}

/// Says in the lock's file who holds it, for the message to others.
fn sign_lock(folder: &Path, mut lock: &File) -> InputResult<()> {
    use std::io::Seek;
    let content = format!("{LOCK_MAGIC}process {}\nhost {}\n", std::process::id(), host_name());
    let write = lock.rewind().and_then(|()| lock.set_len(0)).and_then(|()| lock.write_all(content.as_bytes()));
    write.map_err(|e| InputError::io(folder.join(LOCK), "locking the spill directory", &e))
}

#[cfg(unix)]
fn is_still_there(path: &Path, file: &File) -> bool {
    use std::os::unix::fs::MetadataExt;
    let same = |a: &std::fs::Metadata, b: &std::fs::Metadata| a.dev() == b.dev() && a.ino() == b.ino();
    matches!((std::fs::symlink_metadata(path), file.metadata()), (Ok(a), Ok(b)) if same(&a, &b))
}

#[cfg(not(unix))]
fn is_still_there(_path: &Path, _file: &File) -> bool {
    // A file that is open cannot be removed there.
    true
}

fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok().or_else(|| std::env::var("HOSTNAME").ok());
    name.map_or_else(|| "unknown".to_string(), |n| n.trim().to_string())
}

/// What the FORMAT file says; `None` when there is none.
pub(in crate::page) fn read_format(folder: &Path) -> InputResult<Option<Result<SpillFormat, FormatError>>> {
    Ok(format_bytes_of(folder)?.map(|bytes| SpillFormat::from_bytes(&bytes)))
}

/// The bytes of the FORMAT file, empty for one that is no file; `None` when there is none.
pub(in crate::page) fn format_bytes_of(folder: &Path) -> InputResult<Option<Vec<u8>>> {
    let path = folder.join(FORMAT);
    let failed = |e: io::Error| InputError::io(&path, "reading", &e);
    let file = match with_safe_flags(OpenOptions::new().read(true)).open(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file.map_err(failed)?,
    };
    if !file.metadata().map_err(failed)?.is_file() {
        return Ok(Some(Vec::new()));
    }
    let mut bytes = Vec::new();
    file.take(FORMAT_BYTES as u64 + 1).read_to_end(&mut bytes).map_err(failed)?;
    Ok(Some(bytes))
}

pub(in crate::page) fn bad_format(folder: &Path, error: &FormatError) -> InputError {
    let remedy = match error {
        FormatError::Version { .. } | FormatError::Features { .. } => {
            "use the program that made it, or name another folder"
        }
        _ => OTHER_FOLDER,
    };
    InputError::new(folder.join(FORMAT), error.to_string(), remedy)
}

/// Writes the FORMAT file: whole or not at all, durable before anything else is.
fn write_format(folder: &Path, format: &SpillFormat) -> InputResult<()> {
    let (new, path) = (folder.join(FORMAT_NEW), folder.join(FORMAT));
    let write = || {
        let mut file = with_safe_flags(OpenOptions::new().write(true).create(true).truncate(true)).open(&new)?;
        file.write_all(&format.to_bytes())?;
        file.sync_all()?;
        std::fs::rename(&new, &path)?;
        sync_folder(folder)?;
        // The folder's own entry: its parent may not be ours to open, then the first sync of a file has to do.
        let _ = folder.parent().map(sync_folder);
        Ok(())
    };
    write().map_err(|e| InputError::io(&path, "writing", &e))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn network_drives_are_refused_unless_allowed() {
        let folder = Path::new("/mnt/share");
        let error = warnings_for(folder, FileSystem::Remote("NFS"), false).unwrap_err();
        assert!(error.problem.contains("NFS") && error.remedy.contains("a drive of this machine"));
        assert!(warnings_for(folder, FileSystem::Remote("NFS"), true).unwrap()[0].contains("NFS"));
        assert!(warnings_for(folder, FileSystem::Memory, false).unwrap()[0].contains("take memory"));
        assert!(warnings_for(folder, FileSystem::Overlay, false).unwrap()[0].contains("overlayfs"));
        assert!(warnings_for(folder, FileSystem::Local, false).unwrap().is_empty());
    }

    /// Root passes every check of rights, so the rule is tested by itself.
    #[cfg(unix)]
    #[test]
    fn folders_of_others_are_refused() {
        let error = check_owner(Path::new("x"), 1000, 0).unwrap_err();
        assert!(error.problem.contains("1000") && check_owner(Path::new("x"), 7, 7).is_ok());
    }
}
