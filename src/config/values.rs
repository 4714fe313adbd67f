//! Values of keys: byte sizes, colours, which way is up, where pages live, and words that stand for one of a few choices. The config file
//! or the command line parses a value once; later code never compares text.
//!
//! Invariants: 1. a value that is written reads back the same; 2. file and flag refuse an unknown word with the same message; 3. this file
//! holds no defaults and no meanings; 4. [`choices`] lists every key of words: tests of words go through the list, so that a new key or word
//! is named here alone.

use crate::base::simd::SimdPath;
use crate::base::units::parse_bytes;
use crate::densify::growth::Quality;
use crate::densify::long_axis::GrowthScore;
use crate::densify::strategy::StrategyName;
use crate::exchange::format::Exports;
use crate::exchange::meta::ExportFrame;
use crate::gpu::DeviceChoice;
use crate::optim::method::{Method, OptimizerPlace};
use crate::optim::moments::Moments;
use crate::page::engine::open::IoEngine;
use crate::page::format::codec::Codec;
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::prefetch::Transfers;
use crate::photos::exposure::AppearanceMode;
use crate::render::SsimPadding;
use crate::render::color_correct::ColorCorrect;
use crate::render::metrics::SsimVariant;
use crate::schedule::order::Order;
use clap::builder::{PossibleValue, TypedValueParser, ValueParserFactory};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::borrow::Cow;
use std::marker::PhantomData;
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
pub struct RgbColor(pub [f64; 3]);

impl std::str::FromStr for RgbColor {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("'{text}' is not a colour; write R,G,B with numbers in 0..1");
        three_numbers(text).map(RgbColor).ok_or_else(unknown)
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

/// A key's value that is written as a word.
pub trait Choice: Clone + Send + Sync + 'static {
    /// The key, in kebab-case.
    const KEY: &'static str;
    /// The words that a user may write, for help and errors; `groups:N` stands for any N.
    const WORDS: &'static [&'static str];

    /// The value of a word; `None` for a word that a user may not write.
    fn from_word(word: &str) -> Option<Self>;

    fn word(&self) -> Cow<'static, str>;
}

/// The value of a word. Errors: the word is unknown; the error names the key and its words.
pub fn parse_choice<T: Choice>(word: &str) -> Result<T, String> {
    T::from_word(word).ok_or_else(|| unknown::<T>(T::KEY, word))
}

fn unknown<T: Choice>(flag: &str, word: &str) -> String {
    let (last, first) = T::WORDS.split_last().unwrap_or((&"", &[]));
    let key = if flag.is_empty() { String::from("word") } else { format!("--{flag}") };
    format!("unknown {key} '{word}': use {} or {last}", first.join(", "))
}

/// An optional choice. `None` is written `auto`, or `off` for a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chosen<T>(pub Option<T>);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogFormat {
    /// metrics.jsonl alone.
    Json,
    /// TensorBoard event files as well.
    Tensorboard,
}

/// The value of `--schedule`: what keys become that are not given ([`super::new_run`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Schedule {
    /// Shares of the steps.
    RunLength,
    /// The values for 30,000 steps, whatever the number of steps.
    Classic,
}

impl Chosen<bool> {
    pub const ON: Chosen<bool> = Chosen(Some(true));

    pub fn is_on(self) -> bool {
        self == Chosen::ON
    }
}

/// The keys of what a run may switch on by itself.
const REMEDIES: [&str; 6] =
    ["poor-points", "sweep-points", "robust-views", "robust-pixels", "refine-poses", "export-clean"];

/// Every key whose value is a word, with the words that a user may write.
pub fn choices() -> impl Iterator<Item = (&'static str, &'static [&'static str])> {
    let remedies = REMEDIES.map(|key| (key, <Chosen<bool> as Choice>::WORDS));
    CHOICES.iter().chain(OPEN_CHOICES).chain(&[(Exports::KEY, Exports::WORDS)]).copied().chain(remedies)
}

/// Implements [`Choice`], reading and writing for enums whose values have one word each, and lists them.
macro_rules! choices {
    ($($key:literal: $type:ident { $($value:ident = $word:literal),+ })+) => { $(
        impl Choice for $type {
            const KEY: &'static str = $key;
            const WORDS: &'static [&'static str] = &[$($word),+];

            fn from_word(word: &str) -> Option<$type> {
                match word { $($word => Some($type::$value),)+ _ => None }
            }

            fn word(&self) -> Cow<'static, str> {
                let word = match self { $($type::$value => $word,)+ };
                Cow::Borrowed(word)
            }
        }

        reading_and_writing!($type);
    )+

        const CHOICES: &[(&str, &[&str])] = &[$(($key, <$type as Choice>::WORDS)),+];

        #[cfg(test)]
        fn check_choices() {
            $(tests::check::<$type>();)+
        }
    };
}

/// Reading and writing in config files, and parsing of flags, of a type that implements [`Choice`].
macro_rules! reading_and_writing {
    ($type:ty) => {
        impl Serialize for $type {
            fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
                s.serialize_str(&self.word())
            }
        }

        impl<'de> Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(d: D) -> Result<$type, D::Error> {
                deserialize_choice(d)
            }
        }

        impl ValueParserFactory for $type {
            type Parser = ChoiceParser<$type>;

            fn value_parser() -> ChoiceParser<$type> {
                ChoiceParser(PhantomData)
            }
        }
    };
}

