//! Scalars and pictures as TensorBoard event files.
//!
//! An event file is a sequence of records: length (u64), its checksum, the bytes, their checksum; the bytes are a
//! protocol-buffer message `Event { wall_time = 1: double, step = 2: int64, file_version = 3: string, summary = 5 }` with
//! `Summary { value = 1: repeated { tag = 1: string, simple_value = 2: float, image = 4 } }` and
//! `Image { height = 1, width = 2, colorspace = 3, encoded_image_string = 4: bytes }`. Only these fields are written, by
//! hand: some twenty lines in place of a code generator. A resumed run writes `session_log = 7 { status = 1: START }` with its
//! first step, upon which TensorBoard discards what earlier files say of that step and later ones.
//!
//! Invariants: 1. every record is complete when [`EventFile::write`] returns, so a reader that follows the file sees
//! half a record at most for a moment; 2. non-finite values are left out.

use crate::base::error::{InputError, InputResult};
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// `SessionLog { status = 1: START }`.
const SESSION_START: [u8; 2] = [0x08, 0x01];

const RGB: u32 = 3;

pub struct EventFile {
    path: PathBuf,
    file: File,
    /// Length of all complete records, bytes.
    end: u64,
}

impl EventFile {
    /// Creates an event file in `folder`, under a name that TensorBoard recognises. For a resumed run `first_step` is
    /// its first step: what earlier files say of this step and later ones becomes void.
    /// Errors: the folder cannot be written.
    pub fn create(folder: &Path, first_step: Option<u32>) -> InputResult<EventFile> {
        std::fs::create_dir_all(folder)
            .map_err(|e| InputError::io(folder, "creating the folder of event files", &e))?;
        // Names sort by time, which is the order in which TensorBoard reads them. A run may be resumed within one second, and on a machine
        // whose clock is behind.
        let earlier =
            std::fs::read_dir(folder).into_iter().flatten().flatten().filter_map(|entry| seconds_of(&entry.path()));
        let (seconds, mut number) = (earlier.fold(seconds_now() as u64, u64::max), 0);
        let (path, file) = loop {
            let path = folder.join(format!("events.out.tfevents.{seconds:010}.gsscale.{number:03}"));
            match File::create_new(&path) {
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
                Err(error) => return Err(InputError::io(&path, "creating the event file", &error)),
                Ok(file) => break (path, file),
            }
        };
        let mut events = EventFile { path, file, end: 0 };
        let mut message = Vec::new();
        double(&mut message, 1, seconds_now());
        bytes(&mut message, 3, b"brain.Event:2");
        events.record(&message)?;
        if let Some(step) = first_step {
            let mut message = event_of(step);
            bytes(&mut message, 7, &SESSION_START);
            events.record(&message)?;
        }
        Ok(events)
    }

    /// Appends the scalars of a step: (tag, value), a tag like `loss/train`.
    /// Errors: the disk fails.
    pub fn write(&mut self, step: u32, scalars: &[(&str, f64)]) -> InputResult<()> {
        let mut summary = Vec::new();
        for (tag, value) in scalars.iter().filter(|(_, value)| value.is_finite()) {
            let mut entry = Vec::new();
            bytes(&mut entry, 1, tag.as_bytes());
            key(&mut entry, 2, 5);
            entry.extend_from_slice(&(*value as f32).to_le_bytes());
            bytes(&mut summary, 1, &entry);
        }
        let mut message = event_of(step);
        bytes(&mut message, 5, &summary);
        self.record(&message)
    }

    /// Appends a picture to a step: the bytes of a PNG of `width` times `height` pixels in RGB.
    /// Errors: the disk fails.
    pub fn write_picture(&mut self, step: u32, tag: &str, (width, height): (u32, u32), png: &[u8]) -> InputResult<()> {
        let mut image = Vec::with_capacity(png.len() + 32);
        for (field, value) in [(1, height), (2, width), (3, RGB)] {
            key(&mut image, field, 0);
            varint(&mut image, u64::from(value));
        }
        bytes(&mut image, 4, png);
        let (mut entry, mut summary, mut message) = (Vec::new(), Vec::new(), event_of(step));
        bytes(&mut entry, 1, tag.as_bytes());
        bytes(&mut entry, 4, &image);
        bytes(&mut summary, 1, &entry);
        bytes(&mut message, 5, &summary);
        self.record(&message)
    }

    fn record(&mut self, message: &[u8]) -> InputResult<()> {
        let length = (message.len() as u64).to_le_bytes();
        let mut record = Vec::with_capacity(message.len() + 16);
        record.extend_from_slice(&length);
        record.extend_from_slice(&masked(crc32c(&length)).to_le_bytes());
        record.extend_from_slice(message);
        record.extend_from_slice(&masked(crc32c(message)).to_le_bytes());
        let end = self.end;
        let cut = |file: &mut File| file.set_len(end).and_then(|()| file.seek(SeekFrom::Start(end)).map(|_| ()));
        append_whole(&mut self.file, &record, cut)
            .map_err(|e| InputError::io(&self.path, "writing the event file", &e))?;
        self.end += record.len() as u64;
        Ok(())
    }
}

