//! JSON that remembers the place of every value, so that errors name the file, the frame and the key.
//!
//! A file is parsed three times: for its syntax, for the keys of its top level, and frame by frame. Of an object only
//! the known keys are kept ([`KNOWN`]), and of a key's value the first [`MOST_VALUES`] values: more than any key needs,
//! so that a value that is too long can be recognised.
//!
//! Invariant: besides the file's bytes and the caller's data, memory holds one frame, the top level and its lists of
//! names, whereas a tree of the whole file could take a value per character.

use crate::base::error::{InputError, InputResult};
use crate::dataset::paths::clean_name;
use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::fmt::Formatter;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest file read, bytes; a frame takes about 1 KiB.
const MAX_BYTES: u64 = 128 << 20;
/// Most values kept of one key; a matrix of 4 x 4 has 21, including its rows.
const MOST_VALUES: usize = 64;

/// Remedy for a value of the wrong kind.
pub(super) const FIX_KEY: &str = "correct the key in the JSON or write the file again";
/// Remedy for a name that leaves the folder.
pub(super) const STAY_INSIDE: &str = "paths must be relative to the JSON and stay in its folder: move the JSON to a folder \
                                      above the files that it names and write the paths from there";

/// Known keys of the top level and of frames, apart from `frames` and the lists of names.
const KNOWN: [&str; 25] = [
    "applied_scale",
    "camera_angle_x",
    "camera_angle_y",
    "camera_model",
    "cx",
    "cy",
    "file_path",
    "fl_x",
    "fl_y",
    "frame_index",
    "h",
    "is_fisheye",
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "mask_path",
    "p1",
    "p2",
    "ply_file_path",
    "rot_mat",
    "transform_matrix",
    "w",
];

/// nerfstudio's lists of file names.
pub(super) const LISTS: [&str; 3] = ["train_filenames", "val_filenames", "test_filenames"];

/// A list of file names.
#[derive(Debug, Default)]
pub(super) enum Names {
    #[default]
    Absent,
    /// The cleaned names.
    Listed(BTreeSet<String>),
    /// Unusable: the problem and the remedy.
    Bad(String, &'static str),
}

/// The value of `frames`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Frames {
    Absent,
    NoArray,
    Array(usize),
}

/// A file whose top level is an object.
#[derive(Debug)]
pub(super) struct JsonFile {
    path: PathBuf,
    bytes: Vec<u8>,
    top: Map<String, Value>,
    frames: Frames,
    /// In the order of [`LISTS`].
    names: [Names; 3],
}

/// Reads a file whose top level is an object. Nesting deeper than serde_json's limit (128) is an error.
pub(super) fn load(path: &Path) -> InputResult<JsonFile> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
    let length = file.metadata().map_err(|e| InputError::io(path, "reading", &e))?.len();
    // Reserves room for the whole file and the check for its end, so that reading never reallocates.
    let mut bytes = Vec::with_capacity(length.min(MAX_BYTES) as usize + 64);
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(|e| InputError::io(path, "reading", &e))?;
    if bytes.len() as u64 > MAX_BYTES {
        let problem = format!("the file is larger than {} MiB", MAX_BYTES >> 20);
        return Err(InputError::new(path, problem, "split the scene into several, or use a COLMAP model"));
    }
    serde_json::from_slice::<Skipped>(&bytes).map_err(|e| invalid(path, &e))?;
    if bytes.iter().find(|b| !b.is_ascii_whitespace()) != Some(&b'{') {
        return Err(InputError::new(path, "the top level is not an object", "give a transforms.json with 'frames'"));
    }
    let mut json = JsonFile {
        path: path.to_path_buf(),
        bytes,
        top: Map::new(),
        frames: Frames::Absent,
        names: Default::default(),
    };
    let (mut top, mut frames, mut names) = (Map::new(), Vec::new(), <[Names; 3]>::default());
    json.read_with(TopKeys { top: &mut top, frames: &mut frames, names: &mut names })?;
    if frames.len() > 1 {
        let problem = format!("the key appears {} times", frames.len());
        return Err(InputError::new(path, problem, "write the file again with its frames in one list").at("frames"));
    }
    (json.top, json.names, json.frames) = (top, names, frames.pop().unwrap_or(Frames::Absent));
    Ok(json)
}

