//! Stage "project", backward: gradients of footprints to gradients of means, quats, scales and opacities.
//!
//! Not here: the gradient of the mean through the colour, which `sh_bwd` writes first.
//!
//! Invariants: 1. culled rows get exactly 0 and add nothing; 2. the same bits on every instruction path, as in the
//! forward stage; 3. no step subtracts large numbers to get a small one, so the gradients of needles are accurate in
//! f32.
//!
//! The formulas. Let b_k be the image of the ellipsoid's axis k, s_k its standard deviation, Y the inverse (the conic)
//! of the covariance C = sum s_k^2 b_k b_k^T + eps I, and V the symmetric 2x2 matrix of the conic's gradient, with B's
//! half off the diagonal. dY = -Y dC Y. With w_k = Y b_k and E_kl = w_k^T V w_l the gradients are
//!
//! - log-scale k: -2 s_k^2 E_kk;
//! - rotation about the ellipsoid's own axes: 2 E_12 (s_2^2 - s_1^2), and the same with the indices turned;
//! - depth through the Jacobian's 1/z: -(sum of the log-scale gradients) / z;
//! - the Jacobian's slopes (tx, ty): 2 f/z Y V sum_k s_k^2 z_k w_k, z_k the camera-space z of axis k.
//!
//! For a needle, the conic times the long axis is a small difference of large numbers. The adjugate in cross products
//! avoids it: adj(C) b_k = eps b_k + sum_l s_l^2 perp(b_l) (b_l x b_k), in which the long axis does not contribute to
//! its own w_k.

use crate::base::math::exp32;
use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
use crate::kernels::lanes::{ROWS_PER_CHUNK, block_of, block_of_mut, chunk_of, gather, lane, scatter, set_lane};
use crate::kernels::project_fwd::{Geometry, StoredChunk, View, geometry};
use crate::scene::camera::Camera;
use crate::scene::columns::Columns;
use rayon::prelude::*;

/// Gradient of one row's geometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeometryGradient {
    /// With respect to the world-space mean.
    pub mean: [f32; 3],
    /// With respect to the stored quaternion.
    pub quat: [f32; 4],
    /// With respect to the log of the scales.
    pub log_scale: [f32; 3],
}

/// The images of the axes times the conic: w_k = Y b_k (see the module page).
#[inline(always)]
fn axes_by_conic(g: &Geometry, eps2d: f32) -> [[f32; 2]; 3] {
    let perp = g.axes.map(|b| [-b[1], b[0]]);
    let inv_det = 1.0 / g.det;
    // b_l x b_k is +minor or -minor of the third index.
    let combine = |k: usize, l: usize, m: usize| -> [f32; 2] {
        let by_l = g.scale_sq[l] * g.minors[m];
        let by_m = g.scale_sq[m] * g.minors[l];
        std::array::from_fn(|i| inv_det * (eps2d * g.axes[k][i] - by_l * perp[l][i] + by_m * perp[m][i]))
    };
    [combine(0, 1, 2), combine(1, 2, 0), combine(2, 0, 1)]
}

/// Gradient of one visible row from the gradients of its pixel position and its conic. `v_conic[1]` is with respect to
/// B in sigma = (A dx^2 + C dy^2) / 2 + B dx dy.
#[inline(always)]
pub fn geometry_vjp(view: &View, g: &Geometry, v_mean2d: [f32; 2], v_conic: [f32; 3]) -> GeometryGradient {
    let w = axes_by_conic(g, view.eps2d);
    let half_b = 0.5 * v_conic[1];
    // V w_k
    let vw = w.map(|w| [v_conic[0] * w[0] + half_b * w[1], half_b * w[0] + v_conic[2] * w[1]]);
    let e = |k: usize, l: usize| w[k][0] * vw[l][0] + w[k][1] * vw[l][1];
    let s = g.scale_sq;
    let log_scale: [f32; 3] = std::array::from_fn(|k| -2.0 * (s[k] * e(k, k)));

    let turn = [2.0 * e(1, 2) * (s[2] - s[1]), 2.0 * e(2, 0) * (s[0] - s[2]), 2.0 * e(0, 1) * (s[1] - s[0])];
    // A rotation by t about the own axes moves the unit quaternion by q (0, t) / 2; the columns of that map are
    // orthonormal up to the factor 1/2, so its transpose-inverse is twice the map. The result is already tangent.
    let [qw, qx, qy, qz] = g.quat;
    let by = 2.0 * g.inv_quat_norm;
    let quat = [
        by * (-qx * turn[0] - qy * turn[1] - qz * turn[2]),
        by * (qw * turn[0] - qz * turn[1] + qy * turn[2]),
        by * (qz * turn[0] + qw * turn[1] - qx * turn[2]),
        by * (-qy * turn[0] + qx * turn[1] + qw * turn[2]),
    ];

    let tilt: [f32; 2] = std::array::from_fn(|i| {
        s[0] * g.axes_z[0] * vw[0][i] + s[1] * g.axes_z[1] * vw[1][i] + s[2] * g.axes_z[2] * vw[2][i]
    });
    let inv_det = 1.0 / g.det;
    let [xx, xy, yy] = g.cov2d;
    let y_tilt = [inv_det * (yy * tilt[0] - xy * tilt[1]), inv_det * (xx * tilt[1] - xy * tilt[0])];
    let mut camera = [0.0; 3];
    camera[2] = -g.inv_depth * (log_scale[0] + log_scale[1] + log_scale[2]);
    for i in 0..2 {
        let per_unit = view.focal[i] * g.inv_depth;
        let v_slope = 2.0 * per_unit * y_tilt[i];
        // Where the slope is clamped it does not depend on the mean.
        let v_slope = if g.slope[i] == g.ray[i] { v_slope } else { 0.0 };
        let v_ray = view.focal[i] * v_mean2d[i] + v_slope;
        camera[i] = g.inv_depth * v_ray;
        camera[2] -= g.inv_depth * (g.ray[i] * v_ray);
    }
    let r = &view.world_to_camera;
    let mean = std::array::from_fn(|j| r[0][j] * camera[0] + r[1][j] * camera[1] + r[2][j] * camera[2]);
    GeometryGradient { mean, quat, log_scale }
}

