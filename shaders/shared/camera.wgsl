// Camera constants of the per-row stages: the uniform of project_fwd, sh_fwd, sh_bwd and project_bwd, computed once per
// view by `View` in src/kernels/project_fwd.rs; and the direction in which the camera sees a row.
//
// A stage runs over a window of `row_count` rows: every column, stored or gradient, splats and v_splats are bound from
// the window's first row on and indexed from 0.
#import "shared/math.wgsl"

struct View {
    /// Rows of the world-to-camera rotation, with the translation in w.
    world_to_camera: array<vec4<f32>, 3>,
    /// Cofactors of the rotation: row i is the cross product of the two rows after i.
    cofactors: array<vec4<f32>, 3>,
    /// Position of the camera in the world.
    centre: vec3<f32>,
    /// Blur of the covariance, px^2.
    eps2d: f32,
    /// Pixels.
    focal: vec2<f32>,
    /// Pixels.
    principal: vec2<f32>,
    /// Pixels.
    size: vec2<f32>,
    /// Drawn depths are strictly between these.
    depth_range: vec2<f32>,
    /// Limits of X/Z and Y/Z inside the Jacobian: the image plus 15 % of it on each side.
    slope_low: vec2<f32>,
    slope_high: vec2<f32>,
    /// Number of rows of this window, and number of its first row.
    row_count: u32,
    first_row: u32,
}

/// The smallest positive normal f32.
const LEAST_NORMAL: f32 = 1.17549435e-38;

struct Direction {
    unit: vec3<f32>,
    /// 1 / the original length.
    inv_len: f32,
}

/// The direction in which a camera at `centre` sees a mean, at length 1; zeros if the length is 0 or its square overflows f32.
fn viewing_direction(centre: vec3<f32>, mean: vec3<f32>) -> Direction {
    let dir = mean - centre;
    let len_sq = dir.x * dir.x + dir.y * dir.y + dir.z * dir.z;
    if !(is_finite(len_sq) && len_sq >= LEAST_NORMAL) {
        return Direction(vec3<f32>(), 0.0);
    }
    let inv_len = 1.0 / sqrt(len_sq);
    return Direction(dir * inv_len, inv_len);
}
