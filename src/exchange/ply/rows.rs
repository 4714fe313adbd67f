//! Splits packed bytes or lines of text into the rows of a PLY element.
//!
//! Not here: the meaning of the values.
//!
//! Invariants: 1. buffers are bounded by a constant ([`MAX_LINE_BYTES`]) or by the longest header; 2. no
//! loop runs longer than the file has bytes; 3. errors name the byte offset (binary) or the line (ascii).

use super::header::{Element, Header, PlyFormat, PropertyKind, Scalar, shorten};
use crate::base::error::{InputError, InputResult};
use std::io::{BufRead, ErrorKind, Read};
use std::path::Path;

const MAX_LINE_BYTES: u64 = 1 << 20;
const CUT_SHORT: &str = "the file is cut short or its header is wrong: copy or export it again";

/// The body of a file, with the read position.
pub struct Body<'a, R> {
    pub path: &'a Path,
    reader: R,
    format: PlyFormat,
    position: u64,
    total_bytes: u64,
    line: u64,
    text: Vec<u8>,
}

impl<'a, R: BufRead> Body<'a, R> {
    /// The body of a file of `total_bytes` bytes; `reader` is positioned right after the header.
    pub fn new(reader: R, path: &'a Path, header: &Header, total_bytes: u64) -> Self {
        Body {
            path,
            reader,
            format: header.format,
            position: header.bytes,
            total_bytes,
            line: header.lines,
            text: Vec::new(),
        }
    }

    fn error(&self, problem: impl Into<String>, remedy: &str) -> InputError {
        let place = match self.format {
            PlyFormat::Ascii => format!("line {}", self.line),
            _ => format!("byte {}", self.position),
        };
        InputError::new(self.path, problem, remedy).at(place)
    }

    /// Refuses an element that cannot fit into the bytes left. Lists count as empty.
    ///
    /// A text value takes at least a digit and a separator; the last value of a file takes at least a digit.
    pub fn check_room(&self, element: &Element) -> InputResult<()> {
        let left = self.total_bytes.saturating_sub(self.position);
        let (row, exact) = element.row_bytes();
        let (row, slack) = match self.format {
            PlyFormat::Ascii => (2 * element.properties.len() as u64, 1),
            _ => (row, 0),
        };
        let need = u128::from(element.count) * u128::from(row);
        if row == 0 && element.count > 0 {
            return Err(self.error(format!("element '{}' has no properties", shorten(&element.name)), CUT_SHORT));
        }
        if need <= u128::from(left) + slack {
            return Ok(());
        }
        let least = if exact && self.format != PlyFormat::Ascii { "" } else { "at least " };
        let problem = format!(
            "{} rows of '{}' need {least}{need} bytes, but {left} are left in the file",
            element.count,
            shorten(&element.name)
        );
        Err(self.error(problem, CUT_SHORT))
    }

    pub fn skip(&mut self, element: &Element) -> InputResult<()> {
        if element.count == 0 {
            return Ok(());
        }
        self.check_room(element)?;
        match (self.format, element.row_bytes()) {
            (PlyFormat::Ascii, _) => (0..element.count).try_for_each(|_| self.next_line()),
            // No overflow: the product was compared with the bytes left above.
            (_, (row_bytes, true)) => self.skip_bytes(element.count * row_bytes),
            _ => (0..element.count).try_for_each(|_| self.walk_row(element, |_, _| {})),
        }
    }

    fn fill(&mut self, bytes: &mut [u8]) -> InputResult<()> {
        match self.reader.read_exact(bytes) {
            Ok(()) => {
                self.position += bytes.len() as u64;
                Ok(())
            }
            Err(e) if e.kind() == ErrorKind::UnexpectedEof => Err(self.error("the file ends inside a row", CUT_SHORT)),
            Err(e) => Err(InputError::io(self.path, "reading", &e).at(format!("byte {}", self.position))),
        }
    }

    fn skip_bytes(&mut self, count: u64) -> InputResult<()> {
        if count > self.total_bytes.saturating_sub(self.position) {
            return Err(self.error(format!("a list needs {count} bytes, more than the file has left"), CUT_SHORT));
        }
        let copied = std::io::copy(&mut self.reader.by_ref().take(count), &mut std::io::sink())
            .map_err(|e| InputError::io(self.path, "reading", &e).at(format!("byte {}", self.position)))?;
        self.position += copied;
        if copied < count { Err(self.error("the file ends inside a row", CUT_SHORT)) } else { Ok(()) }
    }

    /// Reads one binary row property by property; `number` receives index and value of each property that is not a
    /// list.
    fn walk_row(&mut self, element: &Element, mut number: impl FnMut(usize, f64)) -> InputResult<()> {
        let big_endian = self.format == PlyFormat::BigEndian;
        let mut raw = [0u8; 8];
        for (index, property) in element.properties.iter().enumerate() {
            match property.kind {
                PropertyKind::Scalar(scalar) => {
                    self.fill(&mut raw[..scalar.size()])?;
                    number(index, scalar.decode(&raw, big_endian));
                }
                PropertyKind::List { count, item } => {
                    self.fill(&mut raw[..count.size()])?;
                    let length = count.decode(&raw, big_endian);
                    if length < 0.0 {
                        return Err(self.error(format!("a list has {length} values"), CUT_SHORT));
                    }
                    // At most 2^32 values of 8 bytes.
                    self.skip_bytes(length as u64 * item.size() as u64)?;
                }
            }
        }
        Ok(())
    }

