//! The generated city is an ordinary COLMAP scene: counts and sizes as requested, the same bytes for any number of
//! threads, photos that agree with their poses, and no half-written or silently replaced folders.

use super::support::files;
use gsscale::dataset::colmap::read_colmap;
use gsscale::dataset::read::ReadOptions;
use gsscale::dataset::synthetic::{CityOptions, CitySummary, write_city};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// A small flight: 8 photos, exposure change and noise included.
fn small() -> CityOptions {
    CityOptions { views: 8, width: 120, height: 80, points: 600, exposure: 0.03, noise: 0.01, ..CityOptions::default() }
}

fn write(folder: &Path, options: &CityOptions) -> CitySummary {
    write_city(folder, options, &|_, _| {}).unwrap()
}

/// Reads little-endian numbers one after the other; written against COLMAP's format, not against the writer.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (head, rest) = self.0.split_first_chunk::<N>().expect("the file ends too early");
        self.0 = rest;
        *head
    }
    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }
    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }
    fn f64s<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| f64::from_le_bytes(self.take()))
    }
    fn name(&mut self) -> String {
        let end = self.0.iter().position(|&b| b == 0).unwrap();
        let name = String::from_utf8(self.0[..end].to_vec()).unwrap();
        self.0 = &self.0[end + 1..];
        name
    }
}

struct Image {
    quat: [f64; 4],
    t: [f64; 3],
    name: String,
    points2d: Vec<([f64; 2], u64)>,
}

struct Point {
    id: u64,
    xyz: [f64; 3],
    rgb: [u8; 3],
    error: f64,
    track: Vec<(u32, u32)>,
}

struct Scene {
    width: u64,
    height: u64,
    /// fx, fy, cx, cy.
    k: [f64; 4],
    images: BTreeMap<u32, Image>,
    points: Vec<Point>,
}

fn read_scene(folder: &Path) -> Scene {
    let read = |name: &str| std::fs::read(folder.join("sparse/0").join(name)).unwrap();
    let bytes = read("cameras.bin");
    let mut b = Bytes(&bytes);
    assert_eq!((b.u64(), b.u32(), b.u32()), (1, 1, 1), "one camera, id 1, model PINHOLE");
    let (width, height, k) = (b.u64(), b.u64(), b.f64s());
    assert!(b.0.is_empty());
    let bytes = read("images.bin");
    let mut b = Bytes(&bytes);
    let mut images = BTreeMap::new();
    for _ in 0..b.u64() {
        let (id, quat, t) = (b.u32(), b.f64s(), b.f64s());
        assert_eq!(b.u32(), 1, "camera id");
        let name = b.name();
        let points2d = (0..b.u64()).map(|_| (b.f64s(), b.u64())).collect();
        images.insert(id, Image { quat, t, name, points2d });
    }
    assert!(b.0.is_empty());
    let bytes = read("points3D.bin");
    let mut b = Bytes(&bytes);
    let points = (0..b.u64())
        .map(|_| {
            let (id, xyz, rgb, [error]) = (b.u64(), b.f64s(), b.take(), b.f64s());
            let track = (0..b.u64()).map(|_| (b.u32(), b.u32())).collect();
            Point { id, xyz, rgb, error, track }
        })
        .collect();
    assert!(b.0.is_empty());
    Scene { width, height, k, images, points }
}

/// Picture position of a world point (rotation of the unit quaternion by the textbook matrix).
fn project(scene: &Scene, image: &Image, p: [f64; 3]) -> [f64; 2] {
    let [w, x, y, z] = image.quat;
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let c: [f64; 3] = std::array::from_fn(|i| r[i][0] * p[0] + r[i][1] * p[1] + r[i][2] * p[2] + image.t[i]);
    assert!(c[2] > 0.0, "an observed point lies behind its camera");
    let [fx, fy, cx, cy] = scene.k;
    [fx * c[0] / c[2] + cx, fy * c[1] / c[2] + cy]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let made = [1, 2, 5].map(|threads| {
        let to = folder.path().join(threads.to_string());
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| write(&to, &small()));
        files(&to)
    });
    // Photos, model and mark.
    assert_eq!(made[0].len(), 8 + 3 + 1);
    assert!(made[0] == made[1] && made[0] == made[2]);
    let other = folder.path().join("other");
    write(&other, &CityOptions { seed: 2, ..small() });
    assert!(files(&other)["images/view_0003.jpg"] != made[0]["images/view_0003.jpg"], "the seed does nothing");
}

