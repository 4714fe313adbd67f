//! Files that users bring: datasets, photos, PLY files, config files; and the generated scene.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod support;

mod configs;
mod disturb;
mod exif;
mod huge_files;
mod import;
mod moved_model;
mod photos;
mod ply;
mod readers;
mod sog;
mod sog_read;
mod spz;
mod synthetic;
