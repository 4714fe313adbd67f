//! Point clouds larger than memory: reading, measuring and partitioning them within a budget gives the same pages and
//! numbers as in memory.

use super::readers::write::{Model, Pt};
use glam::DVec3;
use gsscale::base::error::InputError;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::dataset::colmap;
use gsscale::dataset::frame::Extent;
use gsscale::dataset::import::{Budget, Cloud, FirstPage, ImportOptions, LocalCloud, import_points};
use gsscale::dataset::model::TakePoint;
use gsscale::exchange::ply;
use gsscale::scene::init::{InitOptions, gaussians_from_points};
use gsscale::scene::partition::partition;
use gsscale::scene::state::SceneState;
use std::fmt::Write;
use std::path::Path;

/// A town of tight clusters with map-projection offsets, a few points far beyond it, some twice.
fn points(count: u64) -> (Vec<[f64; 3]>, Vec<[u8; 3]>) {
    let point = |i: u64| {
        let mut s = Stream::new(5, Purpose::Test, i - u64::from(i % 97 == 1), 0);
        let spread = if i.is_multiple_of(1001) { 1e12 } else { 2.0 };
        let house = [(i % 31) as f64 * 20.0 + 5e5, (i % 17) as f64 * 30.0 + 4e6, 100.0];
        (house.map(|x| x + s.normal() * spread), std::array::from_fn(|_| s.below(256) as u8))
    };
    (0..count).map(point).unzip()
}

fn write_colmap(path: &Path, positions: &[[f64; 3]], colors: &[[u8; 3]]) {
    let point = |(i, (&position, &color))| Pt { position, color, track: i % 5 };
    let points = positions.iter().zip(colors).enumerate().map(point).collect();
    let model = Model { cameras: Vec::new(), images: Vec::new(), points };
    std::fs::write(path, model.points_bin()).unwrap();
}

fn write_ply(path: &Path, positions: &[[f64; 3]], colors: &[[u8; 3]]) {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        positions.len()
    );
    for ([x, y, z], [r, g, b]) in positions.iter().zip(colors) {
        writeln!(text, "{x:e} {y:e} {z:e} {r} {g} {b}").unwrap();
    }
    std::fs::write(path, text).unwrap();
}

#[test]
fn files_give_the_pages_of_points_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let (positions, colors) = points(9000);
    let (bin, ply_path) = (folder.path().join("points3D.bin"), folder.path().join("points.ply"));
    write_colmap(&bin, &positions, &colors);
    write_ply(&ply_path, &positions, &colors);
    let cameras: Vec<DVec3> = (0..20).map(|i| DVec3::new(5e5 + f64::from(i) * 30.0, 4e6 + 200.0, 180.0)).collect();
    let extent = Extent::measure(&cameras, &positions);
    let frame = extent.frame();
    // As the loader does it in memory.
    let kept: Vec<usize> = (0..9000).filter(|&i| extent.is_plausible(DVec3::from_array(positions[i]))).collect();
    assert!(kept.len() < 9000 && kept.len() > 8900);
    let local: Vec<[f32; 3]> =
        kept.iter().map(|&i| frame.to_local(DVec3::from_array(positions[i])).as_vec3().to_array()).collect();
    let local_colors: Vec<[u8; 3]> = kept.iter().map(|&i| colors[i]).collect();
    for most in [None, Some(4000)] {
        let init = InitOptions { sh_degree: 0, max_gaussians: most, ..InitOptions::default() };
        let columns = gaussians_from_points(&local, &local_colors, &init);
        let parts = partition(&columns.means, &columns.scales, 100);
        let state = SceneState::from_columns(columns);
        for (is_ply, bytes) in [(false, 1 << 28), (false, 200_000), (true, 60_000)] {
            let budget = Budget { folder: folder.path(), bytes };
            let cloud = Cloud::gather(&budget, |take| {
                if is_ply {
                    assert!(!ply::holds_gaussians(&ply_path)?);
                    return ply::stream_points(&ply_path, take).map(|dropped| assert_eq!(dropped, 0));
                }
                let mut warnings = Vec::new();
                colmap::stream_points(&bin, &mut warnings, take)?;
                assert!(warnings.is_empty());
                Ok(())
            })
            .unwrap();
            let measured = Extent::measure_by(&cameras, |centre| cloud.median_distance(centre)).unwrap();
            assert_eq!(measured, extent);
            let source = LocalCloud { cloud: &cloud, extent: measured, frame: measured.frame() };
            let options = ImportOptions { init: &init, fill: 100, budget };
            let mut pages: Vec<FirstPage> = Vec::new();
            import_points(&source, &options, &mut |page| {
                pages.push(page);
                Ok(())
            })
            .unwrap();
            assert_eq!(pages.len(), parts.len());
            for (page, rows) in pages.iter().zip(parts.iter()) {
                assert!(page.rows == *rows && page.columns == state.select(rows).columns, "{} of {bytes}", page.id);
            }
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing but the two files");
}

#[test]
fn a_cut_file_is_an_error_however_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (positions, colors) = points(50);
    let bin = folder.path().join("points3D.bin");
    write_colmap(&bin, &positions, &colors);
    let bytes = std::fs::read(&bin).unwrap();
    std::fs::write(&bin, &bytes[..bytes.len() - 9]).unwrap();
    let budget = Budget { folder: folder.path(), bytes: 1000 };
    let error = Cloud::gather(&budget, |take| colmap::stream_points(&bin, &mut Vec::new(), take)).unwrap_err();
    assert!(error.to_string().contains("points3D.bin: byte"), "{error}");
}