#[test]
fn counts_sizes_and_tracks_are_as_asked() {
    let folder = tempfile::tempdir().unwrap();
    let options = small();
    let summary = write(folder.path(), &options);
    let scene = read_scene(folder.path());
    assert_eq!((scene.width, scene.height), (120, 80));
    assert_eq!((scene.images.len(), scene.points.len()), (8, 600));
    assert_eq!((summary.views, summary.points), (8, 600));
    let mut names: Vec<_> = scene.images.values().map(|i| i.name.clone()).collect();
    assert!(names.is_sorted());
    names.dedup();
    assert_eq!(names.len(), 8);
    for name in names {
        let photo = image::open(folder.path().join("images").join(name)).unwrap();
        assert_eq!((photo.width(), photo.height()), (120, 80));
    }
    let mut entries = 0;
    for p in &scene.points {
        assert!(!p.track.is_empty() && p.track.iter().is_sorted());
        for &(image, index) in &p.track {
            let (at, id) = scene.images[&image].points2d[index as usize];
            assert_eq!(id, p.id);
            assert!(at[0] >= 0.0 && at[0] < 120.0 && at[1] >= 0.0 && at[1] < 80.0);
            entries += 1;
        }
    }
    assert_eq!(entries, scene.images.values().map(|i| i.points2d.len()).sum::<usize>());
    assert_eq!(entries as u64, summary.observations);
    // With eight photos over one block nearly every place is seen twice.
    let lonely = scene.points.iter().filter(|p| p.track.len() < 2).count();
    assert!(lonely < 60, "{lonely} of 600 points have one observation only");
}

#[test]
fn copies_of_a_city_lie_side_by_side_and_share_out_its_photos() {
    let folder = tempfile::tempdir().unwrap();
    let (one, many) = (folder.path().join("one"), folder.path().join("many"));
    let base = write(&one, &small());
    let summary = write(&many, &CityOptions { tiles: [3, 2], ..small() });
    assert_eq!((summary.points, summary.views, summary.side), (3600, 8, base.side));
    let (one, many) = (read_scene(&one), read_scene(&many));
    for (k, p) in many.points.iter().enumerate() {
        let (tile, of) = (k / 600, &one.points[k % 600]);
        let shift = [(tile % 3) as f64 * base.side, (tile / 3) as f64 * base.side, 0.0];
        assert_eq!((p.id, p.xyz, p.rgb), (k as u64 + 1, std::array::from_fn(|i| of.xyz[i] + shift[i]), of.rgb));
        // A photo is at one of the copies, and its tracks are those of this copy's points.
        let seen: Vec<u32> =
            of.track.iter().map(|&(image, _)| image).filter(|i| (i - 1) as usize % 6 == tile).collect();
        assert_eq!(p.track.iter().map(|&(image, _)| image).collect::<Vec<_>>(), seen);
        for &(image, index) in &p.track {
            let (at, id) = many.images[&image].points2d[index as usize];
            assert_eq!(id, p.id);
            let there = project(&many, &many.images[&image], p.xyz);
            assert!((there[0] - at[0]).hypot(there[1] - at[1]) < 20.0, "{there:?} {at:?}");
        }
    }
    assert!(many.points.iter().map(|p| p.track.len()).sum::<usize>() > 500);
    let raw = read_colmap(&folder.path().join("many"), &ReadOptions::default());
    assert_eq!(raw.unwrap().points.positions.len(), 3600);
    let none = CityOptions { tiles: [0, 1], ..small() };
    assert!(write_city(&folder.path().join("more"), &none, &|_, _| {}).unwrap_err().to_string().starts_with("--tile"));
}

#[test]
fn the_colmap_reader_finds_nothing_to_complain_about() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &CityOptions { offset: [5e5, 4.6e6, 0.0], ..small() });
    let raw = read_colmap(folder.path(), &ReadOptions::default()).unwrap();
    assert_eq!(raw.warnings, Vec::<String>::new());
    let scene = read_scene(folder.path());
    assert_eq!(raw.points.positions, scene.points.iter().map(|p| p.xyz).collect::<Vec<_>>());
    assert_eq!(raw.views.len(), 8);
    for view in &raw.views {
        assert!(view.image_path.is_file());
        // Cameras fly 82 m high with a jitter below 2 m; the z offset is 0. A UTM translation of 4.6e6 m times the
        // rounding of a unit quaternion (1e-16) moves them by far less than a millimetre.
        let centre = view.pose.centre();
        assert!((centre.z - 82.0).abs() < 2.0, "{centre}");
        assert!((centre.x - 5e5).abs() < 200.0 && (centre.y - 4.6e6).abs() < 200.0, "{centre}");
    }
}