fn invalid(path: &Path, e: &serde_json::Error) -> InputError {
    InputError::new(path, format!("not valid JSON: {e}"), "write the file again; NaN and Infinity are not JSON")
        .at(format!("line {} column {}", e.line(), e.column()))
}

impl JsonFile {
    /// The top-level object.
    pub fn top(&self) -> Node<'_> {
        Node { file: &self.path, map: &self.top, frame: None }
    }

    /// The names under [`LISTS`]`[list]`.
    pub fn names(&self, list: usize) -> &Names {
        &self.names[list]
    }

    /// Number of frames in the file.
    ///
    /// # Errors
    /// The list of frames is missing.
    pub fn frame_count(&self) -> InputResult<usize> {
        match self.frames {
            Frames::Array(count) => Ok(count),
            Frames::Absent => Err(self.top().error("frames", "the key is missing", FIX_KEY)),
            Frames::NoArray => Err(self.top().error("frames", "not an array", FIX_KEY)),
        }
    }

    /// Passes the frames to `take` one by one, each with its index.
    ///
    /// # Errors
    /// A frame is not an object, or `take` refused it.
    pub fn for_each_frame(&self, take: &mut dyn FnMut(Node<'_>) -> InputResult<()>) -> InputResult<()> {
        let mut refused = None;
        let mut index = 0;
        let done = self.read_with(FrameList {
            take: &mut |map| {
                let taken = match &map {
                    Some(map) => take(Node { file: &self.path, map, frame: Some(index) }),
                    None => Err(self.top().error(&format!("frames[{index}]"), "not an object", FIX_KEY)),
                };
                index += 1;
                taken.map_err(|error| refused = Some(error)).is_ok()
            },
        });
        match refused {
            Some(error) => Err(error),
            None => done,
        }
    }

    fn read_with<'de>(&'de self, seed: impl DeserializeSeed<'de>) -> InputResult<()> {
        let mut source = serde_json::Deserializer::from_slice(&self.bytes);
        seed.deserialize(&mut source).map(|_| ()).map_err(|e| invalid(&self.path, &e))
    }
}

/// Visitor methods that treat all scalars alike, except `null`.
macro_rules! scalars {
    ($value:expr, null: $null:expr) => {
        fn visit_bool<E>(self, _: bool) -> Result<Self::Value, E> {
            Ok($value)
        }
        fn visit_i64<E>(self, _: i64) -> Result<Self::Value, E> {
            Ok($value)
        }
        fn visit_u64<E>(self, _: u64) -> Result<Self::Value, E> {
            Ok($value)
        }
        fn visit_f64<E>(self, _: f64) -> Result<Self::Value, E> {
            Ok($value)
        }
        fn visit_str<E>(self, _: &str) -> Result<Self::Value, E> {
            Ok($value)
        }
        fn visit_unit<E>(self) -> Result<Self::Value, E> {
            Ok($null)
        }
    };
}

/// A value that is parsed for its syntax only; of an array, its length.
struct Skipped {
    kind: Frames,
}

impl<'de> Deserialize<'de> for Skipped {
    // Not serde's ignored value: for that serde_json checks neither the range of numbers nor the depth.
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Skipped;
            fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
                f.write_str("a value")
            }
            scalars!(Skipped { kind: Frames::NoArray }, null: Skipped { kind: Frames::Absent });
            fn visit_seq<A: SeqAccess<'de>>(self, mut of: A) -> Result<Skipped, A::Error> {
                let mut count = 0;
                while of.next_element::<Skipped>()?.is_some() {
                    count += 1;
                }
                Ok(Skipped { kind: Frames::Array(count) })
            }
            fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<Skipped, A::Error> {
                while of.next_entry::<Skipped, Skipped>()?.is_some() {}
                Ok(Skipped { kind: Frames::NoArray })
            }
        }
        source.deserialize_any(Any)
    }
}

