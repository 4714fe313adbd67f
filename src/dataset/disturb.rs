//! Disturbed scenes: what real captures suffer from, written as ordinary COLMAP scenes, to measure what it costs.
//!
//! Photos are written as training sees them (undistorted, at training size, with their masks), training photos before
//! held-out ones by name: `--test-after` with [`DisturbedPlan::test_after`] gives the same split. Only what training sees is
//! disturbed (photos, poses, points); held-out photos and their poses stay as they are.
//!
//! Invariants: 1. the same scene, disturbance and seed give the same bytes for any number of threads; 2. without a
//! disturbance, pixels are those of the scene; 3. `sparse/` appears last, so that the folder of an interrupted call cannot be
//! read as a scene.

use super::colmap_write::{ColmapModel, ModelImage, Point, make_folder, write_model};
use super::loader::{Dataset, View};
use super::model::{Intrinsics, Lens, Pose, Split};
use super::photo::decode;
use crate::base::error::{InputError, InputResult};
use crate::base::rng::{Purpose, Stream};
use crate::base::whole_file::write_whole;
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use glam::{DMat3, DVec3};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, RgbImage};
use rayon::prelude::*;
use serde::Deserialize;
use std::path::Path;

/// What is wrong with a scene.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case", rename_all_fields = "kebab-case")]
pub enum Disturbance {
    Nothing,
    /// Pixel values of each photo times 2^dt, dt uniform within so many stops.
    Exposure {
        stops: f64,
    },
    /// Red times 2^t and blue times 2^-t, t uniform within so many stops.
    WhiteBalance {
        stops: f64,
    },
    /// This share of the photos have changed places in pairs that share less than half of what they see.
    Swapped {
        share: f64,
        /// Whether these photos are missing instead, as if a user had found them.
        are_removed: bool,
    },
    /// Normal noise on the places of cameras, along each axis; its standard deviation is a share of the scene's size.
    PoseNoise {
        share: f64,
    },
    /// Photos compressed as JPEG, with a quality of 1 to 100.
    Jpeg {
        quality: u8,
    },
    /// Grey boxes at random places of each photo.
    Boxes {
        count: u32,
        /// Whether masks exclude them, as a user could by hand.
        are_masked: bool,
    },
    /// One photo in so many, at least 1; so it is with points.
    FewPhotos {
        one_in: u32,
    },
    FewPoints {
        one_in: u32,
    },
    /// As many points, at random places of their box, of random colours.
    RandomPoints,
    /// Exposures, photos that have changed places and grey boxes at once, as above.
    Together {
        stops: f64,
        share: f64,
        boxes: u32,
    },
    /// One photo in so many, at least 1, is blurred by a normal distribution of a hundredth of its width.
    Blurred {
        one_in: u32,
    },
}

/// A disturbed scene that is not written yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DisturbedPlan {
    /// Views with a greater index, by name, are held out: the value of `--test-after`.
    pub test_after: u32,
    /// Names of the training photos that are wrong: swapped or blurred.
    pub wrong: Vec<String>,
}

/// Points by which it is judged what views share, about.
const POINTS: usize = 2000;
/// Most of what one of two views sees that the other may see, for their photos to change places.
const SHARED_MOST: f64 = 0.5;

/// Sides of a box, as shares of the longer side of the photo.
const BOX_SIDES: [f64; 2] = [0.04, 0.12];
/// Value of the boxes.
const GREY: u8 = 128;
/// Standard deviation of a blur, as a share of the width of the photo.
const BLUR: f32 = 0.01;

/// First letters of the names of photos.
const TRAIN: char = 'a';
const HELD_OUT: char = 'b';

/// Kinds of draws, part of their keys.
#[derive(Debug, Clone, Copy)]
enum DrawKind {
    Photo = 1,
    Pose = 2,
    Swaps = 3,
    Point = 4,
    Chosen = 5,
}

/// The draws of one photo or point.
fn stream(seed: u64, draw: DrawKind, number: usize) -> Stream {
    Stream::new(seed, Purpose::Disturb, draw as u64, number as u64)
}

/// Whether this photo or point is one in `one_in`. Draws, so that no pattern of a flight decides.
fn is_chosen(seed: u64, number: usize, one_in: u32) -> bool {
    stream(seed, DrawKind::Chosen, number).below(u64::from(one_in.max(1))) == 0
}

