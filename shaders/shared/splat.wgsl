// A splat: the output of projection and colours for the tile stages. One record per row of the view, 48 bytes, three
// vec4:
//
//   splats[3 row]     = mean2d.x, mean2d.y, depth, opacity       (pixels, camera-space z, after activation)
//   splats[3 row + 1] = conic.xx, conic.xy, conic.yy, radius.x   (1/px^2; whole pixels, as float)
//   splats[3 row + 2] = red, green, blue, radius.y
//
// project_fwd writes the record with colour 0; sh_fwd then writes the colour. A culled row is all zeros, and radius.x >
// 0 exactly for the drawn rows (radius.y is then above 0 too).
//
// The gradient of a splat has the same layout; the two weights are zero unless rows are weighed:
//
//   v_splats[3 row]     = v_mean2d.x, v_mean2d.y, weight, v_opacity
//   v_splats[3 row + 1] = v_conic.xx, v_conic.xy, v_conic.yy, weight times error  (xy counted once: sigma holds conic.xy dx dy)
//   v_splats[3 row + 2] = v_red, v_green, v_blue, largest        (with respect to the colour after its clamp at 0)
//
// sh_bwd and project_bwd ignore entries of culled rows, and leave in `largest` the largest magnitude of a gradient of the row.

struct Splat {
    mean2d: vec2<f32>,
    depth: f32,
    opacity: f32,
    conic: vec3<f32>,
    radii: vec2<f32>,
    color: vec3<f32>,
}

/// Number of vec4 in a record.
const SPLAT_STRIDE: u32 = 3u;

fn splat_unpack(a: vec4<f32>, b: vec4<f32>, c: vec4<f32>) -> Splat {
    return Splat(a.xy, a.z, a.w, b.xyz, vec2<f32>(b.w, c.w), c.xyz);
}
