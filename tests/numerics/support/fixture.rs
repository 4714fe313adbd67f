//! Reference fixtures of the oracle, and the printed skip where they are absent.

use super::shared::shared_folder;
use gsscale::render::RenderOptions;
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
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

    /// A tensor of `[height][width][3]` as `[3][height][width]`.
    pub fn planar(&self, name: &str) -> Vec<f32> {
        let interleaved = self.f32(name);
        (0..3).flat_map(|c| interleaved.iter().skip(c).step_by(3).copied()).collect()
    }

    pub fn camera(&self) -> Camera {
        let (m, k, wh) = (self.f32("viewmat"), self.f32("K"), self.f64("wh"));
        let viewmat = std::array::from_fn(|i| std::array::from_fn(|j| m[4 * i + j]));
        Camera::pinhole(viewmat, [k[0], k[4], k[2], k[5]], [wh[0] as u32, wh[1] as u32])
    }

    /// Rows, as they are stored, camera and options of a raster file.
    pub fn scene(&self) -> (Columns, Camera, RenderOptions) {
        let sh_degree = self.metadata["sh_degree"].parse().unwrap();
        let (sh0, sh_n) = split_sh(&self.f32("sh"), self.shape("means")[0]);
        let rows = Columns {
            sh_degree,
            means: self.f32("means"),
            quats: self.f32("quats"),
            scales: self.f64("scales").iter().map(|&s| libm::log(s) as f32).collect(),
            opacities: self.f64("opacities").iter().map(|&o| libm::log(o / (1.0 - o)) as f32).collect(),
            sh0,
            sh_n,
        };
        let background = self.f32("background").try_into().unwrap();
        let max_alpha = self.metadata["max_alpha"].parse().unwrap();
        (rows, self.camera(), RenderOptions { sh_degree, max_alpha, background, ..RenderOptions::default() })
    }
}

/// The raster files that every renderer is compared with.
pub const RASTER_FILES: [&str; 9] = [
    "raster_single",
    "raster_small",
    "raster_odd_bg",
    "raster_white_bg",
    "raster_stress",
    "raster_large",
    "raster_dense_a990",
    "raster_dense_a999",
    "garden",
];

/// Splits `[rows][K][3]` coefficients into the constant band and the others.
pub fn split_sh(sh: &[f32], rows: usize) -> (Vec<f32>, Vec<f32>) {
    let width = sh.len() / rows;
    let part = |from: usize, to: usize| sh.chunks_exact(width).flat_map(|row| row[from..to].to_vec()).collect();
    (part(0, 3), part(3, width))
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
