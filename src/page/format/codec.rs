//! Codecs of payloads: raw, halves, or shuffled and compressed.
//!
//! Halves are for payloads in which many 32-bit words have an empty lower half, such as numbers rounded to 16 bits but kept in 32. The
//! stored form: one bit per 64-byte line (1: stored as the upper halves of its words), padded to a line; then the lines in order, 32 or
//! 64 bytes each; then the rest of an incomplete last line.
//!
//! Invariants: 1. decoding yields exactly the length that the index states or an error, for any bytes, and takes no
//! more memory than that; 2. a payload that compression does not shorten is stored raw, so the stored form is never
//! longer than the payload; 3. the same payload gives the same bytes on every machine and for any number of threads.

use crate::page::format::slot_header::StoredAs;
use std::cell::RefCell;
use std::io;
use zstd::zstd_safe::CParameter;

/// Bytes per word of the shuffle: payloads are mostly 32-bit floats.
const WORD: usize = 4;
/// The zstd levels on offer.
const LEVELS: std::ops::RangeInclusive<i32> = 1..=19;

/// The codec of new versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Codec {
    /// Stored unchanged: no work, no copy.
    #[default]
    Raw,
    /// Bytes shuffled, then zstd at this level. Pays on drives below about 0.5 GB/s.
    Zstd {
        /// 1 to 19.
        level: i32,
    },
    /// 64-byte lines whose 32-bit words all have an empty lower half take half the bytes: for 16-bit moments. One cheap
    /// pass.
    Halves,
}

impl Codec {
    /// How people write the codecs.
    pub const WORDS: [&str; 3] = ["raw", "halves", "zstd:LEVEL"];
}

/// The codec that writes this form, where its settings are not known.
impl From<StoredAs> for Codec {
    fn from(form: StoredAs) -> Codec {
        match form {
            StoredAs::Raw => Codec::Raw,
            StoredAs::ShuffledZstd => Codec::Zstd { level: 1 },
            StoredAs::Halves => Codec::Halves,
        }
    }
}

impl std::str::FromStr for Codec {
    type Err = String;

    fn from_str(text: &str) -> Result<Codec, String> {
        let level = text.strip_prefix("zstd:").and_then(|level| level.parse().ok());
        match (text, level) {
            ("raw", _) => Ok(Codec::Raw),
            ("halves", _) => Ok(Codec::Halves),
            (_, Some(level)) if LEVELS.contains(&level) => Ok(Codec::Zstd { level }),
            _ => Err(format!("unknown codec `{text}`: write raw, halves, or zstd:1 to zstd:{}", LEVELS.end())),
        }
    }
}

impl std::fmt::Display for Codec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Codec::Raw => write!(f, "raw"),
            Codec::Halves => write!(f, "halves"),
            Codec::Zstd { level } => write!(f, "zstd:{level}"),
        }
    }
}

/// Scratch memory of one thread, reused by encoding and decoding.
#[derive(Default)]
struct CodecBuffers {
    shuffled: Vec<u8>,
    compressor: Option<zstd::bulk::Compressor<'static>>,
    decompressor: Option<zstd::bulk::Decompressor<'static>>,
}

thread_local! {
    static SCRATCH: RefCell<CodecBuffers> = RefCell::default();
}

/// Encodes `payload` into `stored`, which is at least as long; returns the length and the form. `None` for
/// [`Codec::Raw`], or if the result would not be shorter.
/// Errors: zstd refuses the level, or runs out of memory.
pub fn encode_as(codec: Codec, payload: &[u8], stored: &mut [u8]) -> io::Result<Option<(usize, StoredAs)>> {
    match codec {
        Codec::Raw => Ok(None),
        Codec::Zstd { level } => Ok(encode(payload, level, stored)?.map(|bytes| (bytes, StoredAs::ShuffledZstd))),
        Codec::Halves if halved_bytes(payload) >= payload.len().min(stored.len()) => Ok(None),
        Codec::Halves => Ok(Some((halve(payload, stored), StoredAs::Halves))),
    }
}

