//! Damaged inputs from good ones: bits, numbers that programs trip over, pieces moved, cut, doubled and mixed.

use gsscale::base::rng::{Purpose, Stream};

/// Longest input, bytes.
const LONGEST: usize = 1 << 17;
/// Words of text formats that number readers trip over.
const NUMBERS: &[&str] = &[
    "nan",
    "-inf",
    "1e999",
    "-1e38",
    "4000000000",
    "18446744073709551615",
    "-9223372036854775808",
    "0",
    "-1",
    "1e-320",
    "0.0000000001",
    "1e15",
    "",
    "0x7f",
    "+",
];

pub struct Draws(Stream);

impl Draws {
    pub fn of(target: &str, seed: u64, case: u64) -> Draws {
        let name = target.bytes().fold(0u64, |hash, byte| hash.wrapping_mul(31).wrapping_add(u64::from(byte)));
        Draws(Stream::new(seed, Purpose::Test, name, case))
    }

    fn below(&mut self, bound: usize) -> usize {
        if bound == 0 { 0 } else { self.0.below(bound as u64) as usize }
    }

    fn byte(&mut self) -> u8 {
        self.0.next_u64() as u8
    }

    /// Start and end of a random piece of an input of `len` bytes.
    fn piece(&mut self, len: usize) -> (usize, usize) {
        let start = self.below(len + 1);
        let longest = if self.below(2) == 0 { 16 } else { len };
        (start, start + self.below((len - start).min(longest) + 1))
    }

    /// One of `seeds`, damaged at one to eight places; occasionally random bytes.
    pub fn input(&mut self, seeds: &[Vec<u8>], words: &[&str]) -> Vec<u8> {
        let mut input = seeds[self.below(seeds.len())].clone();
        if self.below(50) == 0 {
            let len = self.below(600);
            input = (0..len).map(|_| self.byte()).collect();
        }
        let more = self.below(2) * self.below(8);
        for _ in 0..1 + more {
            self.damage(&mut input, seeds, words);
            input.truncate(LONGEST);
        }
        input
    }

    fn damage(&mut self, input: &mut Vec<u8>, seeds: &[Vec<u8>], words: &[&str]) {
        let len = input.len();
        match self.below(13) {
            0 | 1 if len > 0 => {
                let at = self.below(len);
                input[at] ^= 1 << self.below(8);
            }
            2 if len > 0 => {
                let at = self.below(len);
                input[at] = self.byte();
            }
            3 | 4 => self.number(input),
            5 => {
                let (from, to) = self.piece(len);
                input.drain(from..to);
            }
            6 => {
                let (from, to) = self.piece(len);
                let piece = input[from..to].to_vec();
                let at = self.below(len + 1);
                input.splice(at..at, piece);
            }
            7 => {
                let at = self.below(len + 1);
                let longest = if self.below(4) == 0 { 3000 } else { 20 };
                let count = self.below(longest);
                let byte = self.byte();
                let random = self.below(2) == 0;
                let piece: Vec<u8> = (0..count).map(|_| if random { self.byte() } else { byte }).collect();
                input.splice(at..at, piece);
            }
            8 => input.truncate(self.below(len + 1)),
            9 => {
                let other = &seeds[self.below(seeds.len())];
                input.truncate(self.below(len + 1));
                input.extend_from_slice(&other[self.below(other.len() + 1)..]);
            }
            10 if !words.is_empty() => {
                let (at, to) = self.piece(len);
                let to = if self.below(2) == 0 { at } else { to };
                input.splice(at..to, words[self.below(words.len())].bytes());
            }
            11 => self.text_number(input),
            _ => {
                let (from, to) = self.piece(len);
                let at = self.below(len);
                let piece = input[from..to].to_vec();
                let end = len.min(at + piece.len());
                input[at..end].copy_from_slice(&piece[..end - at]);
            }
        }
    }

    /// Writes a boundary value of 1 to 8 bytes.
    fn number(&mut self, input: &mut [u8]) {
        let len = input.len() as u64;
        let integers = [0, 1, u64::MAX, u64::MAX >> 1, 1 << 31, u64::from(u32::MAX), len, len + 1, 1 << 40, 1 << 63];
        let floats = [f64::NAN, f64::INFINITY, -0.0, 1e38, 1e300, 1e-300, -1.0];
        let value = match self.below(3) {
            0 => floats[self.below(floats.len())].to_bits(),
            1 => u64::from((floats[self.below(floats.len())] as f32).to_bits()),
            _ => integers[self.below(integers.len())],
        };
        let bytes = [1, 2, 4, 8][self.below(4)];
        if input.len() >= bytes {
            let at = self.below(input.len() - bytes + 1);
            input[at..at + bytes].copy_from_slice(&value.to_le_bytes()[..bytes]);
        }
    }

    /// Replaces a number of a text.
    fn text_number(&mut self, input: &mut Vec<u8>) {
        let is_digit = |byte: u8| byte.is_ascii_digit() || byte == b'.' || byte == b'-';
        let at = self.below(input.len());
        let Some(from) = input.iter().skip(at).position(|&b| is_digit(b)).map(|found| at + found) else { return };
        let to = input[from..].iter().position(|&b| !is_digit(b)).map_or(input.len(), |end| from + end);
        let word = NUMBERS[self.below(NUMBERS.len())];
        input.splice(from..to, word.bytes());
    }
}
