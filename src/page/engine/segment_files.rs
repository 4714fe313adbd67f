//! Segment files: allocated so that writes cannot run out of space, opened without following links, and with a bounded
//! number open at once. Shared by the engines that use files. Bytes of theirs that go through the system's page cache are dropped
//! from it ([`WriteBehind`]), or memory would fill with second copies of the pages that frames hold.
//!
//! Knows neither slots nor pages. Invariants: 1. when [`SegmentFiles::create`] returns, the segment's full length is
//! allocated, and the file and its folder entry are durable; 2. a file opened for writing is synced before it is closed
//! or dropped; after a failed sync every later sync fails too, because the system reports a lost write only once;
//! 3. nothing outside the folder is opened: file names are made here, and a symbolic link in place of a segment is an
//! error; 4. no transfer that [`SegmentFiles::file_of`] accepts touches a byte outside its segment.

use crate::base::error::is_too_many_files;
use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::{Direction, Transfer};
use std::collections::{BTreeMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

const PREFIX: &str = "seg-";
const SUFFIX: &str = ".dat";
/// File descriptors reserved for the rest of the process: photos, logs, sockets, the map.
const FILES_OF_OTHERS: u64 = 32;

pub fn segment_file_name(segment: u32) -> String {
    format!("{PREFIX}{segment:08}{SUFFIX}")
}

/// Number of the segment that a file name stands for; `None` for names that [`segment_file_name`] never produces.
pub fn segment_from_file_name(name: &str) -> Option<u32> {
    let number = name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)?.parse().ok()?;
    (segment_file_name(number) == name).then_some(number)
}

#[derive(Debug)]
struct OpenFile {
    file: Arc<File>,
    last_used: u64,
    is_dirty: bool,
}

#[derive(Debug)]
pub struct SegmentFiles {
    folder: PathBuf,
    /// The folder, kept open so that it can be synced even when no descriptor is left.
    entries: Option<File>,
    direct: bool,
    read_only: bool,
    open: BTreeMap<u32, OpenFile>,
    /// Most files kept open at once; transfers in flight may hold more.
    open_max: usize,
    clock: u64,
    /// The first failed sync.
    lost: Option<(io::ErrorKind, String)>,
}

impl SegmentFiles {
    /// The segments in `folder`. With `direct`, files bypass the page cache if the file system allows it;
    /// [`SegmentFiles::is_direct`] tells.
    /// Errors: the folder cannot be read.
    pub fn new(folder: &Path, direct: bool) -> io::Result<SegmentFiles> {
        // Other systems cannot open folders; there a file's entry is durable with the file.
        let entries = if cfg!(unix) { Some(File::open(folder)?) } else { None };
        let direct = direct && direct_works(folder)?;
        Ok(SegmentFiles { direct, entries, read_only: false, ..SegmentFiles::read_only(folder) })
    }

    /// The segments in `folder`, read-only; the drive may be mounted read-only.
    pub fn read_only(folder: &Path) -> SegmentFiles {
        let (folder, open, open_max) = (folder.to_path_buf(), BTreeMap::new(), open_files_max());
        SegmentFiles { folder, entries: None, direct: false, read_only: true, open, open_max, clock: 0, lost: None }
    }

    /// Whether files bypass the page cache. If so, memory, offsets and lengths must be multiples of
    /// [`ALIGNMENT`].
    pub fn is_direct(&self) -> bool {
        self.direct
    }

    fn path(&self, segment: u32) -> PathBuf {
        self.folder.join(segment_file_name(segment))
    }

