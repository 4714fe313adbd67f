// Camera constants of the per-row stages: the uniform of project_fwd, sh_fwd, sh_bwd and project_bwd. Its values are
// those of `View` in src/kernels/project_fwd.rs, computed once per view on the CPU; src/kernels/uniforms.rs mirrors the
// struct.
//
// A stage runs over a window of `row_count` rows: every column, stored or gradient, splats and v_splats are bound from
// the window's first row on and indexed from 0.

struct RowsUniforms {
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
    /// Limits of X/Z and Y/Z inside the Jacobian.
    slope_low: vec2<f32>,
    slope_high: vec2<f32>,
    /// Number of rows of this window.
    row_count: u32,
}
