//! Resumes transfers of which the system moved only a part.
//!
//! Every engine drives its requests with a [`Resume`]: a short transfer continues where it ended, an interrupted one is
//! tried again, and one that makes no progress ends with an error instead of looping forever.
//!
//! Invariants: 1. a resumed request starts at a multiple of [`ALIGNMENT`] from its first byte, as direct I/O requires,
//! so bytes after the last whole block move again; 2. at most [`TRIES_MAX`] outcomes in a row without a whole block of
//! progress are tolerated.

use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::Direction;
use std::io;

/// Most outcomes in a row without progress.
pub const TRIES_MAX: u8 = 32;
/// `ECANCELED` and `EFAULT` on Linux: the ring returns them for requests whose thread ended. Such a request is cancelled, or the
/// kernel continues it where the process's memory is not mapped. Buffers stay mapped until their transfer ends, so the
/// request may be sent again.
const THREAD_ENDED: [i32; 2] = [125, 14];

/// Progress of one request.
#[derive(Debug, Clone, Copy, Default)]
pub struct Resume {
    /// Bytes moved so far.
    pub done: usize,
    /// Outcomes since the last progress.
    pub tries: u8,
}

impl Resume {
    /// Applies the outcome of the request for the bytes from `self.done` to `total`. Returns whether all bytes have
    /// moved.
    ///
    /// # Errors
    /// The outcome's error if a retry cannot help; `UnexpectedEof` or `WriteZero` at the end of the file.
    pub fn advance(&mut self, direction: Direction, outcome: io::Result<usize>, total: usize) -> io::Result<bool> {
        match outcome {
            Ok(0) if self.done < total => Err(match direction {
                Direction::Read => io::Error::new(io::ErrorKind::UnexpectedEof, "the file ends before the page does"),
                Direction::Write => io::Error::new(io::ErrorKind::WriteZero, "the drive accepts no more bytes"),
            }),
            Ok(moved) => {
                let reached = self.done + moved;
                if reached >= total {
                    self.done = total;
                    return Ok(true);
                }
                let whole = reached - reached % ALIGNMENT;
                if whole > self.done {
                    *self = Resume { done: whole, tries: 0 };
                    return Ok(false);
                }
                self.try_again(|| {
                    io::Error::new(
                        io::ErrorKind::TimedOut,
                        "the drive makes no progress: it moves only parts of a block",
                    )
                })
            }
            Err(error) if may_pass(&error) => self.try_again(|| error),
            Err(error) => Err(error),
        }
    }

    fn try_again(&mut self, error: impl FnOnce() -> io::Error) -> io::Result<bool> {
        self.tries += 1;
        if self.tries > TRIES_MAX { Err(error()) } else { Ok(false) }
    }
}

/// Whether a retry of the same request may succeed.
fn may_pass(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::Interrupted | io::ErrorKind::WouldBlock)
        || (cfg!(target_os = "linux") && error.raw_os_error().is_some_and(|raw| THREAD_ENDED.contains(&raw)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn a_short_transfer_resumes_at_the_last_whole_block() {
        let mut resume = Resume::default();
        let total = 6 * ALIGNMENT;
        assert!(!resume.advance(Direction::Write, Ok(ALIGNMENT + 512), total).unwrap());
        assert_eq!(resume.done, ALIGNMENT);
        assert!(!resume.advance(Direction::Write, Ok(2 * ALIGNMENT), total).unwrap());
        assert_eq!(resume.done, 3 * ALIGNMENT);
        assert!(resume.advance(Direction::Write, Ok(3 * ALIGNMENT), total).unwrap());
        assert_eq!(resume.done, total);
    }

    #[test]
    fn a_transfer_without_progress_ends_with_an_error() {
        for raw in [4, 11, 125, 14] {
            let mut resume = Resume::default();
            let again = || Err(io::Error::from_raw_os_error(raw));
            for _ in 0..TRIES_MAX {
                assert!(!resume.advance(Direction::Read, again(), ALIGNMENT).unwrap());
            }
            let end = resume.advance(Direction::Read, again(), ALIGNMENT).unwrap_err();
            assert_eq!(end.raw_os_error(), Some(raw));
        }
        let mut resume = Resume::default();
        let end = (0..=TRIES_MAX).map(|_| resume.advance(Direction::Read, Ok(100), ALIGNMENT)).find_map(Result::err);
        assert_eq!(end.unwrap().kind(), io::ErrorKind::TimedOut);
    }

    #[test]
    fn end_of_file_and_lasting_errors_are_reported_at_once() {
        let mut resume = Resume::default();
        let end = resume.advance(Direction::Read, Ok(0), ALIGNMENT).unwrap_err();
        assert_eq!(end.kind(), io::ErrorKind::UnexpectedEof);
        let end = resume.advance(Direction::Write, Ok(0), ALIGNMENT).unwrap_err();
        assert_eq!(end.kind(), io::ErrorKind::WriteZero);
        let end = resume.advance(Direction::Read, Err(io::Error::from_raw_os_error(5)), ALIGNMENT).unwrap_err();
        assert_eq!(end.raw_os_error(), Some(5));
        assert_eq!(resume.tries, 0);
    }
}
