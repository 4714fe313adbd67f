//! Exact distances to the three nearest neighbours of every point of a cloud, by a k-d tree over sorted arrays.
//!
//! A cloud that is loaded in parts is searched part by part: [`NeighbourTree::nearer`] gives what one part adds.
//!
//! Not here: the use of the distances.
//!
//! Invariants: 1. distances are those of a brute-force search in f32, bit for bit: distances to boxes use the same
//! operations in the same order as distances to points, and rounding is monotone, so a box is never farther than a
//! point in it; 2. the result does not depend on threads; 3. O(n log n) for any clustering: the tree halves the points,
//! not the space, and equal points may be on both sides.

use super::point_box::{PointBox, norm2};
use rayon::prelude::*;

pub const NEIGHBOURS: usize = 3;

const LEAF: usize = 12;
/// Subtrees below this many points are built by one thread.
const SERIAL_BELOW: usize = 4096;
const QUERIES_PER_TASK: usize = 1024;

#[derive(Clone, Copy)]
struct Entry {
    point: [f32; 3],
    index: u32,
}

/// A balanced tree: every node halves its range of `entries`, and all leaves are at depth `levels`. `boxes` is in
/// preorder: a node's left child is next to it, the right child of a node with `l` levels below is 2^l further.
pub struct NeighbourTree {
    entries: Vec<Entry>,
    boxes: Vec<PointBox>,
    levels: u32,
}

/// Squared distances of every point to its three nearest other points, ascending; infinity if there are fewer. Other
/// points at the same place count, with distance 0. Points with non-finite coordinates have no neighbours. Panics with 2^32
/// points or more.
pub fn nearest_dist2(points: &[[f32; 3]]) -> Vec<[f32; NEIGHBOURS]> {
    NeighbourTree::new(points).nearest_dist2()
}

impl NeighbourTree {
    /// Builds the tree of some points; panics with 2^32 points or more.
    pub fn new(points: &[[f32; 3]]) -> NeighbourTree {
        assert!(u32::try_from(points.len()).is_ok(), "more than 2^32 points");
        let entries = points.iter().enumerate().map(|(i, &point)| Entry { point, index: i as u32 });
        let mut entries: Vec<Entry> = entries.collect();
        let mut levels = 0;
        while points.len().div_ceil(1 << levels) > LEAF {
            levels += 1;
        }
        let mut boxes = vec![PointBox::EMPTY; (2 << levels) - 1];
        build(&mut entries, &mut boxes, levels);
        NeighbourTree { entries, boxes, levels }
    }

    /// Squared distances of every point of the tree, in the order given, to its three nearest others.
    pub fn nearest_dist2(&self) -> Vec<[f32; NEIGHBOURS]> {
        let mut by_entry = vec![[f32::INFINITY; NEIGHBOURS]; self.entries.len()];
        by_entry.par_chunks_mut(QUERIES_PER_TASK).enumerate().for_each(|(task, out)| {
            let first = task * QUERIES_PER_TASK;
            for (entry, out) in self.entries[first..].iter().zip(out) {
                // The search also finds the point itself, at distance 0, which no other point can undercut.
                let mut best = [f32::INFINITY; NEIGHBOURS + 1];
                self.search(0, self.levels, 0, self.entries.len(), entry.point, &mut best);
                out.copy_from_slice(&best[1..]);
            }
        });
        let mut by_point = vec![[f32::INFINITY; NEIGHBOURS]; self.entries.len()];
        for (entry, dist2) in self.entries.iter().zip(by_entry) {
            by_point[entry.index as usize] = dist2;
        }
        by_point
    }

    /// Squared distances below `limit` from `q`, which is not a point of the tree, to its nearest points, ascending;
    /// infinity if there are fewer.
    pub fn nearer(&self, q: [f32; 3], limit: f32) -> [f32; NEIGHBOURS] {
        let mut best = [limit; NEIGHBOURS + 1];
        if self.bounds().dist2(q) < limit {
            self.search(0, self.levels, 0, self.entries.len(), q, &mut best);
        }
        std::array::from_fn(|i| if best[i] < limit { best[i] } else { f32::INFINITY })
    }

    pub fn bounds(&self) -> PointBox {
        self.boxes[0]
    }

