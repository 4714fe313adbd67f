//! Photos: checks at load, the contents of a training target, and the byte budget.

use crate::support::shared::real_scene;
use glam::{DMat3, DVec3};
use gsscale::base::error::InputError;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::dataset::loader::{Dataset, LoadOptions, load_dataset};
use gsscale::dataset::model::{Intrinsics, Lens, PointCloud, Pose, RawScene, RawView, Split};
use gsscale::dataset::photo::decode;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::resize::resize_area;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::dataset::undistort::distort;
use image::{DynamicImage, GrayImage, Luma, Rgb, RgbImage, RgbaImage};
use std::path::{MAIN_SEPARATOR, Path};
use std::sync::Arc;
use tempfile::TempDir;

const SIZE: (u32, u32) = (64, 48);

fn pinhole(width: u32, height: u32) -> Intrinsics {
    let f = 0.9 * f64::from(width);
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Intrinsics { width, height, fx: f, fy: f, cx, cy, lens: Lens::Pinhole }
}

/// A camera on a ring of radius 4 at height 3, looking down.
fn ring_pose(index: usize, count: usize, offset: DVec3) -> Pose {
    let angle = index as f64 / count as f64 * std::f64::consts::TAU;
    let centre = DVec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 3.0) + offset;
    let rotation = DMat3::from_rotation_x(std::f64::consts::PI) * DMat3::from_rotation_z(angle);
    Pose { rotation, translation: -(rotation * centre) }
}

fn raw_view(folder: &Path, name: &str, index: usize, count: usize, intrinsics: Intrinsics) -> RawView {
    RawView {
        name: name.to_string(),
        image_path: folder.join("images").join(name),
        intrinsics,
        pose: ring_pose(index, count, DVec3::ZERO),
        mask_path: None,
        split: None,
    }
}

fn some_points() -> PointCloud {
    let mut s = Stream::new(3, Purpose::Test, 0, 0);
    let positions: Vec<[f64; 3]> = (0..200).map(|_| std::array::from_fn(|_| s.range(-2.0, 2.0))).collect();
    PointCloud { colors: vec![[10, 20, 30]; positions.len()], positions }
}

fn noise_photo(width: u32, height: u32, key: u64) -> RgbImage {
    let mut s = Stream::new(11, Purpose::Test, key, 0);
    RgbImage::from_fn(width, height, |_, _| Rgb(std::array::from_fn(|_| s.next_u64() as u8)))
}

/// A folder with `count` PNG photos of noise and the scene that goes with it.
fn noise_scene(count: usize) -> (TempDir, RawScene) {
    let folder = TempDir::new().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    let views: Vec<RawView> = (0..count)
        .map(|i| {
            let name = format!("p{i:02}.png");
            noise_photo(SIZE.0, SIZE.1, i as u64).save(folder.path().join("images").join(&name)).unwrap();
            raw_view(folder.path(), &name, i, count, pinhole(SIZE.0, SIZE.1))
        })
        .collect();
    (folder, RawScene { views, points: some_points(), ..RawScene::default() })
}

fn load(raw: &RawScene) -> Dataset {
    load_dataset(raw.clone(), &LoadOptions::default()).unwrap()
}

fn refusal(raw: &RawScene, options: &LoadOptions) -> InputError {
    load_dataset(raw.clone(), options).unwrap_err()
}

fn has_warning(dataset: &Dataset, part: &str) -> bool {
    dataset.warnings.iter().any(|w| w.contains(part))
}

#[test]
fn a_plain_scene_loads_without_warnings() {
    let (folder, raw) = noise_scene(9);
    let dataset = load(&raw);
    assert_eq!(dataset.warnings, Vec::<String>::new());
    assert_eq!(dataset.image_folder, folder.path().join("images"));
    assert_eq!(dataset.test_views(), [0, 8]);
    assert_eq!(dataset.train_views(), [1, 2, 3, 4, 5, 6, 7]);
    assert_eq!((dataset.points.len(), dataset.colors.len()), (200, 200));
    let camera = &dataset.views[3].camera;
    assert_eq!((camera.width, camera.height, camera.near_plane), (64, 48, 0.01));
    // Camera positions survive the change of frame: f32 values below 4.
    let world = dataset.frame.to_world(DVec3::from_array(camera.centre().map(f64::from)));
    assert!(world.distance(raw.views[3].pose.centre()) < 1e-5);
    // A ring of radius 4: every camera is 4 from the mean; one unit is about 4.
    let scale = f64::from(dataset.scene_scale) * dataset.frame.scale;
    assert!((scale - 1.1 * 4.0).abs() < 1e-5, "{scale}");
}