choices! {
    "io": IoEngine { Auto = "auto", Uring = "uring", Mmap = "mmap", Pread = "pread" }
    "evict": EvictPolicy { FarthestNextUse = "belady", LeastRecentlyUsed = "lru" }
    "transfers": Transfers { Overlap = "overlap", Ahead = "ahead", Demand = "demand" }
    "ssim-padding": SsimPadding { Valid = "valid", Same = "same" }
    "optimizer": Method { Deferred = "deferred", Dense = "dense", Sparse = "sparse" }
    "moments": Moments { F32 = "f32", Bf16 = "bf16" }
    "strategy": StrategyName { Default = "default", LongAxis = "long-axis", Mcmc = "mcmc", None = "none" }
    "schedule": Schedule { RunLength = "run-length", Classic = "classic" }
    "quality": Quality { Draft = "draft", Normal = "normal", Archive = "archive" }
    "growth-score": GrowthScore { Gradient = "gradient", Error = "error", Mixed = "mixed" }
    "log": LogFormat { Json = "json", Tensorboard = "tensorboard" }
    "ssim-variant": SsimVariant { Same = "same", Valid = "valid", Reflect = "reflect" }
    "export-frame": ExportFrame { Dataset = "dataset", Local = "local" }
}

/// A list of words: `spz,sog`.
impl Choice for Exports {
    const KEY: &'static str = "export";
    const WORDS: &'static [&'static str] = &["ply", "spz", "sog"];

    fn from_word(word: &str) -> Option<Exports> {
        word.split(',').map(str::trim).try_fold(Exports::default(), |exports, format| match format {
            "ply" => Some(exports),
            "spz" => Some(Exports { spz: true, ..exports }),
            "sog" => Some(Exports { sog: true, ..exports }),
            _ => None,
        })
    }

    fn word(&self) -> Cow<'static, str> {
        Cow::Borrowed(match (self.spz, self.sog) {
            (false, false) => "ply",
            (true, false) => "spz",
            (false, true) => "sog",
            (true, true) => "spz,sog",
        })
    }
}

reading_and_writing!(Exports);

/// Implements [`Choice`] for optional choices, with their word for `None`, and lists them.
macro_rules! open_choices {
    ($($key:literal: $type:ident, $none:literal in $words:expr, $from:expr, $to:expr;)+) => { $(
        impl Choice for Chosen<$type> {
            const KEY: &'static str = $key;
            const WORDS: &'static [&'static str] = &$words;

            fn from_word(word: &str) -> Option<Self> {
                if word == $none { Some(Chosen(None)) } else { $from(word).map(|value| Chosen(Some(value))) }
            }

            fn word(&self) -> Cow<'static, str> {
                self.0.map_or(Cow::Borrowed($none), |value| Cow::Owned($to(value)))
            }
        }

        reading_and_writing!(Chosen<$type>);
    )+

        const OPEN_CHOICES: &[(&str, &[&str])] = &[$(($key, <Chosen<$type> as Choice>::WORDS)),+];

        #[cfg(test)]
        fn check_open_choices() {
            $(tests::check::<Chosen<$type>>();)+
        }
    };
}

/// The words for codecs, and `auto`.
const CODECS: [&str; Codec::WORDS.len() + 1] = {
    let mut words = ["auto"; Codec::WORDS.len() + 1];
    words.split_at_mut(Codec::WORDS.len()).0.copy_from_slice(&Codec::WORDS);
    words
};

open_choices! {
    "view-order": Order, "auto" in ["auto", "shuffle", "groups:N", "tour"], parsed, |order: Order| order.to_string();
    "spill-codec": Codec, "auto" in CODECS, parsed, |codec: Codec| codec.to_string();
    "simd": SimdPath, "auto" in ["auto", "avx512", "avx2", "baseline"], SimdPath::from_name, |path: SimdPath| path.name().to_string();
    "optimizer-on": OptimizerPlace, "auto" in ["auto", "device", "host"], OptimizerPlace::from_name, |place: OptimizerPlace| place.name().to_string();
    "appearance": AppearanceMode, "auto" in ["auto", "off", "exposure", "if-needed", "full"], AppearanceMode::from_name, |mode: AppearanceMode| mode.name().to_string();
    "color-correct": ColorCorrect, "off" in ["off", "affine", "quadratic"], ColorCorrect::from_name, |fit: ColorCorrect| fit.name().to_string();
}

/// What a run may switch on by itself. Several keys have values of this type, so a message about a file names none: it shows the
/// line.
impl Choice for Chosen<bool> {
    const KEY: &'static str = "";
    const WORDS: &'static [&'static str] = &["auto", "on", "off"];

    fn from_word(word: &str) -> Option<Self> {
        match word {
            "auto" => Some(Chosen(None)),
            "on" | "true" => Some(Chosen(Some(true))),
            "off" | "false" => Some(Chosen(Some(false))),
            _ => None,
        }
    }

    fn word(&self) -> Cow<'static, str> {
        Cow::Borrowed(self.0.map_or("auto", |is_on| if is_on { "on" } else { "off" }))
    }
}

