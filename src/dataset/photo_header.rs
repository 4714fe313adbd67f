//! Checks a photo file without decoding it: format, size, presence of its end, and the memory that decoding takes.
//!
//! The memory is computed from what the decoders do (crates png 0.18 and zune-jpeg 0.5), except buffers of a few rows.
//! A PNG takes its pixels as decoded (1 to 8 bytes each) and as converted, because [`crate::base::png_pixels`] hides
//! everything else from the decoder. A JPEG takes: its file twice, because the decoder copies metadata anywhere in it;
//! the metadata before its pixels once more, because the decoder joins metadata that is in parts; its pixels; and, if a
//! scan does not hold all of a pixel (progressive files, and others with a scan per component), 2 bytes per
//! coefficient, in whole blocks.
//!
//! Invariants: 1. no allocation is proportional to a number in the file; 2. an accepted file has a complete header, and
//! its format's end marker after the start of the pixel data; 3. EXIF orientation is ignored, as in COLMAP: sizes are
//! those of the stored pixels.
//!
//! Not here: what EXIF data say ([`super::exif`]); a header states only where they lie.

use super::resize::LARGEST_SIDE;
use crate::base::error::{InputError, InputResult};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Photos with more pixels are refused: no camera makes them, but a broken header may state them.
pub const MOST_PIXELS: u64 = 500_000_000;

/// Bytes at the end of a file that are searched for the end marker before the whole file is.
const TAIL: u64 = 64 * 1024;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PhotoFormat {
    /// Baseline, extended or progressive.
    Jpeg,
    Png,
}

/// Place of the EXIF data of a photo in its file: a TIFF structure, without the marker before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExifPlace {
    pub at: u64,
    /// As the file states them.
    pub bytes: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhotoHeader {
    pub format: PhotoFormat,
    /// Of the stored pixels.
    pub width: u32,
    pub height: u32,
    /// Peak memory of the decoder, bytes, including the 8-bit RGB result.
    pub decode_bytes: u64,
    pub has_alpha: bool,
    /// The first EXIF data before the pixels.
    pub exif: Option<ExifPlace>,
}

impl PhotoHeader {
    /// As [`PhotoHeader::decode_bytes`] for an 8-bit gray result, made from RGB in the worst case.
    pub fn gray_bytes(&self) -> u64 {
        self.decode_bytes.max(4 * u64::from(self.width) * u64::from(self.height))
    }
}

/// Reads and checks the header and the end of a photo file.
/// Errors: unreadable, empty, neither JPEG nor PNG, damaged header, cut short, or too large.
pub fn read_header(path: &Path) -> InputResult<PhotoHeader> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening the photo", &e))?;
    let bytes = file.metadata().map_err(|e| InputError::io(path, "reading the photo", &e))?.len();
    if bytes == 0 {
        return Err(InputError::new(path, "the photo is empty (0 bytes)", COPY_AGAIN));
    }
    let mut reader = HeaderReader { path, file: BufReader::with_capacity(4096, file), bytes };
    let mut magic = [0u8; 16];
    let have = bytes.min(16) as usize;
    reader.read(&mut magic[..have], "its first bytes")?;
    if magic.starts_with(&[0xff, 0xd8]) {
        reader.jpeg()
    } else if magic.starts_with(b"\x89PNG\r\n\x1a\n") {
        reader.png()
    } else {
        let problem = match foreign_format(&magic) {
            Some(name) => format!("this is a {name} file; photos must be JPEG or PNG"),
            // The shortest picture of either format is longer: this must be the start of one.
            None if bytes < 8 => {
                return Err(InputError::new(path, format!("the photo is cut short ({bytes} bytes)"), COPY_AGAIN));
            }
            None => "this is not a picture that can be read; photos must be JPEG or PNG".to_string(),
        };
        Err(InputError::new(path, problem, "convert the photo to JPEG or PNG under the name that the model uses")
            .at("byte 0"))
    }
}

/// Width and height from the photo's header; nothing is decoded.
pub(super) fn read_size(path: &Path) -> InputResult<(u64, u64)> {
    let header = read_header(path).map_err(|mut error| {
        error.problem.insert_str(0, "the photo's size cannot be read: ");
        error
    })?;
    Ok((u64::from(header.width), u64::from(header.height)))
}

/// Most segments, fill bytes and pairs of stray bytes before the pixels of a JPEG: each costs a read, and a photo with a large colour profile
/// and previews has some hundred.
const MOST_SEGMENTS: u32 = 10_000;

/// The first bytes of an APP1 segment with EXIF data.
const EXIF_MARK: [u8; 6] = *b"Exif\0\0";

const COPY_AGAIN: &str = "copy the photo again from its source, or remove it and use --allow-missing";

