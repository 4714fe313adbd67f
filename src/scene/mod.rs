//! Gaussians, cameras and images as data: no files, no rendering, no optimizer.

pub mod camera;
pub mod columns;
pub mod events;
pub mod frustum;
pub mod image;
pub mod init;
pub mod log_scales;
pub mod neighbours;
pub mod optimizer_numbers;
pub mod page_layout;
pub mod page_meta;
pub mod page_split;
pub mod partition;
pub mod point_box;
pub mod rotation;
pub mod rows;
pub mod select;
pub mod sightings;
pub mod state;