    /// Creates a segment of `bytes` bytes, durably. An existing segment of that size stays unchanged; a shorter one (a
    /// crash during creation) is extended.
    /// Errors: no space; the folder cannot be written; the file is longer, a link, or not a file.
    pub fn create(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        self.refuse_if_read_only()?;
        let path = self.path(segment);
        let make = |path: &Path| {
            with_safe_flags(OpenOptions::new().read(true).write(true).create(true).truncate(false)).open(path)
        };
        let file = self.open_closing_others(&path, make)?;
        let there = file.metadata()?;
        if !there.is_file() || there.len() > bytes {
            let what = if there.is_file() { "exists with another length" } else { "is not a file" };
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, format!("{} {what}", path.display())));
        }
        // Synced here as well: space may run out then, and a second sync of the same bytes would not tell.
        if there.len() < bytes
            && let Err(error) = allocate(&file, there.len(), bytes).and_then(|()| file.sync_all())
        {
            // Space ran out: the new space is freed, and a file that existed keeps its old length.
            let _ = if there.len() == 0 { std::fs::remove_file(&path) } else { file.set_len(there.len()) };
            return Err(error);
        }
        // Also for a complete file: its creator may have been killed before these calls.
        file.sync_all()?;
        self.entries.as_ref().map_or(Ok(()), File::sync_all)
    }

    /// Checks that the file of a segment exists with exactly `bytes` bytes, without opening it.
    /// Errors: the file is missing, shorter, longer, a link, or not a file.
    pub fn check(&self, segment: u32, bytes: u64) -> io::Result<()> {
        let there = std::fs::symlink_metadata(self.path(segment))?;
        let wrong = |what: String| Err(io::Error::new(io::ErrorKind::InvalidData, what));
        match there.len() {
            _ if !there.is_file() => wrong("is not a file".to_string()),
            len if len != bytes => wrong(format!("has {len} bytes instead of {bytes}")),
            _ => Ok(()),
        }
    }

    /// The file of a segment, for reading.
    /// Errors: the file does not exist or cannot be opened.
    pub fn file(&mut self, segment: u32) -> io::Result<Arc<File>> {
        self.clock += 1;
        if let Some(open) = self.open.get_mut(&segment) {
            open.last_used = self.clock;
            return Ok(Arc::clone(&open.file));
        }
        while self.open.len() >= self.open_max && self.close_oldest()? {}
        let (direct, read_only) = (self.direct, self.read_only);
        let open = |path: &Path| if read_only { open_for_reading(path) } else { open_segment(path, direct) };
        let file = Arc::new(self.open_closing_others(&self.path(segment), open)?);
        let open = OpenFile { file: Arc::clone(&file), last_used: self.clock, is_dirty: false };
        self.open.insert(segment, open);
        Ok(file)
    }

    /// The file of a segment, for writing: it counts as dirty until [`SegmentFiles::sync`].
    /// Errors: the file does not exist or cannot be opened.
    pub fn file_for_write(&mut self, segment: u32) -> io::Result<Arc<File>> {
        self.refuse_if_read_only()?;
        let file = self.file(segment)?;
        if let Some(open) = self.open.get_mut(&segment) {
            open.is_dirty = true;
        }
        Ok(file)
    }

    /// The file of `transfer`. A write makes it dirty until the next sync.
    /// Errors: `NotFound` if the segment does not exist, `UnexpectedEof` for a place beyond its end, `InvalidInput` for
    /// a length that is not a whole number of blocks within the buffer.
    pub fn file_of(&mut self, transfer: &Transfer) -> io::Result<Arc<File>> {
        let (offset, bytes) = (transfer.place.offset, transfer.bytes);
        let whole = offset.is_multiple_of(ALIGNMENT as u64) && bytes.is_multiple_of(ALIGNMENT);
        if !whole || bytes > transfer.buffer.len() {
            let problem = "a transfer must move whole blocks within its buffer";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
        }
        let file = match transfer.direction {
            Direction::Read => self.file(transfer.place.segment)?,
            Direction::Write => self.file_for_write(transfer.place.segment)?,
        };
        if offset.checked_add(bytes as u64).is_none_or(|end| file.metadata().is_ok_and(|m| end > m.len())) {
            let problem = "the place lies beyond the end of the segment";
            return Err(io::Error::new(io::ErrorKind::UnexpectedEof, problem));
        }
        Ok(file)
    }

    /// Makes completed writes durable.
    /// Errors: the drive lost a write, now or before an earlier sync. Nothing unsynced may be trusted.
    pub fn sync(&mut self) -> io::Result<()> {
        if let Some((kind, what)) = &self.lost {
            return Err(io::Error::new(*kind, format!("an earlier sync failed: {what}")));
        }
        for open in self.open.values_mut().filter(|o| o.is_dirty) {
            sync_data(&open.file, &mut self.lost)?;
            open.is_dirty = false;
        }
        Ok(())
    }

    fn refuse_if_read_only(&self) -> io::Result<()> {
        if self.read_only { Err(io::ErrorKind::ReadOnlyFilesystem.into()) } else { Ok(()) }
    }

    /// Opens a file. If the process has run out of file descriptors, closes some of the store's own and tries again.
    fn open_closing_others(&mut self, path: &Path, open: impl Fn(&Path) -> io::Result<File>) -> io::Result<File> {
        loop {
            match open(path) {
                Err(error) if is_too_many_files(&error) && self.close_oldest()? => {}
                opened => return opened,
            }
        }
    }

    /// Closes the least recently used file that no transfer in flight holds: a write that ends after the sync would be
    /// missed by the next sync. Returns whether a file was closed.
    fn close_oldest(&mut self) -> io::Result<bool> {
        let idle = self.open.iter().filter(|(_, open)| Arc::strong_count(&open.file) == 1);
        let Some((&segment, _)) = idle.min_by_key(|(_, open)| open.last_used) else { return Ok(false) };
        // The kernel may forget a failed write-back of a file that nobody has open, so the file is synced before it is
        // closed.
        if let Some(open) = self.open.remove(&segment).filter(|o| o.is_dirty) {
            sync_data(&open.file, &mut self.lost)?;
        }
        Ok(true)
    }
}

