//! A hard limit on the memory of another program: a memory control group of Linux, version 2 or 1, where this user may
//! make one.
//!
//! Invariants: 1. only a group that was made here is ever changed or removed; 2. the program is in the group from its
//! first instruction on, so all of its memory counts.

use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Where the groups are, and the names of their files.
struct Version {
    name: &'static str,
    root: &'static str,
    /// A file that every group has.
    mark: &'static str,
    /// As /proc/self/cgroup names it.
    controller: &'static str,
    limit: &'static str,
    /// Limit of what may go to swap space, and whether memory counts in it.
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
    /// A new group below the one that this process is in, or below one above it.
    ///
    /// # Errors
    /// Why none can be made here, for people.
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

    /// What limits.
    pub fn name(&self) -> &'static str {
        self.version.name
    }

    /// The command as a program of the group.
    pub fn command(&self, program: &Path, arguments: &[OsString]) -> Command {
        let mut command = Command::new("sh");
        command.arg("-c").arg("echo $$ > \"$0\" && exec \"$@\"").arg(self.folder.join("cgroup.procs"));
        command.arg(program).args(arguments);
        command
    }

    /// The most that the group held so far, page cache included.
    pub fn peak_bytes(&self) -> Option<u64> {
        fs::read_to_string(self.folder.join(self.version.peak)).ok()?.trim().parse().ok()
    }
}

impl Drop for MemoryGroup {
    fn drop(&mut self) {
        // Nothing is in it any more; a folder that stays is empty and harmless.
        let _ = fs::remove_dir(&self.folder);
    }
}

/// The folder of the group that this process is in.
fn group_of(version: &Version) -> Result<PathBuf, String> {
    if !Path::new(version.root).join(version.mark).is_file() {
        return Err("not there".to_string());
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

/// Makes a group in the nearest folder from `inside` upwards that allows it.
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
    // In version 2 only; refused where programs are in that group themselves; it may be on already.
    let _ = fs::OpenOptions::new()
        .write(true)
        .open(above.join("cgroup.subtree_control"))
        .and_then(|mut file| file.write_all(b"+memory"));
    fs::create_dir(folder)?;
    fs::write(folder.join(version.limit), bytes.to_string())?;
    // Without this what does not fit would go to swap space; where there is none the file is missing.
    let (swap, counts_memory) = version.swap;
    if folder.join(swap).is_file() {
        fs::write(folder.join(swap), if counts_memory { bytes } else { 0 }.to_string())?;
    }
    // The program must be able to enter.
    fs::OpenOptions::new().write(true).open(folder.join("cgroup.procs")).map(|_| ())
}
