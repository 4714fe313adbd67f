//! Where views come from. A reader (COLMAP, transforms.json) fills a [`RawScene`] in the dataset's own f64
//! coordinates; the loader checks the photos against it and turns it into a [`loader::Dataset`] in the local frame.

pub mod colmap;
pub mod colmap_write;
pub mod loader;
pub mod model;
pub mod synthetic;
pub mod transforms;
