//! Reads the few pickle instructions that PyTorch writes for dictionaries of numbers and tensors. Nothing is executed:
//! a function's name is compared with the two known ones, and never called.
//!
//! Format: CPython's `pickletools`, protocol 2. A tensor is `torch._utils._rebuild_tensor_v2(storage, offset, sizes,
//! strides, requires_grad, hooks)`, where the storage is a persistent id ('storage', type, key, place, count).
//!
//! Invariants: 1. any byte string gives a value or an error; 2. work and memory are bounded by the length of the text
//! and [`ITEMS_MAX`]; 3. values are plain data.

use std::rc::Rc;

/// Most values of one file; a metadata file has under a hundred.
const ITEMS_MAX: usize = 10_000;
const TOO_MANY: &str = "holds more values than any file of metadata";
/// Deepest nesting; recursion over values happens only when they are compared or dropped.
const DEPTH_MAX: usize = 64;

/// A tensor as described by the pickle; its numbers are in another file of the archive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TensorRef {
    /// Type of the storage, for instance `FloatStorage`.
    pub storage: Rc<str>,
    /// Name of the file with the numbers.
    pub key: Rc<str>,
    pub offset: usize,
    pub sizes: Vec<usize>,
    pub strides: Vec<usize>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    /// None, or an object without content of interest, such as an empty ordered dictionary.
    Nothing,
    Bool,
    Int(i64),
    Float(f64),
    Text(Rc<str>),
    /// A tuple or a list.
    List(Rc<Vec<Value>>),
    /// A dictionary, in order.
    Dict(Rc<Vec<(Value, Value)>>),
    Tensor(Rc<TensorRef>),
    /// The name of a function or class, `module name`.
    Name(Rc<str>),
}

impl Value {
    /// The entry of a dictionary under a text key.
    pub fn get(&self, key: &str) -> Option<&Value> {
        let Value::Dict(entries) = self else { return None };
        entries.iter().find(|(k, _)| matches!(k, Value::Text(text) if &**text == key)).map(|(_, v)| v)
    }

    /// The first item of a list.
    fn first(&self) -> Option<&Value> {
        if let Value::List(items) = self { items.first() } else { None }
    }

    fn depth(&self) -> usize {
        match self {
            Value::List(items) => 1 + items.iter().map(Value::depth).max().unwrap_or(0),
            Value::Dict(entries) => 1 + entries.iter().map(|(k, v)| k.depth().max(v.depth())).max().unwrap_or(0),
            _ => 0,
        }
    }
}

/// The error is one sentence without the file's name.
pub(super) fn read(text: &[u8]) -> Result<Value, String> {
    let mut machine = Machine { rest: text, stack: Vec::new(), marks: Vec::new(), memo: Vec::new(), made: 0 };
    loop {
        if let Some(value) = machine.step()? {
            return Ok(value);
        }
    }
}

#[derive(Clone)]
enum Memo {
    Unused,
    /// A list or dictionary. It is never fetched from the memo and so not stored: a stored copy would make every later
    /// change of it a copy.
    Container,
    Value(Value),
}

struct Machine<'a> {
    rest: &'a [u8],
    stack: Vec<Value>,
    /// Stack heights at which tuples and dictionaries began.
    marks: Vec<usize>,
    memo: Vec<Memo>,
    made: usize,
}

