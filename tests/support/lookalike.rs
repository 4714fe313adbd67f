//! Look-alikes: a generated city in the folder layouts of published datasets.
//!
//! The city is first written as a COLMAP scene and then rearranged; photos are moved (MatrixCity's are rewritten as PNG
//! with the same pixels), and views keep the order of the flight. Mega-NeRF's files are as written by `torch.save` for a dictionary: an
//! uncompressed zip archive, protocol 2, little-endian tensors.

use glam::{DMat3, DVec3};
use gsscale::dataset::colmap_write::{ColmapModel, ModelImage, Point, write_model};
use gsscale::dataset::layout::Layout;
use gsscale::dataset::model::{RawScene, RawView};
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use serde_json::{Value, json};
use std::fs;
use std::io::Write;
use std::path::Path;
use zip::CompressionMethod;
use zip::write::{SimpleFileOptions, ZipWriter};

/// World units of MatrixCity's poses, metres.
const MATRIX_CITY_UNIT: f64 = 100.0;

/// Generates a city and writes it to `folder` in a layout. Layouts with a held-out folder put every `test_every`th
/// photo there.
pub fn write_lookalike(folder: &Path, options: &CityOptions, layout: Layout, test_every: usize) {
    write_city(folder, options, &|_, _| {}).unwrap();
    if layout == Layout::Colmap {
        return;
    }
    let city = read_scene(folder, &ReadOptions::default()).unwrap();
    fs::remove_dir_all(folder.join("sparse")).unwrap();
    match layout {
        Layout::Gauu => return gauu(folder, &city),
        Layout::MatrixCity => matrix_city(folder, &city, test_every),
        Layout::MegaNerf => write_mega_nerf(folder, &city, test_every),
        _ => merged(folder, &city, test_every),
    }
    // The photos were moved out of it.
    fs::remove_dir(folder.join("images")).unwrap();
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
fn gauu(folder: &Path, city: &RawScene) {
    let named = |(i, view)| (format!("DJI_{:04}.JPG", i + 1), view);
    for (name, view) in city.views.iter().enumerate().map(named) {
        fs::rename(&view.image_path, folder.join("images").join(name)).unwrap();
    }
    write_model(&folder.join("sparse"), &model_of(city, city.views.iter().enumerate().map(named))).unwrap();
}

/// Mill-19 with the COLMAP models of its two parts beside Mega-NeRF's files.
fn merged(folder: &Path, city: &RawScene, test_every: usize) {
    write_mega_nerf(folder, city, test_every);
    for (part, held_out) in [("train", false), ("val", true)] {
        let of_part = city.views.iter().enumerate().filter(|(i, _)| i.is_multiple_of(test_every) == held_out);
        let model = model_of(city, of_part.map(|(i, view)| (format!("{i:06}.jpg"), view)));
        write_model(&folder.join(part).join("sparse"), &model).unwrap();
    }
}

/// MatrixCity: PNG photos in blocks, poses of all blocks in units of 100 m and of each in metres, a cloud.
fn matrix_city(folder: &Path, city: &RawScene, test_every: usize) {
    let k = city.views[0].intrinsics;
    let angle = 2.0 * libm::atan(0.5 * f64::from(k.width) / k.fx);
    fs::create_dir_all(folder.join("pose/block_all")).unwrap();
    for (set, block, held_out) in [("train", "block_1", false), ("test", "block_1_test", true)] {
        let of_set = city.views.iter().enumerate().filter(|(i, _)| i.is_multiple_of(test_every) == held_out);
        let of_set: Vec<&RawView> = of_set.map(|(_, view)| view).collect();
        let photos = folder.join(set).join(block);
        fs::create_dir_all(&photos).unwrap();
        for (i, view) in of_set.iter().enumerate() {
            image::open(&view.image_path).unwrap().save(photos.join(format!("{i:04}.png"))).unwrap();
            fs::remove_file(&view.image_path).unwrap();
        }
        let named = |(i, view): (usize, &&RawView)| {
            let path = format!("../../{set}/{block}/{i:04}.png");
            json!({ "file_path": path, "transform_matrix": matrix(view, 1.0, 1.0 / MATRIX_CITY_UNIT) })
        };
        let frames: Vec<Value> = of_set.iter().enumerate().map(named).collect();
        let all = json!({ "camera_angle_x": angle, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width,
            "h": k.height, "frames": frames });
        fs::write(folder.join("pose/block_all").join(format!("transforms_{set}.json")), all.to_string()).unwrap();
        let numbered = |(i, view): (usize, &&RawView)| json!({ "frame_index": i, "rot_mat": matrix(view, 0.01, 1.0) });
        let frames: Vec<Value> = of_set.iter().enumerate().map(numbered).collect();
        let of_block = json!({ "camera_angle_x": angle, "frames": frames });
        fs::write(photos.join("transforms.json"), of_block.to_string()).unwrap();
    }
    write_cloud(&folder.join("points.ply"), city);
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

/// The city's points in MatrixCity's unit, as its published clouds are: doubles and bytes.
fn write_cloud(path: &Path, city: &RawScene) {
    let points = &city.points;
    let mut ply = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.positions.len());
    for property in ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue"] {
        ply += &format!("property {property}\n");
    }
    let mut ply = (ply + "end_header\n").into_bytes();
    for (position, color) in points.positions.iter().zip(&points.colors) {
        position.iter().for_each(|x| ply.extend((x / MATRIX_CITY_UNIT).to_le_bytes()));
        ply.extend(color);
    }
    fs::write(path, ply).unwrap();
}

