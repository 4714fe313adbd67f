//! Reference fixtures of the oracle, and the printed skip where they are absent.

use super::shared::shared_folder;
use safetensors::{Dtype, SafeTensors};
use std::collections::HashMap;

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
