//! A codec for payloads in which many 32-bit words have an empty lower half: such lines are stored as their upper
//! halves.
//!
//! Made for numbers rounded to 16 bits but kept in 32; the codec itself knows nothing of numbers. One pass each way,
//! cheaper than any general codec; lines that do not fit the pattern stay whole.
//!
//! Stored form: one bit per 64-byte line (1: halved), padded to a line; then the lines in order, 32 or 64 bytes each;
//! then the rest of an incomplete last line.
//!
//! Invariants: 1. decoding restores every byte; 2. no stored bytes make decoding panic or write beyond its output.

use std::io;

/// Bytes of a line, the unit of halving.
const LINE: usize = 64;

fn table_bytes(payload: usize) -> usize {
    (payload / LINE).div_ceil(8).next_multiple_of(LINE)
}

/// Longest encoding of a payload of `payload` bytes.
pub fn encoded_bytes_max(payload: usize) -> usize {
    table_bytes(payload) + payload
}

/// Length of the encoding of `payload`.
pub fn encoded_bytes(payload: &[u8]) -> usize {
    let halved = payload.chunks_exact(LINE).filter(|line| is_halvable(line)).count();
    encoded_bytes_max(payload.len()) - halved * LINE / 2
}

/// Encodes `payload` into the front of `out`, which has at least [`encoded_bytes`] bytes; returns the length.
pub fn encode(payload: &[u8], out: &mut [u8]) -> usize {
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
///
/// # Errors
/// `stored` is not an encoding of a payload of that length.
pub fn decode(stored: &[u8], payload: &mut [u8]) -> io::Result<()> {
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
    use crate::base::rng::{Purpose, Stream};

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
                let mut out = vec![0xaa; encoded_bytes_max(len)];
                let stored = encode(&payload, &mut out);
                assert_eq!(stored, table_bytes(len) + len - pattern * LINE / 2);
                let mut back = vec![0x55; len];
                assert!(decode(&out[..stored], &mut back).is_ok());
                assert!(back == payload);
            }
        }
    }
}
