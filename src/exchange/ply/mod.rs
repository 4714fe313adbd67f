//! PLY: Gaussians out, Gaussians or coloured points in.
//!
//! Not here: which frame a scene is trained in (the dataset's loader), what to do with points (`scene::init`).
//!
//! Invariants:
//! 1. What is written has the property order of the 3DGS code, which viewers expect: `x y z nx ny nz f_dc_* f_rest_*
//!    opacity scale_* rot_*`, binary little endian f32, `f_rest` channel-major (all red coefficients, then green,
//!    then blue), scales as logs, opacity as a logit, `rot` w-first and of unit length.
//! 2. A target path holds either the whole new file or what it held before: files are written beside it and renamed.
//! 3. What is read is hostile: every count is checked against the bytes left before anything is allocated.
//! 4. Everything handed out is finite.
//!
//! Two frames. Scenes are trained in a *local* frame: `dataset = local * scale + origin`, all of it in f64. A file
//! holds either frame and says which in its comments, together with origin and scale, so that both lead back.

mod header;
mod read;
mod rows;
mod write;

pub use read::{
    ROW_HEAD, gaussians_header, holds_gaussians, parse_ply, push_row, read_ply, rows_promised, stream_gaussians,
    stream_points, take_row,
};
pub use write::{PlyWriter, PlyWritten, write_gaussians};

use crate::scene::columns::Columns;

/// Offsets beyond this many scene radii are not written into f32 positions: one unit in the last place of the offset
/// would be more than 6e-5 radii there, which is pixels in a photo.
pub const MAX_OFFSET_RADII: f64 = 1000.0;

/// The frame in which a file holds its Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFrame {
    /// The dataset's own coordinates.
    Dataset,
    /// The trainer's coordinates: origin and scale removed.
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

    /// The frame that can really be written: `Local` when `origin` lies more than [`MAX_OFFSET_RADII`] times
    /// `scene_radius` (dataset units) from zero, else the one asked for.
    #[must_use]
    pub fn that_fits(self, origin: [f64; 3], scene_radius: f64) -> ExportFrame {
        let offset = libm::sqrt(origin.iter().map(|x| x * x).sum());
        if offset > MAX_OFFSET_RADII * scene_radius { ExportFrame::Local } else { self }
    }
}

/// What a file says about its Gaussians besides their values.
#[derive(Debug, Clone, PartialEq)]
pub struct PlyMeta {
    /// Optimizer steps behind the values; `None` when the file does not say.
    pub step: Option<u64>,
    /// Dataset coordinates of the local frame's zero. Zeros when the file does not say.
    pub origin: [f64; 3],
    /// Dataset units per local unit. 1 when the file does not say.
    pub scale: f64,
    /// Writing: the frame asked for. Reading: the frame of the values. Files of other programs are in the dataset's.
    pub frame: ExportFrame,
    /// Writing: how far the scene reaches, dataset units; decides whether f32 can hold the dataset frame (see
    /// [`ExportFrame::that_fits`]). Not stored; reads back as `scale`.
    pub scene_radius: f64,
    /// Reading: the file was trained with an opacity compensation ("mip", "antialiased") that this renderer lacks.
    pub antialiased: bool,
    /// Reading: rows left out because a value was not finite.
    pub dropped: u64,
}

impl Default for PlyMeta {
    fn default() -> Self {
        PlyMeta {
            step: None,
            origin: [0.0; 3],
            scale: 1.0,
            frame: ExportFrame::Dataset,
            scene_radius: 1.0,
            antialiased: false,
            dropped: 0,
        }
    }
}

/// What a PLY file turned out to hold.
#[derive(Debug, Clone, PartialEq)]
pub enum PlyContent {
    /// A trained scene (the file has `f_dc_0`).
    Gaussians {
        /// The rows, in the frame that `meta` names; quaternions are unit.
        columns: Columns,
        /// What the comments say.
        meta: PlyMeta,
    },
    /// Coloured points.
    Points {
        /// Positions.
        positions: Vec<[f64; 3]>,
        /// sRGB, one per position; mid grey when the file has no colours.
        colors: Vec<[u8; 3]>,
        /// Rows left out because a value was not finite.
        dropped: u64,
    },
}

/// Moves Gaussians that were read with `meta` into the local frame of `origin` and `scale`.
///
/// In f64, then rounded once: `local = (p - origin) / scale` for a file in the dataset's frame; a file in another
/// local frame goes through the dataset's. Log-scales get the log of the ratio of the scales. A file in this very
/// frame keeps its bits. Rows whose values leave f32 on the way are removed; returns how many.
pub fn to_local(columns: &mut Columns, meta: &PlyMeta, origin: [f64; 3], scale: f64) -> u64 {
    let (file_origin, file_scale) = match meta.frame {
        ExportFrame::Local => (meta.origin, meta.scale),
        ExportFrame::Dataset => ([0.0; 3], 1.0),
    };
    if file_origin == origin && file_scale == scale {
        return 0;
    }
    let shift: [f64; 3] = std::array::from_fn(|i| file_origin[i] - origin[i]);
    for mean in columns.means.as_chunks_mut::<3>().0 {
        for i in 0..3 {
            mean[i] = ((f64::from(mean[i]) * file_scale + shift[i]) / scale) as f32;
        }
    }
    let log_ratio = libm::log(file_scale / scale);
    for s in &mut columns.scales {
        *s = (f64::from(*s) + log_ratio) as f32;
    }
    remove_rows_that_are_not_finite(columns)
}

fn remove_rows_that_are_not_finite(columns: &mut Columns) -> u64 {
    use crate::scene::columns::Column;
    let rows = columns.rows();
    let mut kept = 0;
    for row in 0..rows {
        if !Column::ALL.into_iter().all(|c| columns.row(c, row).iter().all(|v| v.is_finite())) {
            continue;
        }
        if kept != row {
            for column in Column::ALL {
                let width = column.width(columns.sh_degree);
                columns.column_mut(column).copy_within(row * width..(row + 1) * width, kept * width);
            }
        }
        kept += 1;
    }
    columns.resize(kept);
    (rows - kept) as u64
}

/// The same rotation at unit length. One that is unit already, to the rounding of f32, keeps its bits, so writing and
/// reading again changes nothing; all zeros become the identity. Finite input gives finite output.
fn unit_quat(q: [f32; 4]) -> [f32; 4] {
    let norm2: f64 = q.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    // Normalising in f64 and rounding leaves at most 2.4e-7 here.
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
            // Each of four squares is off by at most 2 * 2^-24 of itself.
            assert!((norm2 - 1.0).abs() < 2.5e-7, "{q:?} -> {once:?}");
            assert_eq!(once, unit_quat(once));
        }
    }

    #[test]
    fn far_offsets_stay_local() {
        let utm = [500_000.0, 5_000_000.0, 100.0];
        assert_eq!(ExportFrame::Dataset.that_fits(utm, 200.0), ExportFrame::Local);
        assert_eq!(ExportFrame::Dataset.that_fits(utm, 20_000.0), ExportFrame::Dataset);
        assert_eq!(ExportFrame::Local.that_fits([0.0; 3], 1.0), ExportFrame::Local);
        assert_eq!(ExportFrame::Dataset.that_fits([0.0; 3], 0.0), ExportFrame::Dataset);
    }
}