/// Appends a whole record. On failure `cut` removes the partial record, as far as the drive allows: readers would take
/// later records for the rest of it.
fn append_whole<W: Write>(
    file: &mut W,
    record: &[u8],
    cut: impl FnOnce(&mut W) -> std::io::Result<()>,
) -> std::io::Result<()> {
    let written = file.write_all(record);
    if written.is_err() {
        // The append's error is the one to report.
        let _ = cut(file);
    }
    written
}

/// Whether a file has a name as [`EventFile::create`] gives them.
pub fn is_event_file(path: &Path) -> bool {
    seconds_of(path).is_some()
}

/// The time in the name of an event file; `None` for another file.
fn seconds_of(path: &Path) -> Option<u64> {
    let name = path.file_name()?.to_str()?;
    let (seconds, number) = name.strip_prefix("events.out.tfevents.")?.split_once(".gsscale.")?;
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    seconds.parse().ok().filter(|_| is_number(seconds) && is_number(number))
}

fn seconds_now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// The start of an event of a step: time and step.
fn event_of(step: u32) -> Vec<u8> {
    let mut message = Vec::new();
    double(&mut message, 1, seconds_now());
    key(&mut message, 2, 0);
    varint(&mut message, u64::from(step));
    message
}

fn key(out: &mut Vec<u8>, field: u64, wire_type: u64) {
    varint(out, field << 3 | wire_type);
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn double(out: &mut Vec<u8>, field: u64, value: f64) {
    key(out, field, 1);
    out.extend_from_slice(&value.to_le_bytes());
}

fn bytes(out: &mut Vec<u8>, field: u64, value: &[u8]) {
    key(out, field, 2);
    varint(out, value.len() as u64);
    out.extend_from_slice(value);
}

/// Castagnoli's checksum (CRC-32C), bit by bit: a run writes a few hundred bytes a record, and a dozen pictures once.
fn crc32c(data: &[u8]) -> u32 {
    !data.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |c, _| (c >> 1) ^ (0x82f6_3b78 & 0u32.wrapping_sub(c & 1)))
    })
}

/// The format rotates and shifts checksums, so that a record that contains a checksum does not get a fixed one.
fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A writer with room for a given number of bytes.
    struct Full(Vec<u8>, usize);

    impl Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            let room = (self.1 - self.0.len()).min(bytes.len());
            self.0.extend_from_slice(&bytes[..room]);
            if room == 0 { Err(std::io::ErrorKind::StorageFull.into()) } else { Ok(room) }
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_partial_record_is_removed() {
        let mut file = Full(Vec::new(), 10);
        let mut append = |record: &[u8]| {
            let end = file.0.len();
            let result = append_whole(&mut file, record, |file| {
                file.0.truncate(end);
                Ok(())
            });
            (result.is_ok(), file.0.len())
        };
        assert_eq!([append(b"record"), append(b"record"), append(b"four")], [(true, 6), (false, 6), (true, 10)]);
    }

    #[test]
    fn a_later_file_sorts_behind_earlier_ones_of_a_clock_that_is_ahead() {
        let folder = tempfile::tempdir().expect("a scratch folder");
        let ahead = folder.path().join(format!("events.out.tfevents.{}.gsscale.000", seconds_now() as u64 + 600));
        std::fs::write(&ahead, b"").expect("written");
        let later = EventFile::create(folder.path(), Some(3)).expect("created").path;
        assert!(later > ahead && is_event_file(&later), "{} after {}", later.display(), ahead.display());
    }

    #[test]
    fn records_are_framed_and_hold_what_was_written() {
        assert_eq!(crc32c(b"123456789"), 0xe306_9283, "the published check value");
        let folder = tempfile::tempdir().expect("a scratch folder");
        let mut events = EventFile::create(&folder.path().join("tb"), Some(300)).expect("created");
        events.write(300, &[("loss/train", 0.25), ("psnr/test", f64::NAN)]).expect("written");
        let data = std::fs::read(&events.path).expect("readable");
        let mut rest = data.as_slice();
        let mut messages = Vec::new();
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().expect("eight bytes")) as usize;
            let crc = |at: usize| u32::from_le_bytes(rest[at..at + 4].try_into().expect("four bytes"));
            assert_eq!(crc(8), masked(crc32c(&rest[..8])));
            assert_eq!(crc(12 + length), masked(crc32c(&rest[12..12 + length])));
            messages.push(&rest[12..12 + length]);
            rest = &rest[16 + length..];
        }
        assert_eq!(messages.len(), 3);
        assert!(messages[0].ends_with(b"\x1a\x0dbrain.Event:2"));
        // After the time: step 300, then the start of a session.
        assert_eq!(messages[1][9..], [0x10, 0xac, 0x02, 0x3a, 2, 0x08, 0x01]);
        // After the time: step 300 as a varint, then a summary with one value: tag, f32.
        let mut want = vec![0x10, 0xac, 0x02, 0x2a, 19, 0x0a, 17, 0x0a, 10];
        want.extend_from_slice(b"loss/train");
        want.push(0x15);
        want.extend_from_slice(&0.25f32.to_le_bytes());
        assert_eq!(&messages[2][9..], want);
        // Another file within the same second leaves the first one unchanged.
        let second = EventFile::create(&folder.path().join("tb"), None).expect("created");
        assert!(second.path > events.path && std::fs::read(&events.path).expect("readable") == data);
    }
}
