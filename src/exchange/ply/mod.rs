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
//! 5. A file may be turned so that viewers show it upright ([`PlyMeta::upright`]); [`to_local`] turns it back.
//!
//! There are two frames. Scenes are trained in a *local* frame: `dataset = local * scale + origin`, computed in f64. A
//! file holds either frame and names it in its comments, with origin and scale, so that each frame can be derived from
//! the other.

mod header;
mod read;
mod rows;
mod transform;
mod write;

pub use read::{
    ROW_HEAD, gaussians_header, holds_gaussians, parse_ply, push_row, read_ply, stated_rows, stream_gaussians,
    stream_points, take_row,
};
pub use transform::{TRANSFORM_ENDING, transform_path, write_transform};
pub use write::{PlyWriter, PlyWritten, write_gaussians};

use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::rotation::{GaussianRotation, Rotation};

/// Beyond this many scene radii an offset is not written into f32 positions: one unit in the last place of such an
/// offset is more than 6e-5 radii, which is pixels in a photo.
pub const MAX_OFFSET_RADII: f64 = 1000.0;

/// The frame of the Gaussians in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFrame {
    /// The dataset's own coordinates.
    Dataset,
    /// The trainer's coordinates, without origin and scale.
    Local,
}

impl ExportFrame {
    /// The name on the command line and in the file's comment.
    pub fn name(self) -> &'static str {
        match self {
            ExportFrame::Dataset => "dataset",
            ExportFrame::Local => "local",
        }
    }

    /// The frame with this name.
    pub fn from_name(name: &str) -> Option<ExportFrame> {
        [ExportFrame::Dataset, ExportFrame::Local].into_iter().find(|f| f.name() == name)
    }

    /// The frame that f32 can hold: `Local` if `origin` is more than [`MAX_OFFSET_RADII`] times `scene_radius` (dataset
    /// units) from zero, otherwise the requested one.
    #[must_use]
    pub fn fitting_f32(self, origin: [f64; 3], scene_radius: f64) -> ExportFrame {
        let offset = libm::sqrt(origin.iter().map(|x| x * x).sum());
        if offset > MAX_OFFSET_RADII * scene_radius { ExportFrame::Local } else { self }
    }
}

/// Metadata of the Gaussians in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct PlyMeta {
    /// Optimizer steps done; `None` if the file does not say.
    pub step: Option<u64>,
    /// Origin of the local frame in dataset coordinates; zeros if the file does not say.
    pub origin: [f64; 3],
    /// Dataset units per local unit; 1 if the file does not say.
    pub scale: f64,
    /// When writing: the requested frame. When reading: the frame of the values; files of other programs are in the
    /// dataset's.
    pub frame: ExportFrame,
    /// The rotation from the axes of the dataset to those of the file, whose up is -y ([`crate::scene::rotation::VIEWER_UP`]);
    /// applied after the change of frame. `None` where the file has the axes of the dataset.
    pub upright: Option<Rotation>,
    /// When writing: extent of the scene in dataset units, which decides whether f32 can hold the dataset frame (see
    /// [`ExportFrame::fitting_f32`]). Not stored; reading sets it to `scale`.
    pub scene_radius: f64,
    /// When reading: whether training used an opacity compensation ("mip", "antialiased") that this renderer lacks.
    pub antialiased: bool,
    /// When reading: number of rows dropped because a value was not finite.
    pub dropped: u64,
    /// When reading: number of infinite opacities (logits of 0 and 1), which are read as logits of 1e-6 and 1 - 1e-6.
    pub opacities_clamped: u64,
}

impl Default for PlyMeta {
    fn default() -> Self {
        PlyMeta {
            step: None,
            origin: [0.0; 3],
            scale: 1.0,
            frame: ExportFrame::Dataset,
            upright: None,
            scene_radius: 1.0,
            antialiased: false,
            dropped: 0,
            opacities_clamped: 0,
        }
    }
}

/// Content of a PLY file.
#[allow(clippy::large_enum_variant)] // one value a file
#[derive(Debug, Clone, PartialEq)]
pub enum PlyContent {
    /// A trained scene (the file has `f_dc_0`).
    Gaussians {
        /// The rows, in the frame that `meta` names; quaternions are unit.
        columns: Columns,
        /// Metadata from the comments.
        meta: PlyMeta,
    },
    /// Coloured points.
    Points {
        /// Positions.
        positions: Vec<[f64; 3]>,
        /// sRGB, one per position; mid grey if the file has no colours.
        colors: Vec<[u8; 3]>,
        /// Number of rows dropped because a value was not finite.
        dropped: u64,
    },
}

