// Emits one intersection for each row and tile of a range that the row can reach, the twin of src/kernels/isect_emit.rs:
// rows in depth order, the tiles of a row column by column. One invocation finds one intersection, so a row that covers the
// picture costs only its share.
//
// Nothing is written beyond the capacity: the scan's total gives the demand, and the caller runs again with larger
// buffers.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/footprint.wgsl"
#import "shared/workgroup_scan.wgsl"

struct IsectUniforms {
    grid: Grid,
    row_count: u32,
    /// Capacity of the buffers, in intersections.
    capacity: u32,
    pad: vec2<u32>,
    /// The range of tiles that is listed: first column, end of the columns, first row, end of the rows.
    range: vec4<u32>,
}

@group(0) @binding(0) var<uniform> view: IsectUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
/// Rows by rank.
@group(0) @binding(2) var<storage, read> order: array<u32>;
/// First intersection of each rank; row_count + 1 entries.
@group(0) @binding(3) var<storage, read> offsets: array<u32>;
@group(0) @binding(4) var<storage, read_write> tiles: array<u32>;
/// The numbers 0, 1, 2, ..., which the sort by tile permutes.
@group(0) @binding(5) var<storage, read_write> isects: array<u32>;
/// NO_ROW if the intersection was counted but not found.
@group(0) @binding(6) var<storage, read_write> row_from_isect: array<u32>;
/// By rank: number of tiles of the range that the row can reach, from which the scan computes the offsets.
@group(0) @binding(7) var<storage, read_write> counts: array<u32>;
/// The sum of the counts of each workgroup, with which the scan begins.
@group(0) @binding(8) var<storage, read_write> sums: array<u32>;

const NO_ROW: u32 = 0xffffffffu;

/// First column and end of the columns of the range that a splat can reach.
fn columns_in_range(reach: Reach) -> vec2<u32> {
    return vec2<u32>(max(reach.box.x, view.range.x), min(reach.box.z, view.range.y));
}

/// First row and end of the rows of the range that a splat can reach in a column; equal if there are none.
fn rows_in_range(reach: Reach, tile_x: u32) -> vec2<u32> {
    let rows = tile_rows_in(reach, view.grid, tile_x);
    let first = max(rows.x, view.range.z);
    return vec2<u32>(first, max(first, min(rows.y, view.range.w)));
}

/// Counts intersections before any is emitted.
@compute @workgroup_size(256)
fn isect_count(workgroup: Group, place: SubgroupPlace) {
    let group = linear_group(workgroup);
    let rank = 256u * group + place.lane;
    var count = 0u;
    if rank < view.row_count {
        let at = SPLAT_STRIDE * order[rank];
        let reach = reach_of(splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]), view.grid);
        let columns = columns_in_range(reach);
        for (var tile_x = columns.x; tile_x < columns.y; tile_x++) {
            let rows = rows_in_range(reach, tile_x);
            count += rows.y - rows.x;
        }
        counts[rank] = count;
    }
    let scanned = workgroup_scan(count, place);
    if place.lane == 0u && 256u * group < view.row_count {
        sums[group] = scanned.total;
    }
}

/// The last rank whose intersections start at or before this one.
fn rank_from_isect(isect: u32) -> u32 {
    var low = 0u;
    var high = view.row_count;
    while low + 1u < high {
        let middle = (low + high) / 2u;
        if offsets[middle] <= isect {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(256)
fn isect_emit(workgroup: Group, place: Place) {
    let isect = linear_index(workgroup, place, 256u);
    if isect >= min(offsets[view.row_count], view.capacity) {
        return;
    }
    let rank = rank_from_isect(isect);
    let row = order[rank];
    let at = SPLAT_STRIDE * row;
    let reach = reach_of(splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]), view.grid);
    var left = isect - offsets[rank];
    // If the roundings of the two entry points ever differ, an intersection that is not found is sorted after all
    // tiles.
    var tile = view.grid.tiles_x * view.grid.tiles_y;
    var found = NO_ROW;
    let columns = columns_in_range(reach);
    for (var tile_x = columns.x; tile_x < columns.y; tile_x++) {
        let rows = rows_in_range(reach, tile_x);
        if left < rows.y - rows.x {
            tile = (rows.x + left) * view.grid.tiles_x + tile_x;
            found = row;
            break;
        }
        left -= rows.y - rows.x;
    }
    tiles[isect] = tile;
    isects[isect] = isect;
    row_from_isect[isect] = found;
}
