// Stage "sh": colours of the rows that projection has not culled, written into their splats. The twin of
// src/kernels/sh_fwd.rs. Each band has its own buffer, [rows][2 l + 1][3], so that none exceeds the size of a binding
// before the others; SH_DEGREE_1 to SH_DEGREE_3 select the bands in use.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/camera.wgsl"
#import "shared/splat.wgsl"
#import "shared/sh.wgsl"

@group(0) @binding(0) var<uniform> view: RowsUniforms;
@group(0) @binding(1) var<storage, read_write> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> sh0: array<f32>;
#ifdef SH_DEGREE_1
@group(0) @binding(3) var<storage, read> means: array<f32>;
@group(0) @binding(4) var<storage, read> sh1: array<f32>;
#ifdef SH_DEGREE_2
@group(0) @binding(5) var<storage, read> sh2: array<f32>;
#ifdef SH_DEGREE_3
@group(0) @binding(6) var<storage, read> sh3: array<f32>;
#endif
#endif
#endif

@compute @workgroup_size(256)
fn sh_fwd(place: Place) {
    let i = linear_index(place, 256u);
    if i >= view.row_count {
        return;
    }
    let at = SPLAT_STRIDE * i;
    let radius = splats[at + 1u].w;
    if !(radius > 0.0) {
        return;
    }
    var color = vec3<f32>(0.5) + SH_C0 * vec3<f32>(sh0[3u * i], sh0[3u * i + 1u], sh0[3u * i + 2u]);
#ifdef SH_DEGREE_1
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let dir = unit_direction(mean - view.centre).unit;
    var basis1 = sh_band1(dir);
    for (var k = 0u; k < 3u; k++) {
        let first = 9u * i + 3u * k;
        color += basis1[k] * vec3<f32>(sh1[first], sh1[first + 1u], sh1[first + 2u]);
    }
#ifdef SH_DEGREE_2
    var basis2 = sh_band2(dir);
    for (var k = 0u; k < 5u; k++) {
        let first = 15u * i + 3u * k;
        color += basis2[k] * vec3<f32>(sh2[first], sh2[first + 1u], sh2[first + 2u]);
    }
#ifdef SH_DEGREE_3
    var basis3 = sh_band3(dir);
    for (var k = 0u; k < 7u; k++) {
        let first = 21u * i + 3u * k;
        color += basis3[k] * vec3<f32>(sh3[first], sh3[first + 1u], sh3[first + 2u]);
    }
#endif
#endif
#endif
    // NaN becomes 0.
    splats[at + 2u] = vec4<f32>(select(vec3<f32>(), color, color > vec3<f32>()), splats[at + 2u].w);
}
