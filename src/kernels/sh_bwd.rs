//! Stage "sh", backward: gradients of colours to gradients of sh0, sh_n and, through the viewing direction, means.
//!
//! Not here: the gradient of the means through the projection, which `project_bwd` adds afterwards.
//!
//! Invariants: 1. every entry of `means`, `sh0` and `sh_n` is written, with exactly 0 for unused bands and culled rows;
//! 2. a channel whose colour was clamped at 0 passes no gradient; 3. the same bits on every instruction path.

use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
use crate::kernels::lanes::{ROWS_PER_CHUNK, block_of, block_of_mut, chunk_of, lane};
use crate::kernels::project_fwd::{View, dot};
use crate::kernels::sh_fwd::{BASIS, C0, C1, C2, C3, ShChunk, basis_len, viewing_direction};
use crate::scene::camera::Camera;
use crate::scene::columns::{Columns, sh_n_width};
use rayon::prelude::*;

/// Gradient of sum_k `v_basis[k]` basis_k with respect to the unit direction, taken as if x, y, z were free.
#[inline(always)]
fn sh_basis_vjp(degree: u8, dir: [f32; 3], v_basis: &[f32; BASIS]) -> [f32; 3] {
    let [x, y, z] = dir;
    let v = v_basis;
    let mut g = [0.0; 3];
    if degree >= 1 {
        g = [-C1 * v[3], -C1 * v[1], C1 * v[2]];
    }
    if degree >= 2 {
        g[0] += C2[0] * (y * v[4] - z * v[7]) + 2.0 * x * (C2[2] * v[8] - C2[1] * v[6]);
        g[1] += C2[0] * (x * v[4] - z * v[5]) - 2.0 * y * (C2[2] * v[8] + C2[1] * v[6]);
        g[2] += 4.0 * C2[1] * z * v[6] - C2[0] * (y * v[5] + x * v[7]);
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, xz, yz) = (x * y, x * z, y * z);
        g[0] += C3[1] * yz * v[10] + 2.0 * C3[4] * xz * v[14] - 6.0 * (C3[0] * xy * v[9] + C3[3] * xz * v[12]);
        g[0] += C3[2] * (2.0 * xy * v[11] - (4.0 * zz - 3.0 * xx - yy) * v[13]) - 3.0 * C3[0] * (xx - yy) * v[15];
        g[1] += C3[1] * xz * v[10] - 2.0 * C3[4] * yz * v[14] + 6.0 * (C3[0] * xy * v[15] - C3[3] * yz * v[12]);
        g[1] += C3[2] * (2.0 * xy * v[13] - (4.0 * zz - xx - 3.0 * yy) * v[11]) - 3.0 * C3[0] * (xx - yy) * v[9];
        g[2] += C3[1] * xy * v[10] + C3[4] * (xx - yy) * v[14] - 8.0 * C3[2] * (yz * v[11] + xz * v[13]);
        g[2] += 3.0 * C3[3] * (2.0 * zz - xx - yy) * v[12];
    }
    g
}

/// Converts a gradient at the unit direction to one at the unnormalised direction: its tangential part, divided by the
/// length.
#[inline(always)]
fn unit_direction_vjp(unit: [f32; 3], inv_len: f32, v_unit: [f32; 3]) -> [f32; 3] {
    let along = dot(unit, v_unit);
    std::array::from_fn(|i| (v_unit[i] - along * unit[i]) * inv_len)
}

/// The part of the gradient of a row's mean that comes through the viewing direction of its colour. `gradients` are those of
/// the row's stored values: that of `sh0` is the gradient of the colour times the constant of band 0, with clamped channels at 0.
pub fn direction_vjp(sh_degree: u8, rows: &Columns, gradients: &Columns, row: usize, view: &View) -> [f32; 3] {
    let degree = sh_degree.min(rows.sh_degree);
    if degree == 0 {
        return [0.0; 3];
    }
    let v_color: [f32; 3] = std::array::from_fn(|c| gradients.sh0[3 * row + c] / C0);
    let mean = std::array::from_fn(|i| rows.means[3 * row + i]);
    let (unit, inv_len) = viewing_direction(view, mean);
    let coefficients = &rows.sh_n[row * sh_n_width(rows.sh_degree)..][..3 * (basis_len(degree) - 1)];
    let mut v_basis = [0.0; BASIS];
    for (v, coefficient) in v_basis[1..].iter_mut().zip(coefficients.as_chunks::<3>().0) {
        *v = dot(*coefficient, v_color);
    }
    unit_direction_vjp(unit, inv_len, sh_basis_vjp(degree, unit, &v_basis))
}

