//! Writes a COLMAP model in its binary form: `cameras.bin`, `images.bin`, `points3D.bin`, of pinhole cameras.
//!
//! Format: COLMAP, "Output Format" in its documentation, binary files of `src/colmap/scene/reconstruction_io.cc`;
//! little-endian, quaternions w first, world to camera.
//!
//! Invariants: 1. ids of cameras, images and points count from 1; 2. tracks and the images' point lists agree in
//! both directions; 3. a file gets its final name only when all its bytes are on disk, and the model's folder only when
//! all its files are.

use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole_with;
use crate::dataset::model::{Intrinsics, Lens, Pose};
use glam::{DMat3, DQuat};
use std::io::Write;
use std::path::Path;

/// Id of the PINHOLE camera model (fx, fy, cx, cy).
const PINHOLE: i32 = 1;

#[derive(Debug, Clone)]
pub struct ColmapModel {
    /// Pinholes.
    pub cameras: Vec<Intrinsics>,
    pub images: Vec<ModelImage>,
    pub points: Vec<Point>,
    /// Offsets (at least one): the points are written once per offset, moved by it, so that a model may be larger than
    /// memory. Image k sees the points of offset number k modulo their count, and its pose is there.
    pub tiles: Vec<[f64; 3]>,
}

#[derive(Debug, Clone)]
pub struct ModelImage {
    /// Name relative to the image folder.
    pub name: String,
    pub pose: Pose,
    /// Index into the cameras, from 0.
    pub camera: u32,
}

#[derive(Debug, Clone)]
pub struct Point {
    pub position: [f64; 3],
    pub rgb: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error: f64,
    pub observations: Vec<Observation>,
}

/// A sighting of a point in an image.
#[derive(Debug, Clone, Copy)]
pub struct Observation {
    /// Index into the images, from 0.
    pub image: u32,
    /// Position in the image, pixels; the centre of the first pixel is (0.5, 0.5).
    pub at: [f64; 2],
}

/// Writes `<sparse>/0/*.bin`; `sparse` must not exist and its parent must.
pub fn write_model(sparse: &Path, model: &ColmapModel) -> InputResult<()> {
    debug_assert!(model.cameras.iter().all(|k| k.lens == Lens::Pinhole) && !model.tiles.is_empty());
    let partial = sparse.with_extension("partial");
    let folder = partial.join("0");
    make_folder(&folder)?;
    write_whole_with(&folder.join("cameras.bin"), |out| cameras(out, &model.cameras))?;
    write_whole_with(&folder.join("images.bin"), |out| images_bin(out, model))?;
    write_whole_with(&folder.join("points3D.bin"), |out| points_bin(out, model))?;
    std::fs::rename(&partial, sparse).map_err(|e| InputError::io(sparse, "renaming the model's folder", &e))
}

pub fn make_folder(folder: &Path) -> InputResult<()> {
    std::fs::create_dir_all(folder).map_err(|e| InputError::io(folder, "creating the folder", &e))
}

fn cameras(out: &mut dyn Write, cameras: &[Intrinsics]) -> std::io::Result<()> {
    out.write_all(&(cameras.len() as u64).to_le_bytes())?;
    for (id, k) in (1u32..).zip(cameras) {
        out.write_all(&id.to_le_bytes())?;
        out.write_all(&PINHOLE.to_le_bytes())?;
        out.write_all(&u64::from(k.width).to_le_bytes())?;
        out.write_all(&u64::from(k.height).to_le_bytes())?;
        floats(out, &[k.fx, k.fy, k.cx, k.cy])?;
    }
    Ok(())
}

fn floats(out: &mut dyn Write, values: &[f64]) -> std::io::Result<()> {
    values.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))
}

fn tile_of(model: &ColmapModel, image: u32) -> usize {
    image as usize % model.tiles.len()
}

fn images_bin(out: &mut dyn Write, model: &ColmapModel) -> std::io::Result<()> {
    // For each image its observations, in the order of the points of its tile.
    let mut order = vec![Vec::new(); model.images.len()];
    for (k, point) in (1u64..).zip(&model.points) {
        for o in &point.observations {
            order[o.image as usize].push((tile_of(model, o.image) as u64 * model.points.len() as u64 + k, o.at));
        }
    }
    out.write_all(&(model.images.len() as u64).to_le_bytes())?;
    for (k, image) in model.images.iter().enumerate() {
        out.write_all(&(k as u32 + 1).to_le_bytes())?;
        floats(out, &quaternion(&image.pose.rotation))?;
        floats(out, &image.pose.translation.to_array())?;
        out.write_all(&(image.camera + 1).to_le_bytes())?;
        out.write_all(image.name.as_bytes())?;
        out.write_all(&[0])?;
        out.write_all(&(order[k].len() as u64).to_le_bytes())?;
        for (point, at) in &order[k] {
            floats(out, at)?;
            out.write_all(&point.to_le_bytes())?;
        }
    }
    Ok(())
}

fn points_bin(out: &mut dyn Write, model: &ColmapModel) -> std::io::Result<()> {
    // The index of an observation in its image's list: lists are in the order of the points.
    let mut written = vec![0u32; model.images.len()];
    let (points, tiles) = (model.points.len() as u64, model.tiles.len() as u64);
    out.write_all(&(points * tiles).to_le_bytes())?;
    let mut id = 0u64;
    for (tile, shift) in model.tiles.iter().enumerate() {
        for point in &model.points {
            id += 1;
            out.write_all(&id.to_le_bytes())?;
            floats(out, &std::array::from_fn::<f64, 3, _>(|i| point.position[i] + shift[i]))?;
            out.write_all(&point.rgb)?;
            out.write_all(&point.error.to_le_bytes())?;
            let seen = || point.observations.iter().filter(|o| tile_of(model, o.image) == tile);
            out.write_all(&(seen().count() as u64).to_le_bytes())?;
            for o in seen() {
                out.write_all(&(o.image + 1).to_le_bytes())?;
                out.write_all(&written[o.image as usize].to_le_bytes())?;
                written[o.image as usize] += 1;
            }
        }
    }
    Ok(())
}

/// Unit quaternion of a rotation, w first and not negative.
fn quaternion(rotation: &DMat3) -> [f64; 4] {
    let q = DQuat::from_mat3(rotation).normalize();
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [q.w * sign, q.x * sign, q.y * sign, q.z * sign]
}
