//! Removes lens distortion from pixels.
//!
//! The ideal photo keeps size, focal lengths and principal point of the real one. For each of its pixels the lens model
//! directly gives the place in the real photo (no iteration), which is sampled bilinearly. Pixels whose place is
//! outside the real photo repeat its border and are reported as invalid.
//!
//! Models and parameter order are OpenCV's (documentation of its calib3d and fisheye modules), which COLMAP's
//! RADIAL, OPENCV, FULL_OPENCV and *_FISHEYE follow.
//!
//! Invariants: 1. only + - * / sqrt and libm, no contraction: the same bits everywhere; 2. a polynomial that folds back
//! (the distorted radius stops growing) is used only up to the fold; pixels beyond it are invalid.

use super::model::{Intrinsics, Lens};

/// Number of radii, from the axis to the farthest corner, at which the fold of a lens is searched.
const FOLD_STEPS: u32 = 4096;

/// Maps pixels of an ideal photo to places in the real one.
#[derive(Debug, Clone, Copy)]
pub struct Undistorter {
    intrinsics: Intrinsics,
    /// Largest radius (distance from the axis at depth 1) before the lens model folds back.
    fold_radius: f64,
}

impl Undistorter {
    /// For photos with these intrinsics, whose width and height are those of the photo.
    pub fn new(intrinsics: Intrinsics) -> Self {
        Undistorter { intrinsics, fold_radius: fold_radius(&intrinsics) }
    }

    /// Place in the real photo of the ideal photo's point (u, v), both in pixels with the first pixel's centre at (0.5,
    /// 0.5); `None` beyond the fold.
    pub fn source_of(&self, u: f64, v: f64) -> Option<[f64; 2]> {
        let k = &self.intrinsics;
        let (x, y) = ((u - k.cx) / k.fx, (v - k.cy) / k.fy);
        if x * x + y * y > self.fold_radius * self.fold_radius {
            return None;
        }
        let (x, y) = distort(&k.lens, x, y);
        Some([k.fx * x + k.cx, k.fy * y + k.cy])
    }

    /// Whether some pixel of the ideal photo lies inside the real one: of a grid, and of the middle of the lens, which
    /// moves least. All-out distortion leaves none.
    pub fn shows_any(&self) -> bool {
        const GRID: u32 = 32;
        let k = &self.intrinsics;
        let [width, height] = [k.width, k.height].map(f64::from);
        let at = |i: u32, side: f64| (f64::from(i) + 0.5) / f64::from(GRID) * side;
        let pixel = |c: f64, side: f64| c.clamp(0.0, side - 1.0).floor() + 0.5;
        let grid = (0..GRID * GRID).map(|i| [at(i % GRID, width), at(i / GRID, height)]);
        let is_inside = |[x, y]: [f64; 2]| (0.0..=width).contains(&x) && (0.0..=height).contains(&y);
        grid.chain([[pixel(k.cx, width), pixel(k.cy, height)]])
            .any(|[u, v]| self.source_of(u, v).is_some_and(is_inside))
    }

