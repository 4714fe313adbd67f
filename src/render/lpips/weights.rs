//! Reads LPIPS weights from a safetensors file. The user makes the file once, with Python and the `lpips` package:
//!
//! ```text
//! python -c "import lpips, safetensors.torch as s; s.save_file({k: v.clone().contiguous() for k, v in lpips.LPIPS(net='alex').state_dict().items()}, 'lpips_alex.safetensors')"
//! ```
//!
//! (`net='vgg'` for VGG.) The shape of the first layer tells the network. A safetensors file holds numbers only and
//! contains no executable code.

use super::conv::Conv;
use super::{Layer, Lpips, Network};
use crate::base::error::{InputError, InputResult};
use crate::base::simd::SimdPath;
use safetensors::{Dtype, SafeTensors};
use std::path::Path;

/// Size limit of the file: VGG has 59 MB, and a file may also hold the classifier's tensors or copies.
const FILE_BYTES_MAX: u64 = 1 << 30;
const REMEDY: &str = "make it with the one-line export in tools/README.md, section LPIPS";

/// Reads a network with its weights.
/// Errors: the file cannot be read or is not a safetensors file; a tensor is missing, has another shape or is not finite.
pub fn read_lpips(path: &Path, simd: SimdPath) -> InputResult<Lpips> {
    let io = |e: std::io::Error| InputError::io(path, "reading the LPIPS weights", &e);
    if std::fs::metadata(path).map_err(io)?.len() > FILE_BYTES_MAX {
        return Err(InputError::new(path, "exceeds 1 GiB, the size limit for LPIPS weights", REMEDY));
    }
    let bytes = std::fs::read(path).map_err(io)?;
    let tensors = SafeTensors::deserialize(&bytes)
        .map_err(|e| InputError::new(path, format!("is not a safetensors file: {e}"), REMEDY))?;
    let file = File { path, tensors };
    let network = file.network()?;
    let (mut convs, mut channel_weights) = (Vec::new(), Vec::new());
    for layer in network.layers() {
        let Layer::Conv { name, shape: [inputs, outputs], kernel, stride, padding, tap } = *layer else { continue };
        let weights = file.floats(&format!("net.{name}.weight"), &[outputs, inputs, kernel, kernel])?;
        let bias = file.floats(&format!("net.{name}.bias"), &[outputs])?;
        convs.push(Conv::new(&weights, &bias, [inputs, outputs], [kernel, stride, padding]));
        if tap {
            let name = format!("lin{}.model.1.weight", channel_weights.len());
            channel_weights.push(file.floats(&name, &[1, outputs, 1, 1])?);
        }
    }
    Ok(Lpips { network, convs, channel_weights, simd })
}

struct File<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
}

impl File<'_> {
    fn network(&self) -> InputResult<Network> {
        let shape = self.tensors.tensor("net.slice1.0.weight").map(|t| t.shape().to_vec()).unwrap_or_default();
        match shape.as_slice() {
            [64, 3, 11, 11] => Ok(Network::Alex),
            [64, 3, 3, 3] => Ok(Network::Vgg),
            _ => {
                let problem =
                    "holds neither AlexNet nor VGG-16 of the lpips package: unknown shape of net.slice1.0.weight";
                Err(InputError::new(self.path, problem, REMEDY))
            }
        }
    }

    fn floats(&self, name: &str, shape: &[usize]) -> InputResult<Vec<f32>> {
        let wrong = |problem: String| InputError::new(self.path, problem, REMEDY).at(format!("tensor {name}"));
        let tensor = self.tensors.tensor(name).map_err(|_| wrong("is missing".into()))?;
        if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
            let (dtype, got) = (tensor.dtype(), tensor.shape());
            return Err(wrong(format!("is {dtype:?} {got:?}, expected F32 {shape:?}")));
        }
        let values: Vec<f32> =
            tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        match values.iter().all(|x| x.is_finite()) {
            true => Ok(values),
            false => Err(wrong("contains a value that is not finite".into())),
        }
    }
}
