//! Reference fixtures, dense Adam, a second renderer, and a device.

#[path = "../../support/apply_event.rs"]
pub mod apply_event;
#[path = "../../support/child.rs"]
pub mod child;
pub mod dense_adam;
pub mod fixture;
#[path = "../../support/gpu.rs"]
pub mod gpu;
pub mod reference64;
#[allow(dead_code)] // no photo scenes are read here
#[path = "../../support/shared.rs"]
mod shared;

use gsscale::gpu::Gpu;
use gsscale::render::gpu_pages::{DevicePages, PagesView};
use gsscale::scene::camera::Camera;
use gsscale::scene::optimizer_numbers::StepNumbers;

/// Begins a view of pages at a step.
pub fn begin_view(gpu: &Gpu, pages: &DevicePages, camera: &Camera, step: &StepNumbers) -> PagesView {
    let mut recorder = gpu.begin("view");
    let view = pages.begin(&mut recorder, camera, step).unwrap();
    gpu.submit(recorder).unwrap();
    view
}
