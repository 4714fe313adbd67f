//! Values of keys that are no single word or number: byte sizes and colours.
//!
//! Invariant: a value that is written reads back the same.

use crate::base::units::parse_bytes;
use serde::{Deserialize, Serialize};

/// A number of bytes, written as `4GiB`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteSize(pub u64);

impl std::str::FromStr for ByteSize {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        parse_bytes(text).map(ByteSize)
    }
}

impl Serialize for ByteSize {
    fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        let units = [(1u64 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")];
        let text = units
            .iter()
            .find(|(unit, _)| self.0 > 0 && self.0.is_multiple_of(*unit))
            .map_or_else(|| self.0.to_string(), |(unit, name)| format!("{}{name}", self.0 / unit));
        s.serialize_str(&text)
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: serde::Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        let text = String::deserialize(d)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// A colour: three numbers in 0..1, in the file `[0.0, 0.0, 0.0]`, on the command line `0,0,0`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rgb(pub [f64; 3]);

impl std::str::FromStr for Rgb {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let values: Result<Vec<f64>, _> = text.split(',').map(|v| v.trim().parse::<f64>()).collect();
        match values.as_deref() {
            Ok(&[r, g, b]) => Ok(Rgb([r, g, b])),
            _ => Err(format!("'{text}' is not a colour; write R,G,B with numbers in 0..1")),
        }
    }
}
