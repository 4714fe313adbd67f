//! A drive of a few megabytes, for tests of full drives.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A tmpfs of `bytes`, unmounted on drop; `None` if this user may not mount.
pub struct Small(pub PathBuf);

impl Small {
    pub fn mount(folder: &Path, bytes: u64) -> Option<Small> {
        std::fs::create_dir(folder).unwrap();
        let options = format!("size={bytes}");
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", &options, "tmpfs", folder.to_str().unwrap()]).output();
        match mounted {
            Ok(output) if output.status.success() => Some(Small(folder.to_path_buf())),
            other => {
                println!("skipped: a small drive cannot be mounted here ({other:?})");
                None
            }
        }
    }

    /// Takes all its space but `left` bytes, into the file of an earlier call if there is one.
    pub fn fill(&self, left: u64) {
        let mut other = std::fs::File::options().create(true).append(true).open(self.0.join("other")).unwrap();
        for size in [1 << 16, 1 << 12] {
            while other.write_all(&vec![0; size]).is_ok() {}
        }
        let taken = other.metadata().unwrap().len();
        other.set_len(taken.saturating_sub(left)).unwrap();
    }

    /// Gives back what [`Small::fill`] took.
    pub fn free(&self) {
        std::fs::remove_file(self.0.join("other")).unwrap();
    }

    /// Resizes it; its contents must fit.
    pub fn resize(&self, bytes: u64) {
        let options = format!("remount,size={bytes}");
        assert!(Command::new("mount").args(["-o", &options]).arg(&self.0).status().unwrap().success());
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
