//! A second renderer, in f64 and plain: every pixel visits every row in depth order, without tiles or boxes; covariance
//! and inverse follow the textbook. Finite differences are taken of this renderer.
//!
//! Semantics are gsplat's: EWA with slopes cut at 15 % beyond the image, alpha clamped, contributions under 1/255
//! skipped; a pixel ends before the contribution that would bring its transmittance to 1e-4.

use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};

pub const ALPHA_MIN: f64 = 1.0 / 255.0;
pub const TRANSMITTANCE_MIN: f64 = 1e-4;

/// What a rendering depends on besides rows and camera.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    pub sh_degree: u8,
    pub max_alpha: f64,
    pub eps2d: f64,
    pub background: [f64; 3],
}

/// Rows in f64, stored values as in `Columns`.
#[derive(Debug, Clone)]
pub struct Rows64 {
    sh_degree: u8,
    columns: [Vec<f64>; 6],
}

impl Rows64 {
    pub fn new(rows: &Columns) -> Rows64 {
        let widen = |c: Column| rows.column(c).iter().map(|&x| f64::from(x)).collect();
        Rows64 { sh_degree: rows.sh_degree, columns: Column::ALL.map(widen) }
    }

    pub fn rows(&self) -> usize {
        self.columns[Column::Opacities as usize].len()
    }

    pub fn column_mut(&mut self, column: Column) -> &mut Vec<f64> {
        &mut self.columns[column as usize]
    }

    fn row(&self, column: Column, row: usize) -> &[f64] {
        let width = column.width(self.sh_degree);
        &self.columns[column as usize][row * width..(row + 1) * width]
    }
}

#[derive(Debug, Clone, Copy)]
pub struct Splat64 {
    pub row: usize,
    pub mean2d: [f64; 2],
    /// xx, yy of the covariance with its blur, px^2.
    pub variances: [f64; 2],
    /// xx, xy, yy of the inverse covariance.
    pub conic: [f64; 3],
    pub depth: f64,
    pub color: [f64; 3],
    pub opacity: f64,
    /// Smallest relative distance from a kink: a colour's cut at 0, a slope's cut.
    pub margin: f64,
}

/// A picture, and how far every decision made for it was from turning out otherwise.
#[derive(Debug, Clone)]
pub struct Render64 {
    /// One entry per pixel, row-major.
    pub rgb: Vec<[f64; 3]>,
    /// 1 - transmittance.
    pub alpha: Vec<f64>,
    /// Row, pixel and blending weight of every contribution.
    pub weights: Vec<(usize, usize, f64)>,
    /// Smallest relative distance of an alpha from 1/255 or from the clamp, of a transmittance from its end, of two
    /// depths from each other, and the rows' margins.
    pub margin: f64,
    /// Contributions that were blended, clamped; pixels that ended early.
    pub blended: usize,
    pub clamped: usize,
    pub ended: usize,
}

/// World to camera, row-major 3x4.
pub type Pose64 = [[f64; 4]; 3];

type Matrix = [[f64; 3]; 3];

