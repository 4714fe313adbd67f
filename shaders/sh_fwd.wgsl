// Stage "sh": colours of the rows that projection has not culled, written into their splats. The twin of
// src/kernels/sh_fwd.rs. SH_DEGREE_1 to SH_DEGREE_3 select the bands in use.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/math.wgsl"
#import "shared/camera.wgsl"
#import "shared/splat.wgsl"
#import "shared/sh.wgsl"

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> splats: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> sh0: array<f32>;
#ifdef SH_DEGREE_1
@group(0) @binding(3) var<storage, read> means: array<f32>;
@group(0) @binding(4) var<storage, read> sh_n: array<f32>;

fn coefficient(at: u32) -> vec3<f32> {
    return vec3<f32>(sh_n[at], sh_n[at + 1u], sh_n[at + 2u]);
}
#endif

@compute @workgroup_size(256)
fn sh_fwd(workgroup: Group, place: Place) {
    let i = linear_index(workgroup, place, 256u);
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
    let dir = viewing_direction(view.centre, mean).unit;
    var basis1 = sh_band1(dir);
    for (var k = 0u; k < 3u; k++) {
        color += basis1[k] * coefficient(SH_WIDTH * i + 3u * k);
    }
#ifdef SH_DEGREE_2
    var basis2 = sh_band2(dir);
    for (var k = 0u; k < 5u; k++) {
        color += basis2[k] * coefficient(SH_WIDTH * i + SH_BAND_2 + 3u * k);
    }
#ifdef SH_DEGREE_3
    var basis3 = sh_band3(dir);
    for (var k = 0u; k < 7u; k++) {
        color += basis3[k] * coefficient(SH_WIDTH * i + SH_BAND_3 + 3u * k);
    }
#endif
#endif
#endif
    // NaN becomes 0.
    splats[at + 2u] = vec4<f32>(select(vec3<f32>(), color, color > vec3<f32>()), splats[at + 2u].w);
}
