//! The resident memory of a process that renders many views on a device: constant once every buffer and shader is warm.
//! The test runs in a process of its own, because resident memory belongs to the whole process.

use crate::support::child::in_child;
use crate::support::gpu;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::gpu::GpuOptions;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{Gradients, LossOptions, RenderOptions, Renderer};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::Columns;
use gsscale::scene::image::Target;

/// Most rows of a view.
const ROWS: usize = 1500;
/// Views before the measurement: they fill all size classes of buffers, their free lists and the driver's pools.
const WARM: usize = 40;
const VIEWS: usize = 60;
/// Allowed growth of resident memory over [`VIEWS`] views, bytes. Measured: under 1.5 MB, which is heap that worker
/// threads distribute differently. A driver that keeps a copy of each shader for every new count of rows (see
/// [`GpuOptions::uniform_blocks`]) takes 118 MB; one leaked buffer of 64 KiB a view takes 4 MB.
const GROWTH: u64 = 3_000_000;

/// Resident memory of this process, bytes, if the system reports it.
fn resident() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: u64 = text.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * 4096)
}

/// `rows` small Gaussians in front of the camera.
fn rows(rows: usize) -> Columns {
    let mut draws = Stream::new(7, Purpose::Test, rows as u64, 0);
    let mut c = Columns::zeros(rows, 3);
    c.means.fill_with(|| draws.range(-1.0, 1.0) as f32);
    c.quats.fill_with(|| draws.normal() as f32);
    c.scales.fill_with(|| draws.range(-5.0, -3.0) as f32);
    c.opacities.fill_with(|| draws.range(-2.0, 2.0) as f32);
    c
}

#[test]
fn views_whose_counts_are_all_new_leave_no_memory_behind() {
    if !in_child(module_path!(), "views_whose_counts_are_all_new_leave_no_memory_behind") {
        return;
    }
    let Some(device) = gpu::open(&GpuOptions::default()) else { return };
    let (width, height) = (80, 64);
    let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]];
    let camera = Camera::pinhole(viewmat, [70.0, 70.0, 40.0, 32.0], [width, height]);
    let target = Target::new([width, height], vec![128; 3 * 80 * 64]);
    let loss = LossOptions::default();
    let mut renderer = GpuRenderer::new(device).unwrap();
    let mut grads = Gradients::default();
    let mut before = None;
    for view in 0..WARM + VIEWS {
        if view == WARM {
            before = resident();
        }
        let rows = rows(ROWS - 7 * view);
        renderer.draw(&rows, &camera, &RenderOptions::default()).unwrap();
        renderer.loss(&target, &loss).unwrap();
        renderer.backpropagate(&rows, &mut grads).unwrap();
        assert!(renderer.loss_value().unwrap().loss > 0.0);
    }
    let (Some(before), Some(after)) = (before, resident()) else {
        println!("SKIPPED: this system does not tell resident memory");
        return;
    };
    println!("resident: {before} bytes before, {after} after {VIEWS} views");
    assert!(after < before + GROWTH, "{VIEWS} views took {} bytes", after - before);
}