impl<'a> Machine<'a> {
    fn step(&mut self) -> Result<Option<Value>, String> {
        let code = self.take(1)?[0];
        match code {
            0x80 => {
                let protocol = self.take(1)?[0];
                if protocol > 4 {
                    return Err(format!("is a pickle of protocol {protocol}; supported are up to 4"));
                }
            }
            0x95 => _ = self.take(8)?,
            b'.' => return self.pop().map(Some),
            b'(' if self.marks.len() >= ITEMS_MAX => return Err(TOO_MANY.into()),
            b'(' => self.marks.push(self.stack.len()),
            b'}' => self.push(Value::Dict(Rc::default()))?,
            b']' | b')' => self.push(Value::List(Rc::default()))?,
            b'N' => self.push(Value::Nothing)?,
            0x88 | 0x89 => self.push(Value::Bool)?,
            b'K' | b'M' | b'J' | 0x8a => self.integer(code)?,
            b'G' => {
                let bytes = self.take(8)?;
                self.push(Value::Float(f64::from_be_bytes(std::array::from_fn(|i| bytes[i]))))?;
            }
            b'X' | 0x8c => {
                let length = self.number(if code == b'X' { 4 } else { 1 })?;
                let text = std::str::from_utf8(self.take(length)?).map_err(|_| "holds text that is not UTF-8")?;
                self.push(Value::Text(text.into()))?;
            }
            b'q' | b'r' | 0x94 => self.memorize(code)?,
            b'h' | b'j' => {
                let index = self.number(if code == b'h' { 1 } else { 4 })?;
                match self.memo.get(index) {
                    Some(Memo::Value(value)) => self.push(value.clone())?,
                    // Lists that contain the same list repeatedly could be endless to walk, and tensors need none.
                    Some(Memo::Container) => {
                        return Err("uses one container twice, which files of tensors do not".into());
                    }
                    Some(Memo::Unused) | None => return Err("refers to a value that was never made".into()),
                }
            }
            0x85..=0x87 => {
                let mut items = (0..code - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
                items.reverse();
                self.push(Value::List(Rc::new(items)))?;
            }
            b't' => {
                let items = self.since_mark()?;
                self.push(Value::List(Rc::new(items)))?;
            }
            b'a' | b'e' | b's' | b'u' => self.extend(code)?,
            b'c' => self.name()?,
            // A persistent id: the storage of a tensor, kept as a list.
            b'Q' => match self.pop()? {
                id if matches!(id.first(), Some(Value::Text(text)) if &**text == "storage") => self.push(id)?,
                _ => return Err("refers to something that is not the storage of a tensor".into()),
            },
            b'R' => self.call()?,
            // The attributes of an ordered dictionary: they contain no numbers of interest.
            b'b' => _ = self.pop()?,
            other => return Err(format!("uses instruction {other:#04x}, which files of tensors do not have")),
        }
        Ok(None)
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        if count > self.rest.len() {
            return Err("ends in the middle of a value".into());
        }
        let (taken, rest) = self.rest.split_at(count);
        self.rest = rest;
        Ok(taken)
    }

    /// An unsigned little-endian number of up to 4 bytes.
    fn number(&mut self, bytes: usize) -> Result<usize, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |n, &b| n << 8 | usize::from(b)))
    }

    fn push(&mut self, value: Value) -> Result<(), String> {
        self.made += 1;
        if self.made > ITEMS_MAX || value.depth() > DEPTH_MAX {
            return Err(TOO_MANY.into());
        }
        self.stack.push(value);
        Ok(())
    }

    fn pop(&mut self) -> Result<Value, String> {
        if self.marks.last().is_some_and(|&mark| mark >= self.stack.len()) {
            return Err("is malformed: a value is missing".into());
        }
        self.stack.pop().ok_or_else(|| "is malformed: a value is missing".into())
    }

    fn since_mark(&mut self) -> Result<Vec<Value>, String> {
        let mark = self.marks.pop().filter(|&mark| mark <= self.stack.len());
        Ok(self.stack.split_off(mark.ok_or("is malformed: a mark is missing")?))
    }

    fn integer(&mut self, code: u8) -> Result<(), String> {
        let value = match code {
            b'K' => self.number(1)? as i64,
            b'M' => self.number(2)? as i64,
            b'J' => i64::from(self.number(4)? as u32 as i32),
            _ => {
                let length = self.number(1)?;
                let bytes = self.take(length)?;
                if length > 8 {
                    return Err("holds a number of more than 64 bits".into());
                }
                let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
                let fill = if negative { -1i64 } else { 0 };
                bytes.iter().rev().fold(fill, |n, &b| n << 8 | i64::from(b))
            }
        };
        self.push(Value::Int(value))
    }

    fn memorize(&mut self, code: u8) -> Result<(), String> {
        let index = match code {
            b'q' => self.number(1)?,
            b'r' => self.number(4)?,
            _ => self.memo.len(),
        };
        // Writers number values consecutively; a larger number would be an attack on memory.
        if index > self.made {
            return Err("numbers a value beyond those that exist".into());
        }
        if index >= self.memo.len() {
            self.memo.resize(index + 1, Memo::Unused);
        }
        self.memo[index] = match self.stack.last().ok_or("is malformed: a value is missing")? {
            Value::List(_) | Value::Dict(_) => Memo::Container,
            value => Memo::Value(value.clone()),
        };
        Ok(())
    }

    /// Appends items to the list, or entries to the dictionary, below them on the stack.
    fn extend(&mut self, code: u8) -> Result<(), String> {
        let items = match code {
            b'e' | b'u' => self.since_mark()?,
            b'a' => vec![self.pop()?],
            _ => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
        };
        match (self.pop()?, code) {
            (Value::List(mut list), b'a' | b'e') => {
                Rc::make_mut(&mut list).extend(items);
                self.push(Value::List(list))
            }
            (Value::Dict(mut dict), b's' | b'u') if items.len().is_multiple_of(2) => {
                let mut items = items.into_iter();
                while let (Some(key), Some(value)) = (items.next(), items.next()) {
                    Rc::make_mut(&mut dict).push((key, value));
                }
                self.push(Value::Dict(dict))
            }
            // Entries of an ordered dictionary attached to a tensor.
            (Value::Nothing, _) => self.push(Value::Nothing),
            _ => Err("is malformed: entries without their container".into()),
        }
    }

    fn name(&mut self) -> Result<(), String> {
        let mut line = || {
            let end = self.rest.iter().position(|&b| b == b'\n').ok_or("ends in the middle of a name")?;
            let line = std::str::from_utf8(self.take(end)?).map_err(|_| "holds a name that is not UTF-8")?;
            self.take(1)?;
            Ok::<_, String>(line)
        };
        let name = format!("{} {}", line()?, line()?);
        let known = name == "torch._utils _rebuild_tensor_v2"
            || name == "collections OrderedDict"
            || name.strip_prefix("torch ").is_some_and(|n| n.ends_with("Storage"));
        if !known {
            return Err(format!("calls '{name}'; only dictionaries of numbers and tensors are read"));
        }
        self.push(Value::Name(name.into()))
    }

    fn call(&mut self) -> Result<(), String> {
        let (arguments, function) = (self.pop()?, self.pop()?);
        let (Value::Name(name), Value::List(arguments)) = (function, arguments) else {
            return Err("is malformed: a call without a function".into());
        };
        match &*name {
            "collections OrderedDict" if arguments.is_empty() => self.push(Value::Nothing),
            "torch._utils _rebuild_tensor_v2" => {
                let tensor = tensor(&arguments).ok_or("describes a tensor in an unknown way")?;
                self.push(Value::Tensor(Rc::new(tensor)))
            }
            other => Err(format!("calls '{other}' with unsupported arguments")),
        }
    }
}

