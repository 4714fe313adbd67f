// Ranges of tiles: how many splats reach each tile, and the splats that reach a range, copied into one buffer.
//
// The splats of a view lie in segments, and one dispatch processes one segment. The twin of the tally is the count of
// src/kernels/isect_emit.rs; the CPU reads all splats for every range and needs no copy.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"
#import "shared/footprint.wgsl"

struct RangeUniforms {
    grid: Grid,
    /// First column, end of the columns, first row, end of the rows.
    range: vec4<u32>,
    /// The number of the segment.
    segment: u32,
    /// Rows of the segment.
    row_count: u32,
    /// Room of the copy, in rows.
    capacity: u32,
    /// The keys of a depth bin differ in this number of low bits.
    bin_bits: u32,
    /// First depth key of the rows that are wanted, and one past the last.
    depths: vec2<u32>,
    pad: vec2<u32>,
}

@group(0) @binding(0) var<uniform> segment: RangeUniforms;
@group(0) @binding(1) var<storage, read> splats: array<vec4<f32>>;
/// For each tile column, tiles_y + 1 entries: the splats that begin in a tile less those that ended in the tile before.
@group(0) @binding(2) var<storage, read_write> changes: array<atomic<i32>>;
/// For each tile column the splats that begin there, tiles_x + 1 entries; then those that ended in the column before.
@group(0) @binding(3) var<storage, read_write> columns: array<atomic<u32>>;
/// By row of the segment: 1 if the splat reaches the range at a wanted depth.
@group(0) @binding(4) var<storage, read_write> flags: array<u32>;
/// Prefix sums of the segment's flags: the place of each row among the flagged rows of the segment.
@group(0) @binding(5) var<storage, read> places: array<u32>;
/// Records of the segment: splats or their gradients.
@group(0) @binding(6) var<storage, read> records: array<vec4<f32>>;
/// Records of the copy.
@group(0) @binding(7) var<storage, read_write> compact: array<vec4<f32>>;
/// Records of the segment.
@group(0) @binding(8) var<storage, read_write> records_out: array<vec4<f32>>;
/// Records of the copy.
@group(0) @binding(9) var<storage, read> compact_in: array<vec4<f32>>;
/// Prefix sums over the segments: the flagged rows before each segment.
@group(0) @binding(10) var<storage, read> bases: array<u32>;
/// Splats that reach the range, by depth: entry k counts the keys of bin k from the first wanted key on.
@group(0) @binding(11) var<storage, read_write> bins: array<atomic<u32>>;

fn reach_of_row(row: u32) -> Reach {
    let at = SPLAT_STRIDE * row;
    return reach_of(splat_unpack(splats[at], splats[at + 1u], splats[at + 2u]), segment.grid);
}

/// The bits of the depth of a drawn row, as the depth sort orders them.
fn depth_key(row: u32) -> u32 {
    return bitcast<u32>(splats[SPLAT_STRIDE * row].z);
}

/// Whether a splat reaches the range at a wanted depth.
fn is_in_range(row: u32) -> bool {
    let reach = reach_of_row(row);
    let key = depth_key(row);
    if key < segment.depths.x || key >= segment.depths.y {
        return false;
    }
    let end = min(reach.box.z, segment.range.y);
    for (var tile_x = max(reach.box.x, segment.range.x); tile_x < end; tile_x++) {
        let rows = tile_rows_in(reach, segment.grid, tile_x);
        if max(rows.x, segment.range.z) < min(rows.y, segment.range.w) {
            return true;
        }
    }
    return false;
}

/// Adds each splat to the counts of the tiles that it can reach.
@compute @workgroup_size(256)
fn range_tally(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= segment.row_count {
        return;
    }
    let reach = reach_of_row(row);
    if reach.box.x >= reach.box.z {
        return;
    }
    atomicAdd(&columns[reach.box.x], 1u);
    atomicAdd(&columns[segment.grid.tiles_x + 1u + reach.box.z], 1u);
    for (var tile_x = reach.box.x; tile_x < reach.box.z; tile_x++) {
        let rows = tile_rows_in(reach, segment.grid, tile_x);
        if rows.x < rows.y {
            let column = tile_x * (segment.grid.tiles_y + 1u);
            atomicAdd(&changes[column + rows.x], 1);
            atomicAdd(&changes[column + rows.y], -1);
        }
    }
}

/// Flags the splats that reach the range.
@compute @workgroup_size(256)
fn range_select(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= segment.row_count {
        return;
    }
    flags[row] = select(0u, 1u, is_in_range(row));
}

/// Adds each splat that reaches the range at a wanted depth to the bin of its depth.
@compute @workgroup_size(256)
fn range_depths(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= segment.row_count || !is_in_range(row) {
        return;
    }
    atomicAdd(&bins[(depth_key(row) - segment.depths.x) >> segment.bin_bits], 1u);
}

/// The place of a row in the copy, or the capacity if it has none.
fn place_of(row: u32) -> u32 {
    let place = places[row];
    return select(segment.capacity, bases[segment.segment] + place, places[row + 1u] > place);
}

/// Copies the records of the flagged rows to their places.
@compute @workgroup_size(256)
fn range_gather(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= segment.row_count {
        return;
    }
    let to = place_of(row);
    if to < segment.capacity {
        for (var i = 0u; i < SPLAT_STRIDE; i++) {
            compact[SPLAT_STRIDE * to + i] = records[SPLAT_STRIDE * row + i];
        }
    }
}

/// Copies the records of the flagged rows back from their places.
@compute @workgroup_size(256)
fn range_scatter(workgroup: Group, place: Place) {
    let row = linear_index(workgroup, place, 256u);
    if row >= segment.row_count {
        return;
    }
    let to = place_of(row);
    if to < segment.capacity {
        for (var i = 0u; i < SPLAT_STRIDE; i++) {
            records_out[SPLAT_STRIDE * row + i] = compact_in[SPLAT_STRIDE * to + i];
        }
    }
}
