//! Text files in any encoding as UTF-8: the one place where bytes of a text file become text.
//!
//! A byte order mark is dropped, UTF-16 is converted (with the mark or without), and UTF-8 passes as it is. Bytes that are neither
//! belong to a code page that the file does not state: each becomes a character of its own ([`raw_byte`]), so that a name keeps
//! its bytes until the file that it names says what they mean.
//!
//! Invariants: 1. the output is UTF-8 for any input; 2. memory is a constant; 3. UTF-8 keeps its bytes.

use super::error::{InputError, InputResult};
use serde::de::DeserializeOwned;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes converted together.
const CHUNK: usize = 1 << 16;
/// Characters that stand for the bytes 0x80 to 0xff of an unknown code page; a private range that no font defines.
const RAW_FIRST: u32 = 0xef80;
/// Windows-1252 of the bytes 0x80 to 0x9f; from 0xa0 on it is Unicode's. Five bytes have no character.
const WINDOWS_1252: [char; 32] = [
    '€', '\u{81}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{8d}', 'Ž', '\u{8f}', '\u{90}', '‘', '’',
    '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{9d}', 'ž', 'Ÿ',
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Unknown,
    Utf8,
    Utf16Little,
    Utf16Big,
}

impl Encoding {
    /// The encoding of a file that begins with `head`, and the bytes of its mark.
    fn of(head: &[u8]) -> (Encoding, usize) {
        match head {
            [0xef, 0xbb, 0xbf, ..] => (Encoding::Utf8, 3),
            [0xff, 0xfe, ..] => (Encoding::Utf16Little, 2),
            [0xfe, 0xff, ..] => (Encoding::Utf16Big, 2),
            // The files that are read begin with an ASCII character.
            [1..=0x7f, 0, ..] => (Encoding::Utf16Little, 0),
            [0, 1..=0x7f, ..] => (Encoding::Utf16Big, 0),
            _ => (Encoding::Utf8, 0),
        }
    }
}

/// A reader of the UTF-8 of a text file.
#[derive(Debug)]
pub struct TextReader<R> {
    source: R,
    encoding: Encoding,
    /// Bytes of the source that are not converted yet.
    raw: Vec<u8>,
    text: String,
    /// Bytes of `text` that are passed on.
    passed: usize,
    ended: bool,
}

impl<R: Read> TextReader<R> {
    pub fn new(source: R) -> TextReader<R> {
        let (raw, text) = (Vec::new(), String::new());
        TextReader { source, encoding: Encoding::Unknown, raw, text, passed: 0, ended: false }
    }

    fn fill(&mut self) -> std::io::Result<()> {
        let have = self.raw.len();
        self.raw.resize(have + CHUNK, 0);
        let read = self.source.read(&mut self.raw[have..]);
        self.raw.truncate(have + *read.as_ref().unwrap_or(&0));
        self.ended = match read {
            Ok(count) => count == 0,
            Err(e) if e.kind() == ErrorKind::Interrupted => return Ok(()),
            Err(e) => return Err(e),
        };
        self.passed = 0;
        self.text.clear();
        if self.encoding == Encoding::Unknown {
            if self.raw.len() < 3 && !self.ended {
                return Ok(());
            }
            let (encoding, mark) = Encoding::of(&self.raw);
            self.encoding = encoding;
            self.raw.drain(..mark);
        }
        let done = match self.encoding {
            Encoding::Utf16Little => self.take_utf16(u16::from_le_bytes),
            Encoding::Utf16Big => self.take_utf16(u16::from_be_bytes),
            _ => self.take_utf8(),
        };
        self.raw.drain(..done);
        Ok(())
    }

    /// Converts what is complete; returns the bytes taken.
    fn take_utf8(&mut self) -> usize {
        if let Ok(text) = std::str::from_utf8(&self.raw) {
            self.text.push_str(text);
            return self.raw.len();
        }
        let mut rest = self.raw.as_slice();
        for chunk in self.raw.utf8_chunks() {
            self.text.push_str(chunk.valid());
            rest = &rest[chunk.valid().len()..];
            let is_last = chunk.invalid().len() == rest.len();
            if is_last && !self.ended && rest.len() < 4 {
                // The next bytes may complete the character.
                break;
            }
            self.text.extend(chunk.invalid().iter().map(|&byte| char_of(byte)));
            rest = &rest[chunk.invalid().len()..];
        }
        self.raw.len() - rest.len()
    }

