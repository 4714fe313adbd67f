//! COLMAP's binary files, little-endian, read as a stream: memory grows with the kept data, not with the skipped.
//!
//! Invariants: 1. every count is checked against the bytes left, assuming the smallest possible record, before anything
//! is allocated; 2. every error names the byte at which the record or field starts.
//!
//! Layouts: cameras `u64 n, n x {u32 id, i32 model, u64 width, u64 height, f64 params[]}`; images `u64 n, n x {u32 id,
//! f64 qw qx qy qz tx ty tz, u32 camera, name NUL, u64 m, m x {f64 x, f64 y, i64 point}}`; points `u64 n, n x {u64 id,
//! f64 x y z, u8 r g b, f64 error, u64 m, m x {u32 image, u32 index}}`.

use super::{Cameras, DAMAGED, ImageRecord, NO_LENS, PointTally, models};
use crate::base::error::{InputError, InputResult};
use crate::base::text::text_of;
use crate::dataset::model::TakePoint;
use crate::dataset::paths::MAX_NAME_BYTES;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

const CAMERA_MIN: u64 = 4 + 4 + 8 + 8 + 2 * 8;
const IMAGE_MIN: u64 = 4 + 7 * 8 + 4 + 1 + 8;
const POINT_MIN: u64 = 8 + 3 * 8 + 3 + 8 + 8;
const OBSERVATION: u64 = 24;
const TRACK_ELEMENT: u64 = 8;

struct BinaryFile {
    path: PathBuf,
    reader: BufReader<File>,
    size: u64,
    offset: u64,
}

impl BinaryFile {
    fn open(path: &Path) -> InputResult<BinaryFile> {
        let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
        let facts = file.metadata().map_err(|e| InputError::io(path, "reading the size", &e))?;
        if !facts.is_file() {
            return Err(InputError::new(path, "not a regular file", DAMAGED));
        }
        let reader = BufReader::with_capacity(1 << 18, file);
        Ok(BinaryFile { path: path.to_path_buf(), reader, size: facts.len(), offset: 0 })
    }

    fn left(&self) -> u64 {
        self.size.saturating_sub(self.offset)
    }

    fn error(&self, offset: u64, problem: impl Into<String>) -> InputError {
        InputError::new(&self.path, problem, DAMAGED).at(format!("byte {offset}"))
    }

    fn cut_short(&self, what: &str, need: u64) -> InputError {
        let left = self.left();
        self.error(self.offset, format!("the file ends inside {what}: {need} bytes are needed, {left} are left"))
    }

    fn take<const N: usize>(&mut self, what: &str) -> InputResult<[u8; N]> {
        if self.left() < N as u64 {
            return Err(self.cut_short(what, N as u64));
        }
        let mut bytes = [0; N];
        self.reader
            .read_exact(&mut bytes)
            .map_err(|e| InputError::io(&self.path, "reading", &e).at(format!("byte {}", self.offset)))?;
        self.offset += N as u64;
        Ok(bytes)
    }

