// The real spherical harmonics of bands 0 to 3, with the signs and order of src/kernels/sh_fwd.rs. Degree 2 defines
// SH_DEGREE_1 and SH_DEGREE_2; a switch without the lower ones has no effect in the stages.

const SH_C0: f32 = 0.28209479;
const SH_C1: f32 = 0.48860251;
const SH_C2 = vec3<f32>(1.0925484, 0.31539157, 0.5462742);
const SH_C3 = array<f32, 5>(0.5900436, 2.8906114, 0.4570458, 0.37317634, 1.4453057);
/// Floats per row of the bands in use, [rows][(degree + 1)^2 - 1][3], and the first entry of bands 2 and 3.
#ifdef SH_DEGREE_3
const SH_WIDTH: u32 = 45u;
#else
#ifdef SH_DEGREE_2
const SH_WIDTH: u32 = 24u;
#else
const SH_WIDTH: u32 = 9u;
#endif
#endif
const SH_BAND_2: u32 = 9u;
const SH_BAND_3: u32 = 24u;
#ifdef SH_DEGREE_1
fn sh_band1(d: vec3<f32>) -> array<f32, 3> {
    return array<f32, 3>(-SH_C1 * d.y, SH_C1 * d.z, -SH_C1 * d.x);
}

/// Gradient of sum_k v[k] basis_k with respect to the direction, with its components treated as independent.
fn sh_band1_vjp(v: array<f32, 3>) -> vec3<f32> {
    return vec3<f32>(-SH_C1 * v[2], -SH_C1 * v[0], SH_C1 * v[1]);
}
#endif

#ifdef SH_DEGREE_2
fn sh_band2(d: vec3<f32>) -> array<f32, 5> {
    let s = d * d;
    return array<f32, 5>(
        SH_C2.x * (d.x * d.y),
        -SH_C2.x * (d.y * d.z),
        SH_C2.y * (2.0 * s.z - s.x - s.y),
        -SH_C2.x * (d.x * d.z),
        SH_C2.z * (s.x - s.y),
    );
}

fn sh_band2_vjp(d: vec3<f32>, v: array<f32, 5>) -> vec3<f32> {
    return vec3<f32>(
        SH_C2.x * (d.y * v[0] - d.z * v[3]) + 2.0 * d.x * (SH_C2.z * v[4] - SH_C2.y * v[2]),
        SH_C2.x * (d.x * v[0] - d.z * v[1]) - 2.0 * d.y * (SH_C2.z * v[4] + SH_C2.y * v[2]),
        4.0 * SH_C2.y * d.z * v[2] - SH_C2.x * (d.y * v[1] + d.x * v[3]),
    );
}
#endif

#ifdef SH_DEGREE_3
fn sh_band3(d: vec3<f32>) -> array<f32, 7> {
    let s = d * d;
    return array<f32, 7>(
        -SH_C3[0] * (d.y * (3.0 * s.x - s.y)),
        SH_C3[1] * (d.x * d.y * d.z),
        -SH_C3[2] * (d.y * (4.0 * s.z - s.x - s.y)),
        SH_C3[3] * (d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y)),
        -SH_C3[2] * (d.x * (4.0 * s.z - s.x - s.y)),
        SH_C3[4] * (d.z * (s.x - s.y)),
        -SH_C3[0] * (d.x * (s.x - 3.0 * s.y)),
    );
}

fn sh_band3_vjp(d: vec3<f32>, v: array<f32, 7>) -> vec3<f32> {
    let s = d * d;
    let xy = d.x * d.y;
    let xz = d.x * d.z;
    let yz = d.y * d.z;
    var g = vec3<f32>(
        SH_C3[1] * yz * v[1] + 2.0 * SH_C3[4] * xz * v[5] - 6.0 * (SH_C3[0] * xy * v[0] + SH_C3[3] * xz * v[3]),
        SH_C3[1] * xz * v[1] - 2.0 * SH_C3[4] * yz * v[5] + 6.0 * (SH_C3[0] * xy * v[6] - SH_C3[3] * yz * v[3]),
        SH_C3[1] * xy * v[1] + SH_C3[4] * (s.x - s.y) * v[5] - 8.0 * SH_C3[2] * (yz * v[2] + xz * v[4]),
    );
    g.x += SH_C3[2] * (2.0 * xy * v[2] - (4.0 * s.z - 3.0 * s.x - s.y) * v[4]) - 3.0 * SH_C3[0] * (s.x - s.y) * v[6];
    g.y += SH_C3[2] * (2.0 * xy * v[4] - (4.0 * s.z - s.x - 3.0 * s.y) * v[2]) - 3.0 * SH_C3[0] * (s.x - s.y) * v[0];
    g.z += 3.0 * SH_C3[3] * (2.0 * s.z - s.x - s.y) * v[3];
    return g;
}
#endif
