// Stage "sh", backward: gradients of colours to gradients of sh0, the higher bands and, through the viewing
// direction, means. The twin of src/kernels/sh_bwd.rs. Runs before project_bwd.
// Every entry of v_means, v_sh0 and of the bands in use is written, with zeros for culled rows. The gradients of unused
// bands are zero and not stored. With UPDATES those of all coefficients are left to the stage "update".
//
// The stage also writes the row's input of densification. The last word of the row's record receives the largest magnitude of the
// gradients of colours.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/camera.wgsl"
#import "shared/splat.wgsl"
#import "shared/sh.wgsl"

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> v_splats: array<vec4<f32>>;
/// Input of densification for each row: v_mean2d.x, v_mean2d.y, radius.x, radius.y; zeros for a culled row. With WEIGHS a row
/// has a second entry: weight, and weight times error.
@group(0) @binding(3) var<storage, read_write> footprints: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> v_means: array<f32>;
#ifdef SH_DEGREE_1
@group(0) @binding(5) var<storage, read> means: array<f32>;
@group(0) @binding(6) var<storage, read> sh_n: array<f32>;
#ifndef UPDATES
@group(0) @binding(7) var<storage, read_write> v_sh0: array<f32>;
@group(0) @binding(8) var<storage, read_write> v_sh_n: array<f32>;
#endif

/// Writes the gradient of the three coefficients from `at` on, and returns that of their basis function.
fn coefficients_vjp(at: u32, basis: f32, v: vec3<f32>) -> f32 {
#ifndef UPDATES
    for (var c = 0u; c < 3u; c++) {
        v_sh_n[at + c] = basis * v[c];
    }
#endif
    return dot3(vec3<f32>(sh_n[at], sh_n[at + 1u], sh_n[at + 2u]), v);
}
#else
#ifndef UPDATES
@group(0) @binding(5) var<storage, read_write> v_sh0: array<f32>;
#endif
#endif

fn dot3(a: vec3<f32>, b: vec3<f32>) -> f32 {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

fn write_footprint(i: u32, footprint: vec4<f32>, weights: vec2<f32>) {
#ifdef WEIGHS
    footprints[2u * i] = footprint;
    footprints[2u * i + 1u] = vec4<f32>(weights, 0.0, 0.0);
#else
    footprints[i] = footprint;
#endif
}

/// Zeros for a row that is not drawn.
fn clear_row(i: u32) {
    write_footprint(i, vec4<f32>(), vec2<f32>());
    v_splats[SPLAT_STRIDE * i + 2u].w = 0.0;
    for (var c = 0u; c < 3u; c++) {
        v_means[3u * i + c] = 0.0;
    }
#ifndef UPDATES
    for (var c = 0u; c < 3u; c++) {
        v_sh0[3u * i + c] = 0.0;
    }
#ifdef SH_DEGREE_1
    for (var c = 0u; c < SH_WIDTH; c++) {
        v_sh_n[SH_WIDTH * i + c] = 0.0;
    }
#endif
#endif
}

@compute @workgroup_size(256)
fn sh_bwd(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
    if i >= view.row_count {
        return;
    }
    let at = SPLAT_STRIDE * i;
    let radius = splats[at + 1u].w;
    if !(radius > 0.0) {
        clear_row(i);
        return;
    }
    let drawn = splats[at + 2u];
    let v_mean = v_splats[at];
    write_footprint(i, vec4<f32>(v_mean.xy, radius, drawn.w), vec2<f32>(v_mean.z, v_splats[at + 1u].w));
    // A channel clamped at 0 passes no gradient.
    let v = select(vec3<f32>(), v_splats[at + 2u].xyz, drawn.xyz > vec3<f32>());
#ifndef UPDATES
    for (var c = 0u; c < 3u; c++) {
        v_sh0[3u * i + c] = SH_C0 * v[c];
    }
#endif
    var v_dir = vec3<f32>();
    var basis_most = SH_C0;
#ifdef SH_DEGREE_1
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let dir = viewing_direction(view.centre, mean);
    var basis1 = sh_band1(dir.unit);
    var v_basis1: array<f32, 3>;
    for (var k = 0u; k < 3u; k++) {
        v_basis1[k] = coefficients_vjp(SH_WIDTH * i + 3u * k, basis1[k], v);
        basis_most = max(basis_most, abs(basis1[k]));
    }
    v_dir += sh_band1_vjp(v_basis1);
#ifdef SH_DEGREE_2
    var basis2 = sh_band2(dir.unit);
    var v_basis2: array<f32, 5>;
    for (var k = 0u; k < 5u; k++) {
        v_basis2[k] = coefficients_vjp(SH_WIDTH * i + SH_BAND_2 + 3u * k, basis2[k], v);
        basis_most = max(basis_most, abs(basis2[k]));
    }
    v_dir += sh_band2_vjp(dir.unit, v_basis2);
#ifdef SH_DEGREE_3
    var basis3 = sh_band3(dir.unit);
    var v_basis3: array<f32, 7>;
    for (var k = 0u; k < 7u; k++) {
        v_basis3[k] = coefficients_vjp(SH_WIDTH * i + SH_BAND_3 + 3u * k, basis3[k], v);
        basis_most = max(basis_most, abs(basis3[k]));
    }
    v_dir += sh_band3_vjp(dir.unit, v_basis3);
#endif
#endif
    // Gradient of the mean from that of the unit direction: the tangential part, divided by the length.
    v_dir = (v_dir - dot3(dir.unit, v_dir) * dir.unit) * dir.inv_len;
#endif
    for (var c = 0u; c < 3u; c++) {
        v_means[3u * i + c] = v_dir[c];
    }
    // The gradient of a coefficient is its basis function times that of a channel.
    let v_most = largest_magnitude(vec4<f32>(v, 0.0));
    let product = bitcast<u32>(basis_most * bitcast<f32>(v_most));
    v_splats[at + 2u].w = bitcast<f32>(select(product, v_most, v_most >= INFINITY_BITS));
}