reading_and_writing!(Chosen<bool>);

fn parsed<T: std::str::FromStr>(word: &str) -> Option<T> {
    word.parse().ok()
}

fn deserialize_choice<'de, T: Choice, D: Deserializer<'de>>(d: D) -> Result<T, D::Error> {
    /// A word, a list of words as TOML writes it, or a switch.
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected a word")]
    enum Words {
        One(String),
        List(Vec<String>),
        Switch(bool),
    }
    let word = match Words::deserialize(d)? {
        Words::One(word) => word,
        Words::List(words) => words.join(","),
        Words::Switch(is_on) => is_on.to_string(),
    };
    parse_choice(&word).map_err(serde::de::Error::custom)
}

/// Parses a flag whose value is a choice: help lists the words.
#[derive(Clone)]
pub struct ChoiceParser<T>(PhantomData<T>);

impl<T: Choice> TypedValueParser for ChoiceParser<T> {
    type Value = T;

    fn parse_ref(
        &self,
        command: &clap::Command,
        flag: Option<&clap::Arg>,
        value: &std::ffi::OsStr,
    ) -> Result<T, clap::Error> {
        let word = value.to_string_lossy();
        T::from_word(&word).ok_or_else(|| {
            let flag = flag.and_then(clap::Arg::get_long).unwrap_or(T::KEY);
            command.clone().error(clap::error::ErrorKind::InvalidValue, unknown::<T>(flag, &word))
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(T::WORDS.iter().map(PossibleValue::new)))
    }
}

/// The renderer: the value of `--device`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Device {
    Cpu,
    /// The chosen GPU; the CPU if [`DeviceChoice::Auto`] finds none.
    Gpu(DeviceChoice),
}

impl std::str::FromStr for Device {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "cpu" => Ok(Device::Cpu),
            "auto" => Ok(Device::Gpu(DeviceChoice::Auto)),
            "gpu" => Ok(Device::Gpu(DeviceChoice::Gpu)),
            name if name.trim().is_empty() => Err(format!(
                "unknown --device '{name}': use auto, gpu, cpu, or a number (#2) or a part of a name from --list-devices"
            )),
            name => Ok(Device::Gpu(DeviceChoice::Named(name.to_string()))),
        }
    }
}

impl std::fmt::Display for Device {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Device::Cpu => "cpu",
            Device::Gpu(DeviceChoice::Auto) => "auto",
            Device::Gpu(DeviceChoice::Gpu) => "gpu",
            Device::Gpu(DeviceChoice::Named(name)) => name,
        })
    }
}

as_text!(Device);

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::config::file::{KEYS, TrainConfig};

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

    pub(super) fn check<T: Choice + PartialEq + std::fmt::Debug>() {
        assert!(KEYS.iter().any(|key| key.name() == T::KEY), "{} is no key", T::KEY);
        for word in T::WORDS {
            let word = word.replace(":N", ":3").replace(":LEVEL", ":19");
            assert_eq!(parse_choice::<T>(&word).unwrap().word(), word);
            let config = TrainConfig::parse(&format!("{} = \"{word}\"", T::KEY)).unwrap();
            assert!(toml::to_string(&config).unwrap().contains(&format!("{} = \"{word}\"", T::KEY)));
        }
        let problem = parse_choice::<T>("x y").unwrap_err();
        assert!(problem.starts_with(&format!("unknown --{} 'x y': use ", T::KEY)), "{problem}");
        let of_file = TrainConfig::parse(&format!("{} = \"x y\"", T::KEY)).unwrap_err();
        assert!(of_file.contains(&problem), "{of_file}");
    }

    #[test]
    fn every_word_is_written_as_it_is_read() {
        check_choices();
        check_open_choices();
        check::<Exports>();
        for key in REMEDIES {
            for (value, word) in [("true", "on"), ("false", "off"), ("\"on\"", "on"), ("\"auto\"", "auto")] {
                let config = TrainConfig::parse(&format!("{key} = {value}")).unwrap();
                assert!(toml::to_string(&config).unwrap().contains(&format!("{key} = \"{word}\"")), "{key} {value}");
            }
        }
        for list in ["\"sog, spz\"", "[\"spz\", \"sog\", \"ply\"]"] {
            let config = TrainConfig::parse(&format!("export = {list}")).unwrap();
            assert_eq!((config.export.word().as_ref(), config.export), ("spz,sog", Exports { spz: true, sog: true }));
        }
        let problem = parse_choice::<Transfers>("x").unwrap_err();
        assert_eq!(problem, "unknown --transfers 'x': use overlap, ahead or demand");
    }

    #[test]
    fn a_device_is_written_as_it_is_read() {
        for text in ["auto", "gpu", "cpu", "RTX 4070"] {
            assert_eq!(text.parse::<Device>().unwrap().to_string(), text);
        }
        assert!(" ".parse::<Device>().is_err());
    }
}