/// A value, up to the remaining number of values; of an object only the fact that it is one.
struct Kept<'l>(&'l mut usize);

impl<'de> DeserializeSeed<'de> for Kept<'_> {
    type Value = Value;
    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<Value, D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Kept<'_> {
    type Value = Value;
    fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str("a value")
    }
    fn visit_bool<E>(self, x: bool) -> Result<Value, E> {
        Ok(x.into())
    }
    fn visit_i64<E>(self, x: i64) -> Result<Value, E> {
        Ok(x.into())
    }
    fn visit_u64<E>(self, x: u64) -> Result<Value, E> {
        Ok(x.into())
    }
    fn visit_f64<E>(self, x: f64) -> Result<Value, E> {
        Ok(x.into())
    }
    fn visit_str<E>(self, text: &str) -> Result<Value, E> {
        Ok(text.into())
    }
    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut of: A) -> Result<Value, A::Error> {
        let mut values = Vec::new();
        while *self.0 > 0 {
            *self.0 -= 1;
            match of.next_element_seed(Kept(&mut *self.0))? {
                Some(value) => values.push(value),
                None => return Ok(values.into()),
            }
        }
        while of.next_element::<Skipped>()?.is_some() {}
        Ok(values.into())
    }
    fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<Value, A::Error> {
        while of.next_entry::<Skipped, Skipped>()?.is_some() {}
        Ok(Map::new().into())
    }
}

/// Adds the value of a known key.
fn keep_known<'de, A: MapAccess<'de>>(of: &mut A, key: String, map: &mut Map<String, Value>) -> Result<(), A::Error> {
    if KNOWN.contains(&key.as_str()) {
        let value = of.next_value_seed(Kept(&mut { MOST_VALUES }))?;
        map.insert(key, value);
    } else {
        of.next_value::<Skipped>()?;
    }
    Ok(())
}

/// The keys of the top level.
struct TopKeys<'t> {
    top: &'t mut Map<String, Value>,
    frames: &'t mut Vec<Frames>,
    names: &'t mut [Names; 3],
}

impl<'de> DeserializeSeed<'de> for TopKeys<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<(), D::Error> {
        source.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for TopKeys<'_> {
    type Value = ();
    fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str("an object")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<(), A::Error> {
        while let Some(key) = of.next_key::<String>()? {
            if let Some(list) = LISTS.iter().position(|name| *name == key) {
                self.names[list] = of.next_value::<Names>()?;
            } else if key == "frames" {
                let kind = of.next_value::<Skipped>()?.kind;
                self.frames.push(kind);
            } else {
                keep_known(&mut of, key, self.top)?;
            }
        }
        Ok(())
    }
}

impl<'de> Deserialize<'de> for Names {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        struct List;
        impl<'de> Visitor<'de> for List {
            type Value = Names;
            fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
                f.write_str("a list of names")
            }
            scalars!(no_array(), null: Names::Absent);
            fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<Names, A::Error> {
                while of.next_entry::<Skipped, Skipped>()?.is_some() {}
                Ok(no_array())
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut of: A) -> Result<Names, A::Error> {
                let mut names = BTreeSet::new();
                while let Some(name) = of.next_element_seed(Kept(&mut 1))? {
                    let cleaned = match name.as_str() {
                        Some(name) => clean_name(name).map_err(|problem| Names::Bad(problem, STAY_INSIDE)),
                        None => Err(Names::Bad("not a list of strings".to_string(), FIX_KEY)),
                    };
                    match cleaned {
                        Ok(name) => names.insert(name),
                        Err(bad) => {
                            while of.next_element::<Skipped>()?.is_some() {}
                            return Ok(bad);
                        }
                    };
                }
                Ok(Names::Listed(names))
            }
        }
        source.deserialize_any(List)
    }
}

