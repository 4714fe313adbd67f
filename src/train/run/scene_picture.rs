//! Pictures for a page that shows a scene ([`crate::report::live`]): from an orbit, or a training photo beside what the scene shows there.
//!
//! Invariants: 1. nothing is stored, and no bit of the scene changes; 2. memory is bounded: a picture that would take too much is an error.

use crate::base::error::{InputError, InputResult};
use crate::base::png_rows::write_rgb_rows;
use crate::base::units::format_bytes;
use crate::dataset::loader::Dataset;
use crate::dataset::resize::{AreaResizer, Size};
use crate::dataset::target_cache::TargetCache;
use crate::report::live::{Orbit, Picture, PictureKind};
use crate::scene::camera::Camera;
use crate::scene::image::{Image, Target};
use crate::train::error::TrainError;
use crate::train::state::trainer::Trainer;
use crate::train::step::pages::PagedScene;
use crate::train::step::view::{draw, draw_depth};
use glam::{Mat3, Vec3};

/// The renderer may take this part of the budget for the rows of a picture, or as much as for a training view so far.
const PICTURE_SHARE: u64 = 8;
/// A difference of a quarter is white.
const DIFFERENCE_FACTOR: f32 = 4.0;
/// Pixels to each side over which [`PictureKind::Error`] takes its mean, and its colours, evenly from 0 to 1.
const HEAT_RADIUS: usize = 4;
const HEAT: [[f32; 3]; 5] = [[0.0; 3], [0.1, 0.1, 0.7], [0.85, 0.15, 0.1], [1.0, 0.85, 0.1], [1.0; 3]];
/// Most views that are looked at for an overview.
const OVERVIEWS_MOST: usize = 64;

/// What an orbit shows of the scene after the last step, as PNG, at most as wide as the orbit asks and as the training photo.
pub(super) fn picture(trainer: &mut Trainer, dataset: &Dataset, targets: &TargetCache, orbit: Orbit) -> Picture {
    let drawn = draw_orbit(trainer, dataset, targets, orbit);
    let image = drawn.map_err(|error| format!("the picture cannot be drawn: {error}"))?;
    png(&image).map_err(|error| format!("the picture cannot be written: {error}"))
}

fn draw_orbit(
    trainer: &mut Trainer,
    dataset: &Dataset,
    targets: &TargetCache,
    orbit: Orbit,
) -> Result<Image, TrainError> {
    trainer.drain()?;
    let views = dataset.train_views();
    let view = views[orbit.view as usize % views.len().max(1)];
    let base = dataset.views[view].camera;
    let narrow = narrowed(&base, orbit.width);
    let photo = match orbit.show {
        PictureKind::Photo | PictureKind::Difference | PictureKind::Error => {
            let photo = targets.get(view)?;
            Some(resized(&photo, (narrow.width, narrow.height)))
        }
        PictureKind::Scene | PictureKind::Depth => None,
    };
    if let (PictureKind::Photo, Some(photo)) = (orbit.show, &photo) {
        let mut image = Image::new(photo.width, photo.height);
        each_value(&mut image, photo, |_, byte| f32::from(byte) / 255.0);
        return Ok(image);
    }
    let pivot = median_depth(&trainer.scene, &base).unwrap_or(dataset.scene_scale);
    let camera = if photo.is_some() { narrow } else { orbit_camera(&base, pivot, trainer.options.up, orbit) };
    check_picture(trainer, &camera)?;
    trainer.run_memory().fit_frames_to_picture(&camera);
    let render = trainer.render_options();
    match orbit.show {
        PictureKind::Depth => draw_depth(&mut trainer.now(), &camera, &render, pivot * orbit.distance)?,
        _ => draw(&mut trainer.now(), &camera, &render)?,
    }
    let mut image = trainer.renderer.image()?.clone();
    if let Some(photo) = photo {
        each_value(&mut image, &photo, |value, byte| {
            DIFFERENCE_FACTOR * (value.clamp(0.0, 1.0) - f32::from(byte) / 255.0).abs()
        });
        if orbit.show == PictureKind::Error {
            heat(&mut image);
        }
    }
    Ok(image)
}

