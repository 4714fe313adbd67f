//! Writes scenes in Mega-NeRF's layout for [`super::read_mega_nerf`]: to try a run of Mill-19 on a generated city
//! before 20 GB are downloaded.
//!
//! Files are as written by `torch.save` for a dictionary: an uncompressed zip archive, protocol 2, little-endian
//! tensors.

use crate::base::error::{InputError, InputResult};
use crate::dataset::colmap_write::make_folder;
use crate::dataset::model::{RawScene, RawView, Split};
use glam::DMat3;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use zip::CompressionMethod;
use zip::write::{SimpleFileOptions, ZipWriter};

pub(super) enum TorchValue {
    Int(i32),
    Float(f64),
    /// The type of the storage, the bytes of row-major numbers, and their shape.
    Tensor(&'static str, Vec<u8>, Vec<u8>),
}

/// Writes the views of `scene` to `folder`, every `test_every`th one into `val`; photos are moved there.
/// Errors: the folder cannot be written.
pub fn write_mega_nerf(folder: &Path, scene: &RawScene, test_every: usize) -> InputResult<()> {
    let centres: Vec<_> = scene.views.iter().map(|view| view.pose.centre()).collect();
    let (mut low, mut high) = (centres[0], centres[0]);
    for c in &centres {
        (low, high) = (low.min(*c), high.max(*c));
    }
    // The generated world is right-handed with z up: down, right, back are -z, x, -y.
    let drb_from_world = DMat3::from_cols_array(&[0., 1., 0., 0., 0., -1., -1., 0., 0.]);
    let origin = drb_from_world * ((low + high) * 0.5);
    let scale = (high - low).length().max(1.0) * 0.5;
    write_torch(
        &folder.join("coordinates.pt"),
        &[
            (
                "origin_drb",
                TorchValue::Tensor("DoubleStorage", origin.to_array().map(f64::to_le_bytes).concat(), vec![3]),
            ),
            ("pose_scale_factor", TorchValue::Float(scale)),
        ],
    )?;
    for (i, view) in scene.views.iter().enumerate() {
        let split = if i.is_multiple_of(test_every) { Split::Test } else { Split::Train };
        let part = folder.join(if split == Split::Test { "val" } else { "train" });
        let stem = format!("{i:06}");
        for sub in ["metadata", "rgbs"] {
            make_folder(&part.join(sub))?;
        }
        write_metadata(&part.join("metadata").join(format!("{stem}.pt")), view, drb_from_world, origin, scale)?;
        let extension = view.image_path.extension().and_then(|e| e.to_str()).unwrap_or("jpg");
        let photo = part.join("rgbs").join(format!("{stem}.{extension}"));
        std::fs::rename(&view.image_path, &photo).map_err(|e| InputError::io(&photo, "moving the photo", &e))?;
    }
    Ok(())
}

fn write_metadata(path: &Path, view: &RawView, drb: DMat3, origin: glam::DVec3, scale: f64) -> InputResult<()> {
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
    write_torch(
        path,
        &[
            ("W", TorchValue::Int(k.width as i32)),
            ("H", TorchValue::Int(k.height as i32)),
            ("intrinsics", TorchValue::Tensor("FloatStorage", intrinsics, vec![4])),
            ("c2w", TorchValue::Tensor("FloatStorage", c2w.concat(), vec![3, 4])),
        ],
    )
}

pub(super) fn write_torch(path: &Path, entries: &[(&str, TorchValue)]) -> InputResult<()> {
    let io = |e: std::io::Error| InputError::io(path, "writing", &e);
    let zipped = |e: zip::result::ZipError| io(std::io::Error::other(e));
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let mut zip = ZipWriter::new(BufWriter::new(File::create(path).map_err(io)?));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
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
    let mut add = |name: String, bytes: &[u8]| {
        zip.start_file(format!("{stem}/{name}"), stored).map_err(zipped)?;
        zip.write_all(bytes).map_err(io)
    };
    add("data.pkl".into(), &pickle)?;
    for (i, bytes) in data.iter().enumerate() {
        add(format!("data/{i}"), bytes)?;
    }
    add("version".into(), b"3\n")?;
    zip.finish().map_err(zipped)?.into_inner().map_err(|e| io(e.into_error()))?;
    Ok(())
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