/// Shuffles and compresses `payload` into `stored`, which is at least as long; returns the length. `None` if the result
/// would not be shorter (`stored` then holds garbage).
/// Errors: zstd refuses the level, or runs out of memory.
fn encode(payload: &[u8], level: i32, stored: &mut [u8]) -> io::Result<Option<usize>> {
    SCRATCH.with_borrow_mut(|scratch| {
        scratch.shuffled.resize(payload.len(), 0);
        shuffle(payload, &mut scratch.shuffled);
        let compressor = match &mut scratch.compressor {
            Some(compressor) => compressor,
            none => none.insert(zstd::bulk::Compressor::new(level)?),
        };
        compressor.set_parameter(CParameter::CompressionLevel(level))?;
        let room = payload.len().saturating_sub(1).min(stored.len());
        match compressor.compress_to_buffer(&scratch.shuffled, &mut stored[..room]) {
            Ok(bytes) => Ok(Some(bytes)),
            // The only failure that input can cause: the result does not fit, so it is not shorter.
            Err(_) => Ok(None),
        }
    })
}

/// Decodes `stored` so that it fills `payload`.
/// Errors: the bytes are damaged, or do not decode to `payload.len()` bytes.
pub fn decode(stored: &[u8], codec: StoredAs, payload: &mut [u8]) -> io::Result<()> {
    let wrong = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what.to_string());
    match codec {
        StoredAs::Raw if stored.len() == payload.len() => payload.copy_from_slice(stored),
        StoredAs::Raw => return Err(wrong("the stored length differs from the payload's")),
        StoredAs::Halves => unhalve(stored, payload)?,
        StoredAs::ShuffledZstd => decode_zstd(stored, payload)?,
    }
    Ok(())
}

fn decode_zstd(stored: &[u8], payload: &mut [u8]) -> io::Result<()> {
    SCRATCH.with_borrow_mut(|scratch| {
        let decompressor = match &mut scratch.decompressor {
            Some(decompressor) => decompressor,
            none => none.insert(zstd::bulk::Decompressor::new()?),
        };
        scratch.shuffled.resize(payload.len(), 0);
        // A single call that writes to the final buffer: a huge window stated by the frame takes no memory.
        let bytes = decompressor.decompress_to_buffer(stored, scratch.shuffled.as_mut_slice())?;
        if bytes != payload.len() {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "the decoded payload is too short"));
        }
        unshuffle(&scratch.shuffled, payload);
        Ok(())
    })
}

/// The first bytes of all words, then all second bytes, and so on; a remainder shorter than a word stays at the end.
fn shuffle(from: &[u8], to: &mut [u8]) {
    let words = from.len() / WORD;
    for (lane, lane_bytes) in to[..words * WORD].chunks_exact_mut(words.max(1)).enumerate() {
        for (byte, word) in lane_bytes.iter_mut().zip(from.chunks_exact(WORD)) {
            *byte = word[lane];
        }
    }
    to[words * WORD..].copy_from_slice(&from[words * WORD..]);
}

/// The inverse of [`shuffle`].
fn unshuffle(from: &[u8], to: &mut [u8]) {
    let words = from.len() / WORD;
    let (lanes, rest) = from.split_at(words * WORD);
    let (a, b) = lanes.split_at(words * 2);
    let ((a, b), (c, d)) = (a.split_at(words), b.split_at(words));
    for (i, word) in to.chunks_exact_mut(WORD).enumerate() {
        word.copy_from_slice(&[a[i], b[i], c[i], d[i]]);
    }
    to[words * WORD..].copy_from_slice(rest);
}

/// Bytes of a line, the unit of halving.
const LINE: usize = 64;

fn table_bytes(payload: usize) -> usize {
    (payload / LINE).div_ceil(8).next_multiple_of(LINE)
}

/// Longest encoding of a payload of `payload` bytes.
fn halved_bytes_max(payload: usize) -> usize {
    table_bytes(payload) + payload
}

