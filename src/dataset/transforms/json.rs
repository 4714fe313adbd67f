//! JSON that remembers the place of every value, so that errors name the file, the frame and the key.
//!
//! A file is parsed twice: for the keys of its top level, and frame by frame. Of an object only the known keys are kept
//! ([`KNOWN`]), and of a key's value the first [`MOST_VALUES`] values: more than any key needs, so that a value that is
//! too long can be recognised.
//!
//! Invariants: 1. a syntax error anywhere in the file is found by the first pass; 2. besides the file's bytes and the
//! caller's data, memory holds one frame, the top level and its lists of names, whereas a tree of the whole file could
//! take a value per character.

use crate::base::error::{InputError, InputResult};
use crate::dataset::loose_json::{LooseJson, is_no_number};
use crate::dataset::paths::read_name;
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
const KNOWN: &str = "applied_scale camera_angle_x camera_angle_y camera_model cx cy file_path fl_x fl_y frame_index h \
                     is_fisheye k1 k2 k3 k4 k5 k6 mask_path p1 p2 ply_file_path rot_mat transform_matrix w";

fn is_known(key: &str) -> bool {
    KNOWN.split(' ').any(|known| known == key)
}

pub(super) const LISTS: [&str; 3] = ["train_filenames", "val_filenames", "test_filenames"];

#[derive(Debug, Default)]
pub(super) enum Names {
    #[default]
    Absent,
    Listed(BTreeSet<String>),
    /// Unusable: the problem and the remedy.
    Bad(String, &'static str),
}

/// A file whose top level is an object.
#[derive(Debug)]
pub(super) struct JsonFile {
    path: PathBuf,
    bytes: Vec<u8>,
    top: Map<String, Value>,
    lists: TopLists,
}

/// The keys of the top level whose values are lists without a limit.
#[derive(Debug, Default)]
struct TopLists {
    /// The value of `frames`, an array cut after its first element.
    frames: Value,
    /// How often the key `frames` appears.
    frame_keys: usize,
    /// In the order of [`LISTS`].
    names: [Names; 3],
}

/// Reads a file whose top level is an object. Nesting deeper than serde_json's limit (128) is an error.
pub(super) fn load(path: &Path) -> InputResult<JsonFile> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
    let length = file.metadata().map_err(|e| InputError::io(path, "reading", &e))?.len();
    // Reserves room for the whole file and the check for its end, so that reading rarely reallocates.
    let mut bytes = Vec::with_capacity(length.min(MAX_BYTES) as usize + 64);
    let mut limited = file.take(MAX_BYTES + 1);
    LooseJson::new(&mut limited).read_to_end(&mut bytes).map_err(|e| InputError::io(path, "reading", &e))?;
    if limited.limit() == 0 {
        let problem = format!("the file is larger than {} MiB", MAX_BYTES >> 20);
        return Err(InputError::new(path, problem, "split the scene into several, or use a COLMAP model"));
    }
    let mut lists = TopLists::default();
    let mut source = serde_json::Deserializer::from_slice(&bytes);
    let value = JsonPart::Top(&mut lists).deserialize(&mut source);
    let value = value.and_then(|value| source.end().map(|()| value)).map_err(|e| invalid(path, &e))?;
    let Value::Object(top) = value else {
        return Err(InputError::new(path, "the top level is not an object", "give a transforms.json with 'frames'"));
    };
    if lists.frame_keys > 1 {
        let problem = format!("the key appears {} times", lists.frame_keys);
        return Err(InputError::new(path, problem, "write the file again with its frames in one list").at("frames"));
    }
    Ok(JsonFile { path: path.to_path_buf(), bytes, top, lists })
}

fn invalid(path: &Path, e: &serde_json::Error) -> InputError {
    InputError::new(path, format!("not valid JSON: {e}"), "correct the file at this place, or write it again")
        .at(format!("line {} column {}", e.line(), e.column()))
}

impl JsonFile {
    pub fn top(&self) -> JsonNode<'_> {
        JsonNode { file: &self.path, map: &self.top, frame: None }
    }

    pub fn names(&self, list: usize) -> &Names {
        &self.lists.names[list]
    }

    /// Whether the list of frames has any.
    pub fn has_frames(&self) -> InputResult<bool> {
        match &self.lists.frames {
            Value::Array(first) => Ok(!first.is_empty()),
            Value::Null => Err(self.top().error("frames", "the key is missing", FIX_KEY)),
            _ => Err(self.top().error("frames", "not an array", FIX_KEY)),
        }
    }

    /// Passes the frames to `take` one by one, each with its index.
    pub fn for_each_frame(&self, take: &mut dyn FnMut(JsonNode<'_>) -> InputResult<()>) -> InputResult<()> {
        let mut refused = None;
        let mut index = 0;
        let mut one = |frame: Value| {
            let taken = match &frame {
                Value::Object(map) => take(JsonNode { file: &self.path, map, frame: Some(index) }),
                _ => Err(self.top().error(&format!("frames[{index}]"), "not an object", FIX_KEY)),
            };
            index += 1;
            taken.map_err(|error| refused = Some(error)).is_ok()
        };
        let mut source = serde_json::Deserializer::from_slice(&self.bytes);
        let done = JsonPart::TopOfFrames(&mut one).deserialize(&mut source);
        match refused {
            Some(error) => Err(error),
            None => done.map(|_| ()).map_err(|e| invalid(&self.path, &e)),
        }
    }
}