fn multiply(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn transpose(a: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

fn rotation(q: &[f64]) -> Matrix {
    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [w, x, y, z] = std::array::from_fn(|i| q[i] / norm);
    [
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
}

/// The basis up to degree 3 at a unit direction, from its definition: normalised associated Legendre functions with
/// the Condon-Shortley sign, times sqrt 2 cos or sin of m phi, ordered by band and then m = -l..l.
fn basis(dir: [f64; 3]) -> [f64; 16] {
    let [x, y, z] = dir;
    let mut out = [0.0; 16];
    // (x + iy)^m = sin^m(theta) e^(i m phi)
    let mut power = [(1.0, 0.0); 4];
    for m in 1..4 {
        let (re, im) = power[m - 1];
        power[m] = (re * x - im * y, re * y + im * x);
    }
    let factorial = |n: usize| (1..=n).map(|i| i as f64).product::<f64>();
    for m in 0..4usize {
        // Legendre functions without their factor sin^m, by the usual recurrence in l.
        let start = (0..m).map(|i| -((2 * i + 1) as f64)).product::<f64>();
        let (mut before, mut now) = (0.0, start);
        for l in m..4 {
            let k = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - m) / factorial(l + m)).sqrt();
            let middle = l * l + l;
            if m == 0 {
                out[middle] = k * now;
            } else {
                out[middle + m] = 2f64.sqrt() * k * now * power[m].0;
                out[middle - m] = 2f64.sqrt() * k * now * power[m].1;
            }
            let next = ((2 * l + 1) as f64 * z * now - (l + m) as f64 * before) / (l + 1 - m) as f64;
            (before, now) = (now, next);
        }
    }
    out
}

fn color(rows: &Rows64, row: usize, centre: [f64; 3], sh_degree: u8) -> ([f64; 3], f64) {
    let mean = rows.row(Column::Means, row);
    let dir: [f64; 3] = std::array::from_fn(|i| mean[i] - centre[i]);
    let length = dir.iter().map(|x| x * x).sum::<f64>().sqrt();
    let basis = basis(dir.map(|x| x / length));
    let (sh0, sh_n) = (rows.row(Column::Sh0, row), rows.row(Column::ShN, row));
    let used = (sh_degree as usize + 1).pow(2);
    let raw: [f64; 3] = std::array::from_fn(|c| {
        0.5 + basis[0] * sh0[c] + (1..used).map(|k| basis[k] * sh_n[3 * (k - 1) + c]).sum::<f64>()
    });
    (raw.map(|x| x.max(0.0)), raw.iter().fold(f64::INFINITY, |m, x| m.min(x.abs())))
}

pub fn pose_of(camera: &Camera) -> Pose64 {
    camera.viewmat.map(|r| r.map(f64::from))
}

/// One row on the screen; `None` outside of the depth range.
pub fn project(rows: &Rows64, camera: &Camera, settings: &Settings, row: usize) -> Option<Splat64> {
    project_from(rows, (camera, &pose_of(camera)), settings, row)
}

/// As [`project`], from another pose than that of the camera.
fn project_from(rows: &Rows64, (camera, m): (&Camera, &Pose64), settings: &Settings, row: usize) -> Option<Splat64> {
    let view: Matrix = std::array::from_fn(|i| std::array::from_fn(|j| m[i][j]));
    let mean = rows.row(Column::Means, row);
    let p: [f64; 3] = std::array::from_fn(|i| (0..3).map(|j| m[i][j] * mean[j]).sum::<f64>() + m[i][3]);
    if p[2] <= f64::from(camera.near_plane) || p[2] >= f64::from(camera.far_plane) {
        return None;
    }
    let focal = [f64::from(camera.fx), f64::from(camera.fy)];
    let principal = [f64::from(camera.cx), f64::from(camera.cy)];
    let size = [f64::from(camera.width), f64::from(camera.height)];
    let mut jacobian = [[0.0; 3]; 2];
    let mut margin = f64::INFINITY;
    for i in 0..2 {
        let slack = 0.15 * size[i] / focal[i];
        let (low, high) = (-principal[i] / focal[i] - slack, (size[i] - principal[i]) / focal[i] + slack);
        let slope = p[i] / p[2];
        margin = margin.min((slope - low).abs()).min((slope - high).abs());
        jacobian[i][i] = focal[i] / p[2];
        jacobian[i][2] = -focal[i] * slope.clamp(low, high) / p[2];
    }
    let scales = rows.row(Column::Scales, row);
    let mut spread = rotation(rows.row(Column::Quats, row));
    for axis in &mut spread {
        for k in 0..3 {
            axis[k] *= libm::exp(scales[k]);
        }
    }
    let world = multiply(&spread, &transpose(&spread));
    let cov = multiply(&multiply(&view, &world), &transpose(&view));
    let cov2d = |i: usize, j: usize| -> f64 {
        let blur = if i == j { settings.eps2d } else { 0.0 };
        let entry = |a: usize, b: usize| jacobian[i][a] * cov[a][b] * jacobian[j][b];
        blur + (0..9).map(|ab| entry(ab / 3, ab % 3)).sum::<f64>()
    };
    let (xx, xy, yy) = (cov2d(0, 0), cov2d(0, 1), cov2d(1, 1));
    let det = xx * yy - xy * xy;
    let centre = std::array::from_fn(|i| -(0..3).map(|j| m[j][i] * m[j][3]).sum::<f64>());
    let (color, color_margin) = color(rows, row, centre, settings.sh_degree);
    Some(Splat64 {
        row,
        mean2d: std::array::from_fn(|i| focal[i] * p[i] / p[2] + principal[i]),
        variances: [xx, yy],
        conic: [yy / det, -xy / det, xx / det],
        depth: p[2],
        color,
        opacity: 1.0 / (1.0 + libm::exp(-rows.row(Column::Opacities, row)[0])),
        margin: margin.min(color_margin),
    })
}

pub fn render(rows: &Rows64, camera: &Camera, settings: &Settings) -> Render64 {
    render_from(rows, (camera, &pose_of(camera)), settings)
}

/// As [`render`], from another pose than that of the camera.
pub fn render_from(rows: &Rows64, (camera, pose): (&Camera, &Pose64), settings: &Settings) -> Render64 {
    let mut splats: Vec<Splat64> =
        (0..rows.rows()).filter_map(|r| project_from(rows, (camera, pose), settings, r)).collect();
    // Stable: rows of equal depth keep their order.
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let gaps = splats.windows(2).map(|w| w[1].depth / w[0].depth - 1.0);
    let margin = splats.iter().map(|s| s.margin).chain(gaps).fold(f64::INFINITY, f64::min);
    let (rgb, alpha, weights) = (Vec::new(), Vec::new(), Vec::new());
    let mut out = Render64 { rgb, alpha, weights, margin, blended: 0, clamped: 0, ended: 0 };
    for y in 0..camera.height {
        for x in 0..camera.width {
            blend_pixel(&splats, settings, [f64::from(x) + 0.5, f64::from(y) + 0.5], &mut out);
        }
    }
    out
}

fn blend_pixel(splats: &[Splat64], settings: &Settings, pixel: [f64; 2], out: &mut Render64) {
    let mut transmittance = 1.0;
    let mut rgb = [0.0; 3];
    for s in splats {
        let (dx, dy) = (pixel[0] - s.mean2d[0], pixel[1] - s.mean2d[1]);
        let sigma = 0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) + s.conic[1] * dx * dy;
        let raw = s.opacity * libm::exp(-sigma);
        out.margin = out.margin.min((raw / ALPHA_MIN - 1.0).abs()).min((raw / settings.max_alpha - 1.0).abs());
        let alpha = raw.min(settings.max_alpha);
        if sigma < 0.0 || alpha < ALPHA_MIN {
            continue;
        }
        let next = transmittance * (1.0 - alpha);
        out.margin = out.margin.min((next / TRANSMITTANCE_MIN - 1.0).abs());
        if next <= TRANSMITTANCE_MIN {
            out.ended += 1;
            break;
        }
        for c in 0..3 {
            rgb[c] += s.color[c] * alpha * transmittance;
        }
        out.weights.push((s.row, out.rgb.len(), alpha * transmittance));
        transmittance = next;
        out.blended += 1;
        out.clamped += usize::from(raw > settings.max_alpha);
    }
    out.rgb.push(std::array::from_fn(|c| rgb[c] + transmittance * settings.background[c]));
    out.alpha.push(1.0 - transmittance);
}