/// Backward of `sh_fwd`: writes `grads.means`, `grads.sh0` and `grads.sh_n`.
///
/// `colors` is the output of `sh_fwd` and `v_colors` its gradient; `radii` are those given to `sh_fwd`: one entry per
/// row each. `grads` is resized to the rows.
pub fn sh_bwd(
    rows: &Columns,
    camera: &Camera,
    sh_degree: u8,
    radii: &[[u32; 2]],
    colors: &[[f32; 3]],
    v_colors: &[[f32; 3]],
    simd: SimdPath,
    grads: &mut Columns,
) {
    assert!(sh_degree <= rows.sh_degree, "the rows are stored with degree {}", rows.sh_degree);
    assert_eq!([radii.len(), colors.len(), v_colors.len()], [rows.rows(); 3], "one entry per row");
    grads.sh_degree = rows.sh_degree;
    grads.resize(rows.rows());
    let view = View::new(camera, 0.0);
    // rayon refuses chunks of zero floats; without higher bands `sh_n` is empty and the chunk size is unused.
    let sh_n_chunk = (sh_n_width(rows.sh_degree) * ROWS_PER_CHUNK).max(1);
    let Columns { means, sh0, sh_n, .. } = grads;
    let chunk_task = |chunk: usize, means, sh0, sh_n| {
        let stored = ShChunk::new(rows, radii, &view, chunk);
        let colors = chunk_of(colors, chunk, 1);
        let v_colors = chunk_of(v_colors, chunk, 1);
        match sh_degree {
            0 => dispatch(simd, ShBwdChunk::<0> { stored, colors, v_colors, means, sh0, sh_n }),
            1 => dispatch(simd, ShBwdChunk::<1> { stored, colors, v_colors, means, sh0, sh_n }),
            2 => dispatch(simd, ShBwdChunk::<2> { stored, colors, v_colors, means, sh0, sh_n }),
            _ => dispatch(simd, ShBwdChunk::<3> { stored, colors, v_colors, means, sh0, sh_n }),
        }
    };
    let narrow = (means.par_chunks_mut(3 * ROWS_PER_CHUNK), sh0.par_chunks_mut(3 * ROWS_PER_CHUNK)).into_par_iter();
    if sh_n.is_empty() {
        narrow.enumerate().for_each(|(chunk, (means, sh0))| chunk_task(chunk, means, sh0, &mut []));
    } else {
        let all = narrow.zip(sh_n.par_chunks_mut(sh_n_chunk)).enumerate();
        all.for_each(|(chunk, ((means, sh0), sh_n))| chunk_task(chunk, means, sh0, sh_n));
    }
}

struct ShBwdChunk<'a, const DEGREE: u8> {
    stored: ShChunk<'a>,
    colors: &'a [[f32; 3]],
    v_colors: &'a [[f32; 3]],
    means: &'a mut [f32],
    sh0: &'a mut [f32],
    sh_n: &'a mut [f32],
}

impl<const DEGREE: u8> ShBwdChunk<'_, DEGREE> {
    /// Writes the gradient of one drawn row's coefficients; returns the gradient of its basis.
    #[inline(always)]
    fn row(&mut self, row: usize, basis: &[f32; BASIS]) -> [f32; BASIS] {
        let (color, v_color) = (self.colors[row], self.v_colors[row]);
        let v: [f32; 3] = std::array::from_fn(|c| if color[c] > 0.0 { v_color[c] } else { 0.0 });
        let used = basis_len(DEGREE);
        let width = self.stored.sh_n_width;
        for c in 0..3 {
            self.sh0[3 * row + c] = basis[0] * v[c];
        }
        // The constant band does not depend on the direction.
        let mut v_basis = [0.0; BASIS];
        let stored = self.stored.sh_n[row * width..][..3 * (used - 1)].as_chunks::<3>().0;
        let (in_use, unused) = self.sh_n[row * width..][..width].split_at_mut(3 * (used - 1));
        for (k, (out, coefficient)) in in_use.as_chunks_mut::<3>().0.iter_mut().zip(stored).enumerate() {
            *out = v.map(|v| basis[k + 1] * v);
            v_basis[k + 1] = dot(*coefficient, v);
        }
        unused.fill(0.0);
        v_basis
    }
}

