//! `lod-meta.json`: the tree of leaves, and where each level of a leaf lies.
//!
//! Invariant: the text depends on the leaves and their order alone.

use serde_json::{Map, Value, json};
use std::path::Path;

pub const TREE_FILE: &str = "lod-meta.json";

/// Whether `path` is named like the tree of a folder.
pub fn is_tree(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == TREE_FILE)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FilePart {
    pub file: usize,
    /// Its first row in the file.
    pub first: usize,
    pub rows: usize,
}

/// Rows that viewers show at one level at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaf {
    /// Least corner of its box.
    pub low: [f64; 3],
    /// Largest corner.
    pub high: [f64; 3],
    /// One part for each level, the finest first.
    pub parts: Vec<FilePart>,
}

/// The text of the file. `files` are the paths of the `meta.json` files, `environment` that of rows that are always shown.
pub fn text(leaves: &mut [Leaf], files: &[String], environment: Option<&str>, levels: usize) -> String {
    let count = |level: usize| leaves.iter().map(|leaf| leaf.parts[level].rows).sum::<usize>();
    let counts: Vec<usize> = (0..levels).map(count).collect();
    let mut value = json!({
        "version": 1,
        "asset": { "generator": concat!("gsscale ", env!("CARGO_PKG_VERSION")) },
        "count": counts.iter().sum::<usize>(),
        "counts": counts,
        "lodLevels": levels,
        "filenames": files,
        "tree": node(leaves),
    });
    if let Some(path) = environment {
        value["environment"] = path.into();
    }
    value.to_string()
}

/// Halves the leaves by their middles along the longest axis.
fn node(leaves: &mut [Leaf]) -> Value {
    let mut bound = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for leaf in &*leaves {
        for i in 0..3 {
            bound.0[i] = bound.0[i].min(leaf.low[i]);
            bound.1[i] = bound.1[i].max(leaf.high[i]);
        }
    }
    if let [leaf] = leaves {
        let part = |part: &FilePart| json!({ "file": part.file, "offset": part.first, "count": part.rows });
        let parts = leaf.parts.iter().enumerate();
        let lods: Map<String, Value> = parts.map(|(level, p)| (level.to_string(), part(p))).collect();
        return json!({ "bound": { "min": bound.0, "max": bound.1 }, "lods": lods });
    }
    let middle = |leaf: &Leaf, i: usize| leaf.low[i] + leaf.high[i];
    let side = |i: usize| {
        let at = leaves.iter().map(|leaf| middle(leaf, i));
        let (low, high) = at.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        high - low
    };
    let axis = (1..3).fold(0, |best, i| if side(i) > side(best) { i } else { best });
    // Stable: equal leaves stay in their order.
    leaves.sort_by(|a, b| middle(a, axis).total_cmp(&middle(b, axis)));
    let half = leaves.len() / 2;
    let (left, right) = leaves.split_at_mut(half);
    json!({ "bound": { "min": bound.0, "max": bound.1 }, "children": [node(left), node(right)] })
}