/// Replaces each pixel by a colour of [`HEAT`], for the root of the mean of the values in a square of [`HEAT_RADIUS`] around it: errors
/// of good pictures are small.
fn heat(image: &mut Image) {
    let (width, height) = (image.width as usize, image.height as usize);
    let span = |at: usize, size: usize| at.saturating_sub(HEAT_RADIUS)..(at + HEAT_RADIUS + 1).min(size);
    let of_pixel = |at: usize| (0..3).map(|plane| image.rgb[plane * width * height + at].min(1.0)).sum::<f32>() / 3.0;
    let values: Vec<f32> = (0..width * height).map(of_pixel).collect();
    for y in 0..height {
        let rows = span(y, height);
        let sums: Vec<f32> = (0..width).map(|x| rows.clone().map(|row| values[row * width + x]).sum::<f32>()).collect();
        for x in 0..width {
            let columns = span(x, width);
            let count = (columns.len() * rows.len()) as f32;
            let place = (sums[columns].iter().sum::<f32>() / count).max(0.0).sqrt() * (HEAT.len() - 1) as f32;
            let below = (place as usize).min(HEAT.len() - 2);
            let share = (place - below as f32).clamp(0.0, 1.0);
            for plane in 0..3 {
                let [from, to] = [HEAT[below][plane], HEAT[below + 1][plane]];
                image.rgb[(plane * height + y) * width + x] = from + share * (to - from);
            }
        }
    }
}

/// Replaces each value of an image by one that follows from it and from the value of a photo of the same size.
fn each_value(image: &mut Image, photo: &Target, value: impl Fn(f32, u8) -> f32) {
    let pixels = photo.pixels();
    for (plane, values) in image.rgb.chunks_mut(pixels.max(1)).enumerate() {
        let bytes = photo.rgb.iter().skip(plane).step_by(3);
        values.iter_mut().zip(bytes).for_each(|(out, byte)| *out = value(*out, *byte));
    }
}

/// The training view that sees the most pages, by its number among the training views: of [`OVERVIEWS_MOST`] that are spread evenly.
pub(super) fn overview(scene: &PagedScene, dataset: &Dataset) -> u32 {
    let views = dataset.train_views();
    let numbers = (0..views.len()).step_by(views.len().div_ceil(OVERVIEWS_MOST).max(1));
    let seen = |number: &usize| scene.pager.pages_of_view(&dataset.views[views[*number]].camera).len();
    // The first of equals.
    numbers.rev().max_by_key(seen).unwrap_or(0) as u32
}

/// Refuses a picture for which the renderer would need too much memory ([`PICTURE_SHARE`]). Batches bound the memory of gathered rows,
/// not that of the splats, which the renderer keeps for every visible row.
/// Errors: the camera may see too many Gaussians.
fn check_picture(trainer: &Trainer, camera: &Camera) -> InputResult<()> {
    let Some(budget) = trainer.memory.budget.filter(|_| !trainer.scene.is_in_memory()) else { return Ok(()) };
    let pager = &trainer.scene.pager;
    let rows = pager.rows_of(&pager.pages_of_view(camera));
    let needed = trainer.renderer.host_bytes_for_rows(rows);
    if needed <= trainer.renderer.host_bytes_of_rows().max(budget.bytes / PICTURE_SHARE) {
        return Ok(());
    }
    let problem = format!("{rows} Gaussians may be in view, which takes {} of memory", format_bytes(needed));
    Err(InputError::new("--serve", problem, "move nearer"))
}

/// Median depth of the pages that a camera sees, local units; `None` if no page is in front of the camera.
fn median_depth(scene: &PagedScene, camera: &Camera) -> Option<f32> {
    let index = scene.pager.index();
    let [_, _, axis] = camera.viewmat;
    let depth = |centre: [f32; 3]| axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2] + axis[3];
    let pages = scene.pager.pages_of_view(camera);
    let mut depths: Vec<f32> = pages.iter().map(|page| depth(index[page.index()].bounds.centre())).collect();
    depths.retain(|depth| depth.is_finite() && *depth > camera.near_plane);
    depths.sort_unstable_by(f32::total_cmp);
    depths.get(depths.len() / 2).copied()
}

/// The camera of an orbit around the point `pivot`, which lies in front of `base`. `up` is the direction that points up, if it is known.
fn orbit_camera(base: &Camera, pivot: f32, up: Option<[f64; 3]>, orbit: Orbit) -> Camera {
    let row = |i: usize| Vec3::new(base.viewmat[i][0], base.viewmat[i][1], base.viewmat[i][2]);
    let (right, down, forward) = (row(0), row(1), row(2));
    let up = up.map_or(-down, |up| Vec3::from(up.map(|x| x as f32)));
    let up = up.try_normalize().unwrap_or(-down);
    let turn =
        Mat3::from_axis_angle(up, orbit.turn.to_radians()) * Mat3::from_axis_angle(right, orbit.tilt.to_radians());
    // Shifts are level, also those of a camera that looks down.
    let aside = (right - right.dot(up) * up).try_normalize().unwrap_or(right);
    let ahead = up.cross(aside);
    let centre = Vec3::from(base.centre());
    let pivot_point = centre + pivot * (forward + orbit.aside * aside + orbit.ahead * ahead);
    let centre = pivot_point - orbit.distance * pivot * (turn * forward);
    let axes = [right, down, forward].map(|axis| turn * axis);
    let viewmat = axes.map(|axis| [axis.x, axis.y, axis.z, -axis.dot(centre)]);
    Camera { viewmat, ..narrowed(base, orbit.width) }
}

