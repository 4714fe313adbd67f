//! A drive of a few megabytes, for tests of full drives.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A tmpfs of `bytes`, unmounted on drop; `None` if this user may not mount.
pub struct Small(pub PathBuf);

impl Small {
    /// Mounts it on a new folder.
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
