//! Convolution and max pooling of pictures on the CPU, for metrics.
//!
//! The layout is `[y][channel][x]`, so that a row of results is contiguous and rows can be computed in parallel. A
//! convolution gathers the pixels under the kernel for 32 neighbouring results and multiplies them with the weights of
//! eight output channels at a time; the sums stay in registers.
//!
//! Invariant: sums run over (input channel, kernel row, kernel column) in that order, for any number of threads.

use crate::base::simd::{Kernel, SimdPath, dispatch, fma};
use rayon::prelude::*;

/// Neighbouring results in x that are computed together.
const BLOCK: usize = 32;
/// Output channels that are computed together.
const GROUP: usize = 8;

/// Channels of a picture: value (c, y, x) at `(y * channels + c) * width + x`.
#[derive(Debug, Clone)]
pub(super) struct Planes {
    pub channels: usize,
    pub height: usize,
    pub width: usize,
    pub values: Vec<f32>,
}

impl Planes {
    pub fn zeros(channels: usize, height: usize, width: usize) -> Planes {
        Planes { channels, height, width, values: vec![0.0; channels * height * width] }
    }

    pub fn index(&self, channel: usize, y: usize, x: usize) -> usize {
        (y * self.channels + channel) * self.width + x
    }
}

/// A convolution with bias and ReLU.
pub(super) struct Conv {
    /// `[out / 8][in * kernel * kernel][8]`, the last group padded with zeros.
    weights: Vec<f32>,
    /// `[out]`, padded to whole groups.
    bias: Vec<f32>,
    /// Input and output channels.
    channels: [usize; 2],
    kernel: usize,
    stride: usize,
    padding: usize,
}

impl Conv {
    /// Packs weights `[out][in][kernel][kernel]` and a bias `[out]`; `channels` is [in, out].
    pub fn new(weights: &[f32], bias: &[f32], channels: [usize; 2], [kernel, stride, padding]: [usize; 3]) -> Conv {
        let [inputs, outputs] = channels;
        let terms = inputs * kernel * kernel;
        let groups = outputs.div_ceil(GROUP);
        let mut packed = vec![0.0; groups * terms * GROUP];
        for out in 0..outputs {
            for term in 0..terms {
                packed[(out / GROUP * terms + term) * GROUP + out % GROUP] = weights[out * terms + term];
            }
        }
        let mut bias = bias.to_vec();
        bias.resize(groups * GROUP, 0.0);
        Conv { weights: packed, bias, channels, kernel, stride, padding }
    }

    /// max(0, weights * input + bias).
    pub fn apply(&self, input: &Planes, simd: SimdPath) -> Planes {
        let size = |n: usize| (n + 2 * self.padding).saturating_sub(self.kernel) / self.stride + 1;
        let mut out = Planes::zeros(self.channels[1], size(input.height), size(input.width));
        let (row_length, width) = (out.channels * out.width, out.width);
        out.values.par_chunks_mut(row_length).enumerate().for_each_init(Vec::new, |patch, (y, row)| {
            for x in (0..width).step_by(BLOCK) {
                self.gather(input, y, x, patch);
                dispatch(simd, BlockSums { conv: self, patch, row: &mut *row, width, x });
            }
        });
        out
    }

    /// Gathers the inputs of the results (y, x..x + BLOCK) into `patch`, `[in * kernel * kernel][BLOCK]`, with zeros
    /// outside the picture.
    fn gather(&self, input: &Planes, y: usize, x: usize, patch: &mut Vec<f32>) {
        patch.clear();
        for channel in 0..self.channels[0] {
            for ky in 0..self.kernel {
                let from_y = (y * self.stride + ky).wrapping_sub(self.padding);
                for kx in 0..self.kernel {
                    if from_y >= input.height {
                        patch.resize(patch.len() + BLOCK, 0.0);
                        continue;
                    }
                    let row = &input.values[input.index(channel, from_y, 0)..][..input.width];
                    let first = (x * self.stride + kx).wrapping_sub(self.padding);
                    if self.stride == 1 && first < input.width && input.width - first >= BLOCK {
                        patch.extend_from_slice(&row[first..first + BLOCK]);
                    } else {
                        let at = |i: usize| row.get(first.wrapping_add(i * self.stride)).copied().unwrap_or(0.0);
                        patch.extend((0..BLOCK).map(at));
                    }
                }
            }
        }
    }
}

/// Computes all output channels of one block of results.
struct BlockSums<'a> {
    conv: &'a Conv,
    patch: &'a [f32],
    /// `[out][width]`.
    row: &'a mut [f32],
    width: usize,
    x: usize,
}

impl Kernel for BlockSums<'_> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let BlockSums { conv, patch, row, width, x } = self;
        let terms = patch.len() / BLOCK;
        let wanted = BLOCK.min(width - x);
        for (group, weights) in conv.weights.chunks_exact(terms * GROUP).enumerate() {
            let mut sums = [[0.0f32; BLOCK]; GROUP];
            for j in 0..GROUP {
                sums[j] = [conv.bias[group * GROUP + j]; BLOCK];
            }
            for (inputs, weights) in patch.chunks_exact(BLOCK).zip(weights.chunks_exact(GROUP)) {
                for j in 0..GROUP {
                    for l in 0..BLOCK {
                        sums[j][l] = fma::<FMA>(weights[j], inputs[l], sums[j][l]);
                    }
                }
            }
            for j in 0..GROUP.min(conv.channels[1] - group * GROUP) {
                let to = &mut row[(group * GROUP + j) * width + x..][..wanted];
                for l in 0..wanted {
                    to[l] = sums[j][l].max(0.0);
                }
            }
        }
    }
}

/// Maximum over windows of `size` x `size` pixels with stride 2; incomplete windows are dropped.
pub(super) fn max_pool(input: &Planes, size: usize) -> Planes {
    let shrunk = |n: usize| n.saturating_sub(size) / 2 + usize::from(n >= size);
    let mut out = Planes::zeros(input.channels, shrunk(input.height), shrunk(input.width));
    let width = out.width;
    if width == 0 {
        return out;
    }
    out.values.par_chunks_mut(input.channels * width).enumerate().for_each(|(y, row)| {
        for channel in 0..input.channels {
            for x in 0..width {
                let mut largest = f32::NEG_INFINITY;
                for dy in 0..size {
                    let from = input.index(channel, 2 * y + dy, 2 * x);
                    largest = input.values[from..from + size].iter().fold(largest, |m, &v| m.max(v));
                }
                row[channel * width + x] = largest;
            }
        }
    });
    out
}
