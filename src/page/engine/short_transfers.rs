//! Completes transfers of which the system moved only a part.
//!
//! Every engine drives its requests with a [`Resume`]: a short transfer continues where it ended, an interrupted one is
//! tried again, and one that makes no progress ends with an error instead of looping forever.
//!
//! Invariants: 1. a resumed request starts at a multiple of [`ALIGNMENT`] from its first byte, as direct I/O requires,
//! so bytes after the last whole block move again; 2. at most [`TRIES_MAX`] outcomes in a row without a whole block of
//! progress are tolerated.

use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::{Direction, Transfer};
use std::fs::File;
use std::io;
#[cfg(unix)]
use std::os::unix::fs::FileExt;
#[cfg(windows)]
use std::os::windows::fs::FileExt;
use std::time::Duration;

/// Most outcomes in a row without progress.
const TRIES_MAX: u8 = 32;
/// `ECANCELED` and `EFAULT` on Linux: the ring returns them for requests whose thread ended. Such a request is
/// cancelled, or the kernel continues it where the process's memory is not mapped. Buffers stay mapped until their
/// transfer ends, so the request may be sent again.
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
    /// Errors: the outcome's error if a retry cannot help; `UnexpectedEof` or `WriteZero` at the end of the file.
    pub fn advance(&mut self, direction: Direction, outcome: io::Result<usize>, total: usize) -> io::Result<bool> {
        let error = match outcome {
            Ok(0) if self.done < total => {
                return Err(match direction {
                    Direction::Read => {
                        io::Error::new(io::ErrorKind::UnexpectedEof, "the file ends before the page does")
                    }
                    Direction::Write => io::Error::new(io::ErrorKind::WriteZero, "the drive accepts no more bytes"),
                });
            }
            Ok(moved) if self.done + moved >= total => {
                self.done = total;
                return Ok(true);
            }
            Ok(moved) => {
                let reached = self.done + moved;
                let whole = reached - reached % ALIGNMENT;
                if whole > self.done {
                    *self = Resume { done: whole, tries: 0 };
                    return Ok(false);
                }
                let problem = "the drive makes no progress: it moves only parts of a block";
                io::Error::new(io::ErrorKind::TimedOut, problem)
            }
            Err(error) if is_transient(&error) => error,
            Err(error) => return Err(error),
        };
        self.tries += 1;
        if self.tries > TRIES_MAX { Err(error) } else { Ok(false) }
    }
}

/// Whether a retry of the same request may succeed.
fn is_transient(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::Interrupted | io::ErrorKind::WouldBlock)
        || (cfg!(target_os = "linux") && error.raw_os_error().is_some_and(|raw| THREAD_ENDED.contains(&raw)))
}

/// Carries out a whole transfer with blocking calls.
/// Errors: the drive's I/O errors; `UnexpectedEof` if the file ends too early.
pub fn move_bytes(file: &File, transfer: &mut Transfer) -> io::Result<()> {
    move_parts(transfer, |direction, bytes, at| match direction {
        #[cfg(unix)]
        Direction::Read => file.read_at(bytes, at),
        #[cfg(unix)]
        Direction::Write => file.write_at(bytes, at),
        #[cfg(windows)]
        Direction::Read => file.seek_read(bytes, at),
        #[cfg(windows)]
        Direction::Write => file.seek_write(bytes, at),
    })
}

