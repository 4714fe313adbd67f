//! Peak memory of a view for each of its visible rows: all rows at once, and in batches within little memory.
//!
//! `cargo bench --bench view_memory` draws a generated terrain of several sizes, forward and backward, on the CPU and on
//! the best adapter (a software adapter if there is no other). Numbers set other sizes, `--json` prints JSON. A test run
//! draws one tiny terrain.
//!
//! Counted are the rows of the working set (values, gradients, row numbers) and what the renderer holds: on the CPU in host
//! memory, on a device in device memory. Bytes that depend on pixels alone, measured by a view of one row, are subtracted. A view
//! in batches takes a tenth of its rows at a time. On the CPU its lists get 32 bytes a row, on a device it gets the least that the
//! program states for it. Both ways must give the same picture.

pub mod support;

use gsscale::gpu::{DeviceChoice, Gpu, GpuOptions};
use gsscale::render::cpu::CpuRenderer;
use gsscale::render::device_needs::DeviceNeeds;
use gsscale::render::gpu::GpuRenderer;
use gsscale::render::{Gradients, LossOptions, RenderOptions, Renderer, RowBatches, SsimPadding};
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::image::Target;
use gsscale::train::step::pages::WorkingSet;
use serde_json::json;
use std::ops::Range;
use support::{Args, Hash, checked, machine, terrain};

/// Default sizes.
const SIZES: [usize; 3] = [100_000, 400_000, 1_600_000];
/// Bytes of the lists of a view in batches for each of its rows: shorter than the lists of its rows, one each.
const LIST_BYTES_A_ROW: u64 = 32;
/// Bytes of a pixel on a device: picture, transmittance, stops, photo, gradient, derivatives of the loss, state of long lists.
const PIXEL_BYTES: u64 = 60;
/// Batches of a view in batches.
const BATCHES: usize = 10;

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny() != 0);
        return;
    }
    if !args.json {
        println!("{}", machine(args.simd()));
    }
    let sizes = if args.sizes.is_empty() { SIZES.to_vec() } else { args.sizes.clone() };
    for n in sizes {
        for line in measure(n, 640, 480) {
            print(&args, &line);
        }
    }
}

/// One tiny terrain; returns a hash of its figures.
pub fn tiny() -> u64 {
    let lines = measure(3_000, 96, 64);
    assert!(lines.iter().all(|line| line.batches < line.whole), "{lines:?}");
    let mut hash = Hash::default();
    lines.iter().for_each(|line| hash.add(line.whole.to_bits()));
    hash.0
}

/// The figures of one size on one device.
#[derive(Debug)]
struct Line {
    device: String,
    rows: usize,
    /// Bytes a row at the peak, with all rows at once.
    whole: f64,
    /// Bytes a row at the peak, in batches.
    batches: f64,
    /// Bytes a row of `batches` that the rows of one batch and the lists of intersections take; 0 where a budget bounds them.
    batch_and_lists: f64,
}

fn print(args: &Args, line: &Line) {
    let Line { device, rows, whole, batches, batch_and_lists } = line;
    if args.json {
        println!(
            "{}",
            json!({ "device": device, "rows": rows, "bytes_a_row": whole, "bytes_a_row_in_batches": batches,
                    "of_these_one_batch_and_lists": batch_and_lists })
        );
        return;
    }
    let rest = batches - batch_and_lists;
    println!(
        "{rows} visible rows, {device}: {whole:.0} bytes a row at once; in batches {rest:.0}, and {batch_and_lists:.0} \
         for the rows of a batch and the lists"
    );
}

