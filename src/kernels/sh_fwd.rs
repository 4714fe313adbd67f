//! Stage "sh": colours of rows as seen from the camera, by real spherical harmonics of degree 0 to 3.
//!
//! Not here: gradients (`sh_bwd`).
//!
//! Invariants: 1. the basis has the signs and the order of the 3DGS code, so that files can be exchanged; 2. nothing is
//! fused: the same bits on every instruction path; 3. culled rows are neither read nor computed; their colour is 0.

use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
use crate::kernels::lanes::{Lanes, ROWS_PER_CHUNK, block_of, block_of_mut, chunk_of, gather, lane, set_lane};
use crate::kernels::project_fwd::{View, dot};
use crate::scene::camera::Camera;
use crate::scene::columns::{Columns, sh_n_width};
use rayon::prelude::*;

/// Functions in the basis of degree 3.
pub const BASIS: usize = 16;

/// Normalisation of band 0: 1/2 sqrt(1/pi).
pub const C0: f32 = 0.282_094_79;
/// Band 1: sqrt(3 / (4 pi)).
pub(crate) const C1: f32 = 0.488_602_51;
/// Band 2: 1/2 sqrt(15/pi), 1/4 sqrt(5/pi), 1/4 sqrt(15/pi).
pub(crate) const C2: [f32; 3] = [1.092_548_4, 0.315_391_57, 0.546_274_2];
/// Band 3: 1/4 sqrt(35/(2 pi)), 1/2 sqrt(105/pi), 1/4 sqrt(21/(2 pi)), 1/4 sqrt(7/pi), 1/4 sqrt(105/pi).
pub(crate) const C3: [f32; 5] = [0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_34, 1.445_305_7];

/// The direction in which the camera sees a mean, at length 1, and 1 / its original length; both zero if the length is 0 or
/// its square overflows f32.
#[inline(always)]
pub fn viewing_direction(view: &View, mean: [f32; 3]) -> ([f32; 3], f32) {
    let dir: [f32; 3] = std::array::from_fn(|i| mean[i] - view.centre[i]);
    let len_sq = dot(dir, dir);
    let usable = (f32::MIN_POSITIVE..f32::INFINITY).contains(&len_sq);
    let inv_len = if usable { 1.0 / len_sq.sqrt() } else { 0.0 };
    (if usable { dir.map(|x| x * inv_len) } else { [0.0; 3] }, inv_len)
}

/// The basis at a unit direction: band l starts at l^2. Bands above `degree` are 0.
///
/// Real spherical harmonics as in Green 2003, "Spherical Harmonic Lighting", with the Condon-Shortley signs.
#[inline(always)]
pub fn sh_basis(degree: u8, dir: [f32; 3]) -> [f32; BASIS] {
    let [x, y, z] = dir;
    let mut b = [0.0; BASIS];
    b[0] = C0;
    if degree >= 1 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = C2[0] * (x * y);
        b[5] = -C2[0] * (y * z);
        b[6] = C2[1] * (2.0 * zz - xx - yy);
        b[7] = -C2[0] * (x * z);
        b[8] = C2[2] * (xx - yy);
    }
    if degree >= 3 {
        b[9] = -C3[0] * (y * (3.0 * xx - yy));
        b[10] = C3[1] * (x * y * z);
        b[11] = -C3[2] * (y * (4.0 * zz - xx - yy));
        b[12] = C3[3] * (z * (2.0 * zz - 3.0 * xx - 3.0 * yy));
        b[13] = -C3[2] * (x * (4.0 * zz - xx - yy));
        b[14] = C3[4] * (z * (xx - yy));
        b[15] = -C3[0] * (x * (xx - 3.0 * yy));
    }
    b
}

/// Number of basis functions at a degree: (degree + 1)^2.
#[inline(always)]
pub fn basis_len(degree: u8) -> usize {
    (degree as usize + 1) * (degree as usize + 1)
}

/// Colour of one row: basis times coefficients, plus 0.5, not below 0. `sh_n` is `[K - 1][3]`; only the
/// coefficients of the first `basis.len()` functions are used.
#[inline(always)]
fn sh_color(basis: &[f32], sh0: [f32; 3], sh_n: &[f32]) -> [f32; 3] {
    let mut c: [f32; 3] = std::array::from_fn(|i| 0.5 + basis[0] * sh0[i]);
    for (b, coefficient) in basis[1..].iter().zip(sh_n.as_chunks::<3>().0) {
        for i in 0..3 {
            c[i] += b * coefficient[i];
        }
    }
    // Written so that NaN becomes 0.
    c.map(|x| if x > 0.0 { x } else { 0.0 })
}

