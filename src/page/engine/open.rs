//! Which engine moves the pages of a run, and why not another.
//!
//! `auto` takes io_uring where the kernel gives a ring (containers often forbid it), else plain reads and writes on
//! threads. No engine changes a bit of any result, so a run may be resumed with another.

use crate::base::error::{InputError, InputResult};
use crate::page::engine::memory::MemoryEngine;
use crate::page::engine::mmap::MmapEngine;
use crate::page::engine::page_engine::PageEngine;
use crate::page::engine::pread::PreadEngine;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

/// Requests at a drive at once, for engines with threads and for measurements: more gained nothing on any drive that was
/// measured.
pub const DEPTH: usize = 16;
/// Requests in a ring at least. Threads go on by themselves, but a ring gets its next requests only when somebody asks
/// for answers, and a step does so four times: with 16 the drive stood still between, and steps with a tenth of the
/// pages in memory waited 5 % of the time. With 64 they wait 1.8 %, as a drive would cost that is never idle; 256 gained
/// nothing more (pages of 512 rows, steps of 50 ms, one NVMe drive).
const RING_DEPTH: usize = 64;

/// What moves pages: the values of `--io`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IoEngine {
    /// The best that works here.
    Auto,
    /// io_uring with direct I/O; Linux only.
    Uring,
    /// Read-only memory maps, advised ahead; plain writes.
    Mmap,
    /// Plain positioned reads and writes on threads.
    Pread,
    /// No files: segments in memory.
    Memory,
}

impl IoEngine {
    /// All values, as `--io` lists them.
    pub const ALL: [IoEngine; 5] = [IoEngine::Auto, IoEngine::Uring, IoEngine::Mmap, IoEngine::Pread, IoEngine::Memory];

    /// The value as `--io` writes it.
    pub fn name(self) -> &'static str {
        match self {
            IoEngine::Auto => "auto",
            IoEngine::Uring => "uring",
            IoEngine::Mmap => "mmap",
            IoEngine::Pread => "pread",
            IoEngine::Memory => "memory",
        }
    }
}

impl FromStr for IoEngine {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let names = || IoEngine::ALL.map(IoEngine::name).join(", ");
        IoEngine::ALL
            .into_iter()
            .find(|e| e.name() == text)
            .ok_or_else(|| format!("'{text}' is not an I/O engine; use one of: {}", names()))
    }
}

impl fmt::Display for IoEngine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An engine at work, and what a user should know of how it was chosen.
pub struct OpenedEngine {
    /// Moves the pages.
    pub store: Box<dyn PageEngine>,
    /// What was taken instead of what, and why: whole sentences, to be printed. Empty when all went as asked.
    pub notes: Vec<String>,
}

/// Opens `engine` on the segments in `folder`, with `depth` threads, or a ring of `depth` requests of at most 1 MiB, but 64
/// at least: it works on these without being asked. Who wants fewer transfers at the drive submits fewer.
///
/// # Errors
/// The folder cannot be used; an engine that was asked for by name does not work here (`auto` takes another).
pub fn open_engine(engine: IoEngine, folder: &Path, depth: usize) -> InputResult<OpenedEngine> {
    let mut notes = Vec::new();
    if engine == IoEngine::Memory {
        return Ok(OpenedEngine { store: Box::new(MemoryEngine::new()), notes });
    }
    outlive_length_limits();
    // So that what fails below is the engine's fault and not the folder's.
    std::fs::read_dir(folder).map_err(|e| InputError::io(folder, "opening the folder of pages", &e))?;
    let store: Box<dyn PageEngine> = match engine {
        IoEngine::Mmap => Box::new(MmapEngine::open(folder, depth).map_err(|e| not_opened(engine, &e))?),
        IoEngine::Pread => open_pread(folder, depth, &mut notes)?,
        IoEngine::Uring => open_uring(folder, depth, &mut notes).map_err(|e| not_opened(engine, &e))?,
        _ => match open_uring(folder, depth, &mut notes) {
            Ok(store) => store,
            Err(why) => {
                if why.kind() != std::io::ErrorKind::Unsupported || cfg!(target_os = "linux") {
                    notes.push(format!("io_uring is refused here ({why}); pages move with --io pread"));
                }
                open_pread(folder, depth, &mut notes)?
            }
        },
    };
    Ok(OpenedEngine { store, notes })
}

/// A write beyond the limit on the length of files (`ulimit -f`) is an error from here on, as on a full drive; by default it
/// ends the process with a signal.
fn outlive_length_limits() {
    #[cfg(unix)]
    {
        use std::sync::atomic::AtomicBool;
        use std::sync::{Arc, Once};
        static ONCE: Once = Once::new();
        // Where the system refuses a handler, the signal does what it does without us.
        ONCE.call_once(|| {
            let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)));
        });
    }
}

#[cfg(target_os = "linux")]
fn open_uring(folder: &Path, depth: usize, notes: &mut Vec<String>) -> std::io::Result<Box<dyn PageEngine>> {
    let store = crate::page::engine::uring::UringEngine::open(folder, depth.max(RING_DEPTH), true)?;
    note_buffered(store.is_direct(), notes);
    Ok(Box::new(store))
}

#[cfg(not(target_os = "linux"))]
fn open_uring(_folder: &Path, _depth: usize, _notes: &mut Vec<String>) -> std::io::Result<Box<dyn PageEngine>> {
    Err(std::io::Error::new(std::io::ErrorKind::Unsupported, "only Linux has io_uring"))
}

fn open_pread(folder: &Path, depth: usize, notes: &mut Vec<String>) -> InputResult<Box<dyn PageEngine>> {
    let store = PreadEngine::open(folder, depth, true).map_err(|e| not_opened(IoEngine::Pread, &e))?;
    note_buffered(store.is_direct(), notes);
    Ok(Box::new(store))
}

fn note_buffered(direct: bool, notes: &mut Vec<String>) {
    if !direct && cfg!(target_os = "linux") {
        notes.push("this file system has no direct I/O; pages move through the system's page cache".into());
    }
}

fn not_opened(engine: IoEngine, error: &std::io::Error) -> InputError {
    let problem = format!("this engine does not work here: {error}");
    InputError::new(format!("--io {engine}"), problem, "use --io auto, or --io pread, which works everywhere")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back_and_others_are_refused() {
        for engine in IoEngine::ALL {
            assert_eq!(engine.name().parse(), Ok(engine));
        }
        assert!("floppy".parse::<IoEngine>().is_err_and(|e| e.contains("floppy") && e.contains("uring")));
    }

    #[test]
    fn a_folder_that_is_none_is_told_by_name() {
        for engine in [IoEngine::Auto, IoEngine::Pread, IoEngine::Mmap] {
            let refused = open_engine(engine, Path::new("no/such/folder"), 4).err().map(|e| e.to_string());
            assert!(refused.is_some_and(|e| e.contains("no/such/folder") && e.contains("remedy")));
        }
    }
}