/// A part of the file, and what is kept of it. serde's ignored value is of no use for the rest: serde_json checks
/// neither the range of its numbers nor its depth.
enum JsonPart<'t> {
    /// A value: up to this number of values of an array; of an object only the fact that it is one.
    Value(&'t mut usize),
    /// The top level: its known keys.
    Top(&'t mut TopLists),
    Names(&'t mut Names),
    /// The top level, to pass on its frames until one is refused.
    TopOfFrames(&'t mut dyn FnMut(Value) -> bool),
    Frames(&'t mut dyn FnMut(Value) -> bool),
    /// A frame: its known keys.
    Frame,
}

impl<'de> DeserializeSeed<'de> for JsonPart<'_> {
    type Value = Value;
    fn deserialize<D: Deserializer<'de>>(self, source: D) -> Result<Value, D::Error> {
        source.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for JsonPart<'_> {
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
        match self {
            JsonPart::Value(left) => {
                while *left > 0 {
                    *left -= 1;
                    let Some(value) = of.next_element_seed(JsonPart::Value(&mut *left))? else { break };
                    values.push(value);
                }
            }
            JsonPart::Names(names) => *names = read_names(&mut of)?,
            JsonPart::Frames(take) => {
                while let Some(frame) = of.next_element_seed(JsonPart::Frame)? {
                    if !take(frame) {
                        return Err(A::Error::custom("a frame was refused"));
                    }
                }
            }
            _ => {}
        }
        while of.next_element_seed(JsonPart::Value(&mut 0))?.is_some() {}
        Ok(values.into())
    }
    fn visit_map<A: MapAccess<'de>>(mut self, mut of: A) -> Result<Value, A::Error> {
        let mut map = Map::new();
        while let Some(key) = of.next_key::<String>()? {
            match &mut self {
                JsonPart::Top(lists) if key == "frames" => {
                    lists.frame_keys += 1;
                    lists.frames = of.next_value_seed(JsonPart::Value(&mut 1))?;
                }
                JsonPart::Top(lists) if LISTS.contains(&key.as_str()) => {
                    let mut names = Names::Bad("not an array".to_string(), FIX_KEY);
                    if of.next_value_seed(JsonPart::Names(&mut names))?.is_null() {
                        names = Names::Absent;
                    }
                    let list = LISTS.iter().position(|name| *name == key).unwrap_or(0);
                    lists.names[list] = names;
                }
                JsonPart::TopOfFrames(take) if key == "frames" => {
                    _ = of.next_value_seed(JsonPart::Frames(&mut **take))?
                }
                JsonPart::Top(_) | JsonPart::Frame if is_known(&key) => {
                    let value = of.next_value_seed(JsonPart::Value(&mut { MOST_VALUES }))?;
                    map.insert(key, value);
                }
                _ => _ = of.next_value_seed(JsonPart::Value(&mut 0))?,
            }
        }
        Ok(map.into())
    }
}

/// Reads names up to the first bad one.
fn read_names<'de, A: SeqAccess<'de>>(of: &mut A) -> Result<Names, A::Error> {
    let mut names = BTreeSet::new();
    while let Some(name) = of.next_element_seed(JsonPart::Value(&mut 1))? {
        let Some(name) = name.as_str() else {
            return Ok(Names::Bad("not a list of strings".to_string(), FIX_KEY));
        };
        match read_name("", name) {
            Ok(read) => names.insert(read.name),
            Err(problem) => return Ok(Names::Bad(problem, STAY_INSIDE)),
        };
    }
    Ok(Names::Listed(names))
}

/// An object of the file: the top level or one frame.
#[derive(Clone, Copy)]
pub(super) struct JsonNode<'a> {
    pub file: &'a Path,
    pub map: &'a Map<String, Value>,
    /// Index of the frame; `None` for the top level.
    pub frame: Option<usize>,
}

impl<'a> JsonNode<'a> {
    pub fn error(&self, key: &str, problem: impl Into<String>, remedy: &str) -> InputError {
        let place = match self.frame {
            Some(i) => format!("frames[{i}].{key}"),
            None => key.to_string(),
        };
        InputError::new(self.file, problem, remedy).at(place)
    }

    /// The value of a known key; `null` counts as absent.
    pub fn get(&self, key: &str) -> Option<&'a Value> {
        debug_assert!(is_known(key), "{key} is never kept");
        self.map.get(key).filter(|v| !v.is_null())
    }

    pub fn number(&self, key: &str) -> InputResult<Option<f64>> {
        self.typed(key, "a number", Value::as_f64)
    }

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
                None => match value.as_str().filter(|word| is_no_number(word)) {
                    Some(word) => Err(self.error(key, format!("{word} is not {kind}"), FIX_KEY)),
                    None => Err(self.error(key, format!("not {kind}"), FIX_KEY)),
                },
            },
        }
    }
}