impl<const DEGREE: u8> Kernel for ShBwdChunk<'_, DEGREE> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(mut self) {
        let width = self.stored.sh_n_width;
        for block in 0..self.stored.radii.len().div_ceil(LANES) {
            let (dirs, inv_lens) = self.stored.directions(block);
            let basis = ShChunk::basis(DEGREE, &dirs);
            let mut v_basis = [[0.0; LANES]; BASIS];
            for (l, radii) in block_of(self.stored.radii, block, 1).iter().enumerate() {
                let row = block * LANES + l;
                if *radii == [0, 0] {
                    self.sh0[3 * row..3 * row + 3].fill(0.0);
                    self.sh_n[row * width..(row + 1) * width].fill(0.0);
                } else {
                    let v = self.row(row, &basis[l]);
                    for k in 1..BASIS {
                        v_basis[k][l] = v[k];
                    }
                }
            }
            let mut v_means = [[0.0; LANES]; 3];
            for l in 0..LANES {
                let unit = lane(&dirs, l);
                let v_unit = sh_basis_vjp(DEGREE, unit, &lane(&v_basis, l));
                // Rows of zeros may have any direction; their result must still be zero, not NaN.
                let v = unit_direction_vjp(unit, inv_lens[l], v_unit);
                for c in 0..3 {
                    v_means[c][l] = v[c];
                }
            }
            for (l, out) in block_of_mut(self.means, block, 3).as_chunks_mut::<3>().0.iter_mut().enumerate() {
                *out = lane(&v_means, l);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};
    use crate::kernels::project_fwd::tests::camera;
    use crate::kernels::sh_fwd::sh_fwd;

    #[test]
    fn culled_rows_get_zero_and_every_path_the_same_bits() {
        let n = ROWS_PER_CHUNK + 21;
        let mut rng = Stream::new(5, Purpose::Test, 0, 0);
        for stored in 0..=3u8 {
            let mut rows = Columns::zeros(n, stored);
            for column in [&mut rows.means, &mut rows.sh0, &mut rows.sh_n] {
                column.fill_with(|| rng.range(-1.0, 1.0) as f32);
            }
            let radii: Vec<[u32; 2]> = (0..n).map(|row| if row % 3 == 0 { [0, 0] } else { [2, 1] }).collect();
            // No result may depend on a culled row.
            rows.means[..3].fill(f32::NAN);
            rows.sh0[..3].fill(f32::NAN);
            let v_colors: Vec<[f32; 3]> = (0..n).map(|_| std::array::from_fn(|_| rng.normal() as f32)).collect();
            let run = |simd| {
                let (mut colors, mut grads) = (vec![[f32::NAN; 3]; n], Columns::zeros(n, stored));
                grads.means.fill(f32::NAN);
                sh_fwd(&rows, &camera(), stored, &radii, simd, &mut colors);
                sh_bwd(&rows, &camera(), stored, &radii, &colors, &v_colors, simd, &mut grads);
                (colors, grads)
            };
            let want = run(SimdPath::Baseline);
            assert_eq!((want.0[0], &want.1.means[..3], &want.1.sh0[..3]), ([0.0; 3], &[0.0; 3][..], &[0.0; 3][..]));
            assert!(want.1.means.iter().chain(&want.1.sh_n).all(|x| x.is_finite()));
            assert!(want.1.sh0.iter().any(|x| *x != 0.0));
            for simd in SimdPath::ALL {
                assert_eq!(run(simd), want, "{simd:?}");
            }
        }
    }
}
