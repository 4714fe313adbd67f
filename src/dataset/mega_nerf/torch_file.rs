//! Files of `torch.save`: a zip archive with a pickle (`<name>/data.pkl`) and one file of numbers per tensor
//! (`<name>/data/<key>`), little-endian.
//!
//! Invariants: 1. nothing in a file is executed; 2. sizes are checked before anything is allocated: metadata files are
//! small, and larger ones are refused.

use super::pickle::{self, TensorRef, Value};
use crate::base::error::{InputError, InputResult};
use std::cell::RefCell;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// Metadata files have one or two kilobytes; this leaves room for additions.
const FILE_BYTES_MAX: u64 = 16 << 20;
const REMEDY: &str = "save it again with torch.save (PyTorch 1.6 or later) as a dictionary of numbers and tensors";

/// An opened file whose top-level value is a dictionary.
pub(super) struct TorchFile {
    path: PathBuf,
    archive: RefCell<ZipArchive<BufReader<File>>>,
    /// Folder of the entries inside the archive, ending in `/`.
    prefix: String,
    top: Value,
}

impl TorchFile {
    pub fn open(path: &Path) -> InputResult<TorchFile> {
        let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
        let bytes = file.metadata().map_err(|e| InputError::io(path, "opening", &e))?.len();
        let bad = |problem: String| InputError::new(path, problem, REMEDY);
        if bytes > FILE_BYTES_MAX {
            return Err(bad(format!("has {bytes} bytes, far more than a camera's metadata")));
        }
        let mut archive =
            ZipArchive::new(BufReader::new(file)).map_err(|e| bad(format!("is not a file of torch.save: {e}")))?;
        let pickle = archive.file_names().flatten().find(|n| n.ends_with("/data.pkl")).map(|n| n.to_string());
        let pickle = pickle.ok_or_else(|| bad("is not a file of torch.save: data.pkl is missing".into()))?;
        let text = entry(&mut archive, &pickle).map_err(bad)?;
        let top = pickle::read(&text).map_err(|problem| bad(problem).at("data.pkl"))?;
        let prefix = pickle[..pickle.len() - "data.pkl".len()].to_string();
        Ok(TorchFile { path: path.to_path_buf(), archive: RefCell::new(archive), prefix, top })
    }

    /// The numbers under a key: a number, or a tensor of one of the `shapes`, row-major.
    pub fn numbers(&self, key: &str, shapes: &[&[usize]]) -> InputResult<Vec<f64>> {
        let wrong = |problem: String| InputError::new(&self.path, problem, REMEDY).at(format!("key '{key}'"));
        let value = self.top.get(key).ok_or_else(|| wrong("is missing".into()))?;
        match value {
            Value::Int(n) if shapes.contains(&&[][..]) => Ok(vec![*n as f64]),
            Value::Float(x) if shapes.contains(&&[][..]) => Ok(vec![*x]),
            Value::Tensor(tensor) if shapes.contains(&tensor.sizes.as_slice()) => self.tensor(tensor).map_err(wrong),
            Value::Tensor(tensor) => Err(wrong(format!("is a tensor of {:?}, but {shapes:?} is needed", tensor.sizes))),
            _ => Err(wrong(format!("must be a number or a tensor of {shapes:?}"))),
        }
    }

    /// One number under a key: a number or a tensor of one element.
    pub fn number(&self, key: &str) -> InputResult<f64> {
        self.numbers(key, &[&[], &[1]]).map(|n| n[0])
    }

    fn tensor(&self, tensor: &TensorRef) -> Result<Vec<f64>, String> {
        let (width, decode): (usize, fn(&[u8]) -> f64) = match &*tensor.storage {
            "FloatStorage" => (4, |b| f64::from(f32::from_le_bytes(std::array::from_fn(|i| b[i])))),
            "DoubleStorage" => (8, |b| f64::from_le_bytes(std::array::from_fn(|i| b[i]))),
            "LongStorage" => (8, |b| i64::from_le_bytes(std::array::from_fn(|i| b[i])) as f64),
            "IntStorage" => (4, |b| f64::from(i32::from_le_bytes(std::array::from_fn(|i| b[i])))),
            other => return Err(format!("is stored as {other}, which is not supported")),
        };
        let bytes = entry(&mut self.archive.borrow_mut(), &format!("{}data/{}", self.prefix, tensor.key))?;
        // The shape equals one of a short list of known ones: the product is small.
        let count: usize = tensor.sizes.iter().product();
        let mut out = Vec::with_capacity(count);
        for i in 0..count {
            let (mut rest, mut at) = (i, Some(tensor.offset));
            for (&size, &stride) in tensor.sizes.iter().zip(&tensor.strides).rev() {
                at = at.and_then(|at| at.checked_add(stride.checked_mul(rest % size)?));
                rest /= size;
            }
            let element = at.and_then(|at| at.checked_mul(width)).and_then(|at| bytes.get(at..at.checked_add(width)?));
            out.push(decode(element.ok_or("reaches beyond the numbers that the file holds")?));
        }
        Ok(out)
    }
}

fn entry(archive: &mut ZipArchive<BufReader<File>>, name: &str) -> Result<Vec<u8>, String> {
    let mut file = archive.by_name(name).map_err(|e| format!("entry '{name}': {e}"))?;
    if file.size() > FILE_BYTES_MAX {
        return Err(format!("entry '{name}' claims {} bytes", file.size()));
    }
    let mut bytes = Vec::new();
    let read = file.by_ref().take(FILE_BYTES_MAX).read_to_end(&mut bytes);
    read.map_err(|e| format!("entry '{name}': {e}"))?;
    Ok(bytes)
}
