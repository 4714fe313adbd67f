//! LPIPS: a perceptual distance between two pictures in the feature space of an image network (Zhang et al., CVPR
//! 2018).
//!
//! Features of AlexNet or VGG-16 at five layers are scaled to unit length over channels. The squared differences are
//! weighted per channel, averaged over pixels and summed over layers. The computation follows version 0.1 of the
//! authors' package exactly. The weights come from a file (see [`weights`]); the program downloads nothing.
//!
//! Invariants: 1. the result is the same for any number of threads; 2. memory holds the features of one layer at a
//! time, for both pictures; 3. values of different networks or input ranges are not comparable, so every report names
//! both.

mod conv;
pub mod weights;

use crate::base::names::names;
use crate::base::simd::SimdPath;
use crate::scene::image::{Image, Target};
use conv::{Conv, Planes, max_pool};
use rayon::prelude::*;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Network {
    /// AlexNet, as reported by gsplat, GS-Scale and nerfstudio.
    Alex,
    /// VGG-16, as reported by the code of the 3DGS paper and by the CityGaussian line.
    Vgg,
}

names!(Network { Alex = "alex", Vgg = "vgg" });

impl Network {
    fn layers(self) -> &'static [Layer] {
        match self {
            Network::Alex => &ALEX,
            Network::Vgg => &VGG,
        }
    }

    /// Shortest side of a picture that gives every layer at least one pixel, pixels.
    fn shortest_side(self) -> usize {
        match self {
            Network::Alex => 31,
            Network::Vgg => 16,
        }
    }
}

/// The range to which pixel values are mapped before the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputRange {
    /// -1..1, the range of the training data (`normalize=True` of the authors' package).
    Signed,
    /// 0..1, unchanged (`normalize=False`): a mistake of the 3DGS code that many tables repeat.
    Unit,
}

names!(InputRange { Signed = "signed", Unit = "unit" });

impl std::str::FromStr for InputRange {
    type Err = String;

    fn from_str(text: &str) -> Result<InputRange, String> {
        InputRange::from_name(text).ok_or_else(|| format!("unknown input range '{text}': use signed or unit"))
    }
}

/// One layer of a network. A ReLU follows every convolution.
#[derive(Debug, Clone, Copy)]
enum Layer {
    /// Convolution. `name`: tensor name in the file; `shape`: input and output channels; `tap`: whether the distance
    /// compares the features after this layer.
    Conv { name: &'static str, shape: [usize; 2], kernel: usize, stride: usize, padding: usize, tap: bool },
    /// Maximum over windows of `size` x `size` pixels, stride 2.
    Pool { size: usize },
}

const fn conv(name: &'static str, shape: [usize; 2], [kernel, stride, padding]: [usize; 3], tap: bool) -> Layer {
    Layer::Conv { name, shape, kernel, stride, padding, tap }
}

const ALEX: [Layer; 7] = [
    conv("slice1.0", [3, 64], [11, 4, 2], true),
    Layer::Pool { size: 3 },
    conv("slice2.3", [64, 192], [5, 1, 2], true),
    Layer::Pool { size: 3 },
    conv("slice3.6", [192, 384], [3, 1, 1], true),
    conv("slice4.8", [384, 256], [3, 1, 1], true),
    conv("slice5.10", [256, 256], [3, 1, 1], true),
];

const VGG: [Layer; 17] = [
    conv("slice1.0", [3, 64], [3, 1, 1], false),
    conv("slice1.2", [64, 64], [3, 1, 1], true),
    Layer::Pool { size: 2 },
    conv("slice2.5", [64, 128], [3, 1, 1], false),
    conv("slice2.7", [128, 128], [3, 1, 1], true),
    Layer::Pool { size: 2 },
    conv("slice3.10", [128, 256], [3, 1, 1], false),
    conv("slice3.12", [256, 256], [3, 1, 1], false),
    conv("slice3.14", [256, 256], [3, 1, 1], true),
    Layer::Pool { size: 2 },
    conv("slice4.17", [256, 512], [3, 1, 1], false),
    conv("slice4.19", [512, 512], [3, 1, 1], false),
    conv("slice4.21", [512, 512], [3, 1, 1], true),
    Layer::Pool { size: 2 },
    conv("slice5.24", [512, 512], [3, 1, 1], false),
    conv("slice5.26", [512, 512], [3, 1, 1], false),
    conv("slice5.28", [512, 512], [3, 1, 1], true),
];

/// Mean and standard deviation of the training pictures per channel, in the range -1..1.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// A network with its weights.
pub struct Lpips {
    network: Network,
    /// The convolutions, in layer order.
    convs: Vec<Conv>,
    /// Channel weights of each tap.
    channel_weights: Vec<Vec<f32>>,
    simd: SimdPath,
}

impl Lpips {
    pub fn network(&self) -> Network {
        self.network
    }

