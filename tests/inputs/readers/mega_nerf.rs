//! Mega-NeRF's layout: files written by PyTorch, a generated city in that layout, and hostile files.

use crate::support::lookalike::write_mega_nerf;
use glam::DVec3;
use gsscale::dataset::model::Split;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/mega_nerf").join(name)
}

/// PyTorch's files as a scene: one training view, one held out.
fn scene_of_pytorch() -> TempDir {
    let folder = TempDir::new().unwrap();
    std::fs::copy(fixture("coordinates.pt"), folder.path().join("coordinates.pt")).unwrap();
    for (part, name) in [("train", "000000"), ("val", "000001")] {
        for sub in ["metadata", "rgbs"] {
            std::fs::create_dir_all(folder.path().join(part).join(sub)).unwrap();
        }
        let metadata = folder.path().join(part).join("metadata").join(name).with_extension("pt");
        std::fs::copy(fixture(name).with_extension("pt"), metadata).unwrap();
        let photo = folder.path().join(part).join("rgbs").join(name).with_extension("JPG");
        image::RgbImage::new(96, 64).save_with_format(photo, image::ImageFormat::Jpeg).unwrap();
    }
    folder
}

#[test]
fn files_of_pytorch_are_read_with_their_poses() {
    let folder = scene_of_pytorch();
    let scene = read_scene(folder.path(), &ReadOptions::default()).unwrap();
    let text = std::fs::read_to_string(fixture("expected.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(scene.views.len(), 2);
    for (i, view) in scene.views.iter().enumerate() {
        assert_eq!(view.split, Some([Split::Train, Split::Test][i]));
        assert_eq!((view.intrinsics.width, view.intrinsics.fx, view.intrinsics.fy), (96, 80.5, 81.5));
        let number = |v: &serde_json::Value| v.as_f64().unwrap();
        let centre = &expected[i]["centre"];
        let centre = DVec3::new(number(&centre[0]), number(&centre[1]), number(&centre[2]));
        // f32 positions in units of 152 m.
        assert!((view.pose.centre() - centre).length() < 1e-4, "{:?}", view.pose.centre());
        for r in 0..3 {
            for c in 0..3 {
                let want = number(&expected[i]["rotation"][r][c]);
                assert!((view.pose.rotation.row(r)[c] - want).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn a_city_in_this_layout_reads_as_the_same_scene() {
    let folder = TempDir::new().unwrap();
    let options = CityOptions { views: 6, width: 48, height: 32, points: 50, ..CityOptions::default() };
    write_city(folder.path(), &options, &|_, _| {}).unwrap();
    let colmap = read_scene(folder.path(), &ReadOptions::default()).unwrap();
    write_mega_nerf(folder.path(), &colmap, 3);
    std::fs::remove_dir_all(folder.path().join("sparse")).unwrap();
    let scene = read_scene(folder.path(), &ReadOptions::default()).unwrap();
    assert_eq!(scene.views.iter().filter(|v| v.split == Some(Split::Test)).count(), 2);
    // Distances between cameras do not depend on the axes of the world; views 1 and 2 train, 0 and 3 are held out.
    let centre = |name: &str| scene.views.iter().find(|v| v.name.contains(name)).unwrap().pose.centre();
    for (i, a) in ["000000", "000001", "000004"].iter().enumerate() {
        for b in ["000002", "000003", "000005"] {
            let want = (colmap.views[[0, 1, 4][i]].pose.centre()
                - colmap.views[b[5..].parse::<usize>().unwrap()].pose.centre())
            .length();
            assert!(((centre(a) - centre(b)).length() - want).abs() < 1e-3 * want.max(1.0));
        }
    }
}

/// The scene with one file of bytes in place of a metadata file: what the reader says.
fn with_metadata(bytes: &[u8]) -> String {
    let folder = scene_of_pytorch();
    std::fs::write(folder.path().join("train/metadata/000000.pt"), bytes).unwrap();
    let said = read_scene(folder.path(), &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("000000.pt") && said.contains("remedy"), "{said}");
    said
}

#[test]
fn hostile_files_are_refused_by_name() {
    let good = std::fs::read(fixture("000000.pt")).unwrap();
    assert!(with_metadata(b"\x80\x02ccos\nsystem\n").contains("not a file of torch.save"));
    // Another function under the same length: found by the checksum of the archive or by its name, never called.
    let mut evil = good.clone();
    let at = evil.windows(11).position(|w| w == b"torch._util").unwrap();
    evil[at..at + 11].copy_from_slice(b"posix._util");
    with_metadata(&evil);
    for cut in [0, 1, 30, 200, good.len() / 2, good.len() - 1] {
        with_metadata(&good[..cut]);
    }
    let folder = scene_of_pytorch();
    std::fs::remove_file(folder.path().join("train/rgbs/000000.JPG")).unwrap();
    let said = read_scene(folder.path(), &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("train/rgbs/000000") && said.contains("--allow-missing"), "{said}");
    let allowed = ReadOptions { allow_missing: true, ..ReadOptions::default() };
    assert_eq!(read_scene(folder.path(), &allowed).unwrap().views.len(), 1);
    std::fs::write(folder.path().join("coordinates.pt"), b"").unwrap();
    let said = read_scene(folder.path(), &ReadOptions::default()).unwrap_err().to_string();
    assert!(said.contains("coordinates.pt"), "{said}");
}
