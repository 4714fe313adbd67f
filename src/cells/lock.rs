//! One owner for each cell, on any number of machines that see one folder: a file with the owner's name, held by the system's lock where
//! the file system has locks, and by a heartbeat where it has none, or other machines do not see them.
//!
//! Invariants: 1. ages of heartbeats are differences between two times of the folder's own clock, so clocks of machines do not count; 2. who
//! has lost the cell finds out before it publishes (`CellLock::is_held`). Two owners at once, which a folder that lags can cause, cost work
//! and no result: the bytes are the same.

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, SystemTime};

/// Name of the lock in the folder of a cell.
const LOCK: &str = "lock";
/// Time between heartbeats, and the age from which an owner on another machine counts as lost.
const BEAT: Duration = Duration::from_secs(10);
const LOST_AFTER: Duration = Duration::from_secs(90);

/// A cell that this process works on, until dropped.
#[derive(Debug)]
pub(crate) struct CellLock {
    path: PathBuf,
    token: String,
    /// Dropped first, which ends the heartbeat.
    _alive: Sender<()>,
    /// The system's lock.
    _file: File,
}

impl CellLock {
    /// Takes the cell in `folder`; `Err` of the owner's name if another process works on it.
    /// Errors: the folder cannot be written.
    pub fn take(folder: &Path) -> InputResult<Result<CellLock, String>> {
        let path = folder.join(LOCK);
        let failed = |e: std::io::Error| InputError::io(&path, "taking the cell", &e);
        let file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).map_err(failed)?;
        let owner = std::fs::read_to_string(&path).map_err(failed)?;
        if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) {
            return Ok(Err(owner));
        }
        // The system's lock says nothing about processes of other machines.
        let is_foreign = !owner.is_empty() && machine_of(&owner) != machine();
        if is_foreign && age(&path, folder)? < LOST_AFTER {
            return Ok(Err(owner));
        }
        let token = format!("{} process {} {:032x}", machine(), std::process::id(), draw_identity());
        std::fs::write(&path, &token).map_err(failed)?;
        if is_foreign {
            // Another machine may have found the same lost owner: the one that wrote last keeps the cell.
            std::thread::sleep(BEAT);
        }
        let (alive, ended) = channel::<()>();
        let lock = CellLock { path: path.clone(), token: token.clone(), _alive: alive, _file: file };
        if !lock.is_held() {
            return Ok(Err(std::fs::read_to_string(&path).unwrap_or_default()));
        }
        std::thread::spawn(move || {
            while ended.recv_timeout(BEAT) == Err(RecvTimeoutError::Timeout) {
                // A beat that is missed is made up by the next.
                if std::fs::read_to_string(&path).is_ok_and(|owner| owner == token) {
                    let _ = std::fs::write(&path, &token);
                }
            }
        });
        Ok(Ok(lock))
    }

    /// Whether the cell is still this process's.
    pub fn is_held(&self) -> bool {
        std::fs::read_to_string(&self.path).is_ok_and(|owner| owner == self.token)
    }
}

impl Drop for CellLock {
    fn drop(&mut self) {
        if self.is_held() {
            // Emptied, not removed: another process may wait with the file open.
            let _ = std::fs::write(&self.path, "");
        }
    }
}

/// The owner of a cell that is worked on now, as far as the folder tells.
pub(crate) fn owner_of(folder: &Path) -> Option<String> {
    let path = folder.join(LOCK);
    let owner = std::fs::read_to_string(&path).ok().filter(|owner| !owner.is_empty())?;
    let modified = std::fs::metadata(&path).and_then(|of| of.modified()).ok()?;
    let is_lost = SystemTime::now().duration_since(modified).is_ok_and(|age| age > LOST_AFTER);
    (!is_lost).then_some(owner)
}

/// How long ago a file was written, by the clock that gives files in `folder` their times.
fn age(path: &Path, folder: &Path) -> InputResult<Duration> {
    let failed = |e: std::io::Error| InputError::io(folder, "reading the time of the folder", &e);
    let probe = folder.join(format!("lock.{:032x}", draw_identity()));
    std::fs::write(&probe, b"?").map_err(failed)?;
    let now = std::fs::metadata(&probe).and_then(|of| of.modified());
    std::fs::remove_file(&probe).map_err(failed)?;
    let then = std::fs::metadata(path).and_then(|of| of.modified()).map_err(failed)?;
    Ok(now.map_err(failed)?.duration_since(then).unwrap_or(Duration::ZERO))
}

fn machine_of(owner: &str) -> &str {
    owner.split(" process ").next().unwrap_or_default()
}

/// A name that no other machine of the network has.
fn machine() -> String {
    #[cfg(unix)]
    return rustix::system::uname().nodename().to_string_lossy().into_owned();
    #[cfg(not(unix))]
    std::env::var("COMPUTERNAME").unwrap_or_default()
}
