//! LPIPS: how different two pictures look to a network that was trained on something else (Zhang et al., CVPR 2018).
//!
//! The features of AlexNet or VGG-16 after five of their layers are scaled to unit length over channels; their squared
//! differences are weighed per channel, averaged over the picture and added up. Version 0.1 of the authors' package is
//! followed to the letter; the weights come from a file (see [`weights`]), nothing is downloaded.
//!
//! Invariants: 1. the result is the same for any number of threads; 2. memory is that of one picture's features at one
//! layer, twice; 3. numbers of different networks or of different input ranges are never comparable, so every report
//! names both.

mod conv;
pub mod weights;

use crate::base::simd::SimdPath;
use crate::scene::image::{Image, Target};
use conv::{Conv, Planes, max_pool};
use rayon::prelude::*;

/// Which network looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Network {
    /// AlexNet: what gsplat, GS-Scale and nerfstudio report.
    Alex,
    /// VGG-16: what the code of the 3DGS paper and the CityGaussian line report.
    Vgg,
}

impl Network {
    /// The name in reports and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Network::Alex => "alex",
            Network::Vgg => "vgg",
        }
    }

    fn layers(self) -> &'static [Layer] {
        match self {
            Network::Alex => &ALEX,
            Network::Vgg => &VGG,
        }
    }

    /// Shortest side of a picture that leaves something for every layer, pixels.
    fn shortest_side(self) -> usize {
        match self {
            Network::Alex => 31,
            Network::Vgg => 16,
        }
    }
}

/// What the values of a picture are mapped to before the network sees them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputRange {
    /// -1..1, what the weights were trained for (`normalize=True` of the authors' package).
    Signed,
    /// 0..1 as they are (`normalize=False`): a slip of the 3DGS code that many tables repeat.
    Unit,
}

impl InputRange {
    /// The name in reports and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            InputRange::Signed => "signed",
            InputRange::Unit => "unit",
        }
    }
}

impl std::str::FromStr for InputRange {
    type Err = String;

    fn from_str(text: &str) -> Result<InputRange, String> {
        let ranges = [InputRange::Signed, InputRange::Unit];
        ranges.into_iter().find(|r| r.name() == text).ok_or_else(|| format!("'{text}' is neither signed nor unit"))
    }
}

/// One step of a network. Every convolution is followed by a rectifier.
#[derive(Debug, Clone, Copy)]
enum Layer {
    /// Convolution: name in the file, channels in and out, kernel, stride, padding; whether the distance looks here.
    Conv { name: &'static str, shape: [usize; 2], kernel: usize, stride: usize, padding: usize, tap: bool },
    /// Maximum over `size` x `size` pixels, every second one.
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

/// Mean of the training pictures, in the range -1..1, and their deviation.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// A network with its weights.
pub struct Lpips {
    network: Network,
    /// One per convolution, in order.
    convs: Vec<Conv>,
    /// Weights of the channels at each tap.
    channel_weights: Vec<Vec<f32>>,
    simd: SimdPath,
}

impl Lpips {
    /// Which network it is.
    pub fn network(&self) -> Network {
        self.network
    }

    /// Distance of a picture from its photo, 0 for equal ones. Values are cut to 0..1; masked pixels take the photo's
    /// value. NaN when a value is not finite or when the picture is too small for the network.
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
                Layer::Pool { size } => (a, b) = (max_pool(&a, *size), max_pool(&b, *size)),
                Layer::Conv { tap: is_tap, .. } => {
                    (a, b) = (self.convs[conv].apply(&a, self.simd), self.convs[conv].apply(&b, self.simd));
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

/// The two pictures as the network wants them.
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

/// Mean over pixels of the weighed squared differences of features of unit length.
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