/// Colours of the rows whose `radii` are not [0, 0], and 0 for the culled rows. `radii` and `colors` have one entry per
/// row.
///
/// `sh_degree` is the highest band in use and at most `rows.sh_degree`. The direction is from the camera's centre to
/// the mean.
pub fn sh_fwd(
    rows: &Columns,
    camera: &Camera,
    sh_degree: u8,
    radii: &[[u32; 2]],
    simd: SimdPath,
    colors: &mut [[f32; 3]],
) {
    assert!(sh_degree <= rows.sh_degree, "the rows are stored with degree {}", rows.sh_degree);
    assert_eq!([radii.len(), colors.len()], [rows.rows(); 2], "one entry per row");
    let view = View::new(camera, 0.0);
    colors.par_chunks_mut(ROWS_PER_CHUNK).enumerate().for_each(|(chunk, colors)| {
        let stored = ShChunk::new(rows, radii, &view, chunk);
        match sh_degree {
            0 => dispatch(simd, Colors::<0> { stored, colors }),
            1 => dispatch(simd, Colors::<1> { stored, colors }),
            2 => dispatch(simd, Colors::<2> { stored, colors }),
            _ => dispatch(simd, Colors::<3> { stored, colors }),
        }
    });
}

/// Input of the colours of one chunk of rows.
#[derive(Clone, Copy)]
pub(crate) struct ShChunk<'a> {
    pub view: &'a View,
    pub radii: &'a [[u32; 2]],
    pub means: &'a [f32],
    pub sh0: &'a [f32],
    pub sh_n: &'a [f32],
    /// Floats of a row of `sh_n`.
    pub sh_n_width: usize,
}

impl<'a> ShChunk<'a> {
    pub fn new(rows: &'a Columns, radii: &'a [[u32; 2]], view: &'a View, chunk: usize) -> Self {
        let sh_n_width = sh_n_width(rows.sh_degree);
        ShChunk {
            view,
            radii: chunk_of(radii, chunk, 1),
            means: chunk_of(&rows.means, chunk, 3),
            sh0: chunk_of(&rows.sh0, chunk, 3),
            sh_n: chunk_of(&rows.sh_n, chunk, sh_n_width),
            sh_n_width,
        }
    }

    /// Unit directions of a block of rows, and 1 / their lengths.
    #[inline(always)]
    pub fn directions(&self, block: usize) -> (Lanes<3>, [f32; LANES]) {
        let means = gather::<3>(block_of(self.means, block, 3));
        let mut dirs = [[0.0; LANES]; 3];
        let mut inv_lens = [0.0; LANES];
        for l in 0..LANES {
            let (unit, inv_len) = viewing_direction(self.view, lane(&means, l));
            set_lane(&mut dirs, l, unit);
            inv_lens[l] = inv_len;
        }
        (dirs, inv_lens)
    }

    /// The basis for a block of directions, one array per row.
    #[inline(always)]
    pub fn basis(degree: u8, dirs: &Lanes<3>) -> [[f32; BASIS]; LANES] {
        let mut by_function = [[0.0; LANES]; BASIS];
        for l in 0..LANES {
            set_lane(&mut by_function, l, sh_basis(degree, lane(dirs, l)));
        }
        std::array::from_fn(|l| lane(&by_function, l))
    }
}

struct Colors<'a, const DEGREE: u8> {
    stored: ShChunk<'a>,
    colors: &'a mut [[f32; 3]],
}

impl<const DEGREE: u8> Kernel for Colors<'_, DEGREE> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let s = self.stored;
        let used = basis_len(DEGREE);
        for block in 0..s.radii.len().div_ceil(LANES) {
            let radii = block_of(s.radii, block, 1);
            let (dirs, _) = s.directions(block);
            let basis = ShChunk::basis(DEGREE, &dirs);
            let sh0 = block_of(s.sh0, block, 3).as_chunks::<3>().0;
            let sh_n = block_of(s.sh_n, block, s.sh_n_width);
            for (l, color) in block_of_mut(self.colors, block, 1).iter_mut().enumerate() {
                *color = if radii[l] == [0, 0] {
                    [0.0; 3]
                } else {
                    let row = &sh_n[l * s.sh_n_width..(l + 1) * s.sh_n_width];
                    sh_color(&basis[l][..used], sh0[l], &row[..3 * (used - 1)])
                };
            }
        }
    }
}