/// Converts Gaussians that were read with `meta` into the local frame of `origin` and `scale`, with the axes of the
/// dataset.
///
/// An upright file is turned back first ([`turn_back`]). Then, computed in f64 and rounded once: `local = (p - origin) /
/// scale` for a file in the dataset's frame; a file in another local frame is first converted to the dataset's. The log of
/// the ratio of scales is added to log-scales. A file already in this local frame and in these axes keeps its bits. Rows
/// whose values overflow f32 are removed; returns how many.
pub fn to_local(columns: &mut Columns, meta: &PlyMeta, origin: [f64; 3], scale: f64) -> u64 {
    let (file_origin, file_scale) = match meta.frame {
        ExportFrame::Local => (meta.origin, meta.scale),
        ExportFrame::Dataset => ([0.0; 3], 1.0),
    };
    let turning = way_back(meta);
    let is_there = file_origin == origin && file_scale == scale;
    if is_there && turning.is_identity() {
        return 0;
    }
    let shift: [f64; 3] = std::array::from_fn(|i| file_origin[i] - origin[i]);
    for mean in columns.means.as_chunks_mut::<3>().0 {
        let position = turning.position(mean.map(f64::from));
        let moved = |i: usize| if is_there { position[i] } else { (position[i] * file_scale + shift[i]) / scale };
        *mean = [0, 1, 2].map(|i| moved(i) as f32);
    }
    turn_rest(columns, &turning);
    if !is_there {
        let log_ratio = libm::log(file_scale / scale);
        for s in &mut columns.scales {
            *s = (f64::from(*s) + log_ratio) as f32;
        }
    }
    let is_finite =
        |columns: &Columns, row| Column::ALL.into_iter().all(|c| columns.row(c, row).iter().all(|v| v.is_finite()));
    columns.retain_rows(is_finite)
}

/// Turns the rows of an upright file back to the axes of the dataset, in the file's frame. Leaves other files unchanged, bit
/// for bit.
pub fn turn_back(columns: &mut Columns, meta: &PlyMeta) {
    let turning = way_back(meta);
    for mean in columns.means.as_chunks_mut::<3>().0 {
        *mean = turning.position(mean.map(f64::from)).map(|x| x as f32);
    }
    turn_rest(columns, &turning);
}

fn way_back(meta: &PlyMeta) -> GaussianRotation {
    GaussianRotation::new(meta.upright.map_or(Rotation::IDENTITY, |upright| upright.inverse()))
}

/// Turns quaternions and harmonics.
fn turn_rest(columns: &mut Columns, turning: &GaussianRotation) {
    if turning.is_identity() {
        return;
    }
    for quat in columns.quats.as_chunks_mut::<4>().0 {
        *quat = unit_quat(turning.orientation(*quat));
    }
    let width = sh_n_width(columns.sh_degree);
    if width > 0 {
        columns.sh_n.chunks_exact_mut(width).for_each(|sh_n| turning.harmonics(sh_n));
    }
}

/// Normalises a quaternion. One that is already of unit length, to f32 rounding, keeps its bits, so that writing and
/// reading again changes nothing; all zeros become the identity. Finite input gives finite output.
fn unit_quat(q: [f32; 4]) -> [f32; 4] {
    let norm2: f64 = q.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    // Normalising in f64 and rounding leaves an error of at most 2.4e-7.
    if (norm2 - 1.0).abs() <= 1e-6 {
        return q;
    }
    if norm2 == 0.0 {
        return [1.0, 0.0, 0.0, 0.0];
    }
    let norm = libm::sqrt(norm2);
    q.map(|v| (f64::from(v) / norm) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unit_quat_is_stable_and_total() {
        for q in [[0.3f32, -0.2, 0.9, 0.1], [1e-30, 1e-30, 0.0, 0.0], [3e38, 3e38, -3e38, 1.0], [0.0; 4]] {
            let once = unit_quat(q);
            let norm2: f64 = once.iter().map(|&v| f64::from(v).powi(2)).sum();
            // Each of the four squares has a relative error of at most 2 * 2^-24.
            assert!((norm2 - 1.0).abs() < 2.5e-7, "{q:?} -> {once:?}");
            assert_eq!(once, unit_quat(once));
        }
    }
}