/// Derivative of the sigmoid at a logit: o (1 - o), without cancellation near o = 1.
#[inline(always)]
fn sigmoid_slope(logit: f32) -> f32 {
    let e = exp32(-logit.abs());
    let d = 1.0 + e;
    e / (d * d)
}

/// Backward of `project_fwd`: adds to `grads.means` and writes `grads.quats`, `grads.scales` (with respect to the
/// log-scales) and `grads.opacities` (to the logits).
///
/// `v_means2d`, `v_conics` (see [`geometry_vjp`]) and `v_opacities` (with respect to the activated opacity) hold one
/// entry per row; those of culled rows, whose `radii` are [0, 0], are ignored. `grads` is resized to the rows.
pub fn project_bwd(
    rows: &Columns,
    camera: &Camera,
    eps2d: f32,
    radii: &[[u32; 2]],
    v_means2d: &[[f32; 2]],
    v_conics: &[[f32; 3]],
    v_opacities: &[f32],
    simd: SimdPath,
    grads: &mut Columns,
) {
    let n = rows.rows();
    assert_eq!([radii.len(), v_means2d.len(), v_conics.len(), v_opacities.len()], [n; 4], "one entry per row");
    grads.sh_degree = rows.sh_degree;
    grads.resize(n);
    let view = View::new(camera, eps2d);
    let Columns { means, quats, scales, opacities, .. } = grads;
    (means.par_chunks_mut(3 * ROWS_PER_CHUNK), quats.par_chunks_mut(4 * ROWS_PER_CHUNK))
        .into_par_iter()
        .zip((scales.par_chunks_mut(3 * ROWS_PER_CHUNK), opacities.par_chunks_mut(ROWS_PER_CHUNK)))
        .enumerate()
        .for_each(|(chunk, ((means, quats), (scales, opacities)))| {
            dispatch(
                simd,
                ProjectBwdChunk {
                    view: &view,
                    stored: StoredChunk::new(rows, chunk),
                    radii: chunk_of(radii, chunk, 1),
                    v_means2d: chunk_of(v_means2d, chunk, 1),
                    v_conics: chunk_of(v_conics, chunk, 1),
                    v_opacities: chunk_of(v_opacities, chunk, 1),
                    means,
                    quats,
                    scales,
                    opacities,
                },
            );
        });
}

struct ProjectBwdChunk<'a> {
    view: &'a View,
    stored: StoredChunk<'a>,
    radii: &'a [[u32; 2]],
    v_means2d: &'a [[f32; 2]],
    v_conics: &'a [[f32; 3]],
    v_opacities: &'a [f32],
    means: &'a mut [f32],
    quats: &'a mut [f32],
    scales: &'a mut [f32],
    opacities: &'a mut [f32],
}

impl Kernel for ProjectBwdChunk<'_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let view = *self.view;
        let s = self.stored;
        for block in 0..self.radii.len().div_ceil(LANES) {
            let mut visible = [false; LANES];
            for (v, r) in visible.iter_mut().zip(block_of(self.radii, block, 1)) {
                *v = (r[0] | r[1]) != 0;
            }
            let means = gather::<3>(block_of(s.means, block, 3));
            let quats = gather::<4>(block_of(s.quats, block, 4));
            let scales = gather::<3>(block_of(s.scales, block, 3));
            let logits = gather::<1>(block_of(s.opacities, block, 1));
            let v_means2d = gather::<2>(block_of(self.v_means2d, block, 1).as_flattened());
            let v_conics = gather::<3>(block_of(self.v_conics, block, 1).as_flattened());
            let v_opacities = gather::<1>(block_of(self.v_opacities, block, 1));
            let mut grad_means = gather::<3>(block_of(self.means, block, 3));
            let mut grad_quats = [[0.0; LANES]; 4];
            let mut grad_scales = [[0.0; LANES]; 3];
            let mut grad_opacities = [[0.0; LANES]; 1];
            for l in 0..LANES {
                let g = geometry(&view, lane(&means, l), lane(&quats, l), lane(&scales, l).map(exp32));
                let v = geometry_vjp(&view, &g, lane(&v_means2d, l), lane(&v_conics, l));
                let keep = |x: f32| if visible[l] { x } else { 0.0 };
                for c in 0..3 {
                    grad_means[c][l] += keep(v.mean[c]);
                }
                set_lane(&mut grad_quats, l, v.quat.map(keep));
                set_lane(&mut grad_scales, l, v.log_scale.map(keep));
                grad_opacities[0][l] = keep(v_opacities[0][l] * sigmoid_slope(logits[0][l]));
            }
            scatter(&grad_means, block_of_mut(self.means, block, 3));
            scatter(&grad_quats, block_of_mut(self.quats, block, 4));
            scatter(&grad_scales, block_of_mut(self.scales, block, 3));
            scatter(&grad_opacities, block_of_mut(self.opacities, block, 1));
        }
    }
}
