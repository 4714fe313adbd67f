//! The spill directory: a folder on a drive that belongs to one run; created, checked, locked, and cleaned up here.
//!
//! Knows files, not pages. Invariants: 1. nothing in the folder changes before it is certain that the folder is empty
//! or a spill directory, belongs to this user, and no other process uses it; 2. only files that this program created
//! are ever removed, recognised by name and by the store's identity inside; 3. no symbolic link is followed, neither to
//! the folder nor in it; 4. new files are private to the user.

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use crate::base::machine::host_name;
use crate::base::say::shell_word;
use crate::base::whole_file::{folder_of, is_same_file, rename, sync_folder};
use crate::page::engine::segment_files::{open_for_reading, segment_from_file_name, with_safe_flags};
use crate::page::folder::file_system::{FileSystem, free_bytes};
use crate::page::folder::protocol_files::{
    MAP_NAME, MAP_NEW_NAME, RESERVE_NAME, RESERVE_NEW_NAME, WITNESS_NAME, ignore_not_found,
};
use crate::page::format::slot_header::{HEADER_BYTES, KNOWN_COMPATIBLE, SlotHeader};
use crate::page::format::spill_format::{FORMAT_BYTES, FormatError, SlotLayout, SpillFormat};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

pub(in crate::page) const FORMAT: &str = "FORMAT";
/// The FORMAT file while it is written; renamed when complete.
const FORMAT_NEW: &str = "FORMAT.new";
pub(in crate::page) const LOCK: &str = "LOCK";
/// First line of the lock file, which distinguishes it from a foreign file.
pub(in crate::page) const LOCK_MAGIC: &str = "gsscale spill directory\n";
const OTHER_FOLDER: &str = "name another folder";

/// A spill directory in use by this process. Dropping it releases the lock.
#[derive(Debug)]
pub struct SpillDir {
    folder: PathBuf,
    format: SpillFormat,
    warnings: Vec<String>,
    /// Whether this run created the folder, and so may remove it.
    made_folder: bool,
    lock: File,
}

impl SpillDir {
    /// Creates a spill directory in a folder that does not exist (its parent does) or is empty. With `allow_remote`,
    /// also on a network file system.
    /// Errors: the folder is a link, not empty, another user's, in use, left over from another run, read-only, or on a
    /// network file system.
    pub fn create(folder: &Path, layout: SlotLayout, allow_remote: bool) -> InputResult<SpillDir> {
        let made_folder = make_folder(folder)?;
        let result = SpillDir::create_in(folder, layout, allow_remote, made_folder);
        if result.is_err() && made_folder {
            // Removes the folder only if it is still empty; any content belongs to somebody else.
            let _ = std::fs::remove_dir(folder);
        }
        result
    }

    fn create_in(folder: &Path, layout: SlotLayout, allow_remote: bool, made_folder: bool) -> InputResult<SpillDir> {
        let warnings = check_new(folder, allow_remote)?;
        let lock = take_lock(folder)?;
        // Checked again under the lock: another process may have created a store just now.
        if read_format(folder)?.is_some() {
            return Err(of_another_run(folder));
        }
        make_private(folder)?;
        sign_lock(folder, &lock)?;
        let format = SpillFormat { store: draw_identity(), layout, compatible: KNOWN_COMPATIBLE };
        write_format(folder, &format)?;
        Ok(SpillDir { folder: folder.to_path_buf(), format, warnings, made_folder, lock })
    }

    /// Makes a new, empty store in the place of this one. The FORMAT file is there at every moment, so that a folder whose process was
    /// killed here is not taken for one whose drive is missing.
    /// Errors: the folder holds files that are not of this store (nothing changes then), or cannot be written.
    pub fn replace(mut self, layout: SlotLayout) -> InputResult<SpillDir> {
        self.check_identity()?;
        let (ours, foreign) = self.files()?;
        if let Some(foreign) = foreign.first() {
            return Err(has_foreign(&self.folder, foreign));
        }
        remove_files(&self.folder, ours.iter().filter(|name| ![FORMAT, LOCK].contains(&name.as_str())))?;
        self.format = SpillFormat { store: draw_identity(), layout, compatible: KNOWN_COMPATIBLE };
        write_format(&self.folder, &self.format)?;
        Ok(self)
    }

