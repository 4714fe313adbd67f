//! A folder for the files of a case, in memory where the system offers that, and what every scene must satisfy.

use gsscale::base::error::InputResult;
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::{ReadOptions, read_scene};
use std::path::{Component, Path};
use tempfile::TempDir;

/// A new folder, removed on drop.
pub fn scratch() -> TempDir {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
    folder.or_else(|_| tempfile::tempdir()).unwrap()
}

/// Whether a path is below `folder`, however it is spelled.
pub fn stays_in(folder: &Path, path: &Path) -> bool {
    let Ok(rest) = path.strip_prefix(folder) else { return false };
    rest.components().all(|part| matches!(part, Component::Normal(_)))
}

pub fn read_and_check(folder: &Path) -> Option<RawScene> {
    check(folder, read_scene(folder, &ReadOptions { allow_missing: true, ..ReadOptions::default() }))
}

fn check(folder: &Path, result: InputResult<RawScene>) -> Option<RawScene> {
    let scene = match result {
        Ok(scene) => scene,
        Err(e) => {
            assert!(!e.file.as_os_str().is_empty() && !e.remedy.is_empty() && !e.problem.is_empty(), "{e}");
            return None;
        }
    };
    assert!(!scene.views.is_empty());
    for view in &scene.views {
        let i = view.intrinsics;
        assert!(i.width > 0 && i.height > 0 && i.fx > 0.0 && i.fy > 0.0);
        assert!([i.fx, i.fy, i.cx, i.cy].iter().all(|x| x.is_finite()));
        assert!(view.pose.rotation.is_finite() && view.pose.translation.is_finite());
        // A few roundings.
        assert!((view.pose.rotation.determinant() - 1.0).abs() < 1e-9);
        let paths = [Some(&view.image_path), view.mask_path.as_ref()];
        assert!(paths.into_iter().flatten().all(|path| stays_in(folder, path)), "{view:?}");
    }
    assert!(scene.views.windows(2).all(|pair| pair[0].name < pair[1].name));
    assert!(scene.points_path.iter().all(|path| stays_in(folder, path)), "{:?}", scene.points_path);
    assert!(scene.points.positions.iter().flatten().all(|x| x.is_finite()));
    assert_eq!(scene.points.positions.len(), scene.points.colors.len());
    Some(scene)
}