/// The proof that poses, photos and points belong together: projecting points through the written poses lands on
/// their observations and on pixels of their colour; through the pose of another photo it does not.
#[test]
fn points_land_on_pixels_of_their_colour() {
    let folder = tempfile::tempdir().unwrap();
    let options = CityOptions {
        views: 12,
        width: 240,
        height: 160,
        points: 1500,
        offset: [500_000.0, 4_600_000.0, 120.0],
        ..CityOptions::default()
    };
    write(folder.path(), &options);
    let scene = read_scene(folder.path());
    let photos: BTreeMap<u32, image::RgbImage> = scene
        .images
        .iter()
        .map(|(&id, i)| (id, image::open(folder.path().join("images").join(&i.name)).unwrap().to_rgb8()))
        .collect();
    let difference = |p: &Point, id: u32, pose: u32| -> Option<f64> {
        let at = project(&scene, &scene.images[&pose], p.xyz);
        let (x, y) = (at[0].floor(), at[1].floor());
        if x < 0.0 || y < 0.0 || x >= 240.0 || y >= 160.0 {
            return None;
        }
        let pixel = photos[&id].get_pixel(x as u32, y as u32).0;
        Some((0..3).map(|c| f64::from(pixel[c].abs_diff(p.rgb[c]))).sum::<f64>() / 3.0)
    };
    let (mut right, mut wrong, mut misses, mut stated) = (vec![], vec![], vec![], vec![]);
    for p in &scene.points {
        stated.push(p.error);
        for &(id, index) in &p.track {
            let at = project(&scene, &scene.images[&id], p.xyz);
            let seen = scene.images[&id].points2d[index as usize].0;
            misses.push((at[0] - seen[0]).hypot(at[1] - seen[1]));
            right.extend(difference(p, id, id));
            wrong.extend(difference(p, id, id % 12 + 1));
        }
    }
    let (right, wrong) = (median(right), median(wrong));
    // Matching noise is 0.5 pixels per coordinate for the observation and again for the point: the median length of
    // a 2D normal with sigma 0.71 is 0.83 pixels; noise along the line of sight adds a little in other photos.
    let miss = median(misses);
    assert!((0.5..1.3).contains(&miss), "median reprojection error {miss}");
    assert!((median(stated) - miss).abs() < 0.3);
    // A point sits within a pixel of its place, so its colour differs by texture and edges only, and by the gloss in
    // other views: a few of 255 levels. A foreign pose shows what chance agreement would be.
    assert!(right < 12.0, "median colour difference {right}");
    assert!(wrong > 2.0 * right, "foreign poses fit as well: {wrong} against {right}");
}

#[test]
fn exposure_and_noise_change_the_photos_but_not_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let clean = CityOptions { exposure: 0.0, noise: 0.0, ..small() };
    let [a, b] = [("clean", clean), ("dirty", small())].map(|(name, options)| {
        write(&folder.path().join(name), &options);
        files(&folder.path().join(name))
    });
    for model in ["cameras", "images", "points3D"] {
        let name = format!("sparse/0/{model}.bin");
        assert!(a[&name] == b[&name], "{name} depends on the sensor");
    }
    let mean = |bytes: &[u8]| {
        let rgb = image::load_from_memory(bytes).unwrap().to_rgb8().into_raw();
        rgb.iter().map(|&v| f64::from(v)).sum::<f64>() / rgb.len() as f64
    };
    let gains: Vec<f64> =
        (0..8).map(|k| format!("images/view_{k:04}.jpg")).map(|n| mean(&b[&n]) / mean(&a[&n])).collect();
    let spread = gains.iter().fold(0.0f64, |m, g| m.max((g - 1.0).abs()));
    // Eight draws with a standard deviation of 3 % cut at 3: the largest lies between 1 % and 9 % (clipping and
    // JPEG move the mean by less than 0.5 %).
    assert!((0.01..0.095).contains(&spread), "largest gain change {spread}");
}