enum TorchValue {
    Int(i32),
    Float(f64),
    /// The type of the storage, the bytes of row-major numbers, and their shape.
    Tensor(&'static str, Vec<u8>, Vec<u8>),
}

/// Writes the views of `scene` to `folder` in Mega-NeRF's layout, every `test_every`th one into `val`; photos are moved there.
pub fn write_mega_nerf(folder: &Path, scene: &RawScene, test_every: usize) {
    let centres: Vec<_> = scene.views.iter().map(|view| view.pose.centre()).collect();
    let (low, high) = centres.iter().fold((centres[0], centres[0]), |(low, high), c| (low.min(*c), high.max(*c)));
    // The generated world is right-handed with z up: down, right, back are -z, x, -y.
    let drb_from_world = DMat3::from_cols_array(&[0., 1., 0., 0., 0., -1., -1., 0., 0.]);
    let origin = drb_from_world * ((low + high) * 0.5);
    let scale = (high - low).length().max(1.0) * 0.5;
    let numbers = origin.to_array().map(f64::to_le_bytes).concat();
    let entries = [
        ("origin_drb", TorchValue::Tensor("DoubleStorage", numbers, vec![3])),
        ("pose_scale_factor", TorchValue::Float(scale)),
    ];
    write_torch(&folder.join("coordinates.pt"), &entries);
    for (i, view) in scene.views.iter().enumerate() {
        let part = folder.join(if i.is_multiple_of(test_every) { "val" } else { "train" });
        for sub in ["metadata", "rgbs"] {
            fs::create_dir_all(part.join(sub)).unwrap();
        }
        write_metadata(&part.join("metadata").join(format!("{i:06}.pt")), view, drb_from_world, origin, scale);
        fs::rename(&view.image_path, part.join("rgbs").join(format!("{i:06}.jpg"))).unwrap();
    }
}

fn write_metadata(path: &Path, view: &RawView, drb: DMat3, origin: DVec3, scale: f64) {
    let rotation = drb * view.pose.rotation.transpose();
    let centre = (drb * view.pose.centre() - origin) / scale;
    let mut c2w = Vec::with_capacity(12);
    for row in 0..3 {
        // Converts the camera's axes from right-down-forward to right-up-back.
        let r = rotation.row(row);
        c2w.extend([r.x as f32, -r.y as f32, -r.z as f32, centre[row] as f32].map(f32::to_le_bytes));
    }
    let k = view.intrinsics;
    let intrinsics = [k.fx, k.fy, k.cx, k.cy].map(|x| (x as f32).to_le_bytes()).concat();
    let entries = [
        ("W", TorchValue::Int(k.width as i32)),
        ("H", TorchValue::Int(k.height as i32)),
        ("intrinsics", TorchValue::Tensor("FloatStorage", intrinsics, vec![4])),
        ("c2w", TorchValue::Tensor("FloatStorage", c2w.concat(), vec![3, 4])),
    ];
    write_torch(path, &entries);
}

fn write_torch(path: &Path, entries: &[(&str, TorchValue)]) {
    let mut pickle = b"\x80\x02}(".to_vec();
    let mut data = Vec::new();
    for (key, entry) in entries {
        text(&mut pickle, key);
        match entry {
            TorchValue::Int(n) => {
                pickle.push(b'J');
                pickle.extend_from_slice(&n.to_le_bytes());
            }
            TorchValue::Float(x) => {
                pickle.push(b'G');
                pickle.extend_from_slice(&x.to_be_bytes());
            }
            TorchValue::Tensor(storage, bytes, shape) => {
                tensor(&mut pickle, storage, data.len(), shape);
                data.push(bytes);
            }
        }
    }
    pickle.extend_from_slice(b"u.");
    let mut zip = ZipWriter::new(fs::File::create(path).unwrap());
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let stem = path.file_stem().unwrap().to_string_lossy();
    let mut add = |name: String, bytes: &[u8]| {
        zip.start_file(format!("{stem}/{name}"), stored).unwrap();
        zip.write_all(bytes).unwrap();
    };
    add("data.pkl".into(), &pickle);
    data.iter().enumerate().for_each(|(i, bytes)| add(format!("data/{i}"), bytes));
    add("version".into(), b"3\n");
    zip.finish().unwrap();
}

fn text(pickle: &mut Vec<u8>, value: &str) {
    pickle.push(b'X');
    pickle.extend_from_slice(&(value.len() as u32).to_le_bytes());
    pickle.extend_from_slice(value.as_bytes());
}

/// A call of the function that rebuilds a contiguous tensor.
fn tensor(pickle: &mut Vec<u8>, storage: &str, key: usize, shape: &[u8]) {
    pickle.extend_from_slice(b"ctorch._utils\n_rebuild_tensor_v2\n((");
    text(pickle, "storage");
    pickle.extend_from_slice(format!("ctorch\n{storage}\n").as_bytes());
    text(pickle, &key.to_string());
    text(pickle, "cpu");
    pickle.extend_from_slice(&[b'K', shape.iter().product(), b't', b'Q', b'K', 0, b'(']);
    shape.iter().for_each(|&n| pickle.extend_from_slice(&[b'K', n]));
    pickle.extend_from_slice(b"t(");
    for axis in 0..shape.len() {
        pickle.extend_from_slice(&[b'K', shape[axis + 1..].iter().product()]);
    }
    pickle.extend_from_slice(b"t\x89ccollections\nOrderedDict\n)RtR");
}