    /// Reads the next non-blank line into `text`.
    fn next_line(&mut self) -> InputResult<()> {
        loop {
            self.text.clear();
            self.line += 1;
            let read = self
                .reader
                .by_ref()
                .take(MAX_LINE_BYTES)
                .read_until(b'\n', &mut self.text)
                .map_err(|e| InputError::io(self.path, "reading", &e).at(format!("line {}", self.line)))?;
            self.position += read as u64;
            if read == 0 {
                return Err(self.error("the file ends before the last row", CUT_SHORT));
            }
            if read as u64 == MAX_LINE_BYTES && self.text.last() != Some(&b'\n') {
                return Err(self.error(format!("a line is longer than {MAX_LINE_BYTES} bytes"), CUT_SHORT));
            }
            if !self.text.iter().all(u8::is_ascii_whitespace) {
                return Ok(());
            }
        }
    }

    /// Parses the line in `text` as a row of `element`.
    fn parse_line(&self, element: &Element, mut number: impl FnMut(usize, f64)) -> InputResult<()> {
        let name = |index: usize| shorten(&element.properties[index].name);
        let text = String::from_utf8_lossy(&self.text);
        let mut words = text.split_ascii_whitespace();
        for (index, property) in element.properties.iter().enumerate() {
            let Some(word) = words.next() else {
                let problem = format!("the row ends before property '{}'", name(index));
                return Err(self.error(problem, CUT_SHORT));
            };
            match property.kind {
                PropertyKind::Scalar(_) => match word.parse::<f64>() {
                    Ok(value) => number(index, value),
                    Err(_) => {
                        let problem = format!("'{}' is not a number for property '{}'", shorten(word), name(index));
                        return Err(self.error(problem, "repair the line or export the file again"));
                    }
                },
                PropertyKind::List { .. } => {
                    // A count larger than the words of the line fails below or at the next property.
                    let length = word.parse::<u32>().ok();
                    let complete = length.is_some_and(|n| n == 0 || words.nth(n as usize - 1).is_some());
                    if !complete {
                        let problem = format!("list '{}' does not have as many values as its count says", name(index));
                        return Err(self.error(problem, CUT_SHORT));
                    }
                }
            }
        }
        match words.next() {
            None => Ok(()),
            Some(_) => {
                let problem = format!("the row has more values than the {} properties", element.properties.len());
                Err(self.error(problem, "repair the line or export the file again"))
            }
        }
    }
}

/// Reads all rows of `element`, which has passed [`Body::check_room`]. `slots` are the wanted properties, none of them
/// a list; `each` receives the row's number and the values in the order of `slots`.
pub fn read_rows<R: BufRead>(
    body: &mut Body<'_, R>,
    element: &Element,
    slots: &[usize],
    mut each: impl FnMut(u64, &[f64]) -> InputResult<()>,
) -> InputResult<()> {
    let (row_bytes, exact) = element.row_bytes();
    if body.format != PlyFormat::Ascii && exact {
        return read_packed(body, element, row_bytes as usize, slots, each);
    }
    let mut slot_from_property = vec![None; element.properties.len()];
    for (slot, &property) in slots.iter().enumerate() {
        slot_from_property[property] = Some(slot);
    }
    let mut values = vec![0.0; slots.len()];
    for row in 0..element.count {
        let store = |property: usize, value: f64| {
            if let Some(slot) = slot_from_property[property] {
                values[slot] = value;
            }
        };
        if body.format == PlyFormat::Ascii {
            body.next_line()?;
            body.parse_line(element, store)?;
        } else {
            body.walk_row(element, store)?;
        }
        each(row, &values)?;
    }
    Ok(())
}

/// Reads binary rows of fixed length.
fn read_packed<R: BufRead>(
    body: &mut Body<'_, R>,
    element: &Element,
    row_bytes: usize,
    slots: &[usize],
    mut each: impl FnMut(u64, &[f64]) -> InputResult<()>,
) -> InputResult<()> {
    let mut offsets = Vec::with_capacity(element.properties.len());
    let mut offset = 0;
    for property in &element.properties {
        let scalar = if let PropertyKind::Scalar(s) = property.kind { s } else { Scalar::U8 };
        offsets.push((offset, scalar));
        offset += scalar.size();
    }
    let fields: Vec<(usize, Scalar)> = slots.iter().map(|&property| offsets[property]).collect();
    let big_endian = body.format == PlyFormat::BigEndian;
    let (mut bytes, mut values) = (vec![0u8; row_bytes], vec![0.0; slots.len()]);
    for row in 0..element.count {
        body.fill(&mut bytes)?;
        for (value, &(offset, scalar)) in values.iter_mut().zip(&fields) {
            *value = scalar.decode(&bytes[offset..], big_endian);
        }
        each(row, &values)?;
    }
    Ok(())
}
