//! Whether a device computes what the CPU computes: views of generated Gaussians are drawn, and their
//! gradients computed, on both.
//!
//! A driver may compile a stage wrongly; then a run would train something else for hours. Views are compared as a whole, and the first
//! wrong output names the stage in which the fault lies.
//!
//! Not here: the stages one by one, which the tests compare (`tests/numerics/parity`); steps of the optimizer on a device
//! (`train/inputs/page_check`).

use super::cpu::CpuRenderer;
use super::{Gradients, LossOptions, LossValue, RenderError, RenderOptions, Renderer};
use crate::base::rng::{Purpose, Stream};
use crate::scene::camera::Camera;
use crate::scene::columns::{Column, Columns};
use crate::scene::image::{Image, Target};

/// Largest difference of a picture value where both sides decided alike: some hundred roundings of 6e-8.
const PIXEL: f32 = 5e-5;
/// Largest difference where a rounding flipped a decision (one tile more, a stop one Gaussian later).
const FLIPPED: f32 = 1.0 / 255.0;
/// At most one value in so many may have a flipped decision.
const FLIPPED_ONE_OF: usize = 1000;
/// Difference of a loss: the small variances of SSIM, and a few flipped decisions.
const LOSS: f64 = 2e-5;
/// Relative L2 of a column of gradients: a thousand roundings, for sums whose terms cancel.
const GRADIENT: f64 = 2e-4;
/// At most one half extent in so many may differ: rounding up may give the next integer.
const RADIUS_ONE_OF: usize = 500;
/// The views: Gaussians, size of the picture, SH degree; from one to several workgroups.
const VIEWS: [(usize, [u32; 2], u8); 4] =
    [(4000, [160, 112], 3), (3, [65, 47], 2), (20_000, [123, 77], 1), (900, [40, 9], 0)];

pub struct View {
    pub image: Image,
    pub loss: LossValue,
    pub grads: Gradients,
}

/// What a comparison found.
pub enum DeviceVerdict {
    Agrees(Vec<Agreement>),
    /// The first view that differs, and the stage.
    Differs(String),
}

/// The largest differences of a view within the limits.
pub struct Agreement {
    pub view: String,
    /// Of a value of the picture.
    pub pixel: f32,
    pub loss: f64,
    /// Of gradients, relative L2 of a column.
    pub gradients: f64,
}

/// Compares views on a device with the CPU's, clean and with one in a hundred Gaussians broken.
/// Errors: those of the device.
pub fn check(device: &mut dyn Renderer) -> Result<DeviceVerdict, RenderError> {
    let mut cpu = CpuRenderer::new();
    let mut agreements = Vec::new();
    for (rows, [width, height], sh_degree) in VIEWS {
        for broken in [false, true] {
            let (columns, camera) = scene(rows, width, height, broken);
            let options = RenderOptions { sh_degree, background: [0.2, 0.4, 0.1], ..RenderOptions::default() };
            let with = if broken { ", one in a hundred broken" } else { "" };
            let what = format!("{rows} Gaussians at {width}x{height}, degree {sh_degree}{with}");
            let want = view(&mut cpu, &columns, &camera, &options)?;
            let got = view(device, &columns, &camera, &options)?;
            match compare(&got, &want) {
                Ok((pixel, loss, gradients)) => agreements.push(Agreement { view: what, pixel, loss, gradients }),
                Err(why) => return Ok(DeviceVerdict::Differs(format!("{what}: {why}"))),
            }
        }
    }
    Ok(DeviceVerdict::Agrees(agreements))
}

/// Gaussians in front of a camera; some are large, opaque, behind it or off the picture, and if `broken` one in a hundred is not finite.
pub fn scene(rows: usize, width: u32, height: u32, broken: bool) -> (Columns, Camera) {
    let mut draws = Stream::new(41, Purpose::Test, rows as u64, u64::from(width));
    let mut c = Columns::zeros(rows, 3);
    let mut fill = |values: &mut [f32], draw: &mut dyn FnMut(&mut Stream) -> f64| {
        values.iter_mut().for_each(|x| *x = draw(&mut draws) as f32);
    };
    fill(&mut c.means, &mut |d| d.range(-2.0, 2.0));
    fill(&mut c.quats, &mut |d| d.normal());
    fill(&mut c.scales, &mut |d| d.range(-5.0, -1.0));
    fill(&mut c.opacities, &mut |d| d.range(-6.0, 7.0));
    fill(&mut c.sh0, &mut |d| 0.5 * d.normal());
    fill(&mut c.sh_n, &mut |d| 0.5 * d.normal());
    if broken {
        for row in (0..rows).step_by(100) {
            let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38][row / 100 % 4];
            match row / 400 % 4 {
                0 => c.means[3 * row] = value,
                1 => c.quats[4 * row + 1] = value,
                2 => c.scales[3 * row + 2] = value,
                _ => c.opacities[row] = value,
            }
        }
    }
    let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1.5]];
    (c, Camera::pinhole(viewmat, [60.0, 65.0, 0.5 * width as f32, 0.5 * height as f32], [width, height]))
}