    /// Distance of a picture from its photo, 0 if they are equal. Values are clamped to 0..1; masked pixels take the
    /// photo's value. NaN when a value is NaN or the picture is too small for the network.
    ///
    /// # Panics
    /// When picture and target differ in size.
    pub fn distance(&self, image: &Image, target: &Target, range: InputRange) -> f64 {
        assert_eq!([image.width, image.height], [target.width, target.height], "picture and photo differ in size");
        let shortest = image.width.min(image.height) as usize;
        if shortest < self.network.shortest_side() || image.rgb.iter().any(|x| x.is_nan()) {
            return f64::NAN;
        }
        let (mut a, mut b) = input_planes(image, target, range);
        let (mut conv, mut tap) = (0, 0);
        let mut sum = 0.0;
        for layer in self.network.layers() {
            match layer {
                // One after the other: the input of the first is gone before the second is made.
                Layer::Pool { size } => {
                    a = max_pool(&a, *size);
                    b = max_pool(&b, *size);
                }
                Layer::Conv { tap: is_tap, .. } => {
                    a = self.convs[conv].apply(&a, self.simd);
                    b = self.convs[conv].apply(&b, self.simd);
                    conv += 1;
                    if *is_tap {
                        sum += mean_difference(&a, &b, &self.channel_weights[tap]);
                        tap += 1;
                    }
                }
            }
        }
        sum
    }
}

impl Network {
    /// The most bytes that the weights, and features of a picture and its photo of this size in pixels, take at once.
    pub fn bytes(self, [width, height]: [u32; 2]) -> u64 {
        let bytes = |channels: usize, [width, height]: [usize; 2]| (4 * channels * width * height) as u64;
        let (mut channels, mut size) = (3, [width as usize, height as usize]);
        let mut input = bytes(channels, size);
        let (mut most, mut weights) = (2 * input, 0);
        for layer in self.layers() {
            match *layer {
                Layer::Pool { size: window } => size = size.map(|side| side.saturating_sub(window) / 2 + 1),
                Layer::Conv { shape, kernel, stride, padding, .. } => {
                    weights += 4 * (shape[0] * shape[1] * kernel * kernel) as u64;
                    channels = shape[1];
                    size = size.map(|side| (side + 2 * padding).saturating_sub(kernel) / stride + 1);
                }
            }
            let output = bytes(channels, size);
            // The layer is applied to the picture, then to the photo.
            most = most.max(input + output + input.max(output));
            input = output;
        }
        weights + most
    }
}

/// Picture and photo as inputs of the network.
fn input_planes(image: &Image, target: &Target, range: InputRange) -> (Planes, Planes) {
    let (width, height, pixels) = (image.width as usize, image.height as usize, image.pixels());
    let (mut a, mut b) = (Planes::zeros(3, height, width), Planes::zeros(3, height, width));
    let to_input = |x: f32, c: usize| {
        let x = if range == InputRange::Signed { 2.0 * x - 1.0 } else { x };
        (x - SHIFT[c]) / SCALE[c]
    };
    for i in 0..pixels {
        let counts = target.mask.as_ref().is_none_or(|mask| mask[i] != 0);
        for c in 0..3 {
            let photo = f32::from(target.rgb[3 * i + c]) / 255.0;
            let render = if counts { image.rgb[c * pixels + i].clamp(0.0, 1.0) } else { photo };
            let at = a.index(c, i / width, i % width);
            (a.values[at], b.values[at]) = (to_input(render, c), to_input(photo, c));
        }
    }
    (a, b)
}

/// Mean over pixels of the weighted squared differences of unit-length features.
fn mean_difference(a: &Planes, b: &Planes, channel_weights: &[f32]) -> f64 {
    let rows: Vec<f64> = (0..a.height)
        .into_par_iter()
        .map(|y| (0..a.width).map(|x| pixel_difference(a, b, channel_weights, y, x)).sum())
        .collect();
    rows.iter().sum::<f64>() / (a.height * a.width) as f64
}

fn pixel_difference(a: &Planes, b: &Planes, channel_weights: &[f32], y: usize, x: usize) -> f64 {
    let norm = |planes: &Planes| {
        let squares = (0..planes.channels).map(|c| f64::from(planes.values[planes.index(c, y, x)]).powi(2));
        squares.sum::<f64>().sqrt() + 1e-10
    };
    let (norm_a, norm_b) = (norm(a), norm(b));
    let mut sum = 0.0;
    for (c, &weight) in channel_weights.iter().enumerate() {
        let at = a.index(c, y, x);
        let difference = f64::from(a.values[at]) / norm_a - f64::from(b.values[at]) / norm_b;
        sum += f64::from(weight) * difference * difference;
    }
    sum
}