#[test]
fn splits_count_registered_views_in_order() {
    let (_folder, mut raw) = noise_scene(10);
    let tests_with = |raw: &RawScene, options: LoadOptions| load_dataset(raw.clone(), &options).unwrap().test_views();
    let options = LoadOptions::default;
    assert_eq!(tests_with(&raw, LoadOptions { test_every: Some(3), ..options() }), [0, 3, 6, 9]);
    assert_eq!(tests_with(&raw, LoadOptions { test_every: None, ..options() }), Vec::<usize>::new());
    assert_eq!(tests_with(&raw, LoadOptions { test_every: Some(0), ..options() }), Vec::<usize>::new());
    assert_eq!(tests_with(&raw, LoadOptions { test_after: Some(7), ..options() }), [8, 9]);
    assert_eq!(refusal(&raw, &LoadOptions { test_every: Some(1), ..options() }).file, Path::new("--test-every"));
    // A missing photo shifts nobody: p03 is gone, p06 and p09 stay test views.
    std::fs::remove_file(&raw.views[3].image_path).unwrap();
    let kept =
        load_dataset(raw.clone(), &LoadOptions { test_every: Some(3), allow_missing: true, ..options() }).unwrap();
    let names: Vec<&str> = kept.test_views().iter().map(|&i| kept.views[i].name.as_str()).collect();
    assert_eq!(names, ["p00.png", "p06.png", "p09.png"]);
    // The dataset's own split wins.
    raw.views.remove(3);
    for (i, view) in raw.views.iter_mut().enumerate() {
        view.split = Some(if i == 4 { Split::Test } else { Split::Train });
    }
    assert_eq!(tests_with(&raw, LoadOptions { test_after: Some(0), ..options() }), [4]);
}

#[test]
fn one_view_is_for_training() {
    let (_folder, raw) = noise_scene(1);
    let dataset = load(&raw);
    assert_eq!(dataset.train_views(), [0]);
    assert!(has_warning(&dataset, "only one view"));
    assert!(dataset.scene_scale > 0.0 && dataset.scene_scale.is_finite());
}

#[test]
fn missing_photos_are_listed_by_name() {
    let (folder, raw) = noise_scene(30);
    for view in &raw.views[2..25] {
        std::fs::remove_file(&view.image_path).unwrap();
    }
    let error = refusal(&raw, &LoadOptions::default());
    assert_eq!(error.file, folder.path().join("images"));
    assert!(error.problem.contains("23 of 30") && error.problem.contains("p02.png, p03.png"), "{error}");
    assert!(error.problem.contains("p21.png, and 3 more") && error.remedy.contains("--allow-missing"), "{error}");
    let dataset = load_dataset(raw.clone(), &LoadOptions { allow_missing: true, ..LoadOptions::default() }).unwrap();
    assert_eq!(dataset.views.len(), 7);
    assert!(has_warning(&dataset, "23 of 30"));
    // Another file of the name may be the photo, unless it is that of another view.
    let photos = folder.path().join("images/block");
    std::fs::create_dir(&photos).unwrap();
    std::fs::copy(&raw.views[0].image_path, photos.join("p02.png")).unwrap();
    let mut two = RawScene { root: folder.path().to_path_buf(), views: raw.views[..3].to_vec(), ..raw };
    let error = refusal(&two, &LoadOptions::default());
    assert!(error.problem.replace(MAIN_SEPARATOR, "/").contains("'p02.png' may be images/block/p02.png"), "{error}");
    two.views[1].image_path = photos.join("p02.png");
    let error = refusal(&two, &LoadOptions::default());
    assert!(!error.problem.contains("may be") && error.problem.contains("holds 6 pictures of other names"), "{error}");
}

#[test]
fn extra_photos_are_counted() {
    let (folder, raw) = noise_scene(3);
    for name in ["q0.png", "q1.JPG", "q2.jpeg", "q3.png", "notes.txt"] {
        std::fs::write(folder.path().join("images").join(name), b"x").unwrap();
    }
    let dataset = load(&raw);
    assert!(has_warning(&dataset, "4 photos are not in the model and not used: q0.png, q1.JPG, q2.jpeg, ..."));
}

