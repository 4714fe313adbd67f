//! COLMAP's text files, read line by line; of each line, however long, only the needed part is kept.
//!
//! Invariants: 1. no buffer is longer than [`LINE_BYTES`]; 2. every error names its line.
//!
//! Layouts (`#` starts a comment line): cameras `id MODEL width height params...`; images `id qw qx qy qz tx ty tz
//! camera name`, each followed by one line, possibly empty, of `x y point` triples; points `id x y z r g b error`, then
//! the track.

use super::{Cameras, DAMAGED, ImageRecord, NO_LENS, PointTally, models};
use crate::base::error::{InputError, InputResult};
use crate::base::text::{TextReader, shown};
use crate::dataset::loose_json::is_no_number;
use crate::dataset::model::TakePoint;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Bytes kept of a line; the longest record (with a name of 4,096 bytes) is shorter.
const LINE_BYTES: usize = 8192;

struct Lines {
    path: PathBuf,
    reader: BufReader<TextReader<File>>,
    line: u64,
    buffer: Vec<u8>,
    /// Whether the kept part of the last line is incomplete.
    cut: bool,
    /// The count in COLMAP's own comment `# Number of images: 12, ...`.
    stated: Option<u64>,
}

impl Lines {
    fn open(path: &Path) -> InputResult<Lines> {
        let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
        if !file.metadata().is_ok_and(|m| m.is_file()) {
            return Err(InputError::new(path, "not a regular file", DAMAGED));
        }
        let reader = BufReader::with_capacity(1 << 18, TextReader::new(file));
        Ok(Lines { path: path.to_path_buf(), reader, line: 0, buffer: Vec::new(), cut: false, stated: None })
    }

    fn error(&self, problem: impl Into<String>) -> InputError {
        InputError::new(&self.path, problem, DAMAGED).at(format!("line {}", self.line))
    }

    /// Reads the next line into the buffer, at most [`LINE_BYTES`] of it; false at the end of the file.
    fn advance(&mut self) -> InputResult<bool> {
        let failed = |line: u64, e: &std::io::Error| {
            InputError::io(&self.path, "reading", e).at(format!("line {}", line.saturating_add(1)))
        };
        self.buffer.clear();
        let got = (&mut self.reader).take(LINE_BYTES as u64).read_until(b'\n', &mut self.buffer);
        let got = got.map_err(|e| failed(self.line, &e))?;
        self.cut = got == LINE_BYTES && self.buffer.last() != Some(&b'\n');
        if self.cut {
            self.reader.skip_until(b'\n').map_err(|e| failed(self.line, &e))?;
        }
        self.line += u64::from(got > 0);
        Ok(got > 0)
    }

    /// The kept part of the current line as trimmed text.
    fn text(&self) -> InputResult<&str> {
        let valid = match std::str::from_utf8(&self.buffer) {
            Ok(text) => text,
            // A character split by the cut is no error.
            Err(e) if self.cut && e.error_len().is_none() => {
                std::str::from_utf8(&self.buffer[..e.valid_up_to()]).unwrap_or_default()
            }
            Err(_) => return Err(self.error("text that is not UTF-8")),
        };
        Ok(valid.trim())
    }

    /// Moves to the next line that is neither empty nor a comment.
    fn next_record(&mut self) -> InputResult<bool> {
        while self.advance()? {
            let start = self.buffer.trim_ascii_start();
            match start.first() {
                None => {}
                Some(b'#') => self.stated = self.stated.or_else(|| stated_count(start)),
                Some(_) => return Ok(true),
            }
        }
        Ok(false)
    }

    /// A text file cut between two lines looks complete; COLMAP's comment reveals the cut.
    fn finish(&self, what: &str, read: u64, warnings: &mut Vec<String>) {
        if let Some(stated) = self.stated.filter(|&stated| stated != read) {
            let file = self.path.display();
            warnings
                .push(format!("{file}: its comment says {stated} {what}, the file holds {read}; it may be cut short"));
        }
    }
}

/// N of `# Number of images: N` (cameras, points).
fn stated_count(comment: &[u8]) -> Option<u64> {
    let text = std::str::from_utf8(comment).ok()?;
    let (_, rest) = text.split_once("Number of ")?.1.split_once(':')?;
    rest.split(',').next()?.trim().parse().ok()
}

struct LineWords<'a> {
    lines: &'a Lines,
    rest: &'a str,
}

impl<'a> LineWords<'a> {
    fn of(lines: &'a Lines) -> InputResult<LineWords<'a>> {
        Ok(LineWords { lines, rest: lines.text()? })
    }

    fn next(&mut self, what: &str) -> InputResult<&'a str> {
        let end = self.rest.find(char::is_whitespace).unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest.trim_start();
        if word.is_empty() { Err(self.lines.error(format!("the line ends before {what}"))) } else { Ok(word) }
    }