struct TrainView<'a> {
    /// The view whose pose it has.
    view: &'a View,
    /// The view whose photo it shows.
    shown: &'a View,
    pose: Pose,
    /// Number among the training views of the undisturbed scene.
    number: usize,
}

/// The training photos of a disturbed scene.
/// Errors: nothing is left to train on.
pub fn plan(dataset: &Dataset, disturbance: &Disturbance, seed: u64) -> InputResult<DisturbedPlan> {
    let train = views_to_train_on(dataset, disturbance, seed)?;
    let is_wrong = |t: &&TrainView<'_>| {
        let is_blurred = matches!(disturbance, Disturbance::Blurred { one_in } if is_chosen(seed, t.number, *one_in));
        is_blurred || !std::ptr::eq(t.view, t.shown)
    };
    let wrong = train.iter().filter(is_wrong).map(|t| photo_name(TRAIN, t.number, disturbance)).collect();
    Ok(DisturbedPlan { test_after: train.len() as u32 - 1, wrong })
}

/// The training views with the photos and poses that the disturbance gives them.
/// Errors: as [`plan`].
fn views_to_train_on<'a>(
    dataset: &'a Dataset,
    disturbance: &Disturbance,
    seed: u64,
) -> InputResult<Vec<TrainView<'a>>> {
    let train = train_views(dataset, disturbance, seed);
    if train.is_empty() || dataset.points.is_empty() {
        let problem = "the disturbance leaves no photo to train on, or the scene has no points";
        return Err(InputError::new(
            &dataset.image_folder,
            problem,
            "disturb a scene with more photos and with points",
        ));
    }
    Ok(train)
}

/// Writes the scene of `dataset` to `folder`, which must be new, with a disturbance.
/// Errors: as [`plan`]; the folder exists, a photo cannot be decoded, or a file cannot be written.
pub fn write_disturbed(folder: &Path, dataset: &Dataset, disturbance: &Disturbance, seed: u64) -> InputResult<()> {
    if folder.exists() {
        return Err(InputError::new(folder, "the folder exists", "choose another folder"));
    }
    let train = views_to_train_on(dataset, disturbance, seed)?;
    let held_out: Vec<&View> = dataset.views.iter().filter(|view| view.split == Split::Test).collect();
    make_folder(&folder.join("images"))?;
    let of_train = train.par_iter().map(|t| {
        let photo = disturbed(decode(&t.shown.photo)?, disturbance, seed, t.number)?;
        let name = photo_name(TRAIN, t.number, disturbance);
        write_photo(folder, &name, &photo).map(|()| (name, t.pose))
    });
    let of_held_out = held_out.par_iter().enumerate().map(|(number, view)| {
        let photo = disturbed(decode(&view.photo)?, &Disturbance::Nothing, seed, number)?;
        let name = photo_name(HELD_OUT, number, &Disturbance::Nothing);
        write_photo(folder, &name, &photo).map(|()| (name, pose_of(&view.camera)))
    });
    let named: Vec<(String, Pose)> = of_train.chain(of_held_out).collect::<InputResult<_>>()?;
    let (cameras, groups) = cameras(train.iter().map(|t| t.view).chain(held_out));
    let image = |((name, pose), camera)| ModelImage { name, pose, camera };
    let images = named.into_iter().zip(groups).map(image).collect();
    let points = points(dataset, disturbance, seed);
    write_model(&folder.join("sparse"), &ColmapModel { cameras, images, points, tiles: vec![[0.0; 3]] })
}

/// Whether [`write_disturbed`] makes a file of this path in its folder, whole or in part.
pub fn is_of_disturbed(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let whole = name.strip_prefix('.').and_then(|name| name.strip_suffix(".part")).unwrap_or(name);
    let number = whole.strip_suffix(".png").or_else(|| whole.strip_suffix(".jpg")).unwrap_or_default();
    let number = number.strip_prefix([TRAIN, HELD_OUT]).and_then(|number| number.strip_prefix('_'));
    let is_photo = number.is_some_and(|number| number.len() >= 6 && number.bytes().all(|digit| digit.is_ascii_digit()));
    match path.parent() {
        Some(folder) if folder == Path::new("images") || folder == Path::new("masks") => is_photo,
        Some(folder) if folder == Path::new("sparse/0") || folder == Path::new("sparse.partial/0") => {
            ["cameras.bin", "images.bin", "points3D.bin"].contains(&whole)
        }
        _ => false,
    }
}

