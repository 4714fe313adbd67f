//! Disturbed scenes: what is disturbed, and that nothing else is.

use gsscale::base::whole_folder::check_ours;
use gsscale::config::file::TrainConfig;
use gsscale::dataset::disturb::{Disturbance, is_of_disturbed, plan, write_disturbed};
use gsscale::dataset::loader::{Dataset, View};
use gsscale::dataset::model::Split;
use gsscale::dataset::photo::decode;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::train::start::first_scene::prepare;
use std::path::Path;
use tempfile::TempDir;

fn city(folder: &Path) -> Dataset {
    let scene = folder.join("scene");
    let options = CityOptions { seed: 5, views: 24, width: 96, height: 64, points: 900, ..CityOptions::default() };
    write_city(&scene, &options, &|_, _| {}).unwrap();
    // Reduced, as training would see them.
    let config = TrainConfig { max_resolution: 60, ..TrainConfig::default() };
    prepare(&scene, &config).unwrap().dataset
}

/// Writes the scene and loads it as a run does.
fn disturbed(folder: &Path, dataset: &Dataset, disturbance: &Disturbance, seed: u64) -> Dataset {
    let to = folder.join(format!("{disturbance:?} {seed}").replace(|c: char| !c.is_alphanumeric(), "-"));
    write_disturbed(&to, dataset, disturbance, seed).unwrap();
    // A sweep may remove what it wrote, and nothing else.
    check_ours(&to, is_of_disturbed).unwrap();
    let test_after = i64::from(plan(dataset, disturbance, seed).unwrap().test_after);
    prepare(&to, &TrainConfig { test_after, ..TrainConfig::default() }).unwrap().dataset
}

fn of(dataset: &Dataset, split: Split) -> Vec<&View> {
    dataset.views.iter().filter(|view| view.split == split).collect()
}

/// Camera centre, in the frame of its own dataset.
fn centre(view: &View) -> glam::DVec3 {
    let rows = view.camera.viewmat.map(|row| row.map(f64::from));
    let rotation = glam::DMat3::from_cols_array_2d(&rows.map(|row| [row[0], row[1], row[2]])).transpose();
    -(rotation.transpose() * glam::DVec3::new(rows[0][3], rows[1][3], rows[2][3]))
}

#[test]
fn an_undisturbed_scene_has_the_pixels_split_and_poses_of_its_source() {
    let folder = TempDir::new().unwrap();
    let dataset = city(folder.path());
    let same = disturbed(folder.path(), &dataset, &Disturbance::Nothing, 1);
    for split in [Split::Train, Split::Test] {
        let (want, got) = (of(&dataset, split), of(&same, split));
        assert_eq!(want.len(), got.len());
        for (want, got) in want.into_iter().zip(got) {
            assert!(decode(&want.photo).unwrap() == decode(&got.photo).unwrap());
            assert_eq!([want.camera.fx, want.camera.cx, want.camera.cy], [got.camera.fx, got.camera.cx, got.camera.cy]);
            // The written scene is in the local frame of its source, and has the same size there; f32 rounds both.
            let world = same.frame.to_world(centre(got));
            assert!((world - centre(want)).length() < 1e-4, "{world} {}", centre(want));
        }
    }
    assert_eq!((same.points.len(), &same.colors), (dataset.points.len(), &dataset.colors));
    assert!(write_disturbed(&folder.path().join("scene"), &dataset, &Disturbance::Nothing, 1).is_err(), "it exists");
}

#[test]
fn held_out_photos_stay_clean_and_training_photos_change_by_seed() {
    let folder = TempDir::new().unwrap();
    let dataset = city(folder.path());
    let disturbances = [
        Disturbance::Exposure { stops: 1.0 },
        Disturbance::WhiteBalance { stops: 0.3 },
        Disturbance::Jpeg { quality: 20 },
        Disturbance::Boxes { count: 20, are_masked: false },
        Disturbance::Blurred { one_in: 2 },
        Disturbance::Swapped { share: 0.2, are_removed: false },
        Disturbance::Swapped { share: 0.2, are_removed: true },
        Disturbance::Together { stops: 1.0, share: 0.2, boxes: 20 },
    ];
    let pixels = |dataset: &Dataset, split| -> Vec<Vec<u8>> {
        of(dataset, split).into_iter().map(|view| decode(&view.photo).unwrap().rgb).collect()
    };
    for disturbance in disturbances {
        let changed = disturbed(folder.path(), &dataset, &disturbance, 1);
        assert!(pixels(&changed, Split::Test) == pixels(&dataset, Split::Test), "{disturbance:?}");
        assert!(pixels(&changed, Split::Train) != pixels(&dataset, Split::Train), "{disturbance:?}");
        let other = disturbed(folder.path(), &dataset, &disturbance, 2);
        let is_by_seed = !matches!(disturbance, Disturbance::Jpeg { .. });
        assert_eq!(pixels(&changed, Split::Train) != pixels(&other, Split::Train), is_by_seed, "{disturbance:?}");
    }
}