#[test]
fn photos_that_cannot_belong_to_their_camera_are_refused() {
    let (_folder, mut raw) = noise_scene(3);
    raw.views[1].intrinsics = pinhole(64, 64);
    let error = refusal(&raw, &LoadOptions::default());
    assert_eq!(error.file, raw.views[1].image_path);
    assert!(error.place.contains("p01.png") && error.problem.contains("64 x 48"), "{error}");
    raw.views[1].intrinsics = pinhole(48, 64);
    assert!(refusal(&raw, &LoadOptions::default()).remedy.contains("EXIF"));
}

#[test]
fn intrinsics_follow_the_size_of_the_file_and_of_the_target() {
    let (_folder, mut raw) = noise_scene(4);
    let stated =
        Intrinsics { width: 641, height: 479, fx: 600.0, fy: 610.0, cx: 320.0, cy: 240.0, lens: Lens::Pinhole };
    raw.views[2].intrinsics = stated;
    let dataset = load_dataset(raw, &LoadOptions { data_factor: 3.0, ..LoadOptions::default() }).unwrap();
    let (odd, plain) = (&dataset.views[2].camera, &dataset.views[1].camera);
    assert_eq!((odd.width, odd.height, plain.width, plain.height), (21, 16, 21, 16));
    // Ratios of the true sizes, each axis its own; one f32 rounding.
    assert!((odd.fx - 600.0 * 21.0 / 641.0).abs() < 1e-5 && (odd.fy - 610.0 * 16.0 / 479.0).abs() < 1e-5);
    assert!((odd.cx - 320.0 * 21.0 / 641.0).abs() < 1e-5 && (odd.cy - 240.0 * 16.0 / 479.0).abs() < 1e-5);
    assert!((plain.fx - 0.9 * 21.0).abs() < 1e-5);
    let target = decode(&dataset.views[1].photo).unwrap();
    assert_eq!(target.rgb, resize_area(noise_photo(64, 48, 1).as_raw(), 3, SIZE, (21, 16)));
    assert_eq!(target.mask, None);
}

#[test]
fn bad_options_are_refused() {
    let (_folder, raw) = noise_scene(2);
    for factor in [0.0, 0.5, -1.0, f64::NAN, f64::INFINITY] {
        assert!(load_dataset(raw.clone(), &LoadOptions { data_factor: factor, ..LoadOptions::default() }).is_err());
    }
    assert!(load_dataset(raw.clone(), &LoadOptions { max_resolution: Some(0), ..LoadOptions::default() }).is_err());
    assert!(load_dataset(raw, &LoadOptions { near_plane: f64::NAN, ..LoadOptions::default() }).is_err());
    assert!(load_dataset(RawScene::default(), &LoadOptions::default()).is_err());
}

#[test]
fn broken_poses_and_points_are_left_out_by_name_and_count() {
    let (_folder, mut raw) = noise_scene(12);
    let clean = load(&raw);
    raw.views[5].pose.translation.x = f64::NAN;
    raw.views[7].pose = ring_pose(7, 12, DVec3::splat(1e11));
    raw.points.positions[0] = [1e12, 0.0, 0.0];
    raw.points.positions[1] = [-1e12; 3];
    raw.points.positions[2] = [f64::NAN, 0.0, 0.0];
    let dataset = load(&raw);
    assert_eq!(dataset.views.len(), 10);
    assert!(has_warning(&dataset, "left out: p05.png, p07.png"), "{:?}", dataset.warnings);
    assert!(has_warning(&dataset, "2 points are more than a million"));
    assert!(has_warning(&dataset, "1 points are not finite"));
    assert_eq!(dataset.points.len(), 197);
    assert!(dataset.points.as_flattened().iter().all(|x| x.is_finite()));
    // Two of twelve cameras are gone from the ring: its median radius and mean shift, but stay its own.
    assert!((dataset.frame.scale / clean.frame.scale - 1.0).abs() < 0.2);
}

#[test]
fn far_cameras_do_not_count_for_the_scene_scale() {
    let (_folder, mut raw) = noise_scene(12);
    raw.views[4].pose = ring_pose(4, 12, DVec3::new(400.0, 0.0, 0.0));
    let dataset = load(&raw);
    assert_eq!(dataset.views.len(), 12);
    assert!(has_warning(&dataset, "far from all others") && has_warning(&dataset, "p04.png"));
    let scale = f64::from(dataset.scene_scale) * dataset.frame.scale;
    // Eleven of a ring's twelve cameras: their mean is 4/11 off its centre.
    assert!(scale > 1.1 * 4.0 && scale < 1.1 * 4.4, "{scale}");
}

