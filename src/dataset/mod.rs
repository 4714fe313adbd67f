//! Datasets: the source of views. A reader (COLMAP, transforms.json, MatrixCity, Mega-NeRF,
//! OpenSfM, RealityCapture) fills a [`model::RawScene`]
//! in the dataset's own f64 coordinates; the loader checks the photos against it and converts it to a
//! [`loader::Dataset`] in the local frame. Pixels are decoded later, a few views ahead of their use, by
//! [`target_cache`].

pub mod colmap;
pub mod colmap_write;
pub mod disturb;
pub mod exif;
pub mod frame;
mod gathered;
pub mod import;
pub mod layout;
pub mod loader;
mod loose_json;
pub mod masks;
pub mod mega_nerf;
pub mod model;
mod name_index;
pub mod opensfm;
pub mod paths;
pub mod photo;
mod photo_files;
pub mod photo_header;
pub mod plane_sweep;
pub mod read;
pub mod reality_capture;
pub mod resize;
pub mod synthetic;
pub mod target_cache;
pub mod transforms;
pub mod undistort;
pub mod up;