/// The camera with a picture of at most `width` pixels across.
fn narrowed(camera: &Camera, width: u32) -> Camera {
    let scale = (width as f32 / camera.width as f32).min(1.0);
    let side = |pixels: u32| ((pixels as f32 * scale).round() as u32).max(1);
    Camera {
        fx: camera.fx * scale,
        fy: camera.fy * scale,
        cx: camera.cx * scale,
        cy: camera.cy * scale,
        width: side(camera.width),
        height: side(camera.height),
        ..*camera
    }
}

/// The photo with fewer pixels, without its mask.
fn resized(photo: &Target, size: Size) -> Target {
    let mut resizer = AreaResizer::new(3, (photo.width, photo.height), size, 1);
    photo.rgb.chunks_exact(3 * photo.width as usize).for_each(|row| resizer.push_row(row));
    Target::new([size.0, size.1], resizer.finish())
}

fn png(image: &Image) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    write_rgb_rows(&mut bytes, [image.width, image.height], |y, row| image.row_to_rgb8(y, row))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn base() -> Camera {
        let viewmat = [[1.0, 0.0, 0.0, -3.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, -1.0]];
        Camera::pinhole(viewmat, [90.0, 80.0, 60.0, 40.0], [120, 80])
    }

    /// Coordinates of a world point before the camera.
    fn seen(camera: &Camera, point: [f32; 3]) -> [f32; 3] {
        camera.viewmat.map(|row| row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3])
    }

    #[test]
    fn heat_is_the_root_of_the_mean_around_a_pixel() {
        let side = 4 * HEAT_RADIUS + 1;
        let (pixels, middle) = (side * side, side * side / 2);
        let mut image = Image::new(side as u32, side as u32);
        (0..3).for_each(|plane| image.rgb[plane * pixels + middle] = 1.0);
        heat(&mut image);
        // One of 81 values is 1: a ninth of four colours lies between the first two.
        let share = 4.0 / (2 * HEAT_RADIUS + 1) as f32;
        for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
            let is_near = [y, x].iter().all(|at| at.abs_diff(2 * HEAT_RADIUS) <= HEAT_RADIUS);
            for plane in 0..3 {
                let want = if is_near { share * HEAT[1][plane] } else { 0.0 };
                // Rounding of a root and two products.
                assert!((image.rgb[(plane * side + y) * side + x] - want).abs() < 1e-6, "{y} {x}");
            }
        }
    }

    #[test]
    fn an_orbit_at_rest_is_the_view_and_the_pivot_stays_before_every_other() {
        let still = Orbit { width: 120, ..Orbit::default() };
        let at_rest = orbit_camera(&base(), 4.0, None, still);
        for (row, of_base) in at_rest.viewmat.iter().zip(&base().viewmat) {
            // Rounding of sums of a few numbers below 10.
            assert!(row.iter().zip(of_base).all(|(a, b)| (a - b).abs() < 1e-5), "{at_rest:?}");
        }
        let pivot = [3.0, -2.0, 5.0];
        for (turn, tilt, distance) in [(90.0, 0.0, 1.0), (10.0, 70.0, 0.5), (-200.0, -30.0, 3.0)] {
            let orbit = Orbit { turn, tilt, distance, width: 60, ..still };
            let camera = orbit_camera(&base(), 4.0, Some([0.0, -1.0, 0.0]), orbit);
            let [x, y, z] = seen(&camera, pivot);
            assert!(x.abs() < 1e-4 && y.abs() < 1e-4 && (z - 4.0 * distance).abs() < 1e-4, "{orbit:?}: {x} {y} {z}");
            assert_eq!((camera.width, camera.height, camera.fx, camera.cy), (60, 40, 45.0, 20.0));
        }
        // Shifts are level, in distances of the pivot: two to the right of the view and four ahead, which a look down does not change.
        let [still_centre, shifted] = [0.0, 1.0].map(|by| {
            let orbit = Orbit { aside: 0.5 * by, ahead: by, ..still };
            orbit_camera(&base(), 4.0, Some([0.0, -1.0, 0.0]), orbit).centre()
        });
        let moved: Vec<f32> = shifted.iter().zip(still_centre).map(|(a, b)| a - b).collect();
        assert!(moved.iter().zip([2.0, 0.0, 4.0]).all(|(is, want)| (is - want).abs() < 1e-4), "{moved:?}");
        // A quarter turn to the left, seen from above: the camera stands right of the pivot and looks along -x.
        let camera = orbit_camera(&base(), 4.0, Some([0.0, -1.0, 0.0]), Orbit { turn: 90.0, ..still });
        assert!((camera.viewmat[2][0] + 1.0).abs() < 1e-5 && camera.centre()[0] > 6.9, "{camera:?}");
    }
}
