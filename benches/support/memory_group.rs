//! A hard limit on the memory of another program: a memory control group of Linux (version 2 or 1), if the user may
//! create one.
//!
//! Invariants: 1. this module changes and removes only groups that it created; 2. the program is in the group from its
//! first instruction, so all of its memory counts.

use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The location of the groups and the names of their files.
struct Version {
    name: &'static str,
    root: &'static str,
    /// A file that every group has.
    mark: &'static str,
    /// Name in /proc/self/cgroup.
    controller: &'static str,
    limit: &'static str,
    /// File of the limit of swap space, and whether the limit includes memory.
    swap: (&'static str, bool),
    peak: &'static str,
}

const VERSIONS: [Version; 2] = [
    Version {
        name: "cgroup v2",
        root: "/sys/fs/cgroup",
        mark: "cgroup.controllers",
        controller: "",
        limit: "memory.max",
        swap: ("memory.swap.max", false),
        peak: "memory.peak",
    },
    Version {
        name: "cgroup v1",
        root: "/sys/fs/cgroup/memory",
        mark: "tasks",
        controller: "memory",
        limit: "memory.limit_in_bytes",
        swap: ("memory.memsw.limit_in_bytes", true),
        peak: "memory.max_usage_in_bytes",
    },
];

/// A group with a limit; removed when dropped.
pub struct MemoryGroup {
    version: &'static Version,
    folder: PathBuf,
}

impl MemoryGroup {
    /// Creates a group below the group of this process, or below an ancestor of that group.
    ///
    /// # Errors
    /// A message why this system allows no group.
    pub fn new(bytes: u64) -> Result<MemoryGroup, String> {
        let mut why = Vec::new();
        for version in &VERSIONS {
            match group_of(version).and_then(|inside| make(version, &inside, bytes)) {
                Ok(folder) => return Ok(MemoryGroup { version, folder }),
                Err(error) => why.push(format!("{}: {error}", version.name)),
            }
        }
        Err(why.join("; "))
    }

    /// The version of the control groups.
    pub fn name(&self) -> &'static str {
        self.version.name
    }

    /// A command that runs the program inside the group.
    pub fn command(&self, program: &Path, arguments: &[OsString]) -> Command {
        let mut command = Command::new("sh");
        command.arg("-c").arg("echo $$ > \"$0\" && exec \"$@\"").arg(self.folder.join("cgroup.procs"));
        command.arg(program).args(arguments);
        command
    }

    /// Peak memory of the group, including the page cache.
    pub fn peak_bytes(&self) -> Option<u64> {
        fs::read_to_string(self.folder.join(self.version.peak)).ok()?.trim().parse().ok()
    }
}

impl Drop for MemoryGroup {
    fn drop(&mut self) {
        // The group has no process any more. If removing fails, the empty group stays, which is harmless.
        let _ = fs::remove_dir(&self.folder);
    }
}

/// The folder of this process's group.
fn group_of(version: &Version) -> Result<PathBuf, String> {
    if !Path::new(version.root).join(version.mark).is_file() {
        return Err("not available".to_string());
    }
    let text = fs::read_to_string("/proc/self/cgroup").map_err(|e| e.to_string())?;
    let is_ours = |controllers: &str| controllers.split(',').any(|c| c == version.controller);
    let path = text.lines().find_map(|line| {
        let mut fields = line.splitn(3, ':').skip(1);
        fields.next().filter(|c| is_ours(c)).and_then(|_| fields.next())
    });
    let path = path.ok_or("this process is in none")?;
    Ok(Path::new(version.root).join(path.trim_start_matches('/')))
}

/// Creates a group in the nearest folder from `inside` upwards that allows it.
fn make(version: &Version, inside: &Path, bytes: u64) -> Result<PathBuf, String> {
    let mut last = String::from("no folder");
    for above in inside.ancestors().take_while(|folder| folder.starts_with(version.root)) {
        let folder = above.join(format!("gsscale-bench-{}", std::process::id()));
        match try_make(version, above, &folder, bytes) {
            Ok(()) => return Ok(folder),
            Err(error) => {
                last = format!("{}: {error}", above.display());
                let _ = fs::remove_dir(&folder);
            }
        }
    }
    Err(last)
}

fn try_make(version: &Version, above: &Path, folder: &Path, bytes: u64) -> io::Result<()> {
    // Version 2 only. Fails if the parent group has processes; the controller may already be on.
    let _ = fs::OpenOptions::new()
        .write(true)
        .open(above.join("cgroup.subtree_control"))
        .and_then(|mut file| file.write_all(b"+memory"));
    fs::create_dir(folder)?;
    fs::write(folder.join(version.limit), bytes.to_string())?;
    // Without this limit, excess memory would go to swap space. A system without swap space has no such file.
    let (swap, counts_memory) = version.swap;
    if folder.join(swap).is_file() {
        fs::write(folder.join(swap), if counts_memory { bytes } else { 0 }.to_string())?;
    }
    // The program must be able to enter the group.
    fs::OpenOptions::new().write(true).open(folder.join("cgroup.procs")).map(|_| ())
}
