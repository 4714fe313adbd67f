// Stage "project", backward: gradients of footprints to gradients of means, quats, scales and opacities.
// The twin of src/kernels/project_bwd.rs, which documents the formulas. Runs after sh_bwd: adds to v_means, and raises the largest
// magnitude of a row's gradients, the last word of the row's record.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/covariance.wgsl"
#import "shared/splat.wgsl"

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> quats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> scales: array<f32>;
@group(0) @binding(4) var<storage, read> opacities: array<f32>;
@group(0) @binding(5) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> v_splats: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> v_means: array<f32>;
@group(0) @binding(8) var<storage, read_write> v_quats: array<vec4<f32>>;
/// With respect to the log of the standard deviations.
@group(0) @binding(9) var<storage, read_write> v_scales: array<f32>;
/// With respect to the logits.
@group(0) @binding(10) var<storage, read_write> v_opacities: array<f32>;

/// The image of axis k times the conic, from the image and minor of axis k and of the two axes after it, cyclically.
fn axis_by_conic(g: Geometry, eps2d: f32, k: vec2<f32>, l: vec2<f32>, m: vec2<f32>, by_l: f32, by_m: f32) -> vec2<f32> {
    let perp_l = vec2<f32>(-l.y, l.x);
    let perp_m = vec2<f32>(-m.y, m.x);
    return (1.0 / g.det) * (eps2d * k - by_l * perp_l + by_m * perp_m);
}

/// V w for the symmetric V of the conic's gradient.
fn times_v(v_conic: vec3<f32>, w: vec2<f32>) -> vec2<f32> {
    let half_b = 0.5 * v_conic.y;
    return vec2<f32>(v_conic.x * w.x + half_b * w.y, half_b * w.x + v_conic.z * w.y);
}

fn dot2(a: vec2<f32>, b: vec2<f32>) -> f32 {
    return a.x * b.x + a.y * b.y;
}

struct GeometryGradient {
    mean: vec3<f32>,
    quat: vec4<f32>,
    log_scale: vec3<f32>,
}

fn geometry_vjp(g: Geometry, v_mean2d: vec2<f32>, v_conic: vec3<f32>) -> GeometryGradient {
    let s = g.scale_sq;
    let n = g.minors;
    let w0 = axis_by_conic(g, view.eps2d, g.axis0, g.axis1, g.axis2, s.y * n.z, s.z * n.y);
    let w1 = axis_by_conic(g, view.eps2d, g.axis1, g.axis2, g.axis0, s.z * n.x, s.x * n.z);
    let w2 = axis_by_conic(g, view.eps2d, g.axis2, g.axis0, g.axis1, s.x * n.y, s.y * n.x);
    let vw0 = times_v(v_conic, w0);
    let vw1 = times_v(v_conic, w1);
    let vw2 = times_v(v_conic, w2);
    var out: GeometryGradient;
    out.log_scale = -2.0 * (s * vec3<f32>(dot2(w0, vw0), dot2(w1, vw1), dot2(w2, vw2)));

    let turn = vec3<f32>(
        2.0 * dot2(w1, vw2) * (s.z - s.y),
        2.0 * dot2(w2, vw0) * (s.x - s.z),
        2.0 * dot2(w0, vw1) * (s.y - s.x),
    );
    // A rotation by t about the own axes moves the unit quaternion by q (0, t) / 2.
    let q = g.quat;
    out.quat = (2.0 * g.inv_quat_norm) * vec4<f32>(
        -q.y * turn.x - q.z * turn.y - q.w * turn.z,
        q.x * turn.x - q.w * turn.y + q.z * turn.z,
        q.w * turn.x + q.x * turn.y - q.y * turn.z,
        -q.z * turn.x + q.y * turn.y + q.x * turn.z,
    );

    let tilt = s.x * g.axes_z.x * vw0 + s.y * g.axes_z.y * vw1 + s.z * g.axes_z.z * vw2;
    let c = g.cov2d;
    let y_tilt = (1.0 / g.det) * vec2<f32>(c.z * tilt.x - c.y * tilt.y, c.x * tilt.y - c.y * tilt.x);
    let slope_all = 2.0 * (view.focal * g.inv_depth) * y_tilt;
    // Where the slope is clamped it does not depend on the mean.
    let v_slope = select(vec2<f32>(), slope_all, g.slope == g.ray);
    let v_ray = view.focal * v_mean2d + v_slope;
    var camera = vec3<f32>(g.inv_depth * v_ray, -g.inv_depth * (out.log_scale.x + out.log_scale.y + out.log_scale.z));
    camera.z -= g.inv_depth * (g.ray.x * v_ray.x);
    camera.z -= g.inv_depth * (g.ray.y * v_ray.y);
    out.mean = view.world_to_camera[0].xyz * camera.x
        + view.world_to_camera[1].xyz * camera.y
        + view.world_to_camera[2].xyz * camera.z;
    return out;
}

/// Derivative of the sigmoid at a logit, without cancellation near 1.
fn sigmoid_slope(logit: f32) -> f32 {
    let e = exp32(-abs(logit));
    let d = 1.0 + e;
    return e / (d * d);
}

@compute @workgroup_size(256)
fn project_bwd(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= view.row_count {
        return;
    }
    let at = SPLAT_STRIDE * i;
    let radius = splats[at + 1u].w;
    if !(radius > 0.0) {
        // Culled: nothing to add to v_means.
        v_quats[i] = vec4<f32>();
        for (var c = 0u; c < 3u; c++) {
            v_scales[3u * i + c] = 0.0;
        }
        v_opacities[i] = 0.0;
        return;
    }
    let a = v_splats[at];
    let v_conic = v_splats[at + 1u].xyz;
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let scale = exp32_vec3(vec3<f32>(scales[3u * i], scales[3u * i + 1u], scales[3u * i + 2u]));
    let g = geometry(view, mean, quats[i], scale);
    let v = geometry_vjp(g, a.xy, v_conic);
    let v_mean = vec3<f32>(v_means[3u * i], v_means[3u * i + 1u], v_means[3u * i + 2u]) + v.mean;
    for (var c = 0u; c < 3u; c++) {
        v_means[3u * i + c] = v_mean[c];
        v_scales[3u * i + c] = v.log_scale[c];
    }
    v_quats[i] = v.quat;
    let v_opacity = a.w * sigmoid_slope(opacities[i]);
    v_opacities[i] = v_opacity;
    let of_means = largest_magnitude(vec4<f32>(v_mean, v_opacity));
    let of_shape = max(largest_magnitude(v.quat), largest_magnitude(vec4<f32>(v.log_scale, 0.0)));
    let of_colors = bitcast<u32>(v_splats[at + 2u].w);
    v_splats[at + 2u].w = bitcast<f32>(max(of_colors, max(of_means, of_shape)));
}