/// Name of a photo; those of a set are in the order of their numbers.
fn photo_name(set: char, number: usize, disturbance: &Disturbance) -> String {
    let extension = if matches!(disturbance, Disturbance::Jpeg { .. }) { "jpg" } else { "png" };
    format!("{set}_{number:06}.{extension}")
}

/// As [`views_to_train_on`]; may be empty.
fn train_views<'a>(dataset: &'a Dataset, disturbance: &Disturbance, seed: u64) -> Vec<TrainView<'a>> {
    let views: Vec<&View> = dataset.views.iter().filter(|view| view.split == Split::Train).collect();
    let shown = match disturbance {
        Disturbance::Swapped { share, .. } | Disturbance::Together { share, .. } => {
            swapped(dataset, &views, *share, seed)
        }
        _ => (0..views.len()).collect(),
    };
    let noise = match disturbance {
        Disturbance::PoseNoise { share } => share * f64::from(dataset.scene_scale),
        _ => 0.0,
    };
    let is_kept = |number: usize| match disturbance {
        Disturbance::FewPhotos { one_in } => is_chosen(seed, number, *one_in),
        Disturbance::Swapped { are_removed: true, .. } => shown[number] == number,
        _ => true,
    };
    let of_number = |number: usize| TrainView {
        view: views[number],
        shown: views[shown[number]],
        pose: {
            let pose = pose_of(&views[number].camera);
            let mut draws = stream(seed, DrawKind::Pose, number);
            let by = DVec3::from(std::array::from_fn::<f64, 3, _>(|_| noise * draws.normal()));
            Pose { translation: pose.translation - pose.rotation * by, ..pose }
        },
        number,
    };
    (0..views.len()).filter(|&number| is_kept(number)).map(of_number).collect()
}

/// For each view the view whose photo it shows: `share` of them have changed places in pairs, one pair at least. A pair
/// shares less than half of what either sees; a view without such a partner stays.
fn swapped(dataset: &Dataset, views: &[&View], share: f64, seed: u64) -> Vec<usize> {
    let stride = dataset.points.len().div_ceil(POINTS).max(1);
    let points: Vec<[f32; 3]> = dataset.points.iter().copied().step_by(stride).collect();
    let seen: Vec<Vec<bool>> =
        views.iter().map(|view| points.iter().map(|point| sees(&view.camera, *point)).collect()).collect();
    let is_far = |a: usize, b: usize| {
        let count = |of: &dyn Fn(usize) -> bool| (0..points.len()).filter(|&i| of(i)).count() as f64;
        let both = count(&|i| seen[a][i] && seen[b][i]);
        both < SHARED_MOST * count(&|i| seen[a][i]).min(count(&|i| seen[b][i]))
    };
    let mut order: Vec<usize> = (0..views.len()).collect();
    stream(seed, DrawKind::Swaps, 0).shuffle(&mut order);
    let mut shown: Vec<usize> = (0..views.len()).collect();
    let mut pairs = (share * views.len() as f64 / 2.0).ceil() as usize;
    for &a in &order {
        // Photos of one size, so that the photo fits its camera.
        let fits = |&b: &usize| {
            let size = |view: usize| (views[view].camera.width, views[view].camera.height);
            b != a && shown[b] == b && size(a) == size(b) && is_far(a, b)
        };
        if pairs == 0 || shown[a] != a {
            continue;
        }
        if let Some(b) = order.iter().copied().find(fits) {
            shown.swap(a, b);
            pairs -= 1;
        }
    }
    shown
}

/// Whether a point lies in the picture of a camera.
fn sees(camera: &Camera, point: [f32; 3]) -> bool {
    let [x, y, z] = camera.viewmat.map(|row| row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);
    let (u, v) = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy);
    z > camera.near_plane && (0.0..camera.width as f32).contains(&u) && (0.0..camera.height as f32).contains(&v)
}