    /// As [`TextReader::take_utf8`], for UTF-16. Half a pair of surrogates becomes U+FFFD.
    fn take_utf16(&mut self, unit: fn([u8; 2]) -> u16) -> usize {
        let (pairs, odd) = self.raw.as_chunks::<2>();
        let is_high = |pair: &[u8; 2]| (0xd800..0xdc00).contains(&unit(*pair));
        let waits = !self.ended && pairs.last().is_some_and(is_high);
        let pairs = &pairs[..pairs.len() - usize::from(waits)];
        let units = pairs.iter().map(|pair| unit(*pair));
        self.text.extend(char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)));
        2 * pairs.len() + if self.ended { odd.len() } else { 0 }
    }
}

impl<R: Read> Read for TextReader<R> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        while self.passed == self.text.len() && !self.ended {
            self.fill()?;
        }
        let rest = &self.text.as_bytes()[self.passed..];
        let count = rest.len().min(to.len());
        to[..count].copy_from_slice(&rest[..count]);
        self.passed += count;
        Ok(count)
    }
}

/// The text of a file of at most `most` bytes.
/// Errors: the file cannot be read, or is longer; `remedy` says what to do then.
pub fn read_text(file: &Path, most: u64, remedy: &str) -> InputResult<String> {
    let opened = File::open(file).map_err(|e| InputError::io(file, "opening", &e))?;
    let mut limited = opened.take(most + 1);
    let mut text = String::new();
    let read = TextReader::new(&mut limited).read_to_string(&mut text);
    read.map_err(|e| InputError::io(file, "reading", &e))?;
    if limited.limit() == 0 {
        return Err(InputError::new(file, format!("the file is larger than {} MiB", most >> 20), remedy));
    }
    Ok(text)
}

/// Most bytes of a small file that this program has written, such as a summary.
pub const OWN_FILE_MOST: u64 = 64 << 20;

/// The JSON of a small file that this program has written; `None` if the file cannot be read, holds something else, or is larger than
/// [`OWN_FILE_MOST`].
pub fn own_json<T: DeserializeOwned>(file: &Path) -> Option<T> {
    let text = std::io::read_to_string(File::open(file).ok()?.take(OWN_FILE_MOST)).ok()?;
    serde_json::from_str(&text).ok()
}

/// The first characters of a file, from at most `most` of its bytes; nothing of a file that cannot be read.
pub fn head_of(file: &Path, most: u64) -> String {
    let mut text = Vec::new();
    let read = File::open(file).and_then(|file| TextReader::new(file.take(most)).read_to_end(&mut text));
    if read.is_ok() { String::from_utf8_lossy(&text).into_owned() } else { String::new() }
}

/// The text of the last bytes of a file, at most `most`; nothing of a file that cannot be read.
pub fn tail_of(file: &Path, most: u64) -> String {
    let mut tail = Vec::new();
    let read = File::open(file).and_then(|mut file| {
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(most)))?;
        file.take(most).read_to_end(&mut tail)
    });
    if read.is_ok() { String::from_utf8_lossy(&tail).into_owned() } else { String::new() }
}

/// Most bytes of a line of [`lines_of`]; the rest of a longer one counts as the next.
const LINE_MOST: u64 = 1 << 20;

/// The lines of a file with their ends, up to one that cannot be read. A file that cannot be opened has none.
pub fn lines_of(file: &Path) -> impl Iterator<Item = Vec<u8>> + use<> {
    let mut opened = File::open(file).map(BufReader::new).ok();
    std::iter::from_fn(move || {
        let mut line = Vec::new();
        let read = opened.as_mut()?.take(LINE_MOST).read_until(b'\n', &mut line);
        read.is_ok_and(|bytes| bytes > 0).then_some(line)
    })
}

/// The text of bytes that are UTF-8 or of a code page.
pub fn text_of(bytes: &[u8]) -> String {
    let chunks = bytes.utf8_chunks();
    chunks.fold(String::new(), |mut text, chunk| {
        text.push_str(chunk.valid());
        text.extend(chunk.invalid().iter().map(|&byte| char_of(byte)));
        text
    })
}

/// The character that stands for a byte above 0x7f. All others are valid UTF-8.
fn char_of(byte: u8) -> char {
    char::from_u32(RAW_FIRST + u32::from(byte & 0x7f)).unwrap_or(char::REPLACEMENT_CHARACTER)
}