/// Calls `move_part` with the rest of a transfer, as (direction, bytes, their place in the file), until all bytes have
/// moved.
fn move_parts(
    transfer: &mut Transfer,
    mut move_part: impl FnMut(Direction, &mut [u8], u64) -> io::Result<usize>,
) -> io::Result<()> {
    let (direction, total, start) = (transfer.direction, transfer.bytes, transfer.place.offset);
    let mut resume = Resume::default();
    while resume.done < total {
        let rest = &mut transfer.buffer.as_mut_slice()[resume.done..total];
        let outcome = move_part(direction, rest, start + resume.done as u64);
        resume.advance(direction, outcome, total)?;
        if resume.tries > 1 {
            std::thread::sleep(Duration::from_micros(50 * u64::from(resume.tries)));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::page::engine::buffer::PageBuffer;
    use crate::page::engine::page_engine::Place;

    const BYTES: usize = 37 * ALIGNMENT;
    const OFFSET: usize = 3 * ALIGNMENT;

    #[test]
    fn what_cannot_go_on_is_an_error_at_once_or_after_some_tries() {
        use io::ErrorKind::{TimedOut, UnexpectedEof, WriteZero};
        let failed = io::Error::from_raw_os_error;
        let advance = |resume: &mut Resume, direction, outcome| resume.advance(direction, outcome, ALIGNMENT);
        let mut stuck = Resume::default();
        let mut parts = (0..=TRIES_MAX).map(|_| advance(&mut stuck, Direction::Read, Ok(100)));
        assert_eq!(parts.find_map(Result::err).unwrap().kind(), TimedOut);
        let passing: &[i32] = if cfg!(target_os = "linux") { &[4, 11, 125, 14] } else { &[] };
        for &raw in passing {
            let mut resume = Resume::default();
            assert!((0..TRIES_MAX).all(|_| !advance(&mut resume, Direction::Read, Err(failed(raw))).unwrap()));
            assert_eq!(advance(&mut resume, Direction::Read, Err(failed(raw))).unwrap_err().raw_os_error(), Some(raw));
        }
        let end = |direction, outcome| advance(&mut Resume::default(), direction, outcome).unwrap_err();
        assert_eq!(end(Direction::Read, Ok(0)).kind(), UnexpectedEof);
        assert_eq!(end(Direction::Write, Ok(0)).kind(), WriteZero);
        assert_eq!(end(Direction::Read, Err(failed(5))).raw_os_error(), Some(5));
    }

    /// Carries out a transfer against `drive`, which moves few bytes at a time and interrupts often. Returns the number
    /// of calls.
    fn move_in_parts(transfer: &mut Transfer, drive: &mut [u8], draws: &mut Stream) -> usize {
        let mut asked = 0;
        let moved = move_parts(transfer, |direction, bytes, at| {
            asked += 1;
            match asked % 4 {
                1 => return Err(io::Error::from(io::ErrorKind::Interrupted)),
                2 => return Err(io::Error::from(io::ErrorKind::WouldBlock)),
                _ => {}
            }
            // Sometimes less than a block: the rest of a partial block moves again, and progress comes before the limit
            // on tries.
            let count =
                (draws.below(4) as usize * ALIGNMENT + 1 + draws.below(ALIGNMENT as u64) as usize).min(bytes.len());
            let there = &mut drive[at as usize..][..count];
            match direction {
                Direction::Read => bytes[..count].copy_from_slice(there),
                Direction::Write => there.copy_from_slice(&bytes[..count]),
            }
            Ok(count)
        });
        moved.unwrap();
        asked
    }

    #[test]
    fn a_transfer_in_interrupted_parts_arrives_whole() {
        for seed in 0..50 {
            let mut draws = Stream::new(seed, Purpose::Test, 0, 0);
            let mut drive: Vec<u8> = (0..OFFSET + BYTES + ALIGNMENT).map(|_| draws.next_u64() as u8).collect();
            let before = drive.clone();
            let place = Place { segment: 0, offset: OFFSET as u64 };
            // The buffer is longer than the transfer.
            let buffer = PageBuffer::zeroed(BYTES + ALIGNMENT);
            let mut transfer = Transfer { token: 1, direction: Direction::Read, place, bytes: BYTES, buffer };
            let asked = move_in_parts(&mut transfer, &mut drive, &mut draws);
            assert!(asked > 30, "asked {asked} times: too easy");
            let (moved, rest) = transfer.buffer.as_slice().split_at(BYTES);
            assert!(drive == before && *moved == before[OFFSET..OFFSET + BYTES], "seed {seed}: other bytes were read");
            assert!(rest.iter().all(|&b| b == 0));
            transfer.buffer.as_mut_slice().iter_mut().for_each(|b| *b = !*b);
            transfer.direction = Direction::Write;
            move_in_parts(&mut transfer, &mut drive, &mut draws);
            let is_right =
                |(i, b): (usize, &u8)| *b == if (OFFSET..OFFSET + BYTES).contains(&i) { !before[i] } else { before[i] };
            assert!(drive.iter().enumerate().all(is_right), "seed {seed}: other bytes were written");
        }
    }
}
