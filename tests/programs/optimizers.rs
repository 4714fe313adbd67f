//! The optimizers for comparison, through the program: dense Adam equals deferred Adam up to rounding; sparse Adam
//! differs.

use crate::support::scenes::{city, stderr, summary, text, train};
use gsscale::exchange::ply::{PlyContent, read_ply};
use gsscale::scene::columns::Columns;
use std::path::Path;
use tempfile::TempDir;

fn result(scene: &Path, out: &Path, keys: &[&str]) -> Columns {
    let output = train(&[&[text(scene), "--out", text(out), "--quiet", "--page-rows", "32"], keys].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    match read_ply(&out.join("point_cloud.ply")).unwrap() {
        PlyContent::Gaussians { columns, .. } => columns,
        PlyContent::Points { .. } => panic!("the result has no Gaussians"),
    }
}

/// Mean distance of positions.
fn distance(a: &Columns, b: &Columns) -> f64 {
    assert_eq!(a.rows(), b.rows());
    let squares = a
        .means
        .chunks(3)
        .zip(b.means.chunks(3))
        .map(|(p, q)| -> f64 { p.iter().zip(q).map(|(x, y)| f64::from(x - y).powi(2)).sum() });
    squares.map(f64::sqrt).sum::<f64>() / a.rows() as f64
}

#[test]
fn dense_is_deferred_up_to_roundings_and_sparse_is_not() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 40, 64, 48, 2000);
    let of = |name: &str, keys: &[&str]| result(&scene, &folder.path().join(name), keys);
    let fixed = ["--steps", "30", "--strategy", "none"];
    let optimizer = |name: &str| of(name, &[&fixed[..], &["--optimizer", name]].concat());
    let (deferred, dense, sparse) = (optimizer("deferred"), optimizer("dense"), optimizer("sparse"));
    let start = of("start", &["--steps", "1", "--strategy", "none", "--means-lr", "0"]);
    let moved = distance(&start, &deferred);
    // Roundings of 6e-8 grow where gradients are small against their noise; momentum amounts to a tenth of a movement
    // and more.
    let (by_dense, by_sparse) = (distance(&dense, &deferred) / moved, distance(&sparse, &deferred) / moved);
    assert!(by_dense > 0.0 && by_dense < 0.01, "dense is {by_dense} of the movement away");
    assert!(by_sparse > 0.03, "sparse is {by_sparse} of the movement away");
}

/// Rounds, resets and raises reach unseen pages, and pages split while frames are scarce.
#[test]
fn dense_updates_take_events_as_deferred_ones_do() {
    let folder = TempDir::new().unwrap();
    // No view sees more than two thirds of it.
    let scene = city(folder.path(), 150, 48, 32, 8000);
    let events = ["--refine-start", "5", "--refine-every", "6", "--refine-stop", "30", "--reset-every", "15"];
    let more = ["--steps", "32", "--sh-every", "10", "--grow-grad2d", "5e-5", "--view-order", "tour"];
    let of = |name: &str, keys: &[&str]| result(&scene, &folder.path().join(name), &[&events, &more, keys].concat());
    let deferred = of("deferred", &[]);
    let dense = of("dense", &["--optimizer", "dense"]);
    assert!(deferred.rows() > 8100, "the scene grew to {}", deferred.rows());
    // A threshold on values that differ by roundings flips for a few rows of thousands.
    let off = deferred.rows().abs_diff(dense.rows()) as f64 / deferred.rows() as f64;
    assert!(off < 0.01, "{} against {} Gaussians", dense.rows(), deferred.rows());
    // Few frames give the same bits.
    let (spill, pages) =
        (folder.path().join("spill"), summary(&folder.path().join("dense"))["pages"].as_u64().unwrap());
    let frames = (pages * 9 / 10).to_string();
    let few = of("few", &["--optimizer", "dense", "--spill-dir", text(&spill), "--frames", &frames, "--evict", "lru"]);
    assert!(few == dense, "frames change nothing");
}