/// The CPU, and a device if there is one.
fn measure(n: usize, width: u32, height: u32) -> Vec<Line> {
    let (rows, camera) = seen(n, width, height);
    let n = rows.rows();
    let mut lines = Vec::new();
    let mut cpu = CpuRenderer::new();
    draw(&mut cpu, &part(&rows, 0..1), &camera, 1);
    let pixels = cpu.host_bytes();
    let mut cpu = CpuRenderer::new();
    let (working, picture) = draw(&mut cpu, &rows, &camera, 1);
    let whole = working + cpu.host_bytes();
    let mut cpu = CpuRenderer::new();
    let budget = LIST_BYTES_A_ROW * n as u64;
    cpu.set_list_bytes(Some(budget));
    let (working, again) = draw(&mut cpu, &rows, &camera, BATCHES);
    assert!(picture == again, "batches give another picture");
    let of_row = |bytes: u64| bytes.saturating_sub(pixels) as f64 / n as f64;
    let batches = of_row(working + cpu.host_bytes());
    let batch_and_lists = (working + budget) as f64 / n as f64;
    lines.push(Line { device: "CPU".into(), rows: n, whole: of_row(whole), batches, batch_and_lists });

    let open = |budget| Gpu::open_with(&DeviceChoice::Gpu, &GpuOptions { budget, ..GpuOptions::default() }).ok();
    let Some(gpu) = open(None) else { return lines };
    let mut whole = checked(GpuRenderer::new(gpu));
    let (_, picture) = draw(&mut whole, &rows, &camera, 1);
    let sizes = whole.device_sizes().unwrap_or_default();
    let least = DeviceNeeds::new(sizes, RenderOptions::default().sh_degree).least();
    let Some(gpu) = open(Some(least)) else { return lines };
    let mut little = checked(GpuRenderer::new(gpu));
    let (_, again) = draw(&mut little, &rows, &camera, BATCHES);
    assert!(picture == again, "batches give another picture on the device");
    let pixels = PIXEL_BYTES * camera.pixels() as u64;
    let of_row = |renderer: &GpuRenderer| (renderer.gpu().traffic().device_bytes_peak - pixels) as f64 / n as f64;
    let (whole_bytes, batch_bytes) = (of_row(&whole), of_row(&little));
    lines.push(Line {
        device: whole.device(),
        rows: n,
        whole: whole_bytes,
        batches: batch_bytes,
        batch_and_lists: 0.0,
    });
    lines
}

/// The rows of a terrain that its camera sees, and the camera.
fn seen(n: usize, width: u32, height: u32) -> (Columns, Camera) {
    let (rows, camera) = terrain(n, width, height);
    let mut renderer = CpuRenderer::new();
    let mut grads = Gradients::default();
    checked(renderer.draw(&rows, &camera, &RenderOptions::default()));
    checked(renderer.picture_gradient());
    checked(renderer.backpropagate(&rows, &mut grads));
    let mut visible = Columns { sh_degree: rows.sh_degree, ..Columns::default() };
    for column in Column::ALL {
        let width = column.width(rows.sh_degree);
        let of_rows = rows.column(column).chunks_exact(width).zip(&grads.radii);
        *visible.column_mut(column) =
            of_rows.filter(|(_, radii)| **radii != [0, 0]).flat_map(|(values, _)| values).copied().collect();
    }
    (visible, camera)
}

/// The rows of a range.
fn part(rows: &Columns, place: Range<usize>) -> Columns {
    let mut part = Columns { sh_degree: rows.sh_degree, ..Columns::default() };
    for column in Column::ALL {
        let width = column.width(rows.sh_degree);
        *part.column_mut(column) = rows.column(column)[place.start * width..place.end * width].to_vec();
    }
    part
}

/// Draws the view forward and backward in this many batches. Returns the bytes of the working set of the largest batch, and a hash
/// of the picture.
fn draw(renderer: &mut dyn Renderer, rows: &Columns, camera: &Camera, batches: usize) -> (u64, u64) {
    let options = RenderOptions::default();
    let per_batch = rows.rows().div_ceil(batches).max(1);
    let parts = || (0..rows.rows()).step_by(per_batch).map(|first| first..(first + per_batch).min(rows.rows()));
    let how = if batches == 1 { RowBatches::One } else { RowBatches::Several };
    let target = Target::new([camera.width, camera.height], vec![100; 3 * camera.pixels()]);
    let loss = LossOptions { padding: SsimPadding::Valid, ..LossOptions::default() };
    checked(renderer.begin_view(camera, &options, how));
    parts().for_each(|place| checked(renderer.rows_in(&part(rows, place))));
    checked(renderer.picture());
    let mut hash = Hash::default();
    checked(renderer.image()).rgb.iter().for_each(|x| hash.add(u64::from(x.to_bits())));
    checked(renderer.loss(&target, &loss));
    checked(renderer.picture_back());
    let all: Vec<Range<usize>> = parts().collect();
    let mut working = WorkingSet::default();
    let mut most = 0;
    for (i, place) in all.into_iter().enumerate().rev() {
        working.columns = part(rows, place.clone());
        working.row_from_working = vec![0; place.len()];
        checked(renderer.rows_out(i, &working.columns, &mut working.gradients));
        most = most.max(working.bytes() as u64);
    }
    (most, hash.0)
}