    /// Opens an existing spill directory.
    /// Errors: as for [`SpillDir::create`]; also if there is none, or it is damaged or of a newer version.
    pub fn open(folder: &Path, allow_remote: bool) -> InputResult<SpillDir> {
        check_folder(folder)?;
        let warnings = check_file_system(folder, allow_remote)?;
        let read = || {
            let remedy = "give the folder that was named by --spill-dir";
            let missing = || InputError::new(folder, "it is not a spill directory: it has no FORMAT file", remedy);
            read_format(folder)?.ok_or_else(missing)
        };
        // The first read comes before the lock file is created, so that a foreign folder stays unchanged.
        read()?;
        let lock = take_lock(folder)?;
        let format = read()?;
        sign_lock(folder, &lock)?;
        Ok(SpillDir { folder: folder.to_path_buf(), format, warnings, made_folder: false, lock })
    }

    /// Whether this run created the folder.
    pub fn made_folder(&self) -> bool {
        self.made_folder
    }

    /// Takes the folder for this run's: an earlier process of the run created it.
    pub fn adopt_folder(&mut self) {
        self.made_folder = true;
    }

    /// Whether `folder` contains a spill directory of any version and in any state; changes nothing.
    pub fn exists_in(folder: &Path) -> bool {
        !matches!(read_format(folder), Ok(None))
    }

    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Identity of the store and sizes of its slots.
    pub fn format(&self) -> &SpillFormat {
        &self.format
    }

    /// Warnings about the drive, for the user.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Bytes that may still be written to the drive; `None` if the system does not tell.
    /// Errors: the folder no longer exists.
    pub fn free_bytes(&self) -> InputResult<Option<u64>> {
        free_bytes(&self.folder).map_err(|e| InputError::io(&self.folder, "reading the free space", &e))
    }

    /// Numbers of the existing segment files, ascending.
    /// Errors: the folder cannot be read.
    pub fn segments(&self) -> InputResult<Vec<u32>> {
        Ok(segments_in(&self.folder)?.into_iter().map(|(segment, _)| segment).collect())
    }

    /// Refuses a folder whose lock or FORMAT file is no longer the one that this process holds: somebody removed the
    /// store and created another one under the same path.
    fn check_identity(&self) -> InputResult<()> {
        let is_same_lock = is_same_file(&self.folder.join(LOCK), &self.lock);
        let is_same_store = matches!(read_format(&self.folder)?, Some(format) if format.store == self.format.store);
        if is_same_lock && is_same_store {
            return Ok(());
        }
        let problem = "another store has replaced the one of this run, so nothing was removed";
        let remedy = format!("look at that store: gsscale-ckpt ls {}", shell_word(&self.folder));
        Err(InputError::new(&self.folder, problem, remedy))
    }

    /// Removes the files of this store, and the folder if this process created it. Returns the names of files that stay
    /// because they do not belong to this store.
    /// Errors: another store has replaced this one (then nothing is removed), or a file cannot be removed.
    pub fn remove(self) -> InputResult<Vec<String>> {
        self.check_identity()?;
        let (ours, foreign) = self.files()?;
        remove_files(&self.folder, ours.iter())?;
        let SpillDir { folder, made_folder, lock, .. } = self;
        // A network drive keeps a removed file under another name for as long as it is open.
        drop(lock);
        if made_folder && foreign.is_empty() {
            match std::fs::remove_dir(&folder) {
                // Another process was quick to use the folder, or the drive is slow to forget the lock.
                Err(e) if e.kind() != io::ErrorKind::DirectoryNotEmpty => {
                    return Err(InputError::io(&folder, "removing", &e));
                }
                _ => {}
            }
        }
        Ok(foreign)
    }