/// World to camera, in the local frame of the dataset.
fn pose_of(camera: &Camera) -> Pose {
    let [x, y, z] = camera.viewmat.map(|row| DVec3::new(row[0].into(), row[1].into(), row[2].into()));
    let translation = camera.viewmat.map(|row| f64::from(row[3]));
    Pose { rotation: DMat3::from_cols(x, y, z).transpose(), translation: DVec3::from(translation) }
}

/// The distinct intrinsics, and for each view the index of its own.
fn cameras<'a>(views: impl Iterator<Item = &'a View>) -> (Vec<Intrinsics>, Vec<u32>) {
    let (mut cameras, mut groups) = (Vec::<Intrinsics>::new(), Vec::new());
    for Camera { fx, fy, cx, cy, width, height, .. } in views.map(|view| view.camera) {
        let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(f64::from);
        let own = Intrinsics { width, height, fx, fy, cx, cy, lens: Lens::Pinhole };
        let known = cameras.iter().position(|k| *k == own);
        groups.push(known.unwrap_or(cameras.len()) as u32);
        if known.is_none() {
            cameras.push(own);
        }
    }
    (cameras, groups)
}

/// Writes a photo and its mask.
fn write_photo(folder: &Path, name: &str, photo: &EncodedPhoto) -> InputResult<()> {
    write_whole(&folder.join("images").join(name), &photo.bytes)?;
    let Some(mask) = &photo.mask else { return Ok(()) };
    make_folder(&folder.join("masks"))?;
    write_whole(&folder.join("masks").join(name).with_extension("png"), mask)
}

fn points(dataset: &Dataset, disturbance: &Disturbance, seed: u64) -> Vec<Point> {
    let of = |position: [f32; 3], rgb: [u8; 3]| Point {
        position: position.map(f64::from),
        rgb,
        error: 0.5,
        observations: Vec::new(),
    };
    let all = dataset.points.iter().copied().zip(dataset.colors.iter().copied());
    match disturbance {
        Disturbance::FewPoints { one_in } => {
            let chosen = all.enumerate().filter(|(number, _)| is_chosen(seed, *number, *one_in));
            chosen.map(|(_, (position, rgb))| of(position, rgb)).collect()
        }
        Disturbance::RandomPoints => {
            let low: [f32; 3] = std::array::from_fn(|i| quantile(dataset, i, 0.01));
            let high: [f32; 3] = std::array::from_fn(|i| quantile(dataset, i, 0.99));
            let drawn = |number: usize| {
                let mut draws = stream(seed, DrawKind::Point, number);
                let position = std::array::from_fn(|i| draws.range(low[i].into(), high[i].into()) as f32);
                of(position, std::array::from_fn(|_| draws.below(256) as u8))
            };
            (0..dataset.points.len()).map(drawn).collect()
        }
        _ => all.map(|(position, rgb)| of(position, rgb)).collect(),
    }
}

/// A quantile of a coordinate of the points.
fn quantile(dataset: &Dataset, axis: usize, share: f64) -> f32 {
    let mut values: Vec<f32> = dataset.points.iter().map(|point| point[axis]).collect();
    let at = ((values.len() - 1) as f64 * share) as usize;
    *values.select_nth_unstable_by(at, f32::total_cmp).1
}

/// A photo as the bytes of its file.
struct EncodedPhoto {
    pub bytes: Vec<u8>,
    /// The mask as a PNG.
    pub mask: Option<Vec<u8>>,
}

/// The photo of training view `number`, disturbed.
fn disturbed(mut photo: Target, disturbance: &Disturbance, seed: u64, number: usize) -> InputResult<EncodedPhoto> {
    let mut draws = stream(seed, DrawKind::Photo, number);
    match *disturbance {
        Disturbance::Exposure { stops } => {
            let gain = libm::exp2(draws.range(-stops, stops));
            scale(&mut photo, [gain; 3]);
        }
        Disturbance::Together { stops, boxes, .. } => {
            let gain = libm::exp2(draws.range(-stops, stops));
            scale(&mut photo, [gain; 3]);
            (0..boxes).for_each(|_| add_box(&mut photo, false, &mut draws));
        }
        Disturbance::WhiteBalance { stops } => {
            let gain = libm::exp2(draws.range(-stops, stops));
            scale(&mut photo, [gain, 1.0, 1.0 / gain]);
        }
        Disturbance::Boxes { count, are_masked } => {
            (0..count).for_each(|_| add_box(&mut photo, are_masked, &mut draws))
        }
        Disturbance::Blurred { one_in } if is_chosen(seed, number, one_in) => blur(&mut photo),
        _ => {}
    }
    let bytes = match *disturbance {
        Disturbance::Jpeg { quality } => {
            let mut bytes = Vec::new();
            JpegEncoder::new_with_quality(&mut bytes, quality)
                .encode(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)
                .map_err(|e| not_encoded(&e))?;
            bytes
        }
        _ => png(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)?,
    };
    let mask =
        photo.mask.as_ref().map(|mask| png(mask, photo.width, photo.height, ExtendedColorType::L8)).transpose()?;
    Ok(EncodedPhoto { bytes, mask })
}