#[test]
fn a_map_offset_gives_the_same_dataset() {
    let (_folder, raw) = noise_scene(12);
    let offset = DVec3::new(5e5, 4.5e6, 120.0);
    let mut moved = raw.clone();
    for (i, view) in moved.views.iter_mut().enumerate() {
        view.pose = ring_pose(i, 12, offset);
    }
    for p in &mut moved.points.positions {
        *p = (DVec3::from_array(*p) + offset).to_array();
    }
    let (a, b) = (load(&raw), load(&moved));
    // f64 resolves 1e-9 at 4.5e6; what is left is one f32 rounding of values up to 4.
    let close = |x: &[f32], y: &[f32]| x.iter().zip(y).all(|(x, y)| (x - y).abs() <= 2.4e-7);
    assert!(close(a.points.as_flattened(), b.points.as_flattened()));
    for (va, vb) in a.views.iter().zip(&b.views) {
        assert!(close(va.camera.viewmat.as_flattened(), vb.camera.viewmat.as_flattened()));
    }
    assert!((a.scene_scale - b.scene_scale).abs() <= 2.4e-7);
}

#[test]
fn every_pixel_format_becomes_rgb8() {
    let (folder, raw) = noise_scene(5);
    let save =
        |i: usize, picture: DynamicImage| picture.save(folder.path().join(format!("images/p{i:02}.png"))).unwrap();
    let gray = GrayImage::from_fn(64, 48, |x, y| Luma([(3 * x + y) as u8]));
    let rgba = RgbaImage::from_fn(64, 48, |x, _| image::Rgba([200, 100, 50, if x < 32 { 255 } else { 0 }]));
    let deep = image::ImageBuffer::from_fn(64, 48, |x, y| Rgb([257 * x as u16, 257 * y as u16, 65535u16]));
    save(0, gray.clone().into());
    save(1, rgba.into());
    save(2, DynamicImage::ImageRgb16(deep));
    let dataset = load(&raw);
    let targets: Vec<_> = dataset.views.iter().map(|v| decode(&v.photo).unwrap()).collect();
    assert_eq!(targets[0].rgb, gray.as_raw().iter().flat_map(|&g| [g; 3]).collect::<Vec<u8>>());
    assert_eq!((&targets[1].rgb[..3], &targets[1].rgb[3 * 40..][..3]), (&[200, 100, 50][..], &[0, 0, 0][..]));
    assert_eq!(&targets[2].rgb[3 * (2 * 64 + 5)..][..3], &[5, 2, 255]);
    assert_eq!(targets[3].rgb, noise_photo(64, 48, 3).into_raw());
    // Transparent pixels are left out, or show the background.
    let opaque: Vec<u8> = (0..64 * 48).map(|i| if i % 64 < 32 { 255 } else { 0 }).collect();
    assert_eq!(targets[1].mask.as_ref(), Some(&opaque));
    assert!([0, 2, 3, 4].into_iter().all(|i| targets[i].mask.is_none()));
    assert!(has_warning(&dataset, "1 photo has an alpha channel"));
    let over = LoadOptions { masks: false, background: [0, 128, 255], ..LoadOptions::default() };
    let target = decode(&load_dataset(raw, &over).unwrap().views[1].photo).unwrap();
    assert_eq!((&target.rgb[..3], &target.rgb[3 * 40..][..3]), (&[200, 100, 50][..], &[0, 128, 255][..]));
    assert_eq!(target.mask, None);
}