fn foreign_format(magic: &[u8; 16]) -> Option<&'static str> {
    Some(match magic {
        [b'G', b'I', b'F', b'8', ..] => "GIF",
        [b'B', b'M', ..] => "BMP",
        [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => "TIFF (or camera raw)",
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => "WebP",
        [_, _, _, _, b'f', b't', b'y', b'p', ..] => "HEIC or AVIF",
        [0, 0, 0, 12, b'j', b'P', ..] => "JPEG 2000",
        [0, 0, 0, 12, b'J', b'X', ..] => "JPEG XL",
        [0x76, 0x2f, 0x31, 0x01, ..] => "OpenEXR",
        _ => return None,
    })
}

struct JpegFrame {
    code: u8,
    width: u32,
    height: u32,
    pixels: u64,
    components: u8,
    /// Coefficients of all components, in whole blocks and units.
    coefficients: u64,
}

struct HeaderReader<'a> {
    path: &'a Path,
    file: BufReader<File>,
    bytes: u64,
}

impl HeaderReader<'_> {
    fn io(&self, e: &std::io::Error) -> InputError {
        InputError::io(self.path, "reading the photo", e)
    }

    fn read(&mut self, into: &mut [u8], what: &str) -> InputResult<()> {
        let at = self.file.stream_position().map_err(|e| self.io(&e))?;
        self.file.read_exact(into).map_err(|e| {
            if e.kind() == std::io::ErrorKind::UnexpectedEof {
                self.truncated(format!("byte {at} of {}", self.bytes), what)
            } else {
                self.io(&e)
            }
        })
    }

    fn truncated(&self, place: String, what: &str) -> InputError {
        InputError::new(self.path, format!("the photo is cut short: {what} is missing"), COPY_AGAIN).at(place)
    }

    fn damaged(&self, at: u64, problem: &str) -> InputError {
        InputError::new(self.path, format!("the photo is damaged: {problem}"), COPY_AGAIN).at(format!("byte {at}"))
    }

    /// Walks the segments up to the first scan (ITU T.81, annex B).
    fn jpeg(mut self) -> InputResult<PhotoHeader> {
        let mut at = 2u64;
        let (mut frame, mut exif) = (None, None);
        let (mut segments, mut metadata) = (0, 0);
        loop {
            segments += 1;
            if segments > MOST_SEGMENTS {
                return Err(self.damaged(at, "its header does not end"));
            }
            self.file.seek(SeekFrom::Start(at)).map_err(|e| self.io(&e))?;
            let mut marker = [0u8; 2];
            self.read(&mut marker, "a segment of its header")?;
            match marker {
                [0xff, 0xff] => at += 1, // fill byte
                [0xff, 0x01 | 0xd0..=0xd8] => at += 2,
                [0xff, 0xda] => break,
                [0xff, 0xd9] => return Err(self.damaged(at, "it ends before its pixels begin")),
                [0xff, code] if code != 0 => {
                    let mut length = [0u8; 2];
                    self.read(&mut length, "a segment of its header")?;
                    let length = u64::from(u16::from_be_bytes(length));
                    if length < 2 {
                        return Err(self.damaged(at, "a segment is shorter than its own length field"));
                    }
                    if (0xc0..=0xcf).contains(&code) && ![0xc4, 0xc8, 0xcc].contains(&code) {
                        frame = Some(self.jpeg_frame(code, at)?);
                    }
                    if (0xe0..=0xef).contains(&code) {
                        metadata += length;
                    }
                    let mut mark = [0u8; EXIF_MARK.len()];
                    let after_mark = 2 + mark.len() as u64;
                    if code == 0xe1 && exif.is_none() && length >= after_mark {
                        self.read(&mut mark, "a segment of its header")?;
                        let place = ExifPlace { at: at + 2 + after_mark, bytes: (length - after_mark) as u32 };
                        exif = (mark == EXIF_MARK).then_some(place);
                    }
                    at += 2 + length;
                }
                [0xff, _] => return Err(self.damaged(at, "a JPEG marker is expected here")),
                // Stray bytes before a marker, which decoders skip.
                [_, 0xff] => at += 1,
                _ => at += 2,
            }
        }
        let Some(JpegFrame { code, width, height, pixels, components, coefficients }) = frame else {
            return Err(self.damaged(at, "its pixels begin before its size is stated"));
        };
        let mut scan = [0u8; 3];
        self.read(&mut scan, "the header of its first scan")?;
        // The result, plus the RGB made from it if it is gray.
        let result = if components == 1 { 4 } else { 3 } * pixels;
        // All coefficients are kept until the last scan, if there are several.
        let of_scans = if code == 0xc2 || scan[2] != components { 2 * coefficients } else { 0 };
        let decode_bytes = 2 * self.bytes + metadata + result + of_scans;
        // Pixel data cannot contain this pair (a 255 in it is followed by 0), but a preview in the header can: so the
        // search starts after the start of the scan. Anything may follow the marker.
        self.require_end(at, &[0xff, 0xd9], "the end marker (FF D9)")?;
        Ok(PhotoHeader { format: PhotoFormat::Jpeg, width, height, decode_bytes, has_alpha: false, exif })
    }

    fn jpeg_frame(&mut self, code: u8, at: u64) -> InputResult<JpegFrame> {
        let mut f = [0u8; 6];
        self.read(&mut f, "its frame header")?;
        let (height, width) = (u16::from_be_bytes([f[1], f[2]]), u16::from_be_bytes([f[3], f[4]]));
        if code > 0xc2 || f[0] != 8 {
            let problem = "its JPEG coding (lossless, arithmetic or 12-bit) cannot be read";
            let remedy = "save the photo again as an ordinary 8-bit JPEG or as PNG";
            return Err(InputError::new(self.path, problem, remedy).at(format!("byte {at}")));
        }
        let pixels = self.check_size(u32::from(width), u32::from(height), at)?;
        let components = f[5];
        if !(1..=4).contains(&components) {
            return Err(self.damaged(at, &format!("it has {components} components; supported are 1 to 4")));
        }
        let (mut blocks, mut most) = (0, [1, 1]);
        for _ in 0..components {
            let mut c = [0u8; 3];
            self.read(&mut c, "its frame header")?;
            let sampling = [u64::from(c[1] >> 4), u64::from(c[1] & 15)];
            if sampling.iter().any(|s| !(1..=4).contains(s)) {
                return Err(self.damaged(at, "a component has an invalid sampling factor"));
            }
            blocks += sampling[0] * sampling[1];
            most = [most[0].max(sampling[0]), most[1].max(sampling[1])];
        }
        // A single component is never subsampled, whatever its factors say.
        let (blocks, most) = if components == 1 { (1, [1, 1]) } else { (blocks, most) };
        let units = u64::from(width).div_ceil(8 * most[0]) * u64::from(height).div_ceil(8 * most[1]);
        let (width, height) = (width.into(), height.into());
        Ok(JpegFrame { code, width, height, pixels, components, coefficients: 64 * blocks * units })
    }

    /// Signature, IHDR and IEND (PNG specification, sections 5 and 11.2).
    fn png(mut self) -> InputResult<PhotoHeader> {
        self.file.seek(SeekFrom::Start(8)).map_err(|e| self.io(&e))?;
        let mut h = [0u8; 21];
        self.read(&mut h, "its IHDR chunk")?;
        if h[..8] != *b"\0\0\0\x0dIHDR" {
            return Err(self.damaged(8, "an IHDR chunk is expected here"));
        }
        let width = u32::from_be_bytes([h[8], h[9], h[10], h[11]]);
        let height = u32::from_be_bytes([h[12], h[13], h[14], h[15]]);
        let pixels = self.check_size(width, height, 16)?;
        let (at, is_transparent, exif) = self.png_pixels()?;
        let depth = if h[16] == 16 { 2 } else { 1 };
        // Bytes as decoded, and as converted: RGB directly, or RGBA first if there is alpha.
        let (colors, has_alpha) = match h[17] {
            0 => (1, is_transparent),
            2 | 3 => (3, is_transparent),
            4 => (1, true),
            6 => (3, true),
            _ => return Err(self.damaged(25, "its colour type does not exist")),
        };
        let decoded = depth * (colors + u64::from(has_alpha));
        let per_pixel = match (has_alpha, decoded) {
            (true, _) => (decoded + 4).max(4 + 3),
            (false, 3) => 3,
            (false, _) => decoded + 3,
        };
        self.require_end(at, b"IEND\xae\x42\x60\x82", "the end chunk (IEND)")?;
        let decode_bytes = pixels * per_pixel;
        Ok(PhotoHeader { format: PhotoFormat::Png, width, height, decode_bytes, has_alpha, exif })
    }

    /// Walks the chunks up to the first pixels: their position, whether a tRNS chunk makes some transparent, and the EXIF data.
    fn png_pixels(&mut self) -> InputResult<(u64, bool, Option<ExifPlace>)> {
        let (mut at, mut is_transparent, mut exif) = (33u64, false, None);
        for _ in 0..MOST_SEGMENTS {
            self.file.seek(SeekFrom::Start(at)).map_err(|e| self.io(&e))?;
            let mut head = [0u8; 8];
            self.read(&mut head, "a chunk before its pixels")?;
            let [a, b, c, d, kind @ ..] = head;
            match &kind {
                b"IDAT" => return Ok((at, is_transparent, exif)),
                b"IEND" => return Err(self.damaged(at, "it ends before its pixels begin")),
                b"tRNS" => is_transparent = true,
                b"eXIf" if exif.is_none() => {
                    exif = Some(ExifPlace { at: at + 8, bytes: u32::from_be_bytes([a, b, c, d]) });
                }
                _ => {}
            }
            at += 12 + u64::from(u32::from_be_bytes([a, b, c, d]));
        }
        Err(self.damaged(at, "its header does not end"))
    }

    fn check_size(&self, width: u32, height: u32, at: u64) -> InputResult<u64> {
        if width == 0 || height == 0 {
            return Err(self.damaged(at, &format!("it states a size of {width} x {height}")));
        }
        let pixels = u64::from(width) * u64::from(height);
        if width > LARGEST_SIDE || height > LARGEST_SIDE || pixels > MOST_PIXELS {
            let problem = format!(
                "it states a size of {width} x {height}; at most {LARGEST_SIDE} a side and {MOST_PIXELS} pixels can be read"
            );
            let remedy = "if the size is real, make the photos smaller and give their folder with --images";
            return Err(InputError::new(self.path, problem, remedy).at(format!("byte {at}")));
        }
        Ok(pixels)
    }

    /// Requires `marker` somewhere after `from`: first searches the file's last 64 KiB, then all of it.
    fn require_end(&mut self, from: u64, marker: &[u8], what: &str) -> InputResult<()> {
        let tail = self.bytes.saturating_sub(TAIL).max(from);
        for (start, end) in [(tail, self.bytes), (from, self.bytes)] {
            if self.find(start, end, marker)? {
                return Ok(());
            }
        }
        Err(self.truncated(format!("byte {}", self.bytes), what))
    }

    /// Whether `marker` occurs in bytes `start..end`; reads blocks that overlap by a marker's length.
    fn find(&mut self, start: u64, end: u64, marker: &[u8]) -> InputResult<bool> {
        let mut block = vec![0u8; TAIL as usize];
        let overlap = marker.len() as u64 - 1;
        let mut at = start;
        while at + overlap < end {
            let length = (end - at).min(TAIL) as usize;
            self.file.seek(SeekFrom::Start(at)).map_err(|e| self.io(&e))?;
            self.read(&mut block[..length], "its end")?;
            if block[..length].windows(marker.len()).any(|w| w == marker) {
                return Ok(true);
            }
            at += length as u64 - overlap;
        }
        Ok(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn check(bytes: &[u8]) -> InputResult<PhotoHeader> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(bytes).unwrap();
        read_header(file.path())
    }

    fn encoded(format: image::ImageFormat) -> Vec<u8> {
        let picture = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([x as u8 * 6, y as u8 * 8, (x * y) as u8]));
        let mut bytes = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn complete_files_pass_even_with_data_appended_and_every_cut_is_detected() {
        for (format, want) in
            [(image::ImageFormat::Jpeg, PhotoFormat::Jpeg), (image::ImageFormat::Png, PhotoFormat::Png)]
        {
            let mut bytes = encoded(format);
            let header = check(&bytes).unwrap();
            assert_eq!((header.format, header.width, header.height), (want, 40, 30));
            for length in 0..bytes.len() {
                let error = check(&bytes[..length]).unwrap_err();
                assert!(!error.remedy.is_empty() && !error.problem.is_empty());
            }
            for appended in [3, 100_000] {
                bytes.resize(bytes.len() + appended, 0);
                assert_eq!(check(&bytes).unwrap().width, 40);
            }
        }
        // An end marker in a preview does not count.
        let bytes = encoded(image::ImageFormat::Jpeg);
        let mut with_preview = vec![0xff, 0xd8, 0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9];
        with_preview.extend(&bytes[2..]);
        assert!(check(&with_preview).is_ok());
        assert!(check(&with_preview[..with_preview.len() - 40]).is_err());
    }

    #[test]
    fn other_formats_are_refused_by_name() {
        let error = check(b"II\x2a\0\x08\0\0\0").unwrap_err();
        assert!(error.problem.contains("TIFF"), "{error}");
        assert!(check(b"hello, I am no picture").unwrap_err().problem.contains("JPEG or PNG"));
        let filled = [&[0xff, 0xd8][..], &[0xff; 20_000]].concat();
        assert!(check(&filled).unwrap_err().problem.contains("does not end"), "a look for every byte of a large file");
        assert!(check(b"").unwrap_err().problem.contains("empty"));
        let mut huge = encoded(image::ImageFormat::Png);
        huge[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0, 0, 0, 1]);
        assert!(check(&huge).unwrap_err().problem.contains("size"));
    }
}