fn no_array() -> Names {
    Names::Bad("not an array".to_string(), FIX_KEY)
}

/// The frames under `frames`, one by one, until one is refused.
struct FrameList<'t> {
    /// Receives the known keys of a frame, `None` if it is not an object; returns whether to continue.
    take: &'t mut dyn FnMut(Option<Map<String, Value>>) -> bool,
}

impl<'de> DeserializeSeed<'de> for FrameList<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<(), D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for FrameList<'_> {
    type Value = ();
    fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str("an object with frames")
    }
    fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<(), A::Error> {
        while let Some(key) = of.next_key::<String>()? {
            if key == "frames" {
                of.next_value_seed(FrameList { take: &mut *self.take })?;
            } else {
                of.next_value::<Skipped>()?;
            }
        }
        Ok(())
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut of: A) -> Result<(), A::Error> {
        while let Some(OneFrame(map)) = of.next_element()? {
            if !(self.take)(map) {
                return Err(A::Error::custom("a frame was refused"));
            }
        }
        Ok(())
    }
}

/// The known keys of a frame; `None` if it is not an object.
struct OneFrame(Option<Map<String, Value>>);

impl<'de> Deserialize<'de> for OneFrame {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        struct Keys;
        impl<'de> Visitor<'de> for Keys {
            type Value = OneFrame;
            fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
                f.write_str("a frame")
            }
            scalars!(OneFrame(None), null: OneFrame(None));
            fn visit_seq<A: SeqAccess<'de>>(self, mut of: A) -> Result<OneFrame, A::Error> {
                while of.next_element::<Skipped>()?.is_some() {}
                Ok(OneFrame(None))
            }
            fn visit_map<A: MapAccess<'de>>(self, mut of: A) -> Result<OneFrame, A::Error> {
                let mut map = Map::new();
                while let Some(key) = of.next_key::<String>()? {
                    keep_known(&mut of, key, &mut map)?;
                }
                Ok(OneFrame(Some(map)))
            }
        }
        source.deserialize_any(Keys)
    }
}

/// An object of the file: the top level or one frame.
#[derive(Clone, Copy)]
pub(super) struct Node<'a> {
    pub file: &'a Path,
    /// Known keys.
    pub map: &'a Map<String, Value>,
    /// Index of the frame; `None` for the top level.
    pub frame: Option<usize>,
}

impl<'a> Node<'a> {
    /// An error about a key of this object.
    pub fn error(&self, key: &str, problem: impl Into<String>, remedy: &str) -> InputError {
        let place = match self.frame {
            Some(i) => format!("frames[{i}].{key}"),
            None => key.to_string(),
        };
        InputError::new(self.file, problem, remedy).at(place)
    }

    /// The value of a known key; `null` counts as absent.
    pub fn get(&self, key: &str) -> Option<&'a Value> {
        debug_assert!(KNOWN.contains(&key), "{key} is never kept");
        self.map.get(key).filter(|v| !v.is_null())
    }

    /// A number, if the key exists.
    pub fn number(&self, key: &str) -> InputResult<Option<f64>> {
        self.typed(key, "a number", Value::as_f64)
    }

    /// A string, if the key exists.
    pub fn text(&self, key: &str) -> InputResult<Option<&'a str>> {
        self.typed(key, "a string", Value::as_str)
    }

    /// An array, if the key exists; its first values if it is too long.
    pub fn array(&self, key: &str) -> InputResult<Option<&'a Vec<Value>>> {
        self.typed(key, "an array", Value::as_array)
    }

    fn typed<T>(&self, key: &str, kind: &str, get: impl Fn(&'a Value) -> Option<T>) -> InputResult<Option<T>> {
        match self.get(key) {
            None => Ok(None),
            Some(value) => match get(value) {
                Some(found) => Ok(Some(found)),
                None => Err(self.error(key, format!("not {kind}"), FIX_KEY)),
            },
        }
    }
}