fn sync_data(file: &File, lost: &mut Option<(io::ErrorKind, String)>) -> io::Result<()> {
    file.sync_data().inspect_err(|e| *lost = Some((e.kind(), e.to_string())))
}

/// Opens a file of the store for reading, without following links.
/// Errors: the file does not exist or cannot be read.
pub fn open_for_reading(path: &Path) -> io::Result<File> {
    with_safe_flags(OpenOptions::new().read(true)).open(path)
}

/// Adds the flags: private to its owner, follow no link, do not block on a pipe in place of the file. (The standard
/// library already keeps descriptors from being inherited.)
pub fn with_safe_flags(options: &mut OpenOptions) -> &mut OpenOptions {
    #[cfg(unix)]
    {
        use rustix::fs::OFlags;
        use std::os::unix::fs::OpenOptionsExt;
        options.mode(0o600).custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32);
    }
    options
}

#[cfg(target_os = "linux")]
fn open_segment(path: &Path, direct: bool) -> io::Result<File> {
    use rustix::fs::OFlags;
    use std::os::unix::fs::OpenOptionsExt;
    let direct = if direct { OFlags::DIRECT } else { OFlags::empty() };
    let flags = (OFlags::NOFOLLOW | direct).bits() as i32;
    OpenOptions::new().read(true).write(true).custom_flags(flags).open(path)
}

#[cfg(windows)]
fn open_segment(path: &Path, direct: bool) -> io::Result<File> {
    use std::os::windows::fs::OpenOptionsExt;
    // The documentation of `CreateFile` has its value.
    const FILE_FLAG_NO_BUFFERING: u32 = 0x2000_0000;
    let flags = if direct { FILE_FLAG_NO_BUFFERING } else { 0 };
    OpenOptions::new().read(true).write(true).custom_flags(flags).open(path)
}

#[cfg(not(any(target_os = "linux", windows)))]
fn open_segment(path: &Path, _direct: bool) -> io::Result<File> {
    with_safe_flags(OpenOptions::new().read(true).write(true)).open(path)
}

