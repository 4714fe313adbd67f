//! JSON with numbers that are none, as Python and C++ write them (`NaN`, `-Infinity`, `nan(ind)`): each becomes a string, so that
//! the file can be parsed and the reader of the value decides.
//!
//! Invariant: everything else passes byte by byte; memory is a constant.

use crate::base::text::TextReader;
use serde::de::{Deserialize, Deserializer, Error, Visitor};
use std::fmt::Formatter;
use std::io::Read;

/// Longest word that may stand for no number.
const WORD_BYTES: usize = 24;

/// Reads the text of a JSON file.
#[derive(Debug)]
pub(super) struct LooseJson<R> {
    text: TextReader<R>,
    chunk: Vec<u8>,
    out: Vec<u8>,
    passed: usize,
    /// The word outside of strings that is being read.
    word: Vec<u8>,
    in_string: bool,
    escaped: bool,
    ended: bool,
}

impl<R: Read> LooseJson<R> {
    pub(super) fn new(source: R) -> LooseJson<R> {
        let (text, chunk) = (TextReader::new(source), vec![0; 1 << 16]);
        let (out, word) = (Vec::new(), Vec::new());
        LooseJson { text, chunk, out, passed: 0, word, in_string: false, escaped: false, ended: false }
    }

    fn end_word(&mut self) {
        let quote: &[u8] = if std::str::from_utf8(&self.word).is_ok_and(is_no_number) { b"\"" } else { b"" };
        [quote, &self.word, quote].into_iter().for_each(|part| self.out.extend_from_slice(part));
        self.word.clear();
    }

    fn take(&mut self, byte: u8) {
        if self.in_string {
            self.out.push(byte);
            self.in_string = self.escaped || byte != b'"';
            self.escaped = !self.escaped && byte == b'\\';
        } else if byte.is_ascii_alphanumeric() || b"+-.#()".contains(&byte) {
            self.word.push(byte);
            if self.word.len() > WORD_BYTES {
                self.end_word();
            }
        } else {
            if !self.word.is_empty() {
                self.end_word();
            }
            self.out.push(byte);
            self.in_string = byte == b'"';
        }
    }
}

impl<R: Read> Read for LooseJson<R> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        while self.passed == self.out.len() && !self.ended {
            self.passed = 0;
            self.out.clear();
            let mut chunk = std::mem::take(&mut self.chunk);
            let read = self.text.read(&mut chunk);
            let count = *read.as_ref().unwrap_or(&0);
            chunk[..count].iter().for_each(|&byte| self.take(byte));
            self.chunk = chunk;
            self.ended = read? == 0;
            if self.ended {
                self.end_word();
            }
        }
        let count = (&self.out[self.passed..]).read(to)?;
        self.passed += count;
        Ok(count)
    }
}

/// Whether a word stands in the place of a number for one that is none.
pub(super) fn is_no_number(word: &str) -> bool {
    let word = word.trim_start_matches(['+', '-']).to_ascii_lowercase();
    let word = word.split_once('(').map_or(word.as_str(), |(word, _)| word);
    ["nan", "inf", "infinity", "1.#qnan", "1.#ind", "1.#inf"].contains(&word)
}

/// A number; NaN where the file has none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Number(pub f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Number, D::Error> {
        struct Any;
        impl Visitor<'_> for Any {
            type Value = f64;
            fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
                f.write_str("a number")
            }
            fn visit_f64<E>(self, x: f64) -> Result<f64, E> {
                Ok(x)
            }
            fn visit_i64<E>(self, x: i64) -> Result<f64, E> {
                Ok(x as f64)
            }
            fn visit_u64<E>(self, x: u64) -> Result<f64, E> {
                Ok(x as f64)
            }
            fn visit_unit<E>(self) -> Result<f64, E> {
                Ok(f64::NAN)
            }
            fn visit_str<E: Error>(self, word: &str) -> Result<f64, E> {
                if is_no_number(word) { Ok(f64::NAN) } else { Err(E::custom(format!("{word:?} is not a number"))) }
            }
        }
        source.deserialize_any(Any).map(Number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_that_are_no_numbers_become_strings_outside_of_strings() {
        let text = r#"{"a NaN \" Infinity": [NaN,-Infinity, 1e-5,nan(ind) ,null,true], "b": -1.#IND, "c":"NaN\\"}"#;
        let mut loose = String::new();
        LooseJson::new(text.as_bytes()).read_to_string(&mut loose).unwrap();
        let want =
            r#"{"a NaN \" Infinity": ["NaN","-Infinity", 1e-5,"nan(ind)" ,null,true], "b": "-1.#IND", "c":"NaN\\"}"#;
        assert_eq!(loose, want);
        let numbers: Vec<Number> = serde_json::from_str(r#"[1, -2, 0.5, null, "NaN"]"#).unwrap();
        assert!(numbers[3].0.is_nan() && numbers[4].0.is_nan() && numbers[1].0 == -2.0);
        assert!(serde_json::from_str::<Number>("\"x\"").is_err());
        for plain in ["", "NaN", "{\"x\": 1}"] {
            let mut out = String::new();
            LooseJson::new(plain.as_bytes()).read_to_string(&mut out).unwrap();
            assert_eq!(out.trim_matches('"'), plain);
        }
    }
}
