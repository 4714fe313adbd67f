//! Values of keys that are no single word or number: byte sizes, colours, which way is up, where pages live.
//!
//! Invariant: a value that is written reads back the same.

use crate::base::units::parse_bytes;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

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
            .map(|(unit, name)| format!("{}{name}", self.0 / unit));
        // Zero needs no unit.
        let text = text.unwrap_or_else(|| if self.0 == 0 { "0".to_string() } else { format!("{}B", self.0) });
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

/// Which way is up in results: the value of `--up`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Up {
    /// As the cameras and the points say.
    Auto,
    /// Results keep the axes of the dataset.
    Keep,
    /// This direction of the dataset; finite and not zero.
    Along([f64; 3]),
}

impl std::str::FromStr for Up {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("'{text}' is not a direction; write auto, keep or X,Y,Z, such as 0,0,1");
        match text {
            "auto" => return Ok(Up::Auto),
            "keep" => return Ok(Up::Keep),
            _ => {}
        }
        let values: Result<Vec<f64>, _> = text.split(',').map(|v| v.trim().parse::<f64>()).collect();
        let Ok(&[x, y, z]) = values.as_deref() else { return Err(unknown()) };
        let is_direction = [x, y, z].iter().all(|v| v.is_finite()) && [x, y, z] != [0.0; 3];
        if is_direction { Ok(Up::Along([x, y, z])) } else { Err(unknown()) }
    }
}

impl std::fmt::Display for Up {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Up::Auto => f.write_str("auto"),
            Up::Keep => f.write_str("keep"),
            // `{}` prints the shortest decimal that reads back as the same f64.
            Up::Along([x, y, z]) => write!(f, "{x},{y},{z}"),
        }
    }
}

impl Serialize for Up {
    fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Up {
    fn deserialize<D: serde::Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        String::deserialize(d)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Where the pages of a run live, by `--spill-dir` and `--frames`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Residence<'a> {
    /// All pages in memory; the run commits to its output folder.
    Memory,
    /// In `--frames` frames over a store in memory, without commits; for comparisons.
    Frames,
    /// In frames over this spill directory, which is also the checkpoint of the run.
    SpillDir(&'a Path),
}

impl<'a> Residence<'a> {
    /// The spill directory, if any.
    pub fn spill_dir(self) -> Option<&'a Path> {
        match self {
            Residence::SpillDir(folder) => Some(folder),
            Residence::Memory | Residence::Frames => None,
        }
    }

    /// The folder of the checkpoint of a run with the output folder `out`.
    pub fn checkpoint_folder(self, out: &Path) -> PathBuf {
        self.spill_dir().map_or_else(|| checkpoint_folder(out), Path::to_path_buf)
    }
}

/// The folder of the checkpoint of a run without a spill directory.
pub fn checkpoint_folder(out: &Path) -> PathBuf {
    out.join("checkpoint")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_is_written_as_it_is_read() {
        for up in [Up::Auto, Up::Keep, Up::Along([0.1 + 0.2, -1e-20, 3e9])] {
            assert_eq!(up.to_string().parse(), Ok(up));
        }
        assert_eq!(" 0, 0 ,1".parse(), Ok(Up::Along([0.0, 0.0, 1.0])));
        for wrong in ["", "up", "0,0,0", "1,2", "1,2,3,4", "nan,0,1", "inf,0,0"] {
            assert!(wrong.parse::<Up>().is_err_and(|e| e.contains("X,Y,Z")), "{wrong}");
        }
    }
}
