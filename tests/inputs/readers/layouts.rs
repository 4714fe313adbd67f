//! The layouts of published datasets: look-alikes of a generated city are read as that city, and hostile folders are
//! refused.

use super::transforms_good::read;
use super::write::{refused, warned};
use crate::support::lookalike::write_lookalike;
use glam::DVec3;
use gsscale::dataset::layout::{Layout, find_layout};
use gsscale::dataset::model::{RawScene, RawView, Split};
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::synthetic::CityOptions;
use gsscale::exchange::ply::{PlyContent, read_ply};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const VIEWS: u32 = 8;
const TEST_EVERY: usize = 3;

fn lookalike(layout: Layout) -> TempDir {
    let folder = TempDir::new().unwrap();
    let options = CityOptions { views: VIEWS, width: 48, height: 32, points: 60, ..CityOptions::default() };
    write_lookalike(folder.path(), &options, layout, TEST_EVERY);
    folder
}

fn refusal(folder: &Path) -> String {
    read_scene(folder, &ReadOptions::default()).unwrap_err().to_string()
}

fn held_out(scene: &RawScene) -> usize {
    scene.views.iter().filter(|v| v.split == Some(Split::Test)).count()
}

/// Indices into the city's views, training views first.
fn train_then_test() -> Vec<usize> {
    let is_test = |i: &usize| i.is_multiple_of(TEST_EVERY);
    let (test, train): (Vec<_>, Vec<_>) = (0..VIEWS as usize).partition(is_test);
    [train, test].concat()
}

#[test]
fn every_written_layout_is_known_and_complete() {
    for layout in [Layout::Colmap, Layout::ColmapMerged, Layout::MegaNerf, Layout::Gauu, Layout::MatrixCity] {
        let folder = lookalike(layout);
        assert_eq!(layout.missing(folder.path()), Vec::<String>::new(), "{}", layout.name());
        assert_eq!(find_layout(folder.path(), &[layout], &[]).unwrap(), layout);
        assert_eq!(read(folder.path()).views.len(), VIEWS as usize);
    }
}

#[test]
fn merged_folders_and_a_drones_names_give_the_same_scene() {
    let city = read(lookalike(Layout::Colmap).path());
    for layout in [Layout::ColmapMerged, Layout::Gauu] {
        let folder = lookalike(layout);
        let scene = read(folder.path());
        assert_eq!(scene.points, city.points);
        for (i, (a, b)) in scene.views.iter().zip(&city.views).enumerate() {
            assert_eq!(a.intrinsics, b.intrinsics);
            // A quaternion on its way through the file once more.
            assert!((a.pose.centre() - b.pose.centre()).length() < 1e-9, "{}", layout.name());
            assert!(a.image_path.is_file(), "{}", a.image_path.display());
            if layout == Layout::ColmapMerged {
                assert_eq!(a.name, format!("{i:06}.jpg"), "as in the merged folder");
                let part = if i.is_multiple_of(TEST_EVERY) { Split::Test } else { Split::Train };
                assert_eq!(a.split, Some(part));
            }
        }
    }
}

#[test]
fn one_model_over_two_folders_of_photos_is_read_by_name() {
    let folder = lookalike(Layout::ColmapMerged);
    let at = |name: &str| folder.path().join(name);
    let apart = read(folder.path());
    // GS-Scale's own merged model, with the photos where Mill-19's archive puts them.
    let plain = lookalike(Layout::Gauu);
    fs::rename(plain.path().join("sparse"), at("sparse")).unwrap();
    for (i, view) in apart.views.iter().enumerate() {
        fs::rename(&view.image_path, view.image_path.with_file_name(format!("DJI_{:04}.JPG", i + 1))).unwrap();
    }
    let scene = read(folder.path());
    assert_eq!((scene.views.len(), held_out(&scene)), (VIEWS as usize, 0), "the split is the config's");
    for (i, view) in scene.views.iter().enumerate() {
        let part = if i.is_multiple_of(TEST_EVERY) { "val" } else { "train" };
        assert_eq!(view.image_path, at(part).join("rgbs").join(&view.name));
    }
    assert_eq!(find_layout(folder.path(), &[Layout::ColmapMerged], &[]).unwrap(), Layout::ColmapMerged);
    // The same name in both is not guessed at.
    fs::copy(at("train/rgbs/DJI_0002.JPG"), at("val/rgbs/DJI_0002.JPG")).unwrap();
    let said = refusal(folder.path());
    assert!(said.contains("DJI_0002.JPG") && said.contains("2 folders") && said.contains("remedy"), "{said}");
}