    /// Samples one row of the ideal photo from `photo` (interleaved 8-bit, `C` channels, the intrinsics' size) into
    /// `out` with 8 fractional bits, and writes 255 (inside the photo) or 0 into `valid`.
    pub fn sample_row<const C: usize>(&self, photo: &[u8], row: u32, out: &mut [u16], valid: &mut [u8]) {
        let (width, height) = (self.intrinsics.width as usize, self.intrinsics.height as usize);
        let v = f64::from(row) + 0.5;
        for (i, (pixel, valid)) in out.chunks_exact_mut(C).zip(valid.iter_mut()).enumerate() {
            let place = self.source_of(i as f64 + 0.5, v);
            let [x, y] = place.unwrap_or([0.0, 0.0]);
            let inside = place.is_some() && x >= 0.0 && y >= 0.0 && x <= width as f64 && y <= height as f64;
            *valid = if inside { 255 } else { 0 };
            let (x0, x1, tx) = neighbours(x, width);
            let (y0, y1, ty) = neighbours(y, height);
            let at = |px: usize, py: usize| -> [f32; C] {
                let first = (py * width + px) * C;
                let samples = &photo[first..first + C];
                std::array::from_fn(|c| f32::from(samples[c]))
            };
            let (a, b, c, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
            for (i, value) in pixel.iter_mut().enumerate() {
                let top = a[i] + tx * (b[i] - a[i]);
                let bottom = c[i] + tx * (d[i] - c[i]);
                *value = ((top + ty * (bottom - top)) * 256.0 + 0.5) as u16;
            }
        }
    }
}

/// The two pixels around a coordinate, clamped to the photo, and the weight of the second.
fn neighbours(x: f64, size: usize) -> (usize, usize, f32) {
    let last = size - 1;
    // The cast turns NaN into 0; such a pixel is invalid anyway.
    let x = (x - 0.5).clamp(0.0, last as f64);
    let low = x as usize;
    (low, (low + 1).min(last), (x - low as f64) as f32)
}

/// Applies a lens to ideal coordinates at depth 1.
pub fn distort(lens: &Lens, x: f64, y: f64) -> (f64, f64) {
    match lens {
        Lens::Pinhole => (x, y),
        Lens::Radial(k) => {
            let [_, _, p1, p2, ..] = *k;
            let r2 = x * x + y * y;
            let radial = radial_factor(k, r2);
            let dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            let dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
            (x * radial + dx, y * radial + dy)
        }
        Lens::Fisheye(k) => {
            let r = (x * x + y * y).sqrt();
            if r < 1e-9 {
                return (x, y);
            }
            let factor = fisheye_radius(k, r) / r;
            (x * factor, y * factor)
        }
    }
}

fn radial_factor(k: &[f64; 8], r2: f64) -> f64 {
    let [k1, k2, _, _, k3, k4, k5, k6] = *k;
    (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
}

fn fisheye_radius(k: &[f64; 4], r: f64) -> f64 {
    let angle = libm::atan(r);
    let a2 = angle * angle;
    angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
}

/// The radius up to which the distorted radius grows, searched as far as the photo's corners.
fn fold_radius(k: &Intrinsics) -> f64 {
    let side = |c: f64, f: f64, size: u32| (c.abs()).max((f64::from(size) - c).abs()) / f;
    let (x, y) = (side(k.cx, k.fx, k.width), side(k.cy, k.fy, k.height));
    let farthest = (x * x + y * y).sqrt();
    let distorted = |r: f64| match &k.lens {
        Lens::Pinhole => r,
        Lens::Radial(k) => r * radial_factor(k, r * r),
        Lens::Fisheye(k) => fisheye_radius(k, r),
    };
    let mut before = 0.0;
    for i in 1..=FOLD_STEPS {
        let r = farthest * f64::from(i) / f64::from(FOLD_STEPS);
        let now = distorted(r);
        if now <= before || now.is_nan() {
            return farthest * f64::from(i - 1) / f64::from(FOLD_STEPS);
        }
        before = now;
    }
    f64::INFINITY
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics { width: 160, height: 120, fx: 130.0, fy: 128.0, cx: 81.0, cy: 59.0, lens }
    }

    #[test]
    fn models_match_their_formulas_at_a_point() {
        // x = 0.3, y = -0.2: r2 = 0.13. Values worked out by hand from OpenCV's formulas.
        let lens = Lens::Radial([0.1, -0.05, 0.01, -0.02, 0.03, 0.2, 0.0, 0.0]);
        let radial = (1.0 + 0.1 * 0.13 - 0.05 * 0.13 * 0.13 + 0.03 * 0.13 * 0.13 * 0.13) / (1.0 + 0.2 * 0.13);
        let want_x = 0.3 * radial + 2.0 * 0.01 * 0.3 * -0.2 + -0.02 * (0.13 + 2.0 * 0.09);
        let want_y = -0.2 * radial + 0.01 * (0.13 + 2.0 * 0.04) + 2.0 * -0.02 * 0.3 * -0.2;
        let (x, y) = distort(&lens, 0.3, -0.2);
        // 1e-15: a few roundings of values below 1.
        assert!((x - want_x).abs() < 1e-15 && (y - want_y).abs() < 1e-15, "{x} {y}");
        let (x, y) = distort(&Lens::Fisheye([0.0; 4]), 1.0, 0.0);
        assert!((x - std::f64::consts::FRAC_PI_4).abs() < 1e-15 && y == 0.0);
    }

    #[test]
    fn a_lens_that_folds_back_is_cut_at_the_fold() {
        // r (1 - r^2) grows up to r = 1 / sqrt 3 = 0.577; the corner is at about 0.78.
        let undistorter = Undistorter::new(camera(Lens::Radial([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])));
        // The search steps by 1/4096 of 0.78.
        assert!((undistorter.fold_radius - 1.0 / 3f64.sqrt()).abs() < 4e-4, "{}", undistorter.fold_radius);
        assert!(undistorter.source_of(0.5, 0.5).is_none());
        assert!(undistorter.source_of(80.0, 60.0).is_some());
        assert!(undistorter.shows_any());
        assert!(!Undistorter::new(camera(Lens::Radial([1e10, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))).shows_any());
    }
}
