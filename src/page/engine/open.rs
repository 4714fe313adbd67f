//! Chooses and opens the I/O engine of a run, and explains a fallback.
//!
//! `auto` takes io_uring where the kernel allows it (containers often forbid it), else positioned reads and writes on
//! threads. The engine changes no bit of any result, so a run may resume with another.

use crate::base::error::{InputError, InputResult};
use crate::base::names::names;
use crate::page::engine::page_engine::PageEngine;
use crate::page::engine::threaded::ThreadedEngine;
use std::path::Path;

/// Queue depth for engines with threads and for measurements. A deeper queue gained nothing on any drive measured.
pub const DEPTH: usize = 16;
/// Least number of entries of a ring. Threads start their next request by themselves, but a ring starts new requests
/// only when it is polled, which a step does four times. With 16 entries the drive idled in between, and steps with a
/// tenth of the pages in memory waited 5 % of the time. With 64 they waited 1.8 %, the cost of a drive that never
/// idles; 256 gained nothing more (pages of 512 rows, steps of 50 ms, one NVMe drive).
#[cfg(target_os = "linux")]
const RING_DEPTH: usize = 64;

/// The I/O engine that moves pages: the values of `--io`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IoEngine {
    /// The best engine that works here.
    Auto,
    /// io_uring with direct I/O; Linux only.
    Uring,
    /// Read-only memory maps with read-ahead; plain writes.
    Mmap,
    /// Plain positioned reads and writes on threads.
    Pread,
}

names!(IoEngine { Auto = "auto", Uring = "uring", Mmap = "mmap", Pread = "pread" });

/// An open engine, with notes for the user on how it was chosen.
pub struct OpenedEngine {
    pub store: Box<dyn PageEngine>,
    /// Fallbacks and their reasons, as whole sentences to print. Empty if the engine asked for works in full.
    pub notes: Vec<String>,
}

/// Opens `engine` on the segments in `folder`. `depth` is the number of threads, or of ring entries (requests of at
/// most 1 MiB); a ring has at least 64, because it works on them without being polled. Callers that want fewer
/// transfers in flight submit fewer.
/// Errors: the folder cannot be used; an engine that was asked for by name does not work here (`auto` takes another).
pub fn open_engine(engine: IoEngine, folder: &Path, depth: usize) -> InputResult<OpenedEngine> {
    let mut notes = Vec::new();
    ignore_file_size_signal();
    // An unusable folder is reported here, so that later failures are the engine's own.
    std::fs::read_dir(folder).map_err(|e| InputError::io(folder, "opening the folder of pages", &e))?;
    let store: Box<dyn PageEngine> = match engine {
        IoEngine::Mmap => Box::new(ThreadedEngine::mmap(folder, depth).map_err(|e| not_opened(engine, &e))?),
        IoEngine::Pread => open_pread(folder, depth, &mut notes)?,
        IoEngine::Uring => open_uring(folder, depth, &mut notes).map_err(|e| not_opened(engine, &e))?,
        IoEngine::Auto => match open_uring(folder, depth, &mut notes) {
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

/// Makes a write beyond the limit on file length (`ulimit -f`) an error, as on a full drive. By default the signal
/// SIGXFSZ ends the process.
fn ignore_file_size_signal() {
    #[cfg(unix)]
    {
        use std::sync::atomic::AtomicBool;
        use std::sync::{Arc, Once};
        static ONCE: Once = Once::new();
        // If the system refuses the handler, the signal keeps its default effect.
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
    let store = ThreadedEngine::pread(folder, depth, true).map_err(|e| not_opened(IoEngine::Pread, &e))?;
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
    fn a_missing_folder_is_named() {
        for engine in [IoEngine::Auto, IoEngine::Pread, IoEngine::Mmap] {
            let refused = open_engine(engine, Path::new("no/such/folder"), 4).err().map(|e| e.to_string());
            assert!(refused.is_some_and(|e| e.contains("no/such/folder") && e.contains("remedy")));
        }
    }
}