    fn u32(&mut self, what: &str) -> InputResult<u32> {
        self.take(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> InputResult<u64> {
        self.take(what).map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> InputResult<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.take(what).map(f64::from_le_bytes)?;
        }
        Ok(values)
    }

    /// Reads a count of records that must fit into the rest of the file.
    fn count(&mut self, what: &str, record_bytes: u64) -> InputResult<u64> {
        let at = self.offset;
        let (count, left) = (self.u64(what)?, self.left());
        if count.checked_mul(record_bytes).is_none_or(|need| need > left) {
            return Err(self.error(at, format!("{count} {what}, but only {left} bytes follow")));
        }
        Ok(count)
    }

    /// Skips `bytes`, which the caller has checked to exist.
    fn skip(&mut self, bytes: u64) -> InputResult<()> {
        let seek = i64::try_from(bytes).map_err(|_| self.cut_short("a record", bytes))?;
        self.reader
            .seek_relative(seek)
            .map_err(|e| InputError::io(&self.path, "seeking", &e).at(format!("byte {}", self.offset)))?;
        self.offset += bytes;
        Ok(())
    }

    fn name(&mut self) -> InputResult<String> {
        let at = self.offset;
        let mut bytes = Vec::new();
        let limit = (MAX_NAME_BYTES as u64 + 1).min(self.left());
        let got = (&mut self.reader)
            .take(limit)
            .read_until(0, &mut bytes)
            .map_err(|e| InputError::io(&self.path, "reading", &e).at(format!("byte {at}")))?;
        self.offset += got as u64;
        if bytes.pop() != Some(0) {
            return Err(self.error(at, format!("an image name that does not end within {limit} bytes")));
        }
        Ok(text_of(&bytes))
    }

    /// Adds a warning if bytes follow the last record.
    fn finish(&self, warnings: &mut Vec<String>) {
        let left = self.left();
        if left > 0 {
            warnings.push(format!("{}: {left} bytes after the last record are ignored", self.path.display()));
        }
    }
}

pub(super) fn read_cameras(path: &Path, warnings: &mut Vec<String>) -> InputResult<Cameras> {
    let mut source = BinaryFile::open(path)?;
    let count = source.count("cameras", CAMERA_MIN)?;
    let mut cameras = Cameras::new();
    for _ in 0..count {
        let at = source.offset;
        let id = source.u32("a camera")?;
        let number = source.take("a camera").map(i32::from_le_bytes)?;
        let model = models::model_of(&format!("id {number}"), |m| m.id == number)
            .map_err(|p| InputError::new(path, p, models::UNDISTORT).at(format!("byte {at}, camera {id}")))?;
        let size = (source.u64("a camera")?, source.u64("a camera")?);
        let mut params = [0.0; 12];
        for value in params.iter_mut().take(model.params) {
            *value = source.take("camera parameters").map(f64::from_le_bytes)?;
        }
        let intrinsics = models::intrinsics(model, size, &params[..model.params])
            .map_err(|p| InputError::new(path, format!("camera {id} has {p}"), NO_LENS).at(format!("byte {at}")))?;
        if cameras.insert(id, intrinsics).is_some() {
            return Err(source.error(at, format!("camera {id} has a second definition")));
        }
    }
    source.finish(warnings);
    Ok(cameras)
}

/// The number of images that `images.bin` states, if the file is long enough for them.
pub(super) fn count_images(path: &Path) -> InputResult<u64> {
    BinaryFile::open(path)?.count("images", IMAGE_MIN)
}

/// Reads `images.bin`; skips 2D points.
pub(super) fn read_images(path: &Path, warnings: &mut Vec<String>) -> InputResult<Vec<ImageRecord>> {
    let mut source = BinaryFile::open(path)?;
    let count = source.count("images", IMAGE_MIN)?;
    let mut images = Vec::with_capacity(count as usize);
    for _ in 0..count {
        let position = source.offset;
        source.u32("an image")?;
        let [w, x, y, z, tx, ty, tz] = source.f64s("an image")?;
        let camera_id = source.u32("an image")?;
        let name = source.name()?;
        let observations = source.count("2D points", OBSERVATION)?;
        source.skip(observations * OBSERVATION)?;
        images.push(ImageRecord { position, camera_id, quat: [w, x, y, z], translation: [tx, ty, tz], name });
    }
    source.finish(warnings);
    Ok(images)
}

/// Reads `points3D.bin`; skips tracks.
pub(super) fn read_points(path: &Path, warnings: &mut Vec<String>, take: &mut TakePoint<'_>) -> InputResult<()> {
    let mut source = BinaryFile::open(path)?;
    let count = source.count("points", POINT_MIN)?;
    let mut tally = PointTally::default();
    for _ in 0..count {
        let at = source.offset;
        source.u64("a point")?;
        let position = source.f64s("a point")?;
        let color = source.take("a point")?;
        source.f64s::<1>("a point")?;
        let track = source.count("track elements", TRACK_ELEMENT)?;
        source.skip(track * TRACK_ELEMENT)?;
        tally.add(position, color, at, take)?;
    }
    source.finish(warnings);
    tally.finish(path, "byte", warnings)
}
