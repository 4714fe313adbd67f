//! Reference fixtures, dense Adam, a second renderer, cameras, and a device.

#[path = "../../support/apply_event.rs"]
pub mod apply_event;
#[path = "../../support/child.rs"]
pub mod child;
pub mod dense_adam;
pub mod fixture;
#[path = "../../support/gpu.rs"]
pub mod gpu;
pub mod reference64;
#[path = "../../support/rounds.rs"]
pub mod rounds;
#[allow(dead_code)] // no photo scenes are read here
#[path = "../../support/shared.rs"]
mod shared;

use gsscale::base::rng::Stream;
use gsscale::base::simd::SimdPath;
use gsscale::gpu::Gpu;
use gsscale::render::gpu_pages::{DevicePages, PagesView};
use gsscale::scene::camera::Camera;
use gsscale::scene::optimizer_numbers::StepNumbers;

pub fn begin_view(gpu: &Gpu, pages: &DevicePages, camera: &Camera, step: &StepNumbers) -> PagesView {
    let mut recorder = gpu.begin("view");
    let view = pages.begin(&mut recorder, camera, step).unwrap();
    gpu.submit(recorder).unwrap();
    view
}

/// Any rotation, all equally likely.
pub fn random_rotation(draws: &mut Stream) -> [[f64; 3]; 3] {
    let q: [f64; 4] = std::array::from_fn(|_| draws.normal());
    let n = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [w, x, y, z] = q.map(|c| c / n);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

pub fn paths() -> impl Iterator<Item = SimdPath> {
    SimdPath::ALL.into_iter().filter(|path| path.is_supported())
}