    /// Removes everything but what shows that the folder holds a store, which has no commit then.
    /// Errors: the folder holds another store, or a file cannot be removed.
    pub fn clear(&self) -> InputResult<()> {
        self.check_identity()?;
        let (ours, _) = self.files()?;
        remove_files(&self.folder, ours.iter().filter(|name| ![FORMAT, LOCK].contains(&name.as_str())))
    }

    /// The names of this store's files, in the order of their removal, and those of the other files in its folder.
    fn files(&self) -> InputResult<(Vec<String>, Vec<String>)> {
        let mut foreign = Vec::new();
        let mut ours = [MAP_NAME, MAP_NEW_NAME, WITNESS_NAME, RESERVE_NAME, RESERVE_NEW_NAME, FORMAT_NEW, FORMAT, LOCK]
            .map(str::to_string)
            .to_vec();
        for name in names(&self.folder)? {
            if segment_from_file_name(&name).is_some() && self.is_our_segment(&self.folder.join(&name)) {
                ours.insert(0, name);
            } else if !ours.contains(&name) {
                foreign.push(name);
            }
        }
        Ok((ours, foreign))
    }

    /// Whether a segment's first slot belongs to this store or was never written (also after a crash during the
    /// segment's creation).
    fn is_our_segment(&self, path: &Path) -> bool {
        let mut header = Vec::new();
        let file = open_for_reading(path);
        let bytes = file.and_then(|file| {
            let metadata = file.metadata()?;
            if !metadata.is_file() {
                return Err(io::ErrorKind::InvalidInput.into());
            }
            file.take(HEADER_BYTES as u64).read_to_end(&mut header)?;
            Ok(metadata.len())
        });
        let slot = header.first_chunk().map(SlotHeader::decode);
        match (bytes, slot) {
            (Err(_), _) => false,
            (Ok(_), Some(Ok(slot))) => slot.store == self.format.store,
            (Ok(bytes), _) => bytes <= self.format.layout.segment_bytes() && header.iter().all(|&b| b == 0),
        }
    }
}

/// Checks a folder in which a spill directory is to be created, and changes nothing. A store that is there already passes. Returns
/// warnings about the drive.
/// Errors: as [`SpillDir::create`], but for a store of another run and a lock.
pub(in crate::page) fn check_new(folder: &Path, allow_remote: bool) -> InputResult<Vec<String>> {
    let is_there = std::fs::symlink_metadata(folder).is_ok();
    if !is_there {
        let above = folder_of(folder);
        check_above(folder, above)?;
        return check_file_system(above, allow_remote);
    }
    check_folder(folder)?;
    let warnings = check_file_system(folder, allow_remote)?;
    refuse_foreign_files(folder)?;
    Ok(warnings)
}

/// Refuses a spill directory that cannot be created because there is no folder `above`.
fn check_above(folder: &Path, above: &Path) -> InputResult<()> {
    if above.is_dir() {
        return Ok(());
    }
    let what = if above.exists() { "is not a folder" } else { "does not exist (yet)" };
    let problem = format!("it cannot be created: {} {what}", above.display());
    Err(InputError::new(folder, problem, format!("make that folder first, or {OTHER_FOLDER}")))
}

pub(in crate::page) fn of_another_run(folder: &Path) -> InputError {
    let remedy = format!(
        "see whose it is (gsscale-ckpt ls {0}), continue that run (gsscale-train --resume with its output folder), \
         {OTHER_FOLDER}, or give that run up (rm -r {0})",
        shell_word(folder)
    );
    InputError::new(folder, "it holds the checkpoint of another run", remedy)
}