/// Length of the encoding of `payload`.
fn halved_bytes(payload: &[u8]) -> usize {
    let halved = payload.chunks_exact(LINE).filter(|line| is_halvable(line)).count();
    halved_bytes_max(payload.len()) - halved * LINE / 2
}

/// Encodes `payload` into the front of `out`, which has at least [`halved_bytes`] bytes; returns the length.
fn halve(payload: &[u8], out: &mut [u8]) -> usize {
    let (table, data) = out.split_at_mut(table_bytes(payload.len()));
    table.fill(0);
    let lines = payload.chunks_exact(LINE);
    let rest = lines.remainder();
    let mut at = 0;
    for (i, line) in lines.enumerate() {
        if is_halvable(line) {
            table[i / 8] |= 1 << (i % 8);
            for (half, word) in data[at..at + LINE / 2].chunks_exact_mut(2).zip(line.chunks_exact(4)) {
                half.copy_from_slice(&word[2..]);
            }
            at += LINE / 2;
        } else {
            data[at..at + LINE].copy_from_slice(line);
            at += LINE;
        }
    }
    data[at..at + rest.len()].copy_from_slice(rest);
    table.len() + at + rest.len()
}

fn is_halvable(line: &[u8]) -> bool {
    let lower = line.chunks_exact(4).fold(0, |any, word| any | word[0] | word[1]);
    lower == 0
}

