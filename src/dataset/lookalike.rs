//! Look-alikes: a generated city in the folder layouts of published datasets, to try a published run from start to end
//! before gigabytes are downloaded.
//!
//! The city is first written as a COLMAP scene and then rearranged; photos are moved (MatrixCity's are rewritten as PNG
//! with the same pixels), and views keep the order of the flight.
//!
//! Invariant: nothing is overwritten: the folder must be new or empty.

use super::colmap_write::{ColmapModel, ModelImage, Point, make_folder, write_model};
use super::layout::Layout;
use super::mega_nerf::write::write_mega_nerf;
use super::model::{RawScene, RawView};
use super::read::{ReadOptions, read_scene};
use super::synthetic::{CityOptions, CitySummary, write_city};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::{write_whole, write_whole_with};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::path::Path;

/// World units of MatrixCity's poses, metres.
const MATRIX_CITY_UNIT: f64 = 100.0;

/// Generates a city and writes it to `folder` in a layout. Layouts with a held-out folder put every `test_every`th
/// photo there. `progress(done, views)` is called after each photo.
/// Errors: as [`write_city`]; also if the folder is not empty, or the layout cannot be written.
pub fn write_lookalike(
    folder: &Path,
    options: &CityOptions,
    (layout, test_every): (Layout, usize),
    progress: &(dyn Fn(u32, u32) + Sync),
) -> InputResult<CitySummary> {
    if layout == Layout::Colmap {
        return write_city(folder, options, progress);
    }
    if layout == Layout::Transforms || test_every == 0 {
        let (flag, problem) = match test_every {
            0 => ("--test-every", "0 holds out no photo, but this layout has a folder of held-out photos"),
            _ => ("--layout", "this layout is read, not written"),
        };
        return Err(InputError::new(flag, problem, "see gsscale-synth --help"));
    }
    if std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
        let problem = "the folder is not empty, and this layout overwrites nothing";
        return Err(InputError::new(folder, problem, "choose another folder"));
    }
    let summary = write_city(folder, options, progress)?;
    let city = read_scene(folder, &ReadOptions::default())?;
    remove(&folder.join("sparse"))?;
    match layout {
        Layout::Gauu => gauu(folder, &city)?,
        Layout::MatrixCity => matrix_city(folder, &city, test_every)?,
        Layout::MegaNerf => write_mega_nerf(folder, &city, test_every)?,
        _ => merged(folder, &city, test_every)?,
    }
    let images = folder.join("images");
    // The photos were moved out of it, except for GauU-Scene.
    if std::fs::read_dir(&images).is_ok_and(|mut entries| entries.next().is_none()) {
        remove(&images)?;
    }
    Ok(summary)
}

fn remove(folder: &Path) -> InputResult<()> {
    std::fs::remove_dir_all(folder).map_err(|e| InputError::io(folder, "removing the folder of the first layout", &e))
}

/// A model of some views under other names, with the city's points.
fn model_of<'a>(city: &RawScene, views: impl Iterator<Item = (String, &'a RawView)>) -> ColmapModel {
    let colored = city.points.positions.iter().zip(&city.points.colors);
    let point =
        |(&position, &rgb): (&[f64; 3], &[u8; 3])| Point { position, rgb, error: 0.5, observations: Vec::new() };
    ColmapModel {
        cameras: vec![city.views[0].intrinsics],
        images: views.map(|(name, view)| ModelImage { name, pose: view.pose, camera: 0 }).collect(),
        points: colored.map(point).collect(),
        tiles: vec![[0.0; 3]],
    }
}

/// GauU-Scene: COLMAP, photos with a drone's names.
fn gauu(folder: &Path, city: &RawScene) -> InputResult<()> {
    let named = |(i, view)| (format!("DJI_{:04}.JPG", i + 1), view);
    for (name, view) in city.views.iter().enumerate().map(named) {
        let to = folder.join("images").join(name);
        std::fs::rename(&view.image_path, &to).map_err(|e| InputError::io(&to, "moving the photo", &e))?;
    }
    write_model(&folder.join("sparse"), &model_of(city, city.views.iter().enumerate().map(named)))
}

