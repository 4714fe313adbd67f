// Start of each tile's list in the intersections sorted by tile, the twin of src/kernels/isect_offsets.rs, and the
// length of the longest list.
#import "shared/constants.wgsl"
#import "shared/dispatch.wgsl"

struct OffsetsUniforms {
    tile_count: u32,
    capacity: u32,
    /// The number of intersections is live[live_at], limited to the capacity.
    live_at: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> lists: OffsetsUniforms;
@group(0) @binding(1) var<storage, read> live: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
/// tile_count + 1 entries.
@group(0) @binding(3) var<storage, read_write> tile_offsets: array<u32>;
/// One entry, zeroed before.
@group(0) @binding(4) var<storage, read_write> longest: atomic<u32>;

/// The first intersection of this tile or a later one.
fn first_of_tile(tile: u32, count: u32) -> u32 {
    var low = 0u;
    var high = count;
    while low < high {
        let middle = low + (high - low) / 2u;
        if tiles[middle] < tile {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(256)
fn isect_offsets(workgroup: Group, place: Place) {
    let tile = linear_index(workgroup, place, 256u);
    if tile > lists.tile_count {
        return;
    }
    let count = min(live[lists.live_at], lists.capacity);
    let first = first_of_tile(tile, count);
    tile_offsets[tile] = first;
    if tile < lists.tile_count {
        atomicMax(&longest, first_of_tile(tile + 1u, count) - first);
    }
}