/// Creates the folder, private, if the name is free. Returns whether it did.
fn make_folder(folder: &Path) -> InputResult<bool> {
    check_above(folder, folder_of(folder))?;
    #[cfg_attr(not(unix), expect(unused_mut))]
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::DirBuilderExt;
        builder.mode(0o700);
    }
    match builder.create(folder) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
        Err(error) => Err(InputError::io(folder, "creating the spill directory", &error)),
    }
}

/// Checks the folder itself: not a link, owned by this user, not writable by others.
fn check_folder(folder: &Path) -> InputResult<()> {
    let there = std::fs::symlink_metadata(folder).map_err(|e| InputError::io(folder, "reading its metadata", &e))?;
    if there.is_symlink() {
        let remedy = "name the folder that the link points to";
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
            let remedy = format!("remove their permission: chmod go-w {}", shell_word(folder));
            return Err(InputError::new(folder, "other users have write permission", remedy));
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

fn make_private(folder: &Path) -> InputResult<()> {
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
    let kind = FileSystem::of(folder).map_err(|e| InputError::io(folder, "reading its file system type", &e))?;
    warnings_for(folder, kind, allow_remote)
}

fn warnings_for(folder: &Path, kind: FileSystem, allow_remote: bool) -> InputResult<Vec<String>> {
    let name = folder.display();
    match kind {
        FileSystem::Local => Ok(Vec::new()),
        FileSystem::Memory => Ok(vec![format!("{name} is on tmpfs: spilled pages take memory there")]),
        FileSystem::Overlay => {
            Ok(vec![format!("{name} is on overlayfs, the file system of a container: a mounted drive is faster")])
        }
        FileSystem::Remote(what) if allow_remote => {
            Ok(vec![format!("{name} is on {what}: locks and syncs may be unreliable there")])
        }
        FileSystem::Remote(what) => {
            let remedy = "name a folder on a drive of this machine";
            Err(InputError::new(folder, format!("the spill directory is on {what}"), remedy))
        }
    }
}

/// Refuses a folder that contains files foreign to a spill directory.
fn refuse_foreign_files(folder: &Path) -> InputResult<()> {
    // Names before FORMAT: another process may create a store between the two reads, and writes FORMAT first.
    let names = names(folder)?;
    if read_format(folder)?.is_some() {
        return Ok(());
    }
    // A run that was interrupted before it wrote its FORMAT file leaves these.
    match names.iter().find(|n| ![LOCK, FORMAT_NEW].contains(&n.as_str())) {
        None => Ok(()),
        Some(foreign) => Err(has_foreign(folder, foreign)),
    }
}

fn has_foreign(folder: &Path, name: &str) -> InputError {
    let problem = format!("it is neither empty nor a spill directory (it contains {name:?})");
    InputError::new(folder, problem, "name an empty folder, or one that does not exist")
}

fn remove_files<'a>(folder: &Path, mut names: impl Iterator<Item = &'a String>) -> InputResult<()> {
    names.try_for_each(|name| {
        let path = folder.join(name);
        std::fs::remove_file(&path).or_else(ignore_not_found).map_err(|e| InputError::io(path, "removing", &e))
    })
}

/// Numbers and lengths of the segment files in `folder`, ascending.
/// Errors: the folder cannot be read.
pub fn segments_in(folder: &Path) -> InputResult<Vec<(u32, u64)>> {
    let failed = |e: io::Error| InputError::io(folder, "reading the folder", &e);
    let mut segments = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let about = entry.metadata().map_err(failed)?;
        let number = entry.file_name().to_str().and_then(segment_from_file_name);
        segments.extend(number.filter(|_| about.is_file()).map(|segment| (segment, about.len())));
    }
    segments.sort_unstable();
    Ok(segments)
}

