//! One owner for each cell, on any number of machines that see one folder: a file with the owner's name, held by the system's lock where
//! the file system has locks, and by a heartbeat where it has none, or other machines do not see them.
//!
//! Invariants: 1. ages of heartbeats are differences between two times of the folder's own clock, so clocks of machines do not count; 2. if
//! several processes find no owner, one of them makes the lock file, which appears with the owner's name in it and the system's lock held; 3. a
//! heartbeat writes the same bytes in place, so nobody reads a file without them; 4. a worker that has lost the cell finds that out before its
//! copy gets a number (`CellLock::is_held`). Two owners at once, which a folder that lags can cause, cost work and no result.

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use crate::base::machine::system_name;
use crate::base::text::head_of;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Error, ErrorKind, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// Name of the lock in the folder of a cell.
const LOCK: &str = "lock";
/// Most bytes of an owner's name.
const OWNER_MOST: u64 = 512;
/// Time between heartbeats, and the age from which an owner whose end the system does not tell counts as lost.
const BEAT: Duration = Duration::from_secs(10);
const LOST_AFTER: Duration = Duration::from_secs(90);
/// On Windows nobody can read a file that another process has locked, so the heartbeat alone holds a cell.
const HAS_LOCKS: bool = cfg!(unix);

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
        let failed = |e: Error| InputError::io(&path, "taking the cell", &e);
        let token = format!("{} process {} {:032x}", system_name(), std::process::id(), draw_identity());
        let mut options = OpenOptions::new();
        options.read(true).write(true);
        // The file appears under its name when it has its owner and is locked: who finds it unlocked knows that its owner is gone.
        let made = folder.join(format!("{LOCK}.{:032x}", draw_identity()));
        let file = options.clone().create_new(true).open(&made).map_err(failed)?;
        write_token(&file, &token).inspect_err(|_| drop(std::fs::remove_file(&made))).map_err(failed)?;
        if HAS_LOCKS {
            let _ = file.try_lock();
        }
        let named = std::fs::hard_link(&made, &path).or_else(|error| match error.kind() {
            ErrorKind::AlreadyExists => Err(error),
            // The folder knows no second names.
            _ if path.exists() => Err(ErrorKind::AlreadyExists.into()),
            _ => std::fs::rename(&made, &path),
        });
        let _ = std::fs::remove_file(&made);
        let file = match named {
            Ok(()) => file,
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                let file = options.open(&path).map_err(failed)?;
                let owner = head_of(&path, OWNER_MOST);
                let is_gone = match file.try_lock() {
                    _ if !HAS_LOCKS => false,
                    Err(TryLockError::WouldBlock) => return Ok(Err(owner)),
                    // The system's lock says nothing about processes of other machines.
                    locked => locked.is_ok() && machine_of(&owner) == system_name(),
                };
                if !is_gone && age(&path, folder)? < LOST_AFTER {
                    return Ok(Err(owner));
                }
                file.set_len(0).and_then(|()| write_token(&file, &token)).map_err(failed)?;
                if !is_gone {
                    // Another machine may have found the same lost owner: the one that wrote last keeps the cell.
                    std::thread::sleep(BEAT);
                }
                file
            }
            Err(error) => return Err(failed(error)),
        };
        let beating = file.try_clone().map_err(failed)?;
        let (alive, ended) = channel::<()>();
        let lock = CellLock { path: path.clone(), token: token.clone(), _alive: alive, _file: file };
        if !lock.is_held() {
            return Ok(Err(head_of(&path, OWNER_MOST)));
        }
        std::thread::spawn(move || {
            while ended.recv_timeout(BEAT) == Err(RecvTimeoutError::Timeout) {
                // A beat that is missed is made up by the next.
                if head_of(&path, OWNER_MOST) == token {
                    let _ = write_token(&beating, &token);
                }
            }
        });
        Ok(Ok(lock))
    }

    /// Whether the cell is still this process's.
    pub fn is_held(&self) -> bool {
        head_of(&self.path, OWNER_MOST) == self.token
    }
}

impl Drop for CellLock {
    fn drop(&mut self) {
        if self.is_held() {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Writes the owner at the beginning of the lock file, whose time changes with it.
fn write_token(mut file: &File, token: &str) -> std::io::Result<()> {
    file.rewind().and_then(|()| file.write_all(token.as_bytes()))
}

/// The owner of a cell that is worked on now, as far as the folder tells.
pub(crate) fn owner_of(folder: &Path) -> Option<String> {
    let path = folder.join(LOCK);
    if !path.exists() {
        return None;
    }
    let owner = head_of(&path, OWNER_MOST);
    // In a folder that cannot be written the age is unknown.
    let is_lost = age(&path, folder).is_ok_and(|age| age > LOST_AFTER);
    (!is_lost).then_some(owner)
}

/// How long ago a file was written, by the clock that gives files in `folder` their times.
fn age(path: &Path, folder: &Path) -> InputResult<Duration> {
    let failed = |e: Error| InputError::io(folder, "reading the time of the folder", &e);
    let probe = folder.join(format!("lock.{:032x}", draw_identity()));
    // On a full drive the file is empty, and has its time all the same.
    let _ = std::fs::write(&probe, b"?");
    let now = std::fs::metadata(&probe).and_then(|of| of.modified());
    std::fs::remove_file(&probe).map_err(failed)?;
    let then = std::fs::metadata(path).and_then(|of| of.modified()).map_err(failed)?;
    Ok(now.map_err(failed)?.duration_since(then).unwrap_or(Duration::ZERO))
}

fn machine_of(owner: &str) -> &str {
    owner.split(" process ").next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_that_start_at_once_one_takes_the_cell() {
        let folder = tempfile::tempdir().unwrap();
        for _ in 0..20 {
            let taken: Vec<Result<CellLock, String>> = std::thread::scope(|scope| {
                let threads: Vec<_> = (0..4).map(|_| scope.spawn(|| CellLock::take(folder.path()).unwrap())).collect();
                threads.into_iter().map(|thread| thread.join().unwrap()).collect()
            });
            let owners: Vec<&CellLock> = taken.iter().flatten().collect();
            assert_eq!(owners.len(), 1);
            assert!(owners[0].is_held());
            assert_eq!(owner_of(folder.path()), Some(owners[0].token.clone()));
        }
        assert_eq!(owner_of(folder.path()), None);
    }

    #[test]
    fn of_a_huge_lock_a_name_is_read() {
        let folder = tempfile::tempdir().unwrap();
        File::create(folder.path().join(LOCK)).unwrap().set_len(8 << 30).unwrap();
        let owner = CellLock::take(folder.path()).unwrap().unwrap_err();
        assert_eq!(owner.len() as u64, OWNER_MOST);
        assert_eq!(owner_of(folder.path()), Some(owner));
    }
}