/// Decodes into `payload`, whose length is that of the original.
/// Errors: `stored` is not an encoding of a payload of that length.
fn unhalve(stored: &[u8], payload: &mut [u8]) -> io::Result<()> {
    let table_len = table_bytes(payload.len());
    let wrong = |expected: usize| {
        let what = format!("the halves codec expected {expected} stored bytes and found {}", stored.len());
        io::Error::new(io::ErrorKind::InvalidData, what)
    };
    if stored.len() < table_len {
        return Err(wrong(table_len));
    }
    let (table, data) = stored.split_at(table_len);
    let lines = payload.len() / LINE;
    let halved = (0..lines).filter(|i| table[i / 8] >> (i % 8) & 1 == 1).count();
    let expected = payload.len() - halved * LINE / 2;
    if data.len() != expected {
        return Err(wrong(table_len + expected));
    }
    let mut at = 0;
    let mut lines = payload.chunks_exact_mut(LINE);
    for (i, line) in lines.by_ref().enumerate() {
        if table[i / 8] >> (i % 8) & 1 == 1 {
            for (word, half) in line.chunks_exact_mut(4).zip(data[at..at + LINE / 2].chunks_exact(2)) {
                word.copy_from_slice(&[0, 0, half[0], half[1]]);
            }
            at += LINE / 2;
        } else {
            line.copy_from_slice(&data[at..at + LINE]);
            at += LINE;
        }
    }
    lines.into_remainder().copy_from_slice(&data[at..]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream, mix64};

    fn floats(n: usize) -> Vec<u8> {
        (0..n).flat_map(|i| ((i as f32 * 0.37).sin() * 3.0 + 10.0).to_le_bytes()).collect()
    }

    fn noise(n: usize) -> Vec<u8> {
        (0..n).map(|i| mix64(i as u64) as u8).collect()
    }

    #[test]
    fn payloads_round_trip_bit_for_bit() {
        for n in [1, 255, 256, 4096, 186_368] {
            for rest in [0, 1, 3] {
                let mut payload = floats(n);
                payload.extend(noise(rest));
                let mut stored = vec![0; payload.len()];
                for level in [1, 3, 19] {
                    let Some(bytes) = encode(&payload, level, &mut stored).unwrap() else {
                        assert!(n < 256, "{n} smooth floats did not become smaller");
                        continue;
                    };
                    assert!(bytes < payload.len());
                    let mut back = vec![1; payload.len()];
                    decode(&stored[..bytes], StoredAs::ShuffledZstd, &mut back).unwrap();
                    assert!(back == payload, "{n} floats, {rest} bytes, level {level}");
                }
            }
        }
    }

    /// Too long, too short, a bomb, a window of gigabytes: each gives an error, within memory of the payload's
    /// size.
    #[test]
    fn hostile_bytes_end_in_an_error() {
        let payload = floats(4096);
        let mut stored = vec![0; payload.len()];
        let bytes = encode(&payload, 1, &mut stored).unwrap().unwrap();
        let stored = &stored[..bytes];
        let read = |stored: &[u8], bytes: usize| decode(stored, StoredAs::ShuffledZstd, &mut vec![0; bytes]);
        assert!(read(stored, payload.len()).is_ok());
        assert!([payload.len() - 1, payload.len() + 1].iter().all(|&bytes| read(stored, bytes).is_err()));
        let bomb = zstd::bulk::compress(&vec![0; 64 << 20], 1).unwrap();
        assert!(read(&bomb, payload.len()).is_err());
        let wide_window = [0x28, 0xb5, 0x2f, 0xfd, 0x00, 0xa8, 0x01, 0x00, 0x00];
        assert!(read(&wide_window, 4096).is_err());
    }

    #[test]
    fn codecs_have_names() {
        for (text, codec) in [("raw", Codec::Raw), ("halves", Codec::Halves), ("zstd:1", Codec::Zstd { level: 1 })] {
            assert_eq!(text.parse(), Ok(codec));
            assert_eq!(codec.to_string(), text);
        }
        for wrong in ["zstd", "zstd:0", "zstd:20", "zstd:-1", "lz4", "", "zstd:1x"] {
            assert!(
                wrong.parse::<Codec>().is_err_and(|e| e.contains("write raw, halves, or zstd:1 to zstd:19")),
                "{wrong}"
            );
        }
    }

    #[test]
    fn halved_lines_round_trip_and_useless_halving_stays_raw() {
        let mut payload = vec![0u8; 4096];
        payload.chunks_exact_mut(4).for_each(|word| word[2..].copy_from_slice(&[0x80, 0x3f]));
        payload[100] = 7;
        let mut stored = vec![0; 4096];
        let (bytes, stored_as) = encode_as(Codec::Halves, &payload, &mut stored).unwrap().unwrap();
        // A table of one line, 63 halved lines and a whole one.
        assert_eq!((bytes, stored_as), (64 + 63 * 32 + 64, StoredAs::Halves));
        let mut back = vec![1; 4096];
        decode(&stored[..bytes], stored_as, &mut back).unwrap();
        assert_eq!(back, payload);
        assert!(decode(&stored[..bytes - 1], stored_as, &mut back).is_err());
        payload.fill(0x55);
        assert_eq!(encode_as(Codec::Halves, &payload, &mut stored).unwrap(), None);
        assert_eq!(encode_as(Codec::Raw, &payload, &mut stored).unwrap(), None);
    }

    #[test]
    fn every_byte_round_trips_and_halved_lines_take_half() {
        for len in [0, 1, 63, 64, 65, 4096, 64 * 513 + 7, 700_000] {
            for halved in [0u64, 1, 2, 3] {
                let mut draws = Stream::new(1, Purpose::Test, len as u64, halved);
                let mut payload: Vec<u8> = (0..len).map(|_| draws.next_u64() as u8).collect();
                let mut pattern = 0;
                for line in payload.chunks_exact_mut(LINE) {
                    if draws.below(3) < halved {
                        pattern += 1;
                        line.chunks_exact_mut(4).for_each(|word| word[..2].fill(0));
                    }
                }
                let mut out = vec![0xaa; halved_bytes_max(len)];
                let stored = halve(&payload, &mut out);
                assert_eq!(stored, table_bytes(len) + len - pattern * LINE / 2);
                let mut back = vec![0x55; len];
                assert!(unhalve(&out[..stored], &mut back).is_ok());
                assert!(back == payload);
            }
        }
    }
}