/// The byte of a code page for which a character stands.
pub fn raw_byte(c: char) -> Option<u8> {
    let number = u32::from(c).checked_sub(RAW_FIRST).filter(|number| *number < 0x80)?;
    Some(number as u8 | 0x80)
}

/// Whether a text has bytes of a code page.
pub fn has_raw_bytes(text: &str) -> bool {
    text.chars().any(|c| raw_byte(c).is_some())
}

/// The text for messages: a byte of a code page as `\xE4`.
pub fn shown(text: &str) -> String {
    text.chars().fold(String::new(), |shown, c| match raw_byte(c) {
        Some(byte) => shown + &format!("\\x{byte:02X}"),
        None => shown + c.encode_utf8(&mut [0; 4]),
    })
}

/// The bytes from which a text was read.
pub fn raw_bytes(text: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    for c in text.chars() {
        match raw_byte(c) {
            Some(byte) => bytes.push(byte),
            None => bytes.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes()),
        }
    }
    bytes
}

/// The text with its bytes read as Windows-1252, of which Latin-1 is a part.
pub fn as_windows_1252(text: &str) -> String {
    let meant = |byte: u8| WINDOWS_1252.get(usize::from(byte) - 0x80).copied().unwrap_or(char::from(byte));
    text.chars().map(|c| raw_byte(c).map_or(c, meant)).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    /// A source that gives `step` bytes at a time.
    struct Slow<'a>(&'a [u8], usize);

    impl Read for Slow<'_> {
        fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
            let count = self.1.min(self.0.len()).min(to.len());
            to[..count].copy_from_slice(&self.0[..count]);
            self.0 = &self.0[count..];
            Ok(count)
        }
    }

    fn read(bytes: &[u8]) -> String {
        let texts: Vec<String> = [1, 2, 3, 5, 1 << 20]
            .map(|step| {
                let mut text = String::new();
                TextReader::new(Slow(bytes, step)).read_to_string(&mut text).unwrap();
                text
            })
            .into();
        assert!(texts.iter().all(|text| *text == texts[0]), "{texts:?}");
        texts[0].clone()
    }

    #[test]
    fn every_encoding_gives_the_same_text() {
        let text = "name,x\r\nStraße 図𝄞,1\n";
        let units = |bytes: fn(u16) -> [u8; 2]| text.encode_utf16().flat_map(bytes).collect::<Vec<u8>>();
        assert_eq!(read(text.as_bytes()), text);
        assert_eq!(read(&[b"\xef\xbb\xbf", text.as_bytes()].concat()), text);
        for (mark, bytes) in [(&b"\xff\xfe"[..], units(u16::to_le_bytes)), (&b"\xfe\xff"[..], units(u16::to_be_bytes))]
        {
            assert_eq!(read(&[mark, &bytes].concat()), text);
            assert_eq!(read(&bytes), text);
        }
        for short in ["", "{", "{}"] {
            assert_eq!(read(short.as_bytes()), short);
        }
    }

    #[test]
    fn bytes_of_a_code_page_are_kept_and_shown() {
        let bytes = b"Stra\xdfe \xe9\x80.jpg";
        let text = read(bytes);
        assert_eq!(text, text_of(bytes));
        assert_eq!((raw_bytes(&text), has_raw_bytes(&text)), (bytes.to_vec(), true));
        assert_eq!(shown(&text), "Stra\\xDFe \\xE9\\x80.jpg");
        assert_eq!(as_windows_1252(&text), "Straße é€.jpg");
        // A character that is cut off at the end, and UTF-16 with an odd byte and half a pair.
        assert_eq!(shown(&read(b"a\xe2\x82")), "a\\xE2\\x82");
        assert_eq!(read(b"\xff\xfea\0\x00\xd8b"), "a\u{fffd}");
        assert!(!has_raw_bytes("Straße 図𝄞"));
    }

    #[test]
    fn own_json_reads_no_more_than_a_small_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("summary.json");
        assert_eq!(own_json::<[u8; 2]>(&path), None);
        std::fs::write(&path, "[1, 2]").unwrap();
        assert_eq!(own_json(&path), Some([1u8, 2]));
        // White space and nothing else, far beyond the limit.
        File::options().write(true).open(&path).unwrap().set_len(1 << 40).unwrap();
        assert_eq!(own_json::<[u8; 2]>(&path), None);
        assert!(read_text(&path, 1 << 20, "").unwrap_err().to_string().contains("larger than 1 MiB"));
    }
}
