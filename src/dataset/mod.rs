//! Where views come from. A reader (COLMAP, transforms.json) fills a [`model::RawScene`] in the dataset's own f64
//! coordinates; the loader checks the photos against it and turns it into a [`loader::Dataset`] in the local frame.

mod checks;
pub mod colmap;
pub mod loader;
pub mod model;
pub mod paths;
pub mod read;
pub mod synthetic;
pub mod transforms;
