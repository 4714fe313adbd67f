//! LPIPS against PyTorch: drawn weights and pictures, distances computed by tests/fixtures/lpips.py. Also malformed
//! weight files.

use gsscale::base::rng::mix64;
use gsscale::base::simd::SimdPath;
use gsscale::render::lpips::weights::read_lpips;
use gsscale::render::lpips::{InputRange, Lpips};
use gsscale::scene::image::{Image, Target};
use safetensors::tensor::{Dtype, TensorView};
use std::path::Path;

type Layers = &'static [(&'static str, [usize; 4], bool)];
const ALEX: Layers = &[
    ("slice1.0", [64, 3, 11, 11], true),
    ("slice2.3", [192, 64, 5, 5], true),
    ("slice3.6", [384, 192, 3, 3], true),
    ("slice4.8", [256, 384, 3, 3], true),
    ("slice5.10", [256, 256, 3, 3], true),
];
const VGG: Layers = &[
    ("slice1.0", [64, 3, 3, 3], false),
    ("slice1.2", [64, 64, 3, 3], true),
    ("slice2.5", [128, 64, 3, 3], false),
    ("slice2.7", [128, 128, 3, 3], true),
    ("slice3.10", [256, 128, 3, 3], false),
    ("slice3.12", [256, 256, 3, 3], false),
    ("slice3.14", [256, 256, 3, 3], true),
    ("slice4.17", [512, 256, 3, 3], false),
    ("slice4.19", [512, 512, 3, 3], false),
    ("slice4.21", [512, 512, 3, 3], true),
    ("slice5.24", [512, 512, 3, 3], false),
    ("slice5.26", [512, 512, 3, 3], false),
    ("slice5.28", [512, 512, 3, 3], true),
];

/// Like `uniform` of the script.
fn uniform(stream: u64, count: usize) -> impl Iterator<Item = f64> {
    (1..=count as u64).map(move |i| (mix64((stream << 32) + i) >> 40) as f64 / f64::from(1 << 24))
}

fn bytes(values: impl Iterator<Item = f64>) -> Vec<u8> {
    values.flat_map(|x| (x as f32).to_le_bytes()).collect()
}

fn tensors(layers: Layers) -> Vec<(String, Vec<usize>, Vec<u8>)> {
    let mut out = Vec::new();
    let mut taps = 0;
    for (i, &(name, shape, tap)) in layers.iter().enumerate() {
        let stream = 100 + 3 * i as u64;
        let (outputs, fan_in) = (shape[0], shape[1] * shape[2] * shape[3]);
        let bound = (6.0 / fan_in as f64).sqrt();
        let weights = bytes(uniform(stream, outputs * fan_in).map(|u| (2.0 * u - 1.0) * bound));
        out.push((format!("net.{name}.weight"), shape.to_vec(), weights));
        let bias = bytes(uniform(stream + 1, outputs).map(|u| 0.2 * u - 0.1));
        out.push((format!("net.{name}.bias"), vec![outputs], bias));
        if tap {
            let lin = bytes(uniform(stream + 2, outputs));
            out.push((format!("lin{taps}.model.1.weight"), vec![1, outputs, 1, 1], lin));
            taps += 1;
        }
    }
    out
}

fn write(path: &Path, tensors: &[(String, Vec<usize>, Vec<u8>)]) {
    let views = tensors.iter().map(|(n, s, b)| (n.clone(), TensorView::new(Dtype::F32, s.clone(), b).unwrap()));
    std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
}

fn network(layers: Layers, folder: &Path) -> Lpips {
    let path = folder.join("weights.safetensors");
    write(&path, &tensors(layers));
    read_lpips(&path, SimdPath::best()).unwrap()
}

/// The picture and the photo of the script.
fn pictures(width: u32, height: u32) -> (Image, Target) {
    let n = (width * height) as usize;
    let photo: Vec<u8> = uniform(1, 3 * n).map(|u| (u * 256.0) as u8).collect();
    let mut image = Image::new(width, height);
    for (i, noise) in uniform(2, 3 * n).enumerate() {
        image.rgb[i % 3 * n + i / 3] = (0.7 * (f64::from(photo[i]) / 255.0) + 0.3 * noise) as f32;
    }
    (image, Target::new([width, height], photo))
}

#[test]
fn distances_are_those_of_pytorch() {
    let text =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lpips.json")).unwrap();
    let fixture: serde_json::Value = serde_json::from_str(&text).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (name, layers) in [("alex", ALEX), ("vgg", VGG)] {
        let lpips = network(layers, folder.path());
        assert_eq!(lpips.network().name(), name);
        let cases: Vec<_> = fixture["cases"].as_array().unwrap().iter().filter(|c| c["network"] == name).collect();
        assert_eq!(cases.len(), 4);
        for case in cases {
            let size = ["width", "height"].map(|k| case[k].as_u64().unwrap() as u32);
            let (image, target) = pictures(size[0], size[1]);
            let range = if case["range"] == "signed" { InputRange::Signed } else { InputRange::Unit };
            let (got, want) = (lpips.distance(&image, &target, range), case["distance"].as_f64().unwrap());
            // f32 here against f64 there, through up to 13 layers of sums of up to 4,608 terms.
            assert!((got - want).abs() < 2e-5 * want, "{case}: {got}");
        }
    }
}

#[test]
fn masks_equality_and_what_cannot_be_measured() {
    let folder = tempfile::tempdir().unwrap();
    let lpips = network(ALEX, folder.path());
    let (mut image, mut target) = pictures(40, 40);
    assert!(lpips.distance(&image, &target, InputRange::Signed) > 0.0);
    target.mask = Some(vec![0; 1600]);
    assert_eq!(lpips.distance(&image, &target, InputRange::Signed), 0.0, "masked pixels take the photo's value");
    image.rgb[5] = f32::NAN;
    assert!(lpips.distance(&image, &target, InputRange::Signed).is_nan());
    let (image, target) = pictures(30, 64);
    assert!(lpips.distance(&image, &target, InputRange::Signed).is_nan(), "too small for AlexNet's five layers");
}

#[test]
fn wrong_files_of_weights_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let refused = |path: &Path| read_lpips(path, SimdPath::best()).err().expect("refused").to_string();
    assert!(refused(&path).contains("check the path"));
    std::fs::write(&path, b"PK\x03\x04 a pickle").unwrap();
    assert!(refused(&path).contains("not a safetensors file"));
    let whole = tensors(ALEX);
    write(&path, &whole[..whole.len() - 1]);
    assert!(refused(&path).contains("lin4.model.1.weight: is missing"));
    let mut wrong = whole.clone();
    wrong[1].1 = vec![32, 2];
    write(&path, &wrong);
    assert!(refused(&path).contains("net.slice1.0.bias"));
    let mut wrong = whole.clone();
    wrong[3].2[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    write(&path, &wrong);
    assert!(refused(&path).contains("not finite"));
    write(&path, &whole[3..]);
    assert!(refused(&path).contains("neither AlexNet nor VGG"));
    let mut bytes = std::fs::read(&path).unwrap();
    bytes.truncate(bytes.len() / 2);
    std::fs::write(&path, bytes).unwrap();
    assert!(refused(&path).contains("not a safetensors file"));
}
