//! PLY: writes Gaussians, reads Gaussians or coloured points.
//!
//! Not here: the choice of the training frame (the dataset's loader), the use of points (`scene::init`).
//!
//! Invariants:
//! 1. The written property order is that of the 3DGS code, which viewers expect: `x y z nx ny nz f_dc_* f_rest_*
//!    opacity scale_* rot_*`, binary little endian f32, `f_rest` channel-major (all red coefficients, then green,
//!    then blue), scales as logs, opacity as a logit, `rot` w-first and of unit length.
//! 2. A target path holds either the whole new file or its old content: files are written beside it and renamed.
//! 3. Files are untrusted: every count is checked against the bytes left before anything is allocated.
//! 4. All returned values are finite.
//!
//! The comments name the frame of the values, with origin and scale, and the rotation of an upright file ([`super::meta`]).

mod header;
mod read;
mod rows;
mod write;

pub use read::{
    ROW_HEAD, gaussians_header, holds_gaussians, parse_ply, push_row, read_ply, stated_rows, stream_gaussians,
    stream_points, take_row,
};
pub use write::{PlyWriter, write_gaussians};

use super::meta::SceneMeta;
use crate::scene::columns::Columns;

#[allow(clippy::large_enum_variant)] // one value a file
#[derive(Debug, Clone, PartialEq)]
pub enum PlyContent {
    /// A trained scene (the file has `f_dc_0`).
    Gaussians {
        /// The rows, in the frame that `meta` names; quaternions are unit.
        columns: Columns,
        meta: SceneMeta,
    },
    Points {
        positions: Vec<[f64; 3]>,
        /// sRGB, one per position; mid grey if the file has no colours.
        colors: Vec<[u8; 3]>,
        /// Number of rows dropped because a value was not finite.
        dropped: u64,
    },
}