/// Names in the folder, sorted. Names that are not UTF-8 are made printable; no file of this program has one.
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
    // A process that ends may remove the file between open and lock here; then there is a new file to lock.
    for _ in 0..16 {
        let mut options = OpenOptions::new();
        let file = with_safe_flags(options.read(true).write(true).create(true).truncate(false)).open(&path);
        let mut file = file.map_err(failed)?;
        let mut content = String::new();
        // A foreign file may be of any kind and length.
        let is_file = file.metadata().is_ok_and(|m| m.is_file());
        let locked = file.try_lock();
        let read = Read::by_ref(&mut file).take(512).read_to_string(&mut content);
        // On Windows nobody reads a file that another process has locked.
        let is_text = read.as_ref().is_ok_and(|_| content.is_empty() || content.starts_with(LOCK_MAGIC))
            || cfg!(windows) && matches!(locked, Err(TryLockError::WouldBlock)) && read.is_err();
        if !is_file || !is_text {
            return Err(InputError::new(path, "this LOCK file is not from gsscale", OTHER_FOLDER));
        }
        match locked {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let who = content.strip_prefix(LOCK_MAGIC).unwrap_or("").trim().replace('\n', ", ");
                let who = if who.is_empty() { String::new() } else { format!(" ({who})") };
                let remedy = format!("wait for it to end, stop it, or {OTHER_FOLDER}");
                return Err(InputError::new(folder, format!("another process uses the spill directory{who}"), remedy));
            }
            Err(TryLockError::Error(error)) => return Err(failed(error)),
        }
        if is_same_file(&path, &file) {
            return Ok(file);
        }
    }
    Err(InputError::new(
        path,
        "another process keeps removing this file",
        "find out which other process uses the folder",
    ))
}

/// Writes the lock's holder into the lock file, for the message to other processes.
fn sign_lock(folder: &Path, mut lock: &File) -> InputResult<()> {
    use std::io::Seek;
    let content = format!("{LOCK_MAGIC}process {}\nhost {}\n", std::process::id(), host_name());
    let write = lock.rewind().and_then(|()| lock.set_len(0)).and_then(|()| lock.write_all(content.as_bytes()));
    write.map_err(|e| InputError::io(folder.join(LOCK), "locking the spill directory", &e))
}

/// Content of the FORMAT file; `None` if there is none.
/// Errors: the file is damaged, or of another version.
pub(in crate::page) fn read_format(folder: &Path) -> InputResult<Option<SpillFormat>> {
    let Some(bytes) = format_bytes_of(folder)? else { return Ok(None) };
    SpillFormat::from_bytes(&bytes).map(Some).map_err(|error| {
        let remedy = match error {
            FormatError::Version { .. } | FormatError::Features { .. } => {
                "use the program version that created it, or name another folder"
            }
            _ => OTHER_FOLDER,
        };
        InputError::new(folder.join(FORMAT), error.to_string(), remedy)
    })
}

/// Bytes of the FORMAT file, empty if it is not a regular file; `None` if there is none.
fn format_bytes_of(folder: &Path) -> InputResult<Option<Vec<u8>>> {
    let path = folder.join(FORMAT);
    let failed = |e: io::Error| InputError::io(&path, "reading", &e);
    let file = match open_for_reading(&path) {
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

/// Writes the FORMAT file atomically, durable before anything else is.
fn write_format(folder: &Path, format: &SpillFormat) -> InputResult<()> {
    let (new, path) = (folder.join(FORMAT_NEW), folder.join(FORMAT));
    let write = || {
        let mut file = with_safe_flags(OpenOptions::new().write(true).create(true).truncate(true)).open(&new)?;
        file.write_all(&format.to_bytes())?;
        file.sync_all()?;
        rename(&new, &path)?;
        sync_folder(folder)?;
        // The folder's own entry. If its parent cannot be opened, the first sync of a file must suffice.
        let _ = folder.parent().map(sync_folder);
        Ok(())
    };
    write().map_err(|e| InputError::io(&path, "writing", &e))
}

#[cfg(test)]
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
}
