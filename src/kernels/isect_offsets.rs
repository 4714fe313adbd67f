//! Converts tile counts to offsets: the start of each tile's list.
//!
//! Invariant: intersections of a tile are in depth order, because the chunks of the counting sort are cut in depth
//! order and each chunk writes in that order.

use crate::base::room;

/// `tile_counts` is `[chunks][tiles]`: the number of intersections of each chunk of the drawn rows in each tile. On
/// return `tile_offsets` (tiles + 1 entries, the last is the total) holds the start of each tile's list, and `cursors`
/// (`[chunks][tiles]`) the start of each chunk's part of it.
pub fn isect_offsets(tile_counts: &[u32], tiles: usize, tile_offsets: &mut Vec<u64>, cursors: &mut Vec<u64>) {
    tile_offsets.clear();
    room::resize(tile_offsets, tiles + 1, 0);
    for counts in tile_counts.chunks_exact(tiles.max(1)) {
        for (sum, &count) in tile_offsets[1..].iter_mut().zip(counts) {
            *sum += u64::from(count);
        }
    }
    for tile in 0..tiles {
        tile_offsets[tile + 1] += tile_offsets[tile];
    }
    cursors.clear();
    room::resize(cursors, tile_counts.len(), 0);
    if tile_counts.is_empty() {
        return;
    }
    cursors[..tiles].copy_from_slice(&tile_offsets[..tiles]);
    for at in tiles..cursors.len() {
        cursors[at] = cursors[at - tiles] + u64::from(tile_counts[at - tiles]);
    }
}
