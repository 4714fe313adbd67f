//! Values of keys that are no single word or number: byte sizes, colours, which way is up, where pages live.
//!
//! Invariant: a value that is written reads back the same.

use crate::base::units::parse_bytes;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Reading and writing in config files of a type that is written as text.
macro_rules! as_text {
    ($type:ty) => {
        impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
                s.collect_str(self)
            }
        }

        impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
                let text = <String as serde::Deserialize>::deserialize(d)?;
                text.parse().map_err(serde::de::Error::custom)
            }
        }
    };
}
pub(super) use as_text;

/// A number of bytes, written as `4GiB`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteSize(pub u64);

impl std::str::FromStr for ByteSize {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        parse_bytes(text).map(ByteSize)
    }
}

impl std::fmt::Display for ByteSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let units = [(1u64 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"), (1, "B")];
        // Zero needs no unit.
        let unit = units.iter().find(|(unit, _)| self.0 > 0 && self.0.is_multiple_of(*unit));
        match unit {
            Some((unit, name)) => write!(f, "{}{name}", self.0 / unit),
            None => f.write_str("0"),
        }
    }
}

as_text!(ByteSize);

/// A colour: three numbers in 0..1, in the file `[0.0, 0.0, 0.0]`, on the command line `0,0,0`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rgb(pub [f64; 3]);

impl std::str::FromStr for Rgb {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("'{text}' is not a colour; write R,G,B with numbers in 0..1");
        three_numbers(text).map(Rgb).ok_or_else(unknown)
    }
}

/// The numbers of `1,2,3`.
fn three_numbers(text: &str) -> Option<[f64; 3]> {
    let values: Option<Vec<f64>> = text.split(',').map(|v| v.trim().parse().ok()).collect();
    values?.try_into().ok()
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
        let is_direction = |v: &[f64; 3]| v.iter().all(|x| x.is_finite()) && *v != [0.0; 3];
        match text {
            "auto" => Ok(Up::Auto),
            "keep" => Ok(Up::Keep),
            _ => three_numbers(text)
                .filter(is_direction)
                .map(Up::Along)
                .ok_or_else(|| format!("'{text}' is not a direction; write auto, keep or X,Y,Z, such as 0,0,1")),
        }
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

as_text!(Up);

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