#[test]
fn photos_points_and_poses_go_as_told() {
    let folder = TempDir::new().unwrap();
    let dataset = city(folder.path());
    let third = disturbed(folder.path(), &dataset, &Disturbance::FewPhotos { one_in: 3 }, 1);
    assert!((2..14).contains(&of(&third, Split::Train).len()) && of(&third, Split::Test).len() == 3);
    let tenth = disturbed(folder.path(), &dataset, &Disturbance::FewPoints { one_in: 10 }, 1);
    // A tenth of 900 is 90, with a standard deviation of 9.
    assert!((50..130).contains(&tenth.points.len()), "{}", tenth.points.len());
    let random = disturbed(folder.path(), &dataset, &Disturbance::RandomPoints, 1);
    assert!(random.points.len() == dataset.points.len() && random.colors != dataset.colors);
    let moved = disturbed(folder.path(), &dataset, &Disturbance::PoseNoise { share: 0.01 }, 1);
    let distance = |(a, b): (&View, &View)| (moved.frame.to_world(centre(b)) - centre(a)).length();
    let train = of(&dataset, Split::Train).into_iter().zip(of(&moved, Split::Train)).map(distance);
    let (mean, size) = (train.sum::<f64>() / 21.0, f64::from(dataset.scene_scale));
    // The mean length of three normal draws is 1.6 standard deviations.
    assert!((0.011..0.021).contains(&(mean / size)), "{}", mean / size);
    assert!(of(&dataset, Split::Test).into_iter().zip(of(&moved, Split::Test)).map(distance).all(|d| d < 1e-4));
}

#[test]
fn swapped_views_are_the_wrong_ones() {
    let folder = TempDir::new().unwrap();
    let dataset = city(folder.path());
    let disturbance = Disturbance::Swapped { share: 0.2, are_removed: false };
    let swapped = disturbed(folder.path(), &dataset, &disturbance, 1);
    let wrong = plan(&dataset, &disturbance, 1).unwrap().wrong;
    let (before, after) = (of(&dataset, Split::Train), of(&swapped, Split::Train));
    let changed: Vec<String> = before
        .iter()
        .zip(&after)
        .filter(|(a, b)| decode(&a.photo).unwrap().rgb != decode(&b.photo).unwrap().rgb)
        .map(|(_, b)| b.name.clone())
        .collect();
    assert_eq!((changed.len(), &changed), (6, &wrong));
    // As if a user had found them: the same photos without these.
    let found = Disturbance::Swapped { share: 0.2, are_removed: true };
    let names = |scene: &Dataset| -> Vec<String> {
        of(scene, Split::Train).into_iter().map(|view| view.name.clone()).filter(|name| !wrong.contains(name)).collect()
    };
    let removed = disturbed(folder.path(), &dataset, &found, 1);
    assert_eq!((names(&removed), of(&removed, Split::Train).len()), (names(&swapped), 21 - 6));
    assert!(plan(&dataset, &found, 1).unwrap().wrong.is_empty());
    let together = Disturbance::Together { stops: 1.0, share: 0.2, boxes: 20 };
    assert_eq!(plan(&dataset, &together, 1).unwrap().wrong, wrong);
}

#[test]
fn masks_of_a_disturbed_scene_are_ours_and_other_files_are_not() {
    let folder = TempDir::new().unwrap();
    let boxes = Disturbance::Boxes { count: 20, are_masked: true };
    disturbed(folder.path(), &city(folder.path()), &boxes, 1);
    let to = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path());
    let to = to.into_iter().find(|path| path.join("masks").is_dir()).unwrap();
    std::fs::write(to.join("masks/notes.txt"), "mine").unwrap();
    assert!(check_ours(&to, is_of_disturbed).is_err_and(|e| e.to_string().contains("notes.txt")));
}