    fn search(&self, node: usize, levels: u32, low: usize, high: usize, q: [f32; 3], best: &mut [f32; 4]) {
        if levels == 0 {
            for entry in &self.entries[low..high] {
                insert(best, norm2(std::array::from_fn(|i| entry.point[i] - q[i])));
            }
            return;
        }
        let middle = low + (high - low) / 2;
        let (left, right) = (node + 1, node + (1 << levels));
        let (to_left, to_right) = (self.boxes[left].dist2(q), self.boxes[right].dist2(q));
        let mut visit = |is_left: bool| {
            if is_left && to_left < best[NEIGHBOURS] {
                self.search(left, levels - 1, low, middle, q, best);
            } else if !is_left && to_right < best[NEIGHBOURS] {
                self.search(right, levels - 1, middle, high, q, best);
            }
        };
        let left_first = to_left <= to_right;
        visit(left_first);
        visit(!left_first);
    }
}

/// The smallest values of two lists, ascending.
pub fn merged(a: [f32; NEIGHBOURS], b: [f32; NEIGHBOURS]) -> [f32; NEIGHBOURS] {
    let mut best = [a[0], a[1], a[2], f32::INFINITY];
    b.into_iter().for_each(|value| insert(&mut best, value));
    [best[0], best[1], best[2]]
}

/// Keeps the smallest values, ascending; never NaN.
#[inline]
fn insert(best: &mut [f32; 4], value: f32) {
    if value < best[3] {
        best[3] = value;
        for i in (0..3).rev() {
            if best[i + 1] < best[i] {
                best.swap(i, i + 1);
            }
        }
    }
}

/// Sorts `entries` into the tree with `levels` levels below this node, and fills its boxes.
fn build(entries: &mut [Entry], boxes: &mut [PointBox], levels: u32) {
    boxes[0] = PointBox::of(entries.iter().map(|e| e.point));
    if levels == 0 {
        return;
    }
    let axis = boxes[0].longest_axis();
    let middle = entries.len() / 2;
    // Ties are ordered by index, so that the two halves are a function of the points alone.
    entries.select_nth_unstable_by(middle, |a, b| a.point[axis].total_cmp(&b.point[axis]).then(a.index.cmp(&b.index)));
    let serial = entries.len() < SERIAL_BELOW;
    let (left, right) = entries.split_at_mut(middle);
    let (left_boxes, right_boxes) = boxes[1..].split_at_mut((1 << levels) - 1);
    if serial {
        build(left, left_boxes, levels - 1);
        build(right, right_boxes, levels - 1);
    } else {
        rayon::join(|| build(left, left_boxes, levels - 1), || build(right, right_boxes, levels - 1));
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failure
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    fn brute_force(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let of = |i: usize| {
            let mut all: Vec<f32> = (0..points.len())
                .filter(|&j| j != i)
                .map(|j| norm2(std::array::from_fn(|k| points[j][k] - points[i][k])))
                .filter(|d| !d.is_nan())
                .collect();
            all.sort_by(f32::total_cmp);
            std::array::from_fn(|k| all.get(k).copied().unwrap_or(f32::INFINITY))
        };
        (0..points.len()).map(of).collect()
    }

    fn cloud(n: u64, kind: u64) -> Vec<[f32; 3]> {
        let point = |i: u64| {
            let mut s = Stream::new(5, Purpose::Test, kind, i);
            match kind {
                0 => std::array::from_fn(|_| s.uniform() as f32),
                // Tight clusters far apart.
                1 => {
                    std::array::from_fn(|k| (100.0 * ((i % 7) * (k as u64 + 1) % 5) as f64 + 1e-3 * s.normal()) as f32)
                }
                // A coarse lattice: nearly every point has duplicates and ties.
                2 => std::array::from_fn(|_| s.below(4) as f32),
                // A surface with offsets that use up most of f32's precision.
                _ => [1e4 + s.uniform() as f32, -2e4 + s.uniform() as f32, 300.0],
            }
        };
        (0..n).map(point).collect()
    }

    #[test]
    fn equals_brute_force_bit_for_bit() {
        for kind in 0..4 {
            for n in [0, 1, 2, 3, 4, 5, 12, 13, 100, 1500] {
                let points = cloud(n, kind);
                assert_eq!(nearest_dist2(&points), brute_force(&points), "kind {kind}, {n} points");
            }
        }
    }

    #[test]
    fn equal_and_non_finite_points_are_handled_and_threads_do_not_matter() {
        assert_eq!(nearest_dist2(&[[2.5; 3]; 500]), vec![[0.0; 3]; 500]);
        let mut points = cloud(200, 0);
        points[7] = [f32::NAN; 3];
        points[90] = [f32::INFINITY, 0.0, 0.0];
        points[91] = [1e30; 3];
        let found = nearest_dist2(&points);
        assert_eq!(found, brute_force(&points));
        assert_eq!(found[7], [f32::INFINITY; 3]);
        let points = cloud(20_000, 1);
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| nearest_dist2(&points))
        };
        assert_eq!(with(1), with(3));
    }
}