#[test]
fn photos_of_one_name_in_both_parts_are_told_apart() {
    let folder = lookalike(Layout::ColmapMerged);
    let at = |name: &str| folder.path().join(name);
    fs::remove_dir_all(at("val/sparse")).unwrap();
    fs::create_dir_all(at("val/sparse")).unwrap();
    fs::rename(at("train/sparse/0"), at("val/sparse/0")).unwrap();
    let model = at("train/sparse/0");
    fs::create_dir_all(&model).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        fs::copy(at("val/sparse/0").join(name), model.join(name)).unwrap();
    }
    let scene = read(folder.path());
    let names: Vec<&str> = scene.views.iter().map(|v| v.name.as_str()).collect();
    assert!(names.contains(&"train/000001.jpg") && names.contains(&"val/000001.jpg"), "{names:?}");
    assert_eq!(held_out(&scene), names.len() / 2);
}

#[test]
fn matrix_city_is_read_from_both_kinds_of_its_files() {
    let city = read(lookalike(Layout::Colmap).path());
    let folder = lookalike(Layout::MatrixCity);
    let check = |scene: &RawScene| {
        assert_eq!((scene.views.len(), held_out(scene)), (VIEWS as usize, 3));
        let in_order = |split| scene.views.iter().filter(move |v| v.split == Some(split));
        let views = in_order(Split::Train).chain(in_order(Split::Test));
        for (view, i) in views.zip(train_then_test()) {
            let want = city.views[i].pose;
            // Decimal digits of JSON hold an f64; the 0.01 in the rotation costs a rounding.
            assert!((view.pose.centre() * 100.0 - want.centre()).length() < 1e-9, "{}", view.name);
            assert!((view.pose.rotation - want.rotation).to_cols_array().iter().all(|x| x.abs() < 1e-12));
            assert!((view.intrinsics.fx - city.views[i].intrinsics.fx).abs() < 1e-9);
            assert!(view.image_path.is_file());
        }
        let Some(PlyContent::Points { positions, colors, .. }) =
            scene.points_path.as_ref().map(|path| read_ply(path).unwrap())
        else {
            panic!("a cloud");
        };
        assert_eq!(colors, city.points.colors);
        for (a, b) in positions.iter().zip(&city.points.positions) {
            assert!((DVec3::from_array(*a) * 100.0 - DVec3::from_array(*b)).length() < 1e-9);
        }
    };
    let scene = read(folder.path());
    check(&scene);
    assert!(scene.views.iter().any(|v| v.name == "train/block_1/0000.png"), "named from the scene's folder");
    // Without pose/, with the photos where others' scripts unpack them: scaled rotations, metres.
    fs::remove_dir_all(folder.path().join("pose")).unwrap();
    let block = folder.path().join("train/block_1");
    fs::create_dir(block.join("input")).unwrap();
    for i in 0..5 {
        let name = format!("{i:04}.png");
        fs::rename(block.join(&name), block.join("input").join(&name)).unwrap();
    }
    check(&read(folder.path()));
}

fn edit(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut value: Value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    change(&mut value);
    fs::write(path, value.to_string()).unwrap();
}

#[test]
fn hostile_matrix_city_folders_are_refused_or_say_what_is_left_out() {
    let poses = "pose/block_all/transforms_train.json";
    for outside in ["../../../secret.png", "../../train/../../secret.png", "/etc/passwd", "..\\..\\..\\secret.png"] {
        let folder = lookalike(Layout::MatrixCity);
        edit(&folder.path().join(poses), |v| v["frames"][1]["file_path"] = outside.into());
        let said = refusal(folder.path());
        assert!(said.contains("transforms_train.json") && said.contains("frames[1].file_path"), "{said}");
    }
    let folder = lookalike(Layout::MatrixCity);
    // Sheared, mirrored, not finite, zero: left out by name; when none is left, an error.
    let bad = [json!([[1, 0.5, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]), json!([[-1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]])];
    edit(&folder.path().join(poses), |v| {
        v["frames"][0]["transform_matrix"] = bad[0].clone();
        v["frames"][2]["transform_matrix"] = bad[1].clone();
        v["frames"][3]["transform_matrix"][0][0] = Value::Null;
        v["frames"][4]["transform_matrix"] = json!([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3]]);
    });
    let scene = read(folder.path());
    assert_eq!(scene.views.len(), VIEWS as usize - 4);
    let said = scene.warnings.join("\n");
    assert!(said.contains("4 views left out") && said.contains("train/block_1/0000.png"), "{said}");
    edit(&folder.path().join(poses), |v| v["frames"] = json!([]));
    assert!(refusal(folder.path()).contains("frames"));
    fs::remove_file(folder.path().join("pose/block_all/transforms_test.json")).unwrap();
    let said = refusal(folder.path());
    assert!(said.contains("transforms_test.json") && said.contains("remedy"), "{said}");
    fs::write(folder.path().join(poses), b"{").unwrap();
    fs::write(folder.path().join("pose/block_all/transforms_test.json"), b"{}").unwrap();
    assert!(refusal(folder.path()).contains("not valid JSON"));
}