#[test]
fn small_clouds_and_points_that_are_not_finite_give_the_pages_of_points_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let centres: Vec<DVec3> = (0..9).map(|i| DVec3::new(5e5 + f64::from(i), 4e6, -1.0)).collect();
    for (count, most) in [(0, None), (1, None), (2, None), (3, None), (501, None), (700, Some(300)), (200, Some(0))] {
        let (mut positions, colors) = points(count);
        positions.iter_mut().skip(2).step_by(65).for_each(|p| *p = [f64::NAN, 1e200, 0.0]);
        // Exact duplicates, and a lattice with many equal distances.
        for i in (4..positions.len()).step_by(3) {
            positions[i] = [5e5 + (i % 7) as f64, 4e6 + (i % 5) as f64, 100.0];
        }
        let local: Vec<[f32; 3]> =
            positions.iter().map(|p| (DVec3::from_array(*p) - centres[0]).as_vec3().into()).collect();
        let init = InitOptions { sh_degree: 1, max_gaussians: most, seed: 3, ..InitOptions::default() };
        let columns = gaussians_from_points(&local, &colors, &init);
        let parts = partition(&columns.means, &columns.scales, 50);
        let state = SceneState::from_columns(columns);
        for bytes in [1 << 30, 100_000, 20_000, 1000] {
            let budget = Budget { folder: folder.path(), bytes };
            let read = |take: &mut TakePoint<'_>| positions.iter().zip(&colors).try_for_each(|(p, c)| take(*p, *c));
            let cloud = Cloud::gather(&budget, read).unwrap();
            let extent = Extent::measure_by(&centres, |centre| cloud.median_distance(centre)).unwrap();
            assert_eq!(extent, Extent::measure(&centres, &positions));
            let options = ImportOptions { init: &init, fill: 50, budget };
            let source = (local.as_slice(), colors.as_slice());
            let mut pages = Vec::new();
            let summary = import_points(&source, &options, &mut |page| {
                pages.push(page);
                Ok(())
            });
            let summary = summary.unwrap();
            assert_eq!((summary.rows, summary.points, pages.len()), (state.rows() as u64, count, parts.len()));
            for (page, rows) in pages.iter().zip(parts.iter()) {
                assert!(page.rows == *rows && page.columns == state.select(rows).columns, "{} of {bytes}", page.id);
            }
            if count > 0 && most != Some(0) {
                let full = || InputError::new("disk", "full", "free some");
                let refused = import_points(&source, &options, &mut |_| Err(full())).unwrap_err();
                assert_eq!(refused.problem, "full");
            }
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "a file of the import is left");
}