/// A smooth photo with a hole in its mask.
pub fn photo(width: u32, height: u32) -> Target {
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let rgb = pixels.clone().flat_map(|(x, y)| [(3 * x % 256) as u8, ((2 * y + x) % 256) as u8, 90]).collect();
    let mask = Some(pixels.map(|(x, y)| if x / 9 == 1 && y > 5 { 0 } else { 255 }).collect());
    Target { mask, ..Target::new([width, height], rgb) }
}

/// Draws a view, compares it with [`photo`], and takes the loss back to the rows.
pub fn view(
    renderer: &mut dyn Renderer,
    columns: &Columns,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<View, RenderError> {
    let mut grads = Gradients::default();
    renderer.draw(columns, camera, options)?;
    renderer.loss(&photo(camera.width, camera.height), &LossOptions::default())?;
    renderer.backpropagate(columns, &mut grads)?;
    let loss = renderer.loss_value()?;
    let image = renderer.image()?.clone();
    Ok(View { image, loss, grads })
}

/// The largest differences: of a value of the picture, of the loss, of gradients.
/// Errors: the first output that is wrong, which names the stage.
fn compare(got: &View, want: &View) -> Result<(f32, f64, f64), String> {
    let radii = got.grads.radii.iter().zip(&want.grads.radii).filter(|(g, w)| g != w).count();
    if radii * RADIUS_ONE_OF > want.grads.radii.len() {
        return Err(format!("{radii} footprints have another size: stage project_fwd, or the sort"));
    }
    let apart = got.image.rgb.iter().zip(&want.image.rgb).map(|(g, w)| (g - w).abs());
    let worst = apart.clone().fold(0.0f32, |most, d| if d <= most { most } else { d });
    let off = apart.filter(|d| exceeds(f64::from(*d), f64::from(PIXEL))).count();
    if exceeds(f64::from(worst), f64::from(FLIPPED)) || off * FLIPPED_ONE_OF > want.image.rgb.len() {
        return Err(format!(
            "the picture is another (a value by {worst:.1e}; {off} of {} values): colours (sh_fwd), lists (isect_emit, radix_sort), or \
             blending (rasterize_fwd)",
            want.image.rgb.len()
        ));
    }
    let loss = (got.loss.loss - want.loss.loss).abs();
    if exceeds(loss, LOSS) {
        return Err(format!("the loss is {}, but {} on the CPU: stage image_loss", got.loss.loss, want.loss.loss));
    }
    let means2d = l2(got.grads.means2d.as_flattened(), want.grads.means2d.as_flattened());
    if exceeds(means2d, GRADIENT) {
        return Err(format!("gradients of footprints are others ({means2d:.1e} relative): stage rasterize_bwd"));
    }
    let mut gradients = means2d;
    for column in Column::ALL {
        let error = l2(got.grads.columns.column(column), want.grads.columns.column(column));
        if exceeds(error, GRADIENT) {
            let stage = if matches!(column, Column::Sh0 | Column::ShN) { "sh_bwd" } else { "project_bwd" };
            return Err(format!("gradients of {column:?} are others ({error:.1e} relative): stage {stage}"));
        }
        gradients = gradients.max(error);
    }
    Ok((worst, loss, gradients))
}

/// Whether a difference is above a limit; NaN is above any.
fn exceeds(difference: f64, limit: f64) -> bool {
    difference.is_nan() || difference > limit
}

/// Relative L2 distance.
pub fn l2(got: &[f32], want: &[f32]) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    let error = norm(&mut got.iter().zip(want).map(|(g, w)| f64::from(*g) - f64::from(*w)));
    error / norm(&mut want.iter().map(|w| f64::from(*w))).max(1e-30)
}