/// Whether files of this folder support direct I/O; tried on an unnamed file.
#[cfg(target_os = "linux")]
fn direct_works(folder: &Path) -> io::Result<bool> {
    use rustix::fs::{Mode, OFlags, open};
    match open(folder, OFlags::TMPFILE | OFlags::RDWR | OFlags::DIRECT | OFlags::CLOEXEC, Mode::RUSR | Mode::WUSR) {
        Ok(_) => Ok(true),
        // Either the flag or unnamed files are unsupported; both mean an unusual file system.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::OPNOTSUPP | rustix::io::Errno::ISDIR) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Windows accepts the flag on every drive whose sectors [`ALIGNMENT`] covers, which holds for all that are sold.
#[cfg(not(target_os = "linux"))]
fn direct_works(_folder: &Path) -> io::Result<bool> {
    Ok(cfg!(windows))
}

/// Allocates the space `from..to`. Setting the length would not reserve space: later writes could still find the drive
/// full. The file's length is `from` before and `to` after.
#[cfg(unix)]
pub(in crate::page) fn allocate(file: &File, from: u64, to: u64) -> io::Result<()> {
    use rustix::fs::{FallocateFlags, fallocate};
    use rustix::io::Errno;
    loop {
        match fallocate(file, FallocateFlags::empty(), from, to - from) {
            Err(Errno::INTR) => {}
            Err(Errno::OPNOTSUPP | Errno::NOSYS) => return write_zeros(file, from, to),
            other => return Ok(other?),
        }
    }
}

#[cfg(not(unix))]
pub(in crate::page) fn allocate(file: &File, from: u64, to: u64) -> io::Result<()> {
    write_zeros(file, from, to)
}

fn write_zeros(mut file: &File, from: u64, to: u64) -> io::Result<()> {
    use std::io::{Seek, Write};
    let zeros = vec![0; 1 << 20];
    file.seek(io::SeekFrom::Start(from))?;
    let mut left = to - from;
    while left > 0 {
        let bytes = left.min(zeros.len() as u64);
        file.write_all(&zeros[..bytes as usize])?;
        left -= bytes;
    }
    Ok(())
}

/// Most segments open at once, from the process's limit on file descriptors.
#[cfg(unix)]
fn open_files_max() -> usize {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current.unwrap_or(1024);
    limit.saturating_sub(FILES_OF_OTHERS).clamp(4, 512) as usize
}

#[cfg(not(unix))]
fn open_files_max() -> usize {
    256 + FILES_OF_OTHERS as usize
}

/// Written bytes that may wait before being dropped: enough to keep a drive busy.
const BEHIND_BYTES: u64 = 64 << 20;

/// Starts write-back of the dirty bytes of a range and drops its clean ones. A second call, later, therefore drops what
/// the first began to write. `bytes` 0 means to the end of the file.
pub fn drop_cached(file: &File, offset: u64, bytes: u64) {
    #[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
    // If refused, the cached copy only costs memory.
    let _ = rustix::fs::fadvise(file, offset, std::num::NonZeroU64::new(bytes), rustix::fs::Advice::DontNeed);
    #[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
    let _ = (file, offset, bytes);
}

/// Drops written bytes from the page cache some time after the write, when the drive has them.
#[derive(Debug, Default)]
pub struct WriteBehind {
    /// Weak, because a file may be synced and closed before its turn.
    ranges: VecDeque<(Weak<File>, u64, u64)>,
    bytes: u64,
}

impl WriteBehind {
    /// Records a completed write and starts its write-back.
    pub fn record_write(&mut self, file: &Arc<File>, offset: u64, bytes: u64) {
        drop_cached(file, offset, bytes);
        self.ranges.push_back((Arc::downgrade(file), offset, bytes));
        self.bytes += bytes;
        while self.bytes > BEHIND_BYTES {
            self.drop_oldest();
        }
    }

    /// Drops all recorded ranges; call after a sync.
    pub fn drop_all(&mut self) {
        while !self.ranges.is_empty() {
            self.drop_oldest();
        }
    }

    fn drop_oldest(&mut self) {
        if let Some((file, offset, bytes)) = self.ranges.pop_front() {
            if let Some(file) = file.upgrade() {
                drop_cached(&file, offset, bytes);
            }
            self.bytes -= bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_are_allocated_private_and_left_alone_when_they_exist() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = SegmentFiles::new(folder.path(), true).unwrap();
        std::fs::write(files.path(0), b"cut short").unwrap();
        files.create(0, 1 << 20).unwrap();
        files.create(1, 1 << 20).unwrap();
        assert_eq!(&std::fs::read(files.path(0)).unwrap()[..9], b"cut short");
        let metadata = std::fs::metadata(files.path(1)).unwrap();
        assert_eq!(metadata.len(), 1 << 20);
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            assert_eq!(metadata.mode() & 0o777, 0o600);
            assert!(metadata.blocks() * 512 >= 1 << 20, "the space was not taken");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_are_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let foreign = folder.path().join("foreign");
        std::fs::write(&foreign, b"mine").unwrap();
        let mut files = SegmentFiles::new(folder.path(), false).unwrap();
        std::os::unix::fs::symlink(&foreign, files.path(0)).unwrap();
        assert!(files.create(0, 4096).is_err() && files.file(0).is_err());
        assert_eq!(std::fs::read(&foreign).unwrap(), b"mine");
    }

    /// A transfer in flight keeps its file open and dirty until it ends.
    #[test]
    fn files_in_use_are_not_closed() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = SegmentFiles::new(folder.path(), false).unwrap();
        files.open_max = 3;
        (0..10).for_each(|segment| files.create(segment, 4096).unwrap());
        let in_flight = files.file_for_write(0).unwrap();
        (1..10).for_each(|segment| drop(files.file(segment).unwrap()));
        assert!(files.open[&0].is_dirty && files.open.len() == 3);
        drop(in_flight);
        files.sync().unwrap();
        assert!(files.open.values().all(|o| !o.is_dirty));
    }
}
