//! The header of a PLY file: format, elements, properties, comments.
//!
//! Not here: the values after the header, and their meaning.
//!
//! Invariants: 1. at most [`MAX_HEADER_BYTES`] are read, whatever the file says; 2. counts are as stated by the file
//! and unchecked: readers check them; 3. property names of one element are unique.

use crate::base::error::{InputError, InputResult};
use std::io::{BufRead, Read};
use std::path::Path;

/// Longest header that is read. The header of a file of Gaussians takes 1.5 KB.
pub const MAX_HEADER_BYTES: u64 = 64 * 1024;

const REMEDY: &str = "check that this is a complete PLY file";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlyFormat {
    Ascii,
    /// Packed, least significant byte first.
    LittleEndian,
    /// Packed, most significant byte first.
    BigEndian,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    /// The types with their names and bytes.
    const ALL: [(Scalar, [&str; 2], usize); 8] = [
        (Scalar::I8, ["char", "int8"], 1),
        (Scalar::U8, ["uchar", "uint8"], 1),
        (Scalar::I16, ["short", "int16"], 2),
        (Scalar::U16, ["ushort", "uint16"], 2),
        (Scalar::I32, ["int", "int32"], 4),
        (Scalar::U32, ["uint", "uint32"], 4),
        (Scalar::F32, ["float", "float32"], 4),
        (Scalar::F64, ["double", "float64"], 8),
    ];

    pub fn size(self) -> usize {
        Scalar::ALL[self as usize].2
    }

    pub fn is_float(self) -> bool {
        matches!(self, Scalar::F32 | Scalar::F64)
    }

    /// The value at the start of `bytes`, which holds at least [`Scalar::size`] bytes. Every type fits f64 exactly.
    #[inline]
    pub fn decode(self, bytes: &[u8], big_endian: bool) -> f64 {
        macro_rules! number {
            ($t:ty, $n:literal) => {{
                let mut raw = [0u8; $n];
                raw.copy_from_slice(&bytes[..$n]);
                f64::from(if big_endian { <$t>::from_be_bytes(raw) } else { <$t>::from_le_bytes(raw) })
            }};
        }
        match self {
            Scalar::I8 => number!(i8, 1),
            Scalar::U8 => number!(u8, 1),
            Scalar::I16 => number!(i16, 2),
            Scalar::U16 => number!(u16, 2),
            Scalar::I32 => number!(i32, 4),
            Scalar::U32 => number!(u32, 4),
            Scalar::F32 => number!(f32, 4),
            Scalar::F64 => number!(f64, 8),
        }
    }
}

/// Kind of a property: a number or a list of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PropertyKind {
    Scalar(Scalar),
    /// A count, then that many values.
    List {
        count: Scalar,
        item: Scalar,
    },
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Property {
    pub name: String,
    pub kind: PropertyKind,
}

/// An element: a table of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
}

impl Element {
    pub fn find(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }

