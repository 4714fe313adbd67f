//! Small models damaged in many places: the result is a scene or an error, never a panic, an endless loop or a huge
//! allocation.

use super::write::{model, scene_with};
use gsscale::base::error::InputResult;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::fs;
use std::path::Path;

/// What every outcome must satisfy. Room for points is bounded by the files: a record takes at least 10 bytes of it,
/// and a growing vector at most doubles.
fn acceptable(result: InputResult<RawScene>, bytes: usize, what: &str) {
    match result {
        Ok(scene) => {
            assert!(!scene.views.is_empty(), "{what}");
            assert!(scene.points.positions.capacity() <= 8 + 2 * bytes / 10, "{what}");
            for view in &scene.views {
                let i = view.intrinsics;
                assert!(i.width > 0 && i.height > 0 && i.fx > 0.0 && i.fy > 0.0, "{what}");
                assert!(view.pose.rotation.is_finite() && view.pose.translation.is_finite(), "{what}");
                assert!((view.pose.rotation.determinant() - 1.0).abs() < 1e-9, "{what}"); // a few roundings
                assert!(view.name.split('/').all(|part| part != ".."), "{what}");
            }
            assert!(scene.points.positions.iter().flatten().all(|x| x.is_finite()), "{what}");
        }
        Err(e) => {
            assert!(!e.file.as_os_str().is_empty() && !e.remedy.is_empty() && !e.problem.is_empty(), "{what}: {e}")
        }
    }
}

/// Every 37th truncation and `flips` single-byte changes of one file.
fn damage(scene: &Path, file: &Path, flips: u64, key: u64) {
    let whole = fs::read(file).unwrap();
    let beside = file.parent().unwrap().read_dir().unwrap();
    let bytes = beside.map(|entry| entry.unwrap().metadata().unwrap().len() as usize).sum();
    let read = |what: &str| acceptable(read_scene(scene, &ReadOptions::default()), bytes, what);
    for length in (0..whole.len()).step_by(37) {
        fs::write(file, &whole[..length]).unwrap();
        read(&format!("{} cut to {length}", file.display()));
    }
    for flip in 0..flips {
        let mut draw = Stream::new(11, Purpose::Test, key, flip);
        let mut bytes = whole.clone();
        let at = draw.below(whole.len() as u64) as usize;
        // Half of them one bit, half of them any byte.
        bytes[at] = if flip % 2 == 0 { bytes[at] ^ (1 << draw.below(8)) } else { draw.below(256) as u8 };
        fs::write(file, &bytes).unwrap();
        read(&format!("{} byte {at} = {}", file.display(), bytes[at]));
    }
    fs::write(file, whole).unwrap();
}

#[test]
fn damaged_binary_models() {
    let (scene, folder) = scene_with(&model(40), true);
    for (key, name) in ["cameras.bin", "images.bin", "points3D.bin"].iter().enumerate() {
        damage(scene.path(), &folder.join(name), 1_000, key as u64);
    }
}

#[test]
fn damaged_text_models() {
    let (scene, folder) = scene_with(&model(40), false);
    for (key, name) in ["cameras.txt", "images.txt", "points3D.txt"].iter().enumerate() {
        damage(scene.path(), &folder.join(name), 1_000, 10 + key as u64);
    }
}

#[test]
fn damaged_json() {
    let scene = tempfile::TempDir::new().unwrap();
    let file = scene.path().join("transforms.json");
    let frame = |name: &str| {
        format!(
            r#"{{"file_path": "images/{name}.png", "mask_path": "masks/{name}.png", "fl_y": 501.5,
            "transform_matrix": [[1, 0, 0, 0.5], [0, 0, -1, 2], [0, 1, 0, 1e1], [0, 0, 0, 1]]}}"#
        )
    };
    let text = format!(
        r#"{{"camera_model": "OPENCV", "w": 640, "h": 480.0, "camera_angle_x": 0.9, "fl_x": 500, "cx": 320, "k1": 0.01,
        "train_filenames": ["images/a.png", "images/b.png"], "test_filenames": ["images/c.png"],
        "ply_file_path": "p.ply", "frames": [{}, {}, {}]}}"#,
        frame("a"),
        frame("b"),
        frame("c")
    );
    fs::write(&file, text).unwrap();
    damage(scene.path(), &file, 2_000, 20);
    assert_eq!(read_scene(scene.path(), &ReadOptions::default()).unwrap().views.len(), 3);
}
