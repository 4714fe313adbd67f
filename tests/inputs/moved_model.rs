//! A COLMAP model that is written again in another frame: cameras, points and names; damaged files.

use glam::{DMat3, DVec3};
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::poses::geo::Similarity;
use gsscale::poses::model::write_moved;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

fn read(scene: &Path) -> RawScene {
    read_scene(scene, &ReadOptions::default()).unwrap()
}

#[test]
fn a_moved_model_has_moved_cameras_and_points_and_true_names() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene");
    let size = CityOptions { seed: 5, views: 5, width: 48, height: 32, points: 200, ..CityOptions::default() };
    write_city(&scene, &size, &|_, _| {}).unwrap();
    let before = read(&scene);
    let (rotation, translation) =
        (DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.0), DVec3::new(500.0, -3e6, 4.0));
    let moved = Similarity { scale: 7.5, rotation, translation };
    let other = folder.path().join("other");
    fs::create_dir_all(other.join("sparse/0")).unwrap();
    fs::create_dir_all(other.join("images/a b")).unwrap();
    for view in &before.views {
        fs::copy(&view.image_path, other.join("images/a b").join(&view.name)).unwrap();
    }
    let write = |name_of: &dyn Fn(&str) -> Option<String>| {
        write_moved(&scene.join("sparse/0"), &other.join("sparse/0"), &moved, name_of)
    };
    write(&|name| Some(format!("a b/{name}"))).unwrap();
    let after = read(&other);
    for (a, b) in before.views.iter().zip(&after.views) {
        assert_eq!((format!("a b/{}", a.name), a.intrinsics), (b.name.clone(), b.intrinsics));
        assert!(moved.apply(a.pose.centre()).distance(b.pose.centre()) < 1e-6);
        // What a camera sees stays: its axes turn with the scene.
        let turned = a.pose.rotation * rotation.transpose() - b.pose.rotation;
        assert!(turned.to_cols_array().iter().all(|x| x.abs() < 1e-12));
    }
    assert_eq!(before.points.colors, after.points.colors);
    for (&a, &b) in before.points.positions.iter().zip(&after.points.positions) {
        assert!(moved.apply(DVec3::from_array(a)).distance(DVec3::from_array(b)) < 1e-6);
    }

    // An unknown photo, and files that are cut short anywhere: errors, and no file is half written.
    assert!(write(&|_| None).unwrap_err().problem.contains("unknown name"));
    for file in ["images.bin", "points3D.bin"] {
        let path = scene.join("sparse/0").join(file);
        let whole = fs::read(&path).unwrap();
        let target = other.join("sparse/0").join(file);
        for length in [0, 7, 30, whole.len() / 2, whole.len() - 1] {
            let _ = fs::remove_file(&target);
            fs::write(&path, &whole[..length]).unwrap();
            assert!(write(&|name| Some(name.to_string())).is_err() && !target.exists(), "{file}: {length} bytes");
        }
        fs::write(&path, &whole).unwrap();
    }
}
