//! What several test files share: the reference fixtures and how their absence is handled.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)] // test code: each test file uses a part of it, and a panic is a failure

pub mod gpu;
pub mod reference64;

use safetensors::{Dtype, SafeTensors};
use std::collections::HashMap;
use std::path::PathBuf;

/// A folder under the shared fixtures: `$<env>` when set, else `../shared/<name>` beside the repository.
/// Missing: a failure in CI, a printed skip for a user who has only the repository.
pub fn shared_folder(env: &str, name: &str) -> Option<PathBuf> {
    let path = std::env::var_os(env)
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared").join(name), PathBuf::from);
    if path.is_dir() {
        return Some(path);
    }
    assert!(
        std::env::var_os("CI").is_none(),
        "the shared fixtures are missing: {} is not a folder; set {env} to where they are",
        path.display()
    );
    println!("SKIPPED: {} is not there (set {env} to where it is)", path.display());
    None
}

/// The real photo scene of this name, or `None` after a printed skip.
pub fn real_scene(name: &str) -> Option<PathBuf> {
    shared_folder("GSSCALE_DATA", "data").map(|p| p.join(name))
}

/// One fixture file, every tensor widened to f64 (integers and bytes too).
pub struct Fixture {
    tensors: HashMap<String, (Vec<usize>, Vec<f64>)>,
    /// The file's metadata: max_alpha, sh_degree, eps ...
    pub metadata: HashMap<String, String>,
}

impl Fixture {
    /// Reads `<oracle>/<name>.safetensors`, or `None` after a printed skip.
    pub fn open(name: &str) -> Option<Fixture> {
        let path = shared_folder("GSSCALE_ORACLE", "oracle")?.join(format!("{name}.safetensors"));
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let metadata = header.metadata().clone().unwrap_or_default();
        let tensors = file.tensors().into_iter().map(|(n, t)| (n, (t.shape().to_vec(), widen(t.dtype(), t.data()))));
        Some(Fixture { tensors: tensors.collect(), metadata })
    }

    /// Whether the tensor exists.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// Shape of a tensor.
    pub fn shape(&self, name: &str) -> &[usize] {
        &self.tensors.get(name).unwrap_or_else(|| panic!("no tensor {name}")).0
    }

    /// Values of a tensor, row-major.
    pub fn f64(&self, name: &str) -> &[f64] {
        &self.tensors.get(name).unwrap_or_else(|| panic!("no tensor {name}")).1
    }

    /// Values of a tensor as f32 (exact for the inputs, which are f32 in the files).
    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.f64(name).iter().map(|&x| x as f32).collect()
    }
}

fn widen(dtype: Dtype, data: &[u8]) -> Vec<f64> {
    match dtype {
        Dtype::F32 => data.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect(),
        Dtype::F64 => data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect(),
        Dtype::I32 => data.chunks_exact(4).map(|b| f64::from(i32::from_le_bytes(b.try_into().unwrap()))).collect(),
        Dtype::U8 => data.iter().map(|&b| f64::from(b)).collect(),
        other => panic!("fixture holds {other:?}, which no test reads"),
    }
}
