//! Gaussians between the trainer's frame and that of a file: out ([`ExportRows`]) and back in ([`to_local`]).
//!
//! Not here: which frame a file holds ([`super::meta`]), the bytes of a format.
//!
//! Invariants: 1. every change is computed in f64 and rounded once; 2. values that need no change keep their bits; 3. a row with
//! a value that is not finite, before or after the change, does not leave.

use super::meta::{ExportFrame, SceneMeta};
use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::rotation::{GaussianRotation, Rotation};

/// Local units beyond which a position in a file is a fault of the file. Half of the cameras are within 1.
const FAR_MOST: f32 = 1e6;
/// Most values of the bands above the constant one.
const BANDS_MAX: usize = 45;

/// A Gaussian as files hold it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExportRow {
    /// Position in the file's frame.
    pub position: [f32; 3],
    /// Natural logs of the sigmas, file units.
    pub log_scales: [f32; 3],
    /// Unit quaternion, w first.
    pub quat: [f32; 4],
    /// Logit of the opacity.
    pub opacity: f32,
    /// Constant band, one value a channel.
    pub sh0: [f32; 3],
    /// Bands above it, coefficient by coefficient, three channels each; zeros above those of the row.
    pub sh_n: [f32; BANDS_MAX],
}

/// Brings rows of the local frame into that of a file.
///
/// In the dataset's frame positions are `means * scale + origin`, and `ln(scale)` is added to the log-scales. Then
/// [`SceneMeta::upright`] turns positions, quaternions and harmonics. Quaternions get unit length, as viewers expect; the
/// rotation is the same.
#[derive(Debug, Clone)]
pub struct ExportRows {
    frame: ExportFrame,
    origin: [f64; 3],
    scale: f64,
    log_scale: f64,
    turning: GaussianRotation,
}

impl ExportRows {
    /// For a file with this metadata, in the frame that `meta` requests if f32 can hold it.
    pub fn new(meta: &SceneMeta) -> ExportRows {
        let frame = meta.frame.fitting_f32(meta.origin, meta.scene_radius);
        let turning = GaussianRotation::new(meta.upright.unwrap_or(Rotation::IDENTITY));
        ExportRows { frame, origin: meta.origin, scale: meta.scale, log_scale: libm::log(meta.scale), turning }
    }

    pub fn frame(&self) -> ExportFrame {
        self.frame
    }

    /// A position of the local frame in that of the file.
    pub fn position(&self, local: [f64; 3]) -> [f64; 3] {
        let is_local = self.frame == ExportFrame::Local;
        let at = |i: usize| if is_local { local[i] } else { local[i] * self.scale + self.origin[i] };
        self.turning.position([at(0), at(1), at(2)])
    }

    /// A row in the file's frame; `None` if a value is not finite.
    pub fn row(&self, c: &Columns, row: usize) -> Option<ExportRow> {
        let is_local = self.frame == ExportFrame::Local;
        let (mean, scales, quat) = (c.row(Column::Means, row), c.row(Column::Scales, row), c.row(Column::Quats, row));
        let log_scale = |i: usize| if is_local { scales[i] } else { (f64::from(scales[i]) + self.log_scale) as f32 };
        let (sh0, given) = (c.row(Column::Sh0, row), c.row(Column::ShN, row));
        let mut sh_n = [0.0; BANDS_MAX];
        sh_n[..given.len()].copy_from_slice(given);
        self.turning.harmonics(&mut sh_n[..given.len()]);
        // At unit length first: a turned quaternion of any length might overflow.
        let unit = unit_quat([quat[0], quat[1], quat[2], quat[3]]);
        let turned = if self.turning.is_identity() { unit } else { unit_quat(self.turning.orientation(unit)) };
        let exported = ExportRow {
            position: self.position([mean[0], mean[1], mean[2]].map(f64::from)).map(|x| x as f32),
            log_scales: [0, 1, 2].map(log_scale),
            quat: turned,
            opacity: c.opacities[row],
            sh0: [sh0[0], sh0[1], sh0[2]],
            sh_n,
        };
        (quat.iter().all(|v| v.is_finite()) && exported.is_finite()).then_some(exported)
    }
}

impl ExportRow {
    fn is_finite(&self) -> bool {
        let ExportRow { position, log_scales, quat, opacity, sh0, sh_n } = self;
        let parts: [&[f32]; 6] = [position, log_scales, quat, std::slice::from_ref(opacity), sh0, sh_n];
        parts.into_iter().flatten().all(|v| v.is_finite())
    }
}

/// Converts Gaussians that were read with `meta` into the local frame of `origin` and `scale`, with the axes of the
/// dataset.
///
/// An upright file is turned back first ([`rotate_back`]). Then, computed in f64 and rounded once: `local = (p - origin) /
/// scale` for a file in the dataset's frame; a file in another local frame is first converted to the dataset's. The log of
/// the ratio of scales is added to log-scales. A file already in this local frame and in these axes keeps its bits. Rows
/// whose values overflow f32 are removed; returns how many.
pub fn to_local(columns: &mut Columns, meta: &SceneMeta, origin: [f64; 3], scale: f64) -> u64 {
    let (file_origin, file_scale) = match meta.frame {
        ExportFrame::Local => (meta.origin, meta.scale),
        ExportFrame::Dataset => ([0.0; 3], 1.0),
    };
    let turning = inverse_rotation(meta);
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
    rotate_quats_and_sh(columns, &turning);
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

/// As [`to_local`], for a file of another program: also removes rows more than a million units away.
pub fn file_to_local(columns: &mut Columns, meta: &SceneMeta, origin: [f64; 3], scale: f64) -> u64 {
    let overflown = to_local(columns, meta, origin, scale);
    overflown + columns.retain_rows(|columns, row| columns.row(Column::Means, row).iter().all(|x| x.abs() <= FAR_MOST))
}

/// Turns the rows of an upright file back to the axes of the dataset, in the file's frame. Leaves other files unchanged, bit
/// for bit.
pub fn rotate_back(columns: &mut Columns, meta: &SceneMeta) {
    let turning = inverse_rotation(meta);
    for mean in columns.means.as_chunks_mut::<3>().0 {
        *mean = turning.position(mean.map(f64::from)).map(|x| x as f32);
    }
    rotate_quats_and_sh(columns, &turning);
}

fn inverse_rotation(meta: &SceneMeta) -> GaussianRotation {
    GaussianRotation::new(meta.upright.map_or(Rotation::IDENTITY, |upright| upright.inverse()))
}

fn rotate_quats_and_sh(columns: &mut Columns, turning: &GaussianRotation) {
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
pub(super) fn unit_quat(q: [f32; 4]) -> [f32; 4] {
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
