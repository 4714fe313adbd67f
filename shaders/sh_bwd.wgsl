// Stage "sh", backward: gradients of colours to gradients of sh0, the higher bands and, through the viewing
// direction, means. The twin of src/kernels/sh_bwd.rs.
// Every entry of v_means, v_sh0 and of the bands in use is written, with zeros for culled rows. The gradients of unused
// bands are zero and not stored: they are not bound.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/camera.wgsl"
#import "shared/splat.wgsl"
#import "shared/sh.wgsl"

@group(0) @binding(0) var<uniform> view: RowsUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> v_splats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> v_means: array<f32>;
@group(0) @binding(4) var<storage, read_write> v_sh0: array<f32>;
#ifdef SH_DEGREE_1
@group(0) @binding(5) var<storage, read> means: array<f32>;
@group(0) @binding(6) var<storage, read> sh1: array<f32>;
@group(0) @binding(7) var<storage, read_write> v_sh1: array<f32>;
#ifdef SH_DEGREE_2
@group(0) @binding(8) var<storage, read> sh2: array<f32>;
@group(0) @binding(9) var<storage, read_write> v_sh2: array<f32>;
#ifdef SH_DEGREE_3
@group(0) @binding(10) var<storage, read> sh3: array<f32>;
@group(0) @binding(11) var<storage, read_write> v_sh3: array<f32>;
#endif
#endif
#endif

fn dot3(a: vec3<f32>, b: vec3<f32>) -> f32 {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

/// Zeros for a row that is not drawn.
fn clear_row(i: u32) {
    for (var c = 0u; c < 3u; c++) {
        v_means[3u * i + c] = 0.0;
        v_sh0[3u * i + c] = 0.0;
    }
#ifdef SH_DEGREE_1
    for (var c = 0u; c < 9u; c++) {
        v_sh1[9u * i + c] = 0.0;
    }
#ifdef SH_DEGREE_2
    for (var c = 0u; c < 15u; c++) {
        v_sh2[15u * i + c] = 0.0;
    }
#ifdef SH_DEGREE_3
    for (var c = 0u; c < 21u; c++) {
        v_sh3[21u * i + c] = 0.0;
    }
#endif
#endif
#endif
}

@compute @workgroup_size(256)
fn sh_bwd(place: Place) {
    let i = linear_index(place, 256u);
    if i >= view.row_count {
        return;
    }
    let at = SPLAT_STRIDE * i;
    let radius = splats[at + 1u].w;
    if !(radius > 0.0) {
        clear_row(i);
        return;
    }
    // A channel clamped at 0 passes no gradient.
    let v = select(vec3<f32>(), v_splats[at + 2u].xyz, splats[at + 2u].xyz > vec3<f32>());
    for (var c = 0u; c < 3u; c++) {
        v_sh0[3u * i + c] = SH_C0 * v[c];
    }
    var v_dir = vec3<f32>();
#ifdef SH_DEGREE_1
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let dir = unit_direction(mean - view.centre);
    var basis1 = sh_band1(dir.unit);
    var v_basis1: array<f32, 3>;
    for (var k = 0u; k < 3u; k++) {
        let first = 9u * i + 3u * k;
        v_basis1[k] = dot3(vec3<f32>(sh1[first], sh1[first + 1u], sh1[first + 2u]), v);
        for (var c = 0u; c < 3u; c++) {
            v_sh1[first + c] = basis1[k] * v[c];
        }
    }
    v_dir += sh_band1_vjp(v_basis1);
#ifdef SH_DEGREE_2
    var basis2 = sh_band2(dir.unit);
    var v_basis2: array<f32, 5>;
    for (var k = 0u; k < 5u; k++) {
        let first = 15u * i + 3u * k;
        v_basis2[k] = dot3(vec3<f32>(sh2[first], sh2[first + 1u], sh2[first + 2u]), v);
        for (var c = 0u; c < 3u; c++) {
            v_sh2[first + c] = basis2[k] * v[c];
        }
    }
    v_dir += sh_band2_vjp(dir.unit, v_basis2);
#ifdef SH_DEGREE_3
    var basis3 = sh_band3(dir.unit);
    var v_basis3: array<f32, 7>;
    for (var k = 0u; k < 7u; k++) {
        let first = 21u * i + 3u * k;
        v_basis3[k] = dot3(vec3<f32>(sh3[first], sh3[first + 1u], sh3[first + 2u]), v);
        for (var c = 0u; c < 3u; c++) {
            v_sh3[first + c] = basis3[k] * v[c];
        }
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
}
