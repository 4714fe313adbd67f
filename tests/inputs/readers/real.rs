//! The real scenes against independently known numbers.

use crate::support::shared::real_scene;
use glam::DVec3;
use gsscale::dataset::model::{Lens, RawScene, RawView};
use gsscale::dataset::read::{ReadOptions, read_scene};

/// Share of the points that project into the photo, per cent.
fn share_in_view(scene: &RawScene, view: &RawView) -> f64 {
    let i = view.intrinsics;
    let inside = |p: &&[f64; 3]| {
        let q = view.pose.rotation * DVec3::from_array(**p) + view.pose.translation;
        let (x, y) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
        q.z > 0.0 && (0.0..f64::from(i.width)).contains(&x) && (0.0..f64::from(i.height)).contains(&y)
    };
    100.0 * scene.points.positions.iter().filter(inside).count() as f64 / scene.points.positions.len() as f64
}

fn check(name: &str, views: usize, points: usize, size: (u32, u32), shares: Option<[f64; 3]>) {
    let Some(folder) = real_scene(name) else { return };
    let scene = read_scene(&folder, &ReadOptions::default()).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((scene.views.len(), scene.points.positions.len()), (views, points));
    assert_eq!(scene.points.colors.len(), points);
    assert_eq!(scene.warnings, Vec::<String>::new());
    assert!(scene.views.windows(2).all(|w| w[0].name < w[1].name));
    for view in &scene.views {
        assert!(view.image_path.is_file(), "{}", view.image_path.display());
        assert_eq!((view.intrinsics.width, view.intrinsics.height), size);
        assert_eq!(view.intrinsics.lens, Lens::Pinhole);
    }
    // The share of points in a view, lowest, median and highest, as the scenes' own README states them in rounded
    // per cent: half a unit of its last digit. A wrong axis, order or direction of the pose is far off.
    let Some(want) = shares else { return };
    let mut found: Vec<f64> = scene.views.iter().map(|v| share_in_view(&scene, v)).collect();
    found.sort_by(f64::total_cmp);
    let middle = 0.5 * (found[(views - 1) / 2] + found[views / 2]);
    for (got, want) in [found[0], middle, found[views - 1]].into_iter().zip(want) {
        let half_digit = if want < 15.0 { 0.05 } else { 0.5 };
        assert!((got - want).abs() <= half_digit + 1e-9, "{name}: {got} % of the points, stated {want} %");
    }
}

#[test]
fn brighton() {
    check("brighton", 18, 7_395, (1200, 674), None);
}

#[test]
fn seneca() {
    check("seneca", 165, 59_927, (1000, 744), Some([0.4, 5.8, 10.8]));
}

#[test]
fn sheffield_cross() {
    check("sheffield_cross", 172, 41_321, (790, 594), Some([15.0, 29.0, 39.0]));
}