    /// Bytes of a row in a binary file with all lists empty, and whether that is exact because there are no lists.
    pub fn row_bytes(&self) -> (u64, bool) {
        let mut exact = true;
        let mut bytes = 0;
        for property in &self.properties {
            bytes += match property.kind {
                PropertyKind::Scalar(s) => s.size() as u64,
                PropertyKind::List { count, .. } => {
                    exact = false;
                    count.size() as u64
                }
            };
        }
        (bytes, exact)
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    pub format: PlyFormat,
    pub elements: Vec<Element>,
    /// Comments without the word `comment`, trimmed.
    pub comments: Vec<String>,
    pub bytes: u64,
    pub lines: u64,
}

/// Reads the header up to and including `end_header`. Errors name the line.
pub fn parse_header(reader: &mut impl BufRead, path: &Path) -> InputResult<Header> {
    let mut limited = reader.by_ref().take(MAX_HEADER_BYTES);
    let mut header =
        Header { format: PlyFormat::Ascii, elements: Vec::new(), comments: Vec::new(), bytes: 0, lines: 0 };
    let mut format = None;
    let mut raw = Vec::new();
    loop {
        raw.clear();
        let read = limited.read_until(b'\n', &mut raw).map_err(|e| InputError::io(path, "reading the header", &e))?;
        header.bytes += read as u64;
        header.lines += 1;
        let line = header.lines;
        let bad = |problem: String| InputError::new(path, problem, REMEDY).at(format!("header line {line}"));
        if raw.last() != Some(&b'\n') {
            let what = if line == 1 {
                "this is not a PLY file".to_string()
            } else if header.bytes >= MAX_HEADER_BYTES {
                format!("no end_header within {MAX_HEADER_BYTES} bytes")
            } else {
                "the file ends inside the header".to_string()
            };
            return Err(bad(what));
        }
        let text = String::from_utf8_lossy(&raw);
        let text = text.trim();
        if line == 1 {
            if text != "ply" {
                return Err(bad("this is not a PLY file: it does not begin with 'ply'".into()));
            }
            continue;
        }
        let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
        match word {
            "format" => {
                format = match rest.split_whitespace().collect::<Vec<_>>()[..] {
                    ["ascii", "1.0"] => Some(PlyFormat::Ascii),
                    ["binary_little_endian", "1.0"] => Some(PlyFormat::LittleEndian),
                    ["binary_big_endian", "1.0"] => Some(PlyFormat::BigEndian),
                    _ => return Err(bad(format!("unknown format '{}'", shorten(rest)))),
                }
            }
            "comment" => header.comments.push(rest.trim().to_string()),
            "obj_info" | "" => {}
            "element" => header.elements.push(parse_element(rest, &header.elements).map_err(bad)?),
            "property" => match header.elements.last_mut() {
                Some(element) => element.properties.push(parse_property(rest, element).map_err(bad)?),
                None => return Err(bad("a property before any element".into())),
            },
            "end_header" => break,
            other => return Err(bad(format!("unknown keyword '{}'", shorten(other)))),
        }
    }
    header.format =
        format.ok_or_else(|| InputError::new(path, "the header has no format line", REMEDY).at("header"))?;
    Ok(header)
}

fn parse_element(rest: &str, before: &[Element]) -> Result<Element, String> {
    let [name, count] = rest.split_whitespace().collect::<Vec<_>>()[..] else {
        return Err("an element line needs a name and a count".into());
    };
    let Ok(count) = count.parse::<u64>() else {
        return Err(format!("'{}' is not a count of elements", shorten(count)));
    };
    if before.iter().any(|e| e.name == name) {
        return Err(format!("element '{}' appears twice", shorten(name)));
    }
    Ok(Element { name: name.to_string(), count, properties: Vec::new() })
}

fn parse_property(rest: &str, element: &Element) -> Result<Property, String> {
    let scalar = |name: &str| {
        let known = Scalar::ALL.into_iter().find(|(_, names, _)| names.contains(&name));
        known.map(|(scalar, ..)| scalar).ok_or_else(|| format!("unknown type '{}'", shorten(name)))
    };
    let (kind, name) = match rest.split_whitespace().collect::<Vec<_>>()[..] {
        ["list", count, item, name] => {
            let (count, item) = (scalar(count)?, scalar(item)?);
            if count.is_float() {
                return Err(format!("the count of list '{}' is a floating-point type", shorten(name)));
            }
            (PropertyKind::List { count, item }, name)
        }
        [kind, name] => (PropertyKind::Scalar(scalar(kind)?), name),
        _ => return Err("a property line needs a type and a name".into()),
    };
    if element.find(name).is_some() {
        return Err(format!("property '{}' appears twice", shorten(name)));
    }
    Ok(Property { name: name.to_string(), kind })
}

/// Shortens text of a file to fit into a message.
pub fn shorten(text: &str) -> String {
    let mut out: String = text.chars().take(40).map(|c| if c.is_control() { '?' } else { c }).collect();
    if text.chars().nth(40).is_some() {
        out.push_str("...");
    }
    out
}