fn tensor(arguments: &[Value]) -> Option<TensorRef> {
    let counts = |value: &Value| -> Option<Vec<usize>> {
        let Value::List(items) = value else { return None };
        items.iter().map(count).collect()
    };
    let Value::List(storage) = arguments.first()? else { return None };
    let (Value::Name(kind), Value::Text(key)) = (storage.get(1)?, storage.get(2)?) else { return None };
    let (sizes, strides) = (counts(arguments.get(2)?)?, counts(arguments.get(3)?)?);
    let storage = kind.strip_prefix("torch ")?.into();
    let tensor = TensorRef { storage, key: key.clone(), offset: count(arguments.get(1)?)?, sizes, strides };
    (tensor.sizes.len() == tensor.strides.len()).then_some(tensor)
}

fn count(value: &Value) -> Option<usize> {
    let Value::Int(n) = value else { return None };
    usize::try_from(*n).ok()
}

#[cfg(test)]
mod tests {
    /// `tests/fuzz` mutates these; here each is refused for its own reason.
    #[test]
    fn attacks_are_refused() {
        for (text, word) in [
            (&b"cos\nsystem\n."[..], "os system"),
            (b"cbuiltins\neval\n(X\x01\x00\x00\x001tR.", "builtins eval"),
            (b"X\xff\xff\xff\xffabc.", "ends in the middle"),
            (b"Nr\xff\xff\xff\x7f.", "beyond"),
            (b"h\x05.", "never made"),
            (b"]q\x00h\x00.", "twice"),
            (b"I1\n.", "instruction"),
        ] {
            let said = super::read(text).err().unwrap_or_default();
            assert!(said.contains(word), "{said} for {text:?}");
        }
    }
}
