//! Weights for `--lpips`.

use std::fs;
use std::path::{Path, PathBuf};

/// Writes AlexNet with random weights as a file for --lpips.
pub fn lpips_weights(folder: &Path) -> PathBuf {
    let shapes: [(&str, [usize; 4]); 5] = [
        ("slice1.0", [64, 3, 11, 11]),
        ("slice2.3", [192, 64, 5, 5]),
        ("slice3.6", [384, 192, 3, 3]),
        ("slice4.8", [256, 384, 3, 3]),
        ("slice5.10", [256, 256, 3, 3]),
    ];
    let floats = |count: usize, scale: f32| -> Vec<u8> {
        (0..count as u32)
            .flat_map(|i| (((i.wrapping_mul(2_654_435_761) >> 16) as f32 / 32768.0 - 1.0) * scale).to_le_bytes())
            .collect()
    };
    let mut tensors = Vec::new();
    for (i, (name, shape)) in shapes.into_iter().enumerate() {
        let scale = (6.0 / (shape[1] * shape[2] * shape[3]) as f32).sqrt();
        tensors.push((format!("net.{name}.weight"), shape.to_vec(), floats(shape.iter().product(), scale)));
        tensors.push((format!("net.{name}.bias"), vec![shape[0]], floats(shape[0], 0.1)));
        let ones: Vec<u8> = (0..shape[0]).flat_map(|_| 0.5f32.to_le_bytes()).collect();
        tensors.push((format!("lin{i}.model.1.weight"), vec![1, shape[0], 1, 1], ones));
    }
    let views = tensors.iter().map(|(name, shape, bytes)| {
        (name.clone(), safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape.clone(), bytes).unwrap())
    });
    let path = folder.join("lpips_alex.safetensors");
    fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
    path
}
