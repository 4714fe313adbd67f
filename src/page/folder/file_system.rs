//! The kind of file system that a folder is on, and its free space.
//!
//! On Linux the magic number of `statfs` tells the kind; elsewhere every file system counts as a local drive.

use std::io;
use std::path::Path;

/// Kinds of file systems, as far as they matter to pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileSystem {
    /// A drive of this machine, as far as the system tells.
    Local,
    /// Files are in memory.
    Memory,
    /// Layers over another file system, as in containers: slower, and often small.
    Overlay,
    /// Served by another machine or program: locks and syncs may be unreliable.
    Remote(&'static str),
}

#[cfg(target_os = "linux")]
const KINDS: &[(u32, FileSystem)] = &[
    (0x0102_1994, FileSystem::Memory), // tmpfs
    (0x8584_58f6, FileSystem::Memory), // ramfs
    (0x794c_7630, FileSystem::Overlay),
    (0x0000_6969, FileSystem::Remote("NFS")),
    (0x0000_517b, FileSystem::Remote("SMB")),
    (0xff53_4d42, FileSystem::Remote("CIFS")),
    (0xfe53_4d42, FileSystem::Remote("SMB2")),
    (0x0102_1997, FileSystem::Remote("9p")),
    (0x6573_5546, FileSystem::Remote("FUSE")),
    (0x00c3_6400, FileSystem::Remote("Ceph")),
    (0x5346_414f, FileSystem::Remote("AFS")),
    (0x6b41_4653, FileSystem::Remote("AFS")),
    (0x7375_7245, FileSystem::Remote("Coda")),
    (0x0bd0_0bd0, FileSystem::Remote("Lustre")),
    (0x4750_4653, FileSystem::Remote("GPFS")),
    (0x1983_0326, FileSystem::Remote("BeeGFS")),
    (0x0116_1970, FileSystem::Remote("GFS2")),
    (0x7461_636f, FileSystem::Remote("OCFS2")),
    (0x786f_4256, FileSystem::Remote("a shared folder of VirtualBox")),
    (0xbacb_acbc, FileSystem::Remote("a shared folder of VMware")),
    (0x5346_4846, FileSystem::Remote("a Windows drive seen from WSL")),
];

impl FileSystem {
    /// The kind of a folder's file system.
    /// Errors: the system does not tell.
    #[cfg(target_os = "linux")]
    pub fn of(folder: &Path) -> io::Result<FileSystem> {
        // The magic number has 32 bits; the field is wider and signed on some machines.
        let magic = rustix::fs::statfs(folder)?.f_type as u32;
        Ok(KINDS.iter().find(|(number, _)| *number == magic).map_or(FileSystem::Local, |(_, kind)| *kind))
    }

    /// The kind of a folder's file system.
    /// Errors: never on this system.
    #[cfg(not(target_os = "linux"))]
    pub fn of(_folder: &Path) -> io::Result<FileSystem> {
        Ok(FileSystem::Local)
    }
}

/// Bytes that this user may still write to the drive of `folder`; `None` if the system does not tell.
/// Errors: the system call fails.
pub fn free_bytes(folder: &Path) -> io::Result<Option<u64>> {
    #[cfg(unix)]
    {
        let there = rustix::fs::statvfs(folder)?;
        Ok(Some(there.f_bavail.saturating_mul(there.f_frsize)))
    }
    #[cfg(windows)]
    {
        fs4::available_space(folder).map(Some)
    }
    #[cfg(not(any(unix, windows)))]
    {
        let _ = folder;
        Ok(None)
    }
}

/// Whether two folders lie on one drive; true if the system does not report it.
pub fn is_same_drive(a: &Path, b: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let device = |folder: &Path| std::fs::metadata(folder).map(|m| m.dev()).ok();
        device(a).zip(device(b)).is_none_or(|(a, b)| a == b)
    }
    #[cfg(not(unix))]
    {
        // The letter or the share that a full path begins with.
        let drive =
            |folder: &Path| Some(std::fs::canonicalize(folder).ok()?.components().next()?.as_os_str().to_owned());
        drive(a).zip(drive(b)).is_none_or(|(a, b)| a == b)
    }
}