/// Fill bytes and stray bytes before a marker of a JPEG are skipped, as other decoders do; nothing else of the header is.
#[test]
fn stray_bytes_between_the_segments_of_a_jpeg_are_skipped() {
    let (folder, mut raw) = noise_scene(3);
    let path = folder.path().join("images/p00.jpg");
    noise_photo(64, 48, 9).save(&path).unwrap();
    raw.views[0].image_path = path.clone();
    let whole = std::fs::read(&path).unwrap();
    let want = decode(&load(&raw).views[0].photo).unwrap().rgb;
    // The places of the first segments.
    let mut places = vec![2];
    while let [0xff, code, high, low, ..] = whole[*places.last().unwrap()..] {
        if code == 0xda {
            break;
        }
        places.push(places.last().unwrap() + 2 + usize::from(u16::from_be_bytes([high, low])));
    }
    assert!(places.len() > 4, "{places:?}");
    for &place in &places {
        for stray in [&[0][..], &[0; 7], b"garbage", &[0xff], &[0xff; 3], &[1, 0xff, 0xff], &[0; 3000]] {
            std::fs::write(&path, [&whole[..place], stray, &whole[place..]].concat()).unwrap();
            assert!(decode(&load(&raw).views[0].photo).unwrap().rgb == want, "{stray:?} at {place}");
        }
        std::fs::write(&path, [&whole[..place], &[0; 30_000], &whole[place..]].concat()).unwrap();
        assert!(refusal(&raw, &LoadOptions::default()).problem.contains("header does not end"));
    }
}

