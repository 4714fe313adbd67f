// One row seen by a view: the projected ellipsoid before inversion. The twin of `geometry` in
// src/kernels/project_fwd.rs, which documents the derivation: the determinant is a sum of squares (the 2x2 minors of
// the projected axes), because c0 c2 - c1^2 cancels for needles.
#import "shared/camera.wgsl"
#import "shared/math.wgsl"

/// A quaternion whose squared length is outside this range has no usable direction: its row is culled.
const QUAT_NORM_SQ_MIN: f32 = 1e-30;
const QUAT_NORM_SQ_MAX: f32 = 1e30;

struct Geometry {
    depth: f32,
    inv_depth: f32,
    /// X/Z, Y/Z; and the same, clamped for the Jacobian.
    ray: vec2<f32>,
    slope: vec2<f32>,
    /// Unit quaternion, w x y z, and 1 / length of the stored one.
    quat: vec4<f32>,
    inv_quat_norm: f32,
    quat_ok: bool,
    /// Images of the ellipsoid's axes, px per world unit.
    axis0: vec2<f32>,
    axis1: vec2<f32>,
    axis2: vec2<f32>,
    /// Cross products of the images: (1,2), (2,0), (0,1).
    minors: vec3<f32>,
    /// Camera-space z of the ellipsoid's axes.
    axes_z: vec3<f32>,
    scale_sq: vec3<f32>,
    /// Blurred covariance xx, xy, yy, px^2, and its determinant.
    cov2d: vec3<f32>,
    det: f32,
}

/// Sums in the order of the CPU twin.
fn dot3(a: vec3<f32>, b: vec3<f32>) -> f32 {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

/// As clamp(), but NaN stays.
fn cut(x: f32, low: f32, high: f32) -> f32 {
    let above = select(x, low, x < low);
    return select(above, high, above > high);
}

/// Projects one row; `quat` need not be unit, `scale` is after activation.
fn geometry(view: View, mean: vec3<f32>, quat: vec4<f32>, scale: vec3<f32>) -> Geometry {
    let w0 = view.world_to_camera[0];
    let w1 = view.world_to_camera[1];
    let w2 = view.world_to_camera[2];
    var g: Geometry;
    let p = vec3<f32>(dot3(w0.xyz, mean) + w0.w, dot3(w1.xyz, mean) + w1.w, dot3(w2.xyz, mean) + w2.w);
    g.depth = p.z;
    g.inv_depth = 1.0 / p.z;
    g.ray = p.xy * g.inv_depth;
    g.slope = vec2<f32>(
        cut(g.ray.x, view.slope_low.x, view.slope_high.x),
        cut(g.ray.y, view.slope_low.y, view.slope_high.y),
    );

    let norm_sq = (quat.x * quat.x + quat.y * quat.y) + (quat.z * quat.z + quat.w * quat.w);
    g.inv_quat_norm = 1.0 / sqrt(norm_sq);
    g.quat = quat * g.inv_quat_norm;
    g.quat_ok = is_finite(norm_sq) && norm_sq >= QUAT_NORM_SQ_MIN && norm_sq < QUAT_NORM_SQ_MAX;
    // Quaternions are stored w first: .x is w.
    let w = g.quat.x;
    let x = g.quat.y;
    let y = g.quat.z;
    let z = g.quat.w;
    let column0 = vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y));
    let column1 = vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x));
    let column2 = vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));

    let per_unit = view.focal * g.inv_depth;
    let t0 = per_unit.x * (w0.xyz - g.slope.x * w2.xyz);
    let t1 = per_unit.y * (w1.xyz - g.slope.y * w2.xyz);
    let area = per_unit.x * per_unit.y;
    let normal = area * (view.cofactors[2].xyz + g.slope.x * view.cofactors[0].xyz + g.slope.y * view.cofactors[1].xyz);
    g.axis0 = vec2<f32>(dot3(t0, column0), dot3(t1, column0));
    g.axis1 = vec2<f32>(dot3(t0, column1), dot3(t1, column1));
    g.axis2 = vec2<f32>(dot3(t0, column2), dot3(t1, column2));
    g.minors = vec3<f32>(dot3(normal, column0), dot3(normal, column1), dot3(normal, column2));
    g.axes_z = vec3<f32>(dot3(w2.xyz, column0), dot3(w2.xyz, column1), dot3(w2.xyz, column2));

    g.scale_sq = scale * scale;
    let s = g.scale_sq;
    let xx = s.x * (g.axis0.x * g.axis0.x) + s.y * (g.axis1.x * g.axis1.x) + s.z * (g.axis2.x * g.axis2.x);
    let xy = s.x * (g.axis0.x * g.axis0.y) + s.y * (g.axis1.x * g.axis1.y) + s.z * (g.axis2.x * g.axis2.y);
    let yy = s.x * (g.axis0.y * g.axis0.y) + s.y * (g.axis1.y * g.axis1.y) + s.z * (g.axis2.y * g.axis2.y);
    let m = vec3<f32>(scale.y * scale.z, scale.z * scale.x, scale.x * scale.y) * g.minors;
    let eps = view.eps2d;
    g.cov2d = vec3<f32>(xx + eps, xy, yy + eps);
    g.det = dot3(m, m) + eps * (xx + yy) + eps * eps;
    return g;
}
