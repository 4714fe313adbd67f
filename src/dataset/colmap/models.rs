//! COLMAP's camera models: ids, names, parameter order, and the corresponding lens.
//!
//! The table follows COLMAP's `src/colmap/sensor/models` (ids 0 to 17 in 2026).

use crate::dataset::gathered::checked_intrinsics;
use crate::dataset::model::{Intrinsics, Lens};

pub(super) const UNDISTORT: &str =
    "undistort the photos first, which writes PINHOLE cameras: colmap image_undistorter --output_type COLMAP";

#[derive(Debug, PartialEq, Eq)]
pub(super) struct CameraModel {
    pub id: i32,
    pub name: &'static str,
    /// Number of parameters of a supported model, 0 for an unsupported one.
    pub params: usize,
}

const fn model(id: i32, name: &'static str, params: usize) -> CameraModel {
    CameraModel { id, name, params }
}

static MODELS: [CameraModel; 18] = [
    model(0, "SIMPLE_PINHOLE", 3),
    model(1, "PINHOLE", 4),
    model(2, "SIMPLE_RADIAL", 4),
    model(3, "RADIAL", 5),
    model(4, "OPENCV", 8),
    model(5, "OPENCV_FISHEYE", 8),
    model(6, "FULL_OPENCV", 12),
    model(7, "FOV", 0),
    model(8, "SIMPLE_RADIAL_FISHEYE", 4),
    model(9, "RADIAL_FISHEYE", 5),
    model(10, "THIN_PRISM_FISHEYE", 0),
    model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 0),
    model(12, "SIMPLE_DIVISION", 0),
    model(13, "DIVISION", 0),
    model(14, "SIMPLE_FISHEYE", 0),
    model(15, "FISHEYE", 0),
    model(16, "EUCM", 0),
    model(17, "EQUIRECTANGULAR", 0),
];

/// The supported model that `is_meant`, called `word` in the file, or the reason.
pub(super) fn model_of(word: &str, is_meant: impl Fn(&CameraModel) -> bool) -> Result<&'static CameraModel, String> {
    match MODELS.iter().find(|m| is_meant(m)) {
        Some(m) if m.params > 0 => Ok(m),
        Some(m) => Err(format!("camera model {} (id {}) is not supported", m.name, m.id)),
        None => Err(format!("camera model {word} is unknown")),
    }
}

/// Intrinsics from COLMAP's parameters; `p` has `m.params` values.
pub(super) fn intrinsics(m: &CameraModel, size: (u64, u64), p: &[f64]) -> Result<Intrinsics, String> {
    if p.len() != m.params {
        return Err(format!("{} takes {} parameters, not {}", m.name, m.params, p.len()));
    }
    let one_focal = matches!(m.id, 0 | 2 | 3 | 8 | 9);
    let (focal, centre, k) =
        if one_focal { ([p[0], p[0]], [p[1], p[2]], &p[3..]) } else { ([p[0], p[1]], [p[2], p[3]], &p[4..]) };
    let coefficient = |i: usize| k.get(i).copied().unwrap_or(0.0);
    let lens = match m.id {
        2 | 3 | 4 | 6 => Lens::Radial(std::array::from_fn(coefficient)),
        5 | 8 | 9 => Lens::Fisheye(std::array::from_fn(coefficient)),
        _ => Lens::Pinhole,
    };
    checked_intrinsics(size, focal, centre, lens)
}