#[test]
fn a_folder_with_something_in_it_is_refused_unless_told_otherwise() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes.txt");
    std::fs::write(&notes, "mine").unwrap();
    let error = write_city(folder.path(), &small(), &|_, _| {}).unwrap_err().to_string();
    assert!(error.contains("not empty") && error.contains("--overwrite"), "{error}");
    assert_eq!(files(folder.path()).len(), 1, "a refused folder was changed");
    write(folder.path(), &CityOptions { overwrite: true, ..small() });
    write(folder.path(), &CityOptions { overwrite: true, views: 4, ..small() });
    let found = files(folder.path());
    assert_eq!(found.len(), 1 + 1 + 4 + 3, "the notes, the mark, photos and model: {:?}", found.keys());
    assert_eq!(std::fs::read_to_string(notes).unwrap(), "mine", "overwriting touched a foreign file");
    // Real photos are worth more than a flag.
    std::fs::write(folder.path().join("images/DSC_0001.jpg"), "a photo").unwrap();
    let before = files(folder.path());
    let error = write_city(folder.path(), &CityOptions { overwrite: true, ..small() }, &|_, _| {}).unwrap_err();
    assert!(error.to_string().contains("DSC_0001.jpg"), "{error}");
    assert!(files(folder.path()) == before);
    std::fs::remove_file(folder.path().join("images/DSC_0001.jpg")).unwrap();
    // So is another reconstruction, beside the generated photos.
    std::fs::write(folder.path().join("sparse/0/project.ini"), "").unwrap();
    let before = files(folder.path());
    let error = write_city(folder.path(), &CityOptions { overwrite: true, ..small() }, &|_, _| {}).unwrap_err();
    assert!(error.to_string().contains("project.ini"), "{error}");
    assert!(files(folder.path()) == before);
}

/// Photos and poses of a user may have the very names of generated ones.
#[test]
fn a_scene_that_is_not_marked_as_generated_is_never_removed() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &CityOptions { views: 2, ..small() });
    std::fs::remove_file(folder.path().join(".gsscale-city")).unwrap();
    // Of a whole scene, then of the photos that are left.
    for part in ["sparse", "images"] {
        let before = files(folder.path());
        let error = write_city(folder.path(), &CityOptions { overwrite: true, ..small() }, &|_, _| {}).unwrap_err();
        let said = error.to_string();
        assert!(said.contains(part) && said.contains(".gsscale-city"), "{said}");
        assert!(files(folder.path()) == before);
        std::fs::remove_dir_all(folder.path().join(part)).unwrap();
    }
}

#[test]
fn a_model_that_cannot_be_finished_leaves_no_sparse_folder() {
    let folder = tempfile::tempdir().unwrap();
    // The last photo's name is taken by a folder: everything before it is written, then the run fails.
    let failed = {
        let blocked = folder.path().join("images/view_0007.jpg");
        let last = std::sync::atomic::AtomicBool::new(false);
        let result = write_city(folder.path(), &small(), &|done, _| {
            if done == 3 && !last.swap(true, std::sync::atomic::Ordering::SeqCst) {
                std::fs::create_dir(&blocked).unwrap();
                std::fs::write(blocked.join("x"), "x").unwrap();
            }
        });
        result.unwrap_err().to_string()
    };
    assert!(failed.contains("view_0007.jpg"), "{failed}");
    assert!(!folder.path().join("sparse").exists(), "half a scene reads as a whole one");
    assert!(files(folder.path()).keys().all(|n| !n.ends_with(".partial")));
}

fn synth(arguments: &[&str]) -> (Option<i32>, String, String) {
    let out = Command::new(env!("CARGO_BIN_EXE_gsscale-synth")).args(arguments).output().unwrap();
    let text = |b: Vec<u8>| String::from_utf8(b).unwrap();
    (out.status.code(), text(out.stdout), text(out.stderr))
}

#[test]
fn the_program_writes_a_scene_says_what_next_and_reports_errors() {
    let folder = tempfile::tempdir().unwrap();
    let city = folder.path().join("city");
    let dir = city.to_str().unwrap();
    let flags = ["--views", "2", "--resolution", "64x48", "--points", "50", "--supersample", "1"];
    let arguments: Vec<&str> = [dir].into_iter().chain(flags).chain(["--offset", "-5,4600000,0"]).collect();
    let (code, out, err) = synth(&arguments);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains(&format!("gsscale-train {dir} --out")), "{out}");
    assert_eq!(read_scene(&city).images.len(), 2);
    let (code, _, err) = synth(&arguments);
    assert_eq!(code, Some(1));
    assert!(err.contains("not empty") && err.contains("remedy"), "{err}");
    // A file stands where the folder should be made.
    let below = city.join("sparse/0/cameras.bin/city");
    let (code, _, err) = synth(&[below.to_str().unwrap(), "--views", "2"]);
    assert_eq!(code, Some(1));
    assert!(err.contains("cameras.bin"), "{err}");
    assert_eq!(synth(&[dir, "--resolution", "huge"]).0, Some(2));
    assert_eq!(synth(&[dir, "--no-such-flag"]).0, Some(2));
    assert_eq!(synth(&[folder.path().join("x").to_str().unwrap(), "--views", "0"]).0, Some(1));
    assert!(!folder.path().join("x").exists(), "refused options made a folder");
}