/// Mill-19 with the COLMAP models of its two parts beside Mega-NeRF's files.
fn merged(folder: &Path, city: &RawScene, test_every: usize) -> InputResult<()> {
    write_mega_nerf(folder, city, test_every)?;
    for (part, held_out) in [("train", false), ("val", true)] {
        let of_part = city.views.iter().enumerate().filter(|(i, _)| i.is_multiple_of(test_every) == held_out);
        let model = model_of(city, of_part.map(|(i, view)| (format!("{i:06}.jpg"), view)));
        if !model.images.is_empty() {
            write_model(&folder.join(part).join("sparse"), &model)?;
        }
    }
    Ok(())
}

/// MatrixCity: PNG photos in blocks, poses of all blocks in units of 100 m and of each in metres, a cloud.
fn matrix_city(folder: &Path, city: &RawScene, test_every: usize) -> InputResult<()> {
    let k = city.views[0].intrinsics;
    let angle = 2.0 * libm::atan(0.5 * f64::from(k.width) / k.fx);
    make_folder(&folder.join("pose/block_all"))?;
    for (set, block, held_out) in [("train", "block_1", false), ("test", "block_1_test", true)] {
        let of_set = city.views.iter().enumerate().filter(|(i, _)| i.is_multiple_of(test_every) == held_out);
        let of_set: Vec<&RawView> = of_set.map(|(_, view)| view).collect();
        let photos = folder.join(set).join(block);
        make_folder(&photos)?;
        let to = |i: usize| photos.join(format!("{i:04}.png"));
        of_set.par_iter().enumerate().map(|(i, v)| to_png(&v.image_path, &to(i))).collect::<InputResult<Vec<()>>>()?;
        let named = |(i, view): (usize, &&RawView)| {
            let path = format!("../../{set}/{block}/{i:04}.png");
            json!({ "file_path": path, "transform_matrix": matrix(view, 1.0, 1.0 / MATRIX_CITY_UNIT) })
        };
        let frames: Vec<Value> = of_set.iter().enumerate().map(named).collect();
        let all = json!({ "camera_angle_x": angle, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width,
            "h": k.height, "frames": frames });
        write_json(&folder.join("pose/block_all").join(format!("transforms_{set}.json")), &all)?;
        let numbered = |(i, view): (usize, &&RawView)| json!({ "frame_index": i, "rot_mat": matrix(view, 0.01, 1.0) });
        let frames: Vec<Value> = of_set.iter().enumerate().map(numbered).collect();
        write_json(&photos.join("transforms.json"), &json!({ "camera_angle_x": angle, "frames": frames }))?;
    }
    write_cloud(&folder.join("points.ply"), city)
}

/// Camera to world in OpenGL axes, rotation and position each times a factor.
fn matrix(view: &RawView, rotation: f64, position: f64) -> [[f64; 4]; 4] {
    let r = view.pose.rotation;
    let centre = view.pose.centre();
    let row = |i: usize| {
        let [x, y, z] = [r.row(0)[i], -r.row(1)[i], -r.row(2)[i]].map(|v| v * rotation);
        [x, y, z, centre[i] * position]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

fn write_json(path: &Path, value: &Value) -> InputResult<()> {
    write_whole(path, value.to_string().as_bytes())
}

/// Rewrites a photo as PNG with the same pixels, and removes the original.
fn to_png(from: &Path, to: &Path) -> InputResult<()> {
    let wrong = |e: image::ImageError| {
        InputError::new(to, format!("turning {} into PNG failed: {e}", from.display()), "check the disk and its space")
    };
    image::open(from).and_then(|photo| photo.save(to)).map_err(wrong)?;
    std::fs::remove_file(from).map_err(|e| InputError::io(from, "removing the original photo", &e))
}

/// The city's points in MatrixCity's unit, as its published clouds are: doubles and bytes.
fn write_cloud(path: &Path, city: &RawScene) -> InputResult<()> {
    let points = &city.points;
    write_whole_with(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.positions.len())?;
        for property in ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue"] {
            writeln!(out, "property {property}")?;
        }
        out.write_all(b"end_header\n")?;
        for (position, color) in points.positions.iter().zip(&points.colors) {
            for x in position {
                out.write_all(&(x / MATRIX_CITY_UNIT).to_le_bytes())?;
            }
            out.write_all(color)?;
        }
        Ok(())
    })
}
