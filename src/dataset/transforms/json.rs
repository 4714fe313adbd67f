//! JSON with a memory of where a value stood, so that every complaint names the file, the frame and the key.

use crate::base::error::{InputError, InputResult};
use serde_json::{Map, Value};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Largest file read, bytes; a frame takes about 1 KiB, and parsed values some ten times their text.
const MAX_BYTES: u64 = 128 << 20;

/// Remedy for a value of the wrong kind.
pub(super) const FIX_KEY: &str = "correct the key in the JSON or write the file again";

/// Reads a file whose top level is an object. Nesting deeper than serde_json's limit (128) is an error.
pub(super) fn load(path: &Path) -> InputResult<Map<String, Value>> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(|e| InputError::io(path, "reading", &e))?;
    if bytes.len() as u64 > MAX_BYTES {
        let problem = format!("the file is larger than {} MiB", MAX_BYTES >> 20);
        return Err(InputError::new(path, problem, "split the scene into several, or use a COLMAP model"));
    }
    let value = serde_json::from_slice(&bytes).map_err(|e| {
        InputError::new(path, format!("not valid JSON: {e}"), "write the file again; NaN and Infinity are not JSON")
            .at(format!("line {} column {}", e.line(), e.column()))
    })?;
    match value {
        Value::Object(map) => Ok(map),
        _ => Err(InputError::new(path, "the top level is not an object", "give a transforms.json with 'frames'")),
    }
}

/// An object of the file: the top level or one frame.
#[derive(Clone, Copy)]
pub(super) struct Node<'a> {
    pub file: &'a Path,
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

    /// The value of a key; `null` counts as absent.
    pub fn get(&self, key: &str) -> Option<&'a Value> {
        self.map.get(key).filter(|v| !v.is_null())
    }

    /// A number, if the key is there.
    pub fn number(&self, key: &str) -> InputResult<Option<f64>> {
        self.typed(key, "a number", Value::as_f64)
    }

    /// A string, if the key is there.
    pub fn text(&self, key: &str) -> InputResult<Option<&'a str>> {
        self.typed(key, "a string", Value::as_str)
    }

    /// An array, if the key is there.
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
