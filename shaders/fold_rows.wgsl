// Folds the sums of each row over its intersections, in emit order (tiles column by column), and turns them into
// gradients: the twin of `fold_rows` in src/kernels/rasterize_bwd.rs. Nine invocations take a row, one for each sum.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/splat.wgsl"

struct FoldUniforms {
    row_count: u32,
    /// Intersections that the buffers hold.
    capacity: u32,
    pad: vec2<u32>,
}

@group(0) @binding(0) var<uniform> view: FoldUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
/// Rows by rank.
@group(0) @binding(2) var<storage, read> order: array<u32>;
/// Where each rank's intersections begin; row_count + 1 entries.
@group(0) @binding(3) var<storage, read> offsets: array<u32>;
@group(0) @binding(4) var<storage, read> row_from_isect: array<u32>;
/// [intersections][9]
@group(0) @binding(5) var<storage, read> partials: array<f32>;
@group(0) @binding(6) var<storage, read_write> v_splats: array<vec4<f32>>;

const SUMS: u32 = 9u;
/// Rows of a workgroup; its last four invocations rest.
const GROUP_ROWS: u32 = 28u;

var<workgroup> sums: array<f32, 256>;

/// One sum of one intersection; nothing where it was counted and then not found, since no tile wrote it.
fn partial(isect: u32, row: u32, which: u32) -> f32 {
    return select(0.0, partials[isect * SUMS + which], row_from_isect[isect] == row);
}

@compute @workgroup_size(256)
fn fold_rows(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let group = linear_group(workgroup, workgroups);
    let rank = group * GROUP_ROWS + lane / SUMS;
    let which = lane % SUMS;
    var sum = 0.0;
    if lane < GROUP_ROWS * SUMS && rank < view.row_count {
        let row = order[rank];
        let end = min(offsets[rank + 1u], view.capacity);
        var isect = min(offsets[rank], end);
        // By fours, to stay below the limit on iterations; the order of the additions is that of the intersections.
        while isect + 4u <= end {
            let p0 = partial(isect, row, which);
            let p1 = partial(isect + 1u, row, which);
            let p2 = partial(isect + 2u, row, which);
            let p3 = partial(isect + 3u, row, which);
            sum = (((sum + p0) + p1) + p2) + p3;
            isect += 4u;
        }
        while isect < end {
            sum += partial(isect, row, which);
            isect++;
        }
    }
    sums[lane] = sum;
    workgroupBarrier();
    let own_rank = group * GROUP_ROWS + lane;
    if lane >= GROUP_ROWS || own_rank >= view.row_count {
        return;
    }
    let row = order[own_rank];
    let at = SPLAT_STRIDE * row;
    let splat = splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]);
    let s = lane * SUMS;
    // dL/dsigma = -h; sigma = (A dx^2 + C dy^2) / 2 + B dx dy with dx = pixel - mean.
    let conic = splat.conic;
    let v_mean = vec2<f32>(conic.x * sums[s + 1u] + conic.y * sums[s + 2u], conic.y * sums[s + 1u] + conic.z * sums[s + 2u]);
    // A row that is not drawn has no opacity, and no sums either.
    let v_opacity = select(0.0, sums[s] / splat.opacity, splat.opacity > 0.0);
    v_splats[at] = vec4<f32>(v_mean, 0.0, v_opacity);
    v_splats[at + 1u] = vec4<f32>(-0.5 * sums[s + 3u], -sums[s + 4u], -0.5 * sums[s + 5u], 0.0);
    v_splats[at + 2u] = vec4<f32>(sums[s + 6u], sums[s + 7u], sums[s + 8u], 0.0);
}
