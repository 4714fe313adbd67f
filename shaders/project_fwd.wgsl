// Stage "project": rows to footprints on the screen, culled rows to records of zeros.
// The twin of src/kernels/project_fwd.rs: the same operations in the same order and the same decisions.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/covariance.wgsl"
#import "shared/splat.wgsl"

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> quats: array<vec4<f32>>;
/// Log of the standard deviations.
@group(0) @binding(3) var<storage, read> scales: array<f32>;
/// Logits.
@group(0) @binding(4) var<storage, read> opacities: array<f32>;
@group(0) @binding(5) var<storage, read_write> splats: array<vec4<f32>>;
#ifdef KEYS
/// Keys and values of the sort by depth, as depth_keys of radix_sort.wgsl writes them.
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> values: array<u32>;
#endif

/// Natural logarithm for x in [1, 256), within 3e-7 + 2e-7 ln x; unspecified outside.
fn ln_1_to_256(x: f32) -> f32 {
    // Subtracting the bits of 2/3 first puts m into [2/3, 4/3).
    let shifted = bitcast<u32>(x) - 0x3f2aaaabu;
    let e = f32(bitcast<i32>(shifted) >> 23u);
    let m = bitcast<f32>((shifted & 0x007fffffu) + 0x3f2aaaabu);
    let r = (m - 1.0) / (m + 1.0);
    let r_sq = r * r;
    let series = 1.0 + r_sq * (1.0 / 3.0 + r_sq * (1.0 / 5.0 + r_sq * (1.0 / 7.0 + r_sq * (1.0 / 9.0))));
    return e * 0.693147181 + 2.0 * r * series;
}

/// Whether the box mean +- radius overlaps the pixels 0..size along one side, and neither is NaN.
fn on_screen(mean: f32, radius: f32, size: f32) -> bool {
    return is_finite(mean) && is_finite(radius) && radius > 0.0 && mean + radius > 0.0 && mean - radius < size;
}

@compute @workgroup_size(256)
fn project_fwd(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= view.row_count {
        return;
    }
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let scale = exp32_vec3(vec3<f32>(scales[3u * i], scales[3u * i + 1u], scales[3u * i + 2u]));
    let opacity = sigmoid(opacities[i]);
    let g = geometry(view, mean, quats[i], scale);

    let inv_det = 1.0 / g.det;
    let conic = vec3<f32>(g.cov2d.z * inv_det, -(g.cov2d.y * inv_det), g.cov2d.x * inv_det);
    let mean2d = view.focal * g.ray + view.principal;
    // alpha reaches 1/255 at sqrt(2 ln(255 opacity)) standard deviations.
    let reach = min(sqrt(2.0 * ln_1_to_256(opacity * 255.0)), EXTENT_SIGMAS);
    let radii = vec2<f32>(ceil(reach * sqrt(g.cov2d.x)), ceil(reach * sqrt(g.cov2d.z)));

    let visible = g.quat_ok
        && is_finite(opacity) && opacity >= ALPHA_MIN
        && is_finite(g.det) && g.det > 0.0
        && is_finite(g.depth) && g.depth > view.depth_range.x && g.depth < view.depth_range.y
        && on_screen(mean2d.x, radii.x, view.size.x) && on_screen(mean2d.y, radii.y, view.size.y)
        && is_finite(conic.x) && is_finite(conic.y) && is_finite(conic.z);
    let at = SPLAT_STRIDE * i;
#ifdef KEYS
    keys[i] = select(0xffffffffu, bitcast<u32>(g.depth), visible);
    values[i] = view.first_row + i;
#endif
    if visible {
        splats[at] = vec4<f32>(mean2d, g.depth, opacity);
        splats[at + 1u] = vec4<f32>(conic, radii.x);
        splats[at + 2u] = vec4<f32>(0.0, 0.0, 0.0, radii.y);
    } else {
        splats[at] = vec4<f32>();
        splats[at + 1u] = vec4<f32>();
        splats[at + 2u] = vec4<f32>();
    }
}