/// The folder that `--images` names counts in every layout: no other photos silently take its place.
#[test]
fn another_folder_of_photos_is_read_or_missed() {
    let smaller = ReadOptions { images: Some("photos_4".into()), ..ReadOptions::default() };
    for layout in [Layout::ColmapMerged, Layout::MegaNerf, Layout::MatrixCity] {
        let folder = lookalike(layout);
        let views = read(folder.path()).views;
        match read_scene(folder.path(), &smaller) {
            Err(error) => assert!(error.to_string().contains("photos_4"), "{}: {error}", layout.name()),
            Ok(found) => warned(&found, &["8 of 8 photos have other names"]),
        }
        for view in &views {
            let (photos, file) = (view.image_path.parent().unwrap(), view.image_path.file_name().unwrap());
            // MatrixCity's photos lie in the folder of their block.
            let smaller = match layout {
                Layout::MatrixCity => photos.join("photos_4"),
                _ => photos.with_file_name("photos_4"),
            };
            fs::create_dir_all(&smaller).unwrap();
            fs::copy(&view.image_path, smaller.join(file)).unwrap();
        }
        let found = read_scene(folder.path(), &smaller).unwrap().views;
        let is_smaller = |view: &RawView| view.image_path.parent().unwrap().ends_with("photos_4");
        assert!(found.len() == views.len() && found.iter().all(is_smaller), "{}", layout.name());
    }
}

#[test]
fn parts_that_are_broken_are_named() {
    let folder = lookalike(Layout::ColmapMerged);
    let at = |name: &str| folder.path().join(name);
    // A count that the file does not hold.
    let images = fs::read(at("val/sparse/0/images.bin")).unwrap();
    let mut more = images.clone();
    more[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    fs::write(at("val/sparse/0/images.bin"), more).unwrap();
    refused(read_scene(folder.path(), &ReadOptions::default()), "images.bin", &[]);
    // A photo name that leaves the folder.
    let mut climbing = images.clone();
    let name = images.windows(10).position(|w| w == b"000000.jpg").unwrap();
    climbing[name..name + 10].copy_from_slice(b"../../a.jp");
    fs::write(at("val/sparse/0/images.bin"), climbing).unwrap();
    refused(read_scene(folder.path(), &ReadOptions::default()), "images.bin", &["climbs"]);
    fs::write(at("val/sparse/0/images.bin"), images).unwrap();
    fs::remove_dir_all(at("val/rgbs")).unwrap();
    refused(read_scene(folder.path(), &ReadOptions::default()), "val", &["no photos"]);
}

#[test]
fn missing_parts_are_reported_with_the_tree_and_the_source() {
    let folder = lookalike(Layout::MegaNerf);
    fs::remove_dir_all(folder.path().join("val/rgbs")).unwrap();
    let fetch = ["https://example.org/data".to_string()];
    let accepted = [Layout::ColmapMerged, Layout::Colmap, Layout::MegaNerf];
    let said = find_layout(folder.path(), &accepted, &fetch).unwrap_err().to_string();
    assert!(said.contains("as mega-nerf: val/rgbs/ missing"), "{said}");
    assert!(said.contains("as colmap-merged: a model (cameras and images) in train/sparse/0, "), "{said}");
    assert!(said.contains("https://example.org/data") && said.contains("coordinates.pt "), "{said}");
    let [near, far] = ["mega-nerf:\n", "colmap-merged:\n"].map(|tree| said.find(tree).unwrap());
    assert!(near < far, "the nearest layout's tree comes first");
    let said = find_layout(&folder.path().join("nothing"), &accepted, &fetch).unwrap_err().to_string();
    assert!(said.contains("does not exist") && said.contains("https://example.org/data"), "{said}");
}