/// At the edge of a cut-out object, colours are those of its opaque part, whatever lies hidden under the transparent one.
#[test]
fn alpha_is_a_mask_at_any_size_and_under_a_lens() {
    let (folder, raw) = noise_scene(3);
    let rgba = RgbaImage::from_fn(64, 48, |x, _| {
        if x < 33 { image::Rgba([200, 100, 50, 255]) } else { image::Rgba([255, 255, 255, 0]) }
    });
    rgba.save(folder.path().join("images/p01.png")).unwrap();
    let soft = RgbaImage::from_fn(64, 48, |x, _| image::Rgba([200, 100, 50, if x < 32 { 200 } else { 127 }]));
    soft.save(folder.path().join("images/p02.png")).unwrap();
    let options = LoadOptions { data_factor: 2.0, ..LoadOptions::default() };
    let dataset = load_dataset(raw.clone(), &options).unwrap();
    let [cut, soft] = [1, 2].map(|i| decode(&dataset.views[i].photo).unwrap());
    let mask = cut.mask.unwrap();
    // Column 16 of 32 is half opaque: it counts, in the colour of its opaque half.
    assert!((0..32).all(|x| (mask[x] == 255) == (x <= 16)));
    // Roundings to 8 bits of a colour times alpha, and of its quotient by alpha, which is 1/2 here.
    assert!(
        cut.rgb[3 * 16..][..3].iter().zip([200, 100, 50]).all(|(c, want)| c.abs_diff(want) <= 2),
        "{:?}",
        &cut.rgb[48..51]
    );
    assert!((0..32).all(|x| (soft.mask.as_ref().unwrap()[x] == 255) == (x < 16)));
    assert!(soft.rgb[..3].iter().zip([200, 100, 50]).all(|(c, want)| c.abs_diff(want) <= 1));
    let mut bent = raw;
    for view in &mut bent.views {
        view.intrinsics.lens = Lens::Radial([-0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }
    let dataset = load_dataset(bent, &LoadOptions::default()).unwrap();
    let target = decode(&dataset.views[1].photo).unwrap();
    let mask = target.mask.unwrap();
    let middle = |x: usize| 24 * 64 + x;
    assert!(mask[middle(10)] == 255 && mask[middle(50)] == 0, "the lens moves the edge by less than 10 pixels");
    assert_eq!(&target.rgb[3 * middle(10)..][..3], &[200, 100, 50]);
}

#[test]
fn masks_keep_white_and_can_be_inverted() {
    let (folder, raw) = noise_scene(4);
    let masks = folder.path().join("masks");
    std::fs::create_dir(&masks).unwrap();
    // Half the photo's size; columns 0..10 of 32 are white.
    GrayImage::from_fn(32, 24, |x, _| Luma([if x < 10 { 255 } else { 0 }])).save(masks.join("p01.png.png")).unwrap();
    GrayImage::from_pixel(64, 48, Luma([255])).save(masks.join("p02.PNG")).unwrap();
    let options = LoadOptions { data_factor: 4.0, ..LoadOptions::default() };
    let dataset = load_dataset(raw.clone(), &options).unwrap();
    assert!(has_warning(&dataset, "2 of 4 photos have no mask"));
    let mask = decode(&dataset.views[1].photo).unwrap().mask.unwrap();
    // 16 x 12 targets; 10 of 32 columns are 5 of 16.
    let want: Vec<u8> = (0..12).flat_map(|_| (0..16).map(|x| if x < 5 { 255 } else { 0 })).collect();
    assert_eq!(mask, want);
    assert_eq!(decode(&dataset.views[2].photo).unwrap().mask, None, "a mask that keeps all is none");
    let inverted = load_dataset(raw.clone(), &LoadOptions { invert_masks: true, ..options.clone() }).unwrap();
    let mask = decode(&inverted.views[1].photo).unwrap().mask.unwrap();
    assert!(mask.iter().zip(&want).all(|(a, b)| *a == 255 - *b));
    let without = load_dataset(raw.clone(), &LoadOptions { masks: false, ..options }).unwrap();
    assert!(without.views.iter().all(|v| v.photo.mask.is_none()));
    std::fs::remove_file(masks.join("p02.PNG")).unwrap();
    GrayImage::new(50, 48).save(masks.join("p02.png")).unwrap();
    assert!(refusal(&raw, &LoadOptions::default()).problem.contains("mask"));
    std::fs::write(masks.join("p02.png"), b"\x89PNG\r\n\x1a\n").unwrap();
    let error = refusal(&raw, &LoadOptions::default());
    assert!(error.problem.contains("the mask is cut short") && !error.remedy.contains("--allow-missing"), "{error}");
    let mut stated = raw.clone();
    stated.views[0].mask_path = Some(masks.join("none.png"));
    let error = refusal(&stated, &LoadOptions::default());
    assert!(error.place.contains("mask_path") && error.problem.contains("no such mask"), "{error}");
}

/// A soft checker on the plane at depth 1, 0 to 255.
fn checker(x: f64, y: f64) -> f64 {
    127.5 + 127.5 * (40.0 * x).sin() * (40.0 * y).cos()
}

/// The direction whose distorted image is (xd, yd), by Newton's method with numeric derivatives.
fn undistort_direction(lens: &Lens, xd: f64, yd: f64) -> (f64, f64) {
    let (mut x, mut y) = (xd, yd);
    for _ in 0..50 {
        let h = 1e-6;
        let (fx, fy) = distort(lens, x, y);
        let ((ax, ay), (bx, by)) = (distort(lens, x + h, y), distort(lens, x, y + h));
        let (j00, j10, j01, j11) = ((ax - fx) / h, (ay - fy) / h, (bx - fx) / h, (by - fy) / h);
        let det = j00 * j11 - j01 * j10;
        let (ex, ey) = (fx - xd, fy - yd);
        x -= (j11 * ex - j01 * ey) / det;
        y -= (j00 * ey - j10 * ex) / det;
    }
    (x, y)
}

#[test]
fn distortion_is_removed() {
    let (width, height) = (320u32, 240u32);
    let lenses = [
        Lens::Radial([-0.18, 0.06, 0.002, -0.003, 0.01, 0.02, 0.0, 0.0]),
        Lens::Radial([0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        Lens::Fisheye([0.03, -0.01, 0.002, 0.0]),
    ];
    for lens in lenses {
        let k = Intrinsics { width, height, fx: 250.0, fy: 245.0, cx: 163.0, cy: 118.0, lens };
        let folder = TempDir::new().unwrap();
        std::fs::create_dir(folder.path().join("images")).unwrap();
        let photo = GrayImage::from_fn(width, height, |i, j| {
            let (xd, yd) = ((f64::from(i) + 0.5 - k.cx) / k.fx, (f64::from(j) + 0.5 - k.cy) / k.fy);
            let (x, y) = undistort_direction(&lens, xd, yd);
            Luma([checker(x, y).round() as u8])
        });
        photo.save(folder.path().join("images/a.png")).unwrap();
        let raw = RawScene { views: vec![raw_view(folder.path(), "a.png", 0, 1, k)], ..RawScene::default() };
        for factor in [1.0, 2.0] {
            let dataset =
                load_dataset(raw.clone(), &LoadOptions { data_factor: factor, ..LoadOptions::default() }).unwrap();
            let camera = dataset.views[0].camera;
            let target = decode(&dataset.views[0].photo).unwrap();
            let (mut valid, mut worst) = (0usize, 0.0f64);
            for (pixel, rgb) in target.rgb.chunks_exact(3).enumerate() {
                if target.mask.as_ref().is_some_and(|m| m[pixel] == 0) {
                    continue;
                }
                valid += 1;
                let (i, j) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
                let x = (f64::from(i) + 0.5 - f64::from(camera.cx)) / f64::from(camera.fx);
                let y = (f64::from(j) + 0.5 - f64::from(camera.cy)) / f64::from(camera.fy);
                let (xd, yd) = distort(&lens, x, y);
                let (u, v) = (k.fx * xd + k.cx, k.fy * yd + k.cy);
                // Places within a target pixel of the photo's rim rest in part on its repeated border.
                let inner = |place: f64, size: u32| place > 3.0 && place < f64::from(size) - 3.0;
                if inner(u, width) && inner(v, height) {
                    worst = worst.max((f64::from(rgb[1]) - checker(x, y)).abs());
                }
            }
            // 40 / fx = 0.16 rad a pixel (up to 0.19 where the lens shrinks): linear interpolation misses up to
            // 0.19^2 / 8 of 127.5 on each axis (1.2 in all), rounding 1; a target pixel of two averages the sine,
            // 4 x (0.16^2 / 24 x 127.5) on each axis more.
            let limit = if factor == 1.0 { 2.5 } else { 4.0 };
            assert!(worst < limit, "{lens:?} / {factor}: {worst}");
            assert!(valid as f64 > 0.8 * camera.pixels() as f64, "{lens:?}: {valid}");
            // A lens that shrinks towards the rim has the whole ideal photo; one that stretches loses its corners.
            assert_eq!(target.mask.is_some(), lens == lenses[1], "{lens:?}");
        }
    }
}

#[test]
fn budgets_are_kept_and_change_no_bit() {
    let (_folder, raw) = noise_scene(12);
    let options = LoadOptions { data_factor: 2.0, test_every: None, ..LoadOptions::default() };
    let dataset = load_dataset(raw, &options).unwrap();
    let views = &dataset.views;
    let want: Vec<_> = views.iter().map(|v| decode(&v.photo).unwrap()).collect();
    let one_decode = views.iter().map(|v| v.photo.decode_bytes()).max().unwrap();
    let one_target = views[0].photo.target_bytes();
    let all = TargetCache::bytes_to_keep_all(views, 3);
    let mut order = Stream::new(1, Purpose::Test, 1, 1);
    let epochs: Vec<Vec<usize>> = (0..6)
        .map(|_| {
            let mut epoch: Vec<usize> = (0..views.len()).collect();
            order.shuffle(&mut epoch);
            epoch
        })
        .collect();
    for budget in [0, one_decode, one_decode + one_target, one_decode + 5 * one_target, all, 10 * all] {
        for threads in [0, 1, 3] {
            let cache = TargetCache::new(&dataset.views, budget, threads).unwrap();
            for epoch in &epochs {
                cache.prefetch(epoch);
                for &view in epoch {
                    assert_eq!(*cache.get(view).unwrap(), want[view]);
                    let stats = cache.stats();
                    assert!(stats.peak_bytes <= budget.max(one_decode), "{stats:?} of {budget}");
                }
            }
            let stats = cache.stats();
            assert_eq!(stats.hits + stats.waits, 72);
            if budget >= all {
                assert_eq!(stats.decodes, 12, "everything fits: nothing is decoded twice");
            } else if budget < one_decode + one_target {
                assert!(stats.decodes >= 12 * 6 - 6, "{stats:?}"); // only the last of an epoch may serve again
            }
        }
    }
}

#[test]
fn held_targets_count_and_are_never_evicted() {
    let (_folder, raw) = noise_scene(8);
    let dataset = load(&raw);
    let views = &dataset.views;
    let one_decode = views[0].photo.decode_bytes();
    let one_target = views[0].photo.target_bytes();
    let cache = TargetCache::new(&dataset.views, one_decode + one_target, 2).unwrap();
    let first = cache.get(0).unwrap();
    let second = cache.get(1).unwrap();
    let third = cache.get(2).unwrap();
    assert!(Arc::ptr_eq(&first, &cache.get(0).unwrap()), "still the same allocation");
    // Two held, one decoded past the budget: the documented least.
    assert_eq!(cache.stats().peak_bytes, one_decode + 2 * one_target);
    assert_eq!(cache.stats().bytes, 3 * one_target);
    drop((first, second, third));
    let _fourth = cache.get(3).unwrap();
    assert!(cache.stats().bytes <= one_decode + one_target);
}

#[test]
fn several_callers_share_a_small_cache() {
    let (_folder, raw) = noise_scene(10);
    let dataset = load(&raw);
    let views = &dataset.views;
    let want: Vec<_> = views.iter().map(|v| decode(&v.photo).unwrap()).collect();
    for threads in [0, 2] {
        let cache = TargetCache::new(&dataset.views, 1, threads).unwrap();
        std::thread::scope(|scope| {
            for key in 0..3 {
                let (cache, want) = (&cache, &want);
                scope.spawn(move || {
                    let mut s = Stream::new(2, Purpose::Test, key, 0);
                    for _ in 0..60 {
                        let view = s.below(10) as usize;
                        if s.below(4) == 0 {
                            cache.prefetch(&[s.below(10) as usize, view, s.below(10) as usize]);
                        }
                        assert_eq!(*cache.get(view).unwrap(), want[view]);
                    }
                });
            }
        });
    }
}

#[test]
fn a_photo_that_breaks_after_load_is_an_error_of_its_view_alone() {
    let (_folder, raw) = noise_scene(3);
    let dataset = load(&raw);
    let views = &dataset.views;
    let path = &views[1].photo.image_path;
    let bytes = std::fs::read(path).unwrap();
    std::fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    noise_photo(20, 20, 1).save(&views[2].photo.image_path).unwrap();
    let cache = TargetCache::new(&dataset.views, 1 << 20, 1).unwrap();
    cache.prefetch(&[0, 1, 2]);
    assert!(cache.get(0).is_ok());
    assert_eq!(&cache.get(1).unwrap_err().file, path);
    assert_eq!(&cache.get(1).unwrap_err().file, path);
    assert!(cache.get(2).unwrap_err().problem.contains("20 x 20"));
    assert!(cache.get(0).is_ok());
}

/// The end of another photo's download: zeros to the full length. (Other cuts: `photo_header`.)
#[test]
fn a_photo_that_ends_in_zeros_is_refused_at_load() {
    let (_folder, mut raw) = noise_scene(3);
    let path = raw.views[1].image_path.with_extension("jpg");
    noise_photo(SIZE.0, SIZE.1, 9).save(&path).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..].fill(0);
    std::fs::write(&path, bytes).unwrap();
    raw.views[1].image_path = path.clone();
    let error = refusal(&raw, &LoadOptions::default());
    assert!(error.file == path && error.problem.contains("cut short") && error.remedy.contains("again"), "{error}");
}

#[test]
fn a_real_scene_fits_its_frame() {
    let Some(folder) = real_scene("brighton") else { return };
    let raw = read_scene(&folder, &ReadOptions::default()).unwrap();
    let world: Vec<DVec3> = raw.points.positions.iter().map(|&p| DVec3::from_array(p)).collect();
    let poses: Vec<(Pose, Intrinsics)> = raw.views.iter().map(|v| (v.pose, v.intrinsics)).collect();
    let dataset = load_dataset(raw, &LoadOptions { data_factor: 2.0, ..LoadOptions::default() }).unwrap();
    assert_eq!(dataset.warnings, Vec::<String>::new());
    assert_eq!((dataset.views.len(), dataset.points.len()), (18, 7395));
    assert_eq!(dataset.test_views(), [0, 8, 16]);
    // Half of the cameras are within one unit; the farthest of a flight is a few units away.
    assert!((1.1..4.0).contains(&dataset.scene_scale), "{}", dataset.scene_scale);
    for (view, (pose, k)) in dataset.views.iter().zip(&poses) {
        let (m, camera) = (&view.camera.viewmat, &view.camera);
        assert_eq!((camera.width, camera.height), (600, 337));
        let mut inside = 0;
        for (point, world) in dataset.points.iter().zip(&world) {
            let at = |i: usize| m[i][0] * point[0] + m[i][1] * point[1] + m[i][2] * point[2] + m[i][3];
            let (x, y) = (camera.fx * at(0) / at(2) + camera.cx, camera.fy * at(1) / at(2) + camera.cy);
            let p = pose.rotation * *world + pose.translation;
            let want = [(k.fx * p.x / p.z + k.cx) / 2.0, (k.fy * p.y / p.z + k.cy) / 2.0];
            if p.z > 0.0 && (0.0..600.0).contains(&want[0]) && (0.0..337.0).contains(&want[1]) {
                inside += 1;
                // f32 along the way: 600 pixels x 1e-7 x a few operations with cancellation.
                assert!(
                    (f64::from(x) - want[0]).abs() < 2e-3 && (f64::from(y) - want[1]).abs() < 2e-3,
                    "{x} {y} {want:?}"
                );
            }
        }
        assert!(inside > 300, "{}: {inside} points in the photo", view.name);
    }
}