/// Multiplies the channels, and clamps.
fn scale(photo: &mut Target, gains: [f64; 3]) {
    for (i, byte) in photo.rgb.iter_mut().enumerate() {
        *byte = (f64::from(*byte) * gains[i % 3]).round().min(255.0) as u8;
    }
}

/// Paints one box, cut at the border of the photo.
fn add_box(photo: &mut Target, is_masked: bool, draws: &mut Stream) {
    let (width, height) = (photo.width as usize, photo.height as usize);
    let longest = width.max(height) as f64;
    let [wide, high] = [0, 1].map(|_| (draws.range(BOX_SIDES[0], BOX_SIDES[1]) * longest).max(1.0) as usize);
    let [x, y] = [width, height].map(|side| draws.below(side as u64) as usize);
    if is_masked {
        photo.mask.get_or_insert_with(|| vec![255; width * height]);
    }
    for row in y..height.min(y + high) {
        let pixels = row * width + x..row * width + width.min(x + wide);
        photo.rgb[3 * pixels.start..3 * pixels.end].fill(GREY);
        if let Some(mask) = photo.mask.as_mut().filter(|_| is_masked) {
            mask[pixels].fill(0);
        }
    }
}

fn blur(photo: &mut Target) {
    let rgb = std::mem::take(&mut photo.rgb);
    // Photo and size belong together, so there is a picture.
    if let Some(picture) = RgbImage::from_raw(photo.width, photo.height, rgb) {
        photo.rgb = image::imageops::blur(&picture, (BLUR * photo.width as f32).max(0.5)).into_raw();
    }
}

fn png(pixels: &[u8], width: u32, height: u32, color: ExtendedColorType) -> InputResult<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(pixels, width, height, color).map_err(|e| not_encoded(&e))?;
    Ok(bytes)
}

fn not_encoded(e: &image::ImageError) -> InputError {
    InputError::new("a photo", format!("compressing failed: {e}"), "choose smaller photos with --max-resolution")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo() -> Target {
        let rgb = (0..3 * 40 * 30).map(|i| (i * 7 % 200) as u8).collect();
        Target::new([40, 30], rgb)
    }

    fn read(encoded: &EncodedPhoto) -> Vec<u8> {
        image::load_from_memory(&encoded.bytes).unwrap().to_rgb8().into_raw()
    }

    #[test]
    fn boxes_are_grey_and_masked_where_asked_and_white_balance_keeps_green() {
        let of = |are_masked| disturbed(photo(), &Disturbance::Boxes { count: 5, are_masked }, 3, 5).unwrap();
        let (plain, masked) = (of(false), of(true));
        assert!(plain.mask.is_none() && read(&plain) == read(&masked));
        let mask = image::load_from_memory(&masked.mask.clone().unwrap()).unwrap().to_luma8().into_raw();
        let changed = |i: usize| read(&plain)[3 * i..3 * i + 3] != photo().rgb[3 * i..3 * i + 3];
        assert!((0..mask.len()).all(|i| !changed(i) || mask[i] == 0), "what is painted is masked");
        let balanced = read(&disturbed(photo(), &Disturbance::WhiteBalance { stops: 0.5 }, 3, 5).unwrap());
        assert!(balanced.iter().zip(&photo().rgb).skip(1).step_by(3).all(|(a, b)| a == b), "green stays");
        let boxes = mask.iter().filter(|&&byte| byte == 0).count();
        assert!((5..600).contains(&boxes), "{boxes} pixels");
    }
}