    fn number<T: FromStr>(&mut self, what: &str) -> InputResult<T> {
        let word = self.next(what)?;
        word.parse().map_err(|_| self.lines.error(format!("{what} is {:?}, which is not a valid number", shown(word))))
    }

    /// NaN for what programs write that have no number, such as `-nan(ind)`.
    fn number_or_nan(&mut self, what: &str) -> InputResult<f64> {
        match self.rest.split_ascii_whitespace().next() {
            Some(word) if is_no_number(word) => self.next(what).map(|_| f64::NAN),
            _ => self.number(what),
        }
    }

    fn numbers<const N: usize>(&mut self, what: &str) -> InputResult<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number_or_nan(what)?;
        }
        Ok(values)
    }
}

pub(super) fn read_cameras(path: &Path, warnings: &mut Vec<String>) -> InputResult<Cameras> {
    let mut lines = Lines::open(path)?;
    let mut cameras = Cameras::new();
    while lines.next_record()? {
        let mut words = LineWords::of(&lines)?;
        let id: u32 = words.number("the camera's number")?;
        let name = words.next("the camera model")?;
        let model = models::model_of(&format!("{name:?}"), |m| m.name == name)
            .map_err(|p| InputError::new(path, p, models::UNDISTORT).at(format!("line {}, camera {id}", lines.line)))?;
        let size = (words.number("the width")?, words.number("the height")?);
        let mut params = Vec::with_capacity(model.params);
        while !words.rest.is_empty() && params.len() <= model.params {
            params.push(words.number("a camera parameter")?);
        }
        let intrinsics = models::intrinsics(model, size, &params).map_err(|p| {
            let problem = format!("camera {id} has a wrong entry: {p}");
            InputError::new(path, problem, NO_LENS).at(format!("line {}", lines.line))
        })?;
        if cameras.insert(id, intrinsics).is_some() {
            return Err(lines.error(format!("camera {id} has a second definition")));
        }
    }
    lines.finish("cameras", cameras.len() as u64, warnings);
    Ok(cameras)
}

pub(super) fn count_images(path: &Path) -> InputResult<u64> {
    let mut lines = Lines::open(path)?;
    let mut count = 0;
    while lines.next_record()? {
        count += 1;
        lines.advance()?;
    }
    Ok(count)
}

/// Reads `images.txt`; skips 2D points.
pub(super) fn read_images(path: &Path, warnings: &mut Vec<String>) -> InputResult<Vec<ImageRecord>> {
    let mut lines = Lines::open(path)?;
    let mut images = Vec::new();
    while lines.next_record()? {
        if lines.cut {
            return Err(lines.error(format!("an image entry longer than {LINE_BYTES} bytes")));
        }
        let mut words = LineWords::of(&lines)?;
        let _: u32 = words.number("the image's number")?;
        let quat = words.numbers("the quaternion")?;
        let translation = words.numbers("the translation")?;
        let camera_id = words.number("the camera's number")?;
        let name = words.rest.to_string();
        if name.is_empty() {
            return Err(lines.error("the line ends before the image's name"));
        }
        images.push(ImageRecord { position: lines.line, camera_id, quat, translation, name });
        if lines.advance()? {
            // In a file without the lines of 2D points every second image would be lost.
            let mut words = lines.text()?.split_whitespace();
            let third_is_id = words.clone().nth(2).is_none_or(|w| w.parse::<i64>().is_ok());
            if !third_is_id || !lines.cut && !words.by_ref().count().is_multiple_of(3) {
                let problem = "the line after an image must hold its 2D points as 'x y point' triples, or be empty";
                let remedy = "add an empty line after each image that has no 2D points";
                return Err(InputError::new(path, problem, remedy).at(format!("line {}", lines.line)));
            }
        }
    }
    lines.finish("images", images.len() as u64, warnings);
    Ok(images)
}

/// Reads `points3D.txt`; skips tracks.
pub(super) fn read_points(path: &Path, warnings: &mut Vec<String>, take: &mut TakePoint<'_>) -> InputResult<()> {
    let mut lines = Lines::open(path)?;
    let mut tally = PointTally::default();
    while lines.next_record()? {
        let mut words = LineWords::of(&lines)?;
        let _: u64 = words.number("the point's number")?;
        let position = words.numbers("a coordinate")?;
        let color = [words.number("red")?, words.number("green")?, words.number("blue")?];
        words.number_or_nan("the reprojection error")?;
        tally.add(position, color, lines.line, take)?;
    }
    lines.finish("points", tally.total, warnings);
    tally.finish(path, "line", warnings)
}
