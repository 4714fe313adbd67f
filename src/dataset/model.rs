//! What a reader is asked for and what it returns before any photo is opened: plain data in the dataset's own
//! coordinates, all f64.

use crate::base::error::InputResult;
use glam::{DMat3, DVec3};
use std::path::PathBuf;

/// The user's options for reading a scene.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Image folder, relative to the scene; `None` is `images`. Photo names in transforms.json include their folder:
    /// for these, `images` is only a second place to look, and any other folder replaces the one in the name.
    pub images: Option<String>,
    /// Drop a view with a warning, instead of failing, if its missing photo is needed now (the JSON does not state its
    /// size). The loader reports missing photos whose size is known.
    pub allow_missing: bool,
    /// Leave points in their file and return its path: they may exceed memory.
    pub points_later: bool,
}

/// Supported lens models, with COLMAP's parameter order in the comments.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    Pinhole,
    /// k1, k2, p1, p2, k3, k4, k5, k6: radial (rational if k4..k6 are not 0) and tangential, as OpenCV's.
    /// SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV are cases of it.
    Radial([f64; 8]),
    /// k1, k2, k3, k4 on the angle (equidistant fisheye), as OpenCV's fisheye.
    /// SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE and OPENCV_FISHEYE are cases of it.
    Fisheye([f64; 4]),
}

impl Lens {
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Lens::Pinhole => &[],
            Lens::Radial(k) => k,
            Lens::Fisheye(k) => k,
        }
    }

    pub fn distorts(&self) -> bool {
        !self.coefficients().is_empty()
    }

    /// The same mapping without needless parameters: a radial lens of zeros is a pinhole.
    pub fn simplified(self) -> Lens {
        if self == Lens::Radial([0.0; 8]) { Lens::Pinhole } else { self }
    }
}

/// Intrinsics of a photo as the dataset states them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Size that the other numbers refer to, pixels.
    pub width: u32,
    pub height: u32,
    /// Focal lengths, pixels.
    pub fx: f64,
    pub fy: f64,
    /// Principal point, pixels; the centre of the first pixel is (0.5, 0.5).
    pub cx: f64,
    pub cy: f64,
    pub lens: Lens,
}

/// World to camera, OpenCV axes: `p_cam = rotation * p + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: DMat3,
    /// Camera-space position of the world's origin.
    pub translation: DVec3,
}

impl Pose {
    pub fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    Train,
    /// Held out: only evaluated.
    Test,
}

#[derive(Debug, Clone, PartialEq)]
pub struct RawView {
    /// Name in the dataset, `/`-separated, relative to the image folder and checked to stay inside it.
    pub name: String,
    pub image_path: PathBuf,
    /// Intrinsics at the size stated by the dataset.
    pub intrinsics: Intrinsics,
    pub pose: Pose,
    /// A mask named by the dataset itself; the loader finds masks by folder.
    pub mask_path: Option<PathBuf>,
    /// The split that the dataset prescribes (transforms_train/val/test.json), if any.
    pub split: Option<Split>,
}

/// Receives points one by one: position in dataset coordinates, sRGB.
pub type TakePoint<'a> = dyn FnMut([f64; 3], [u8; 3]) -> InputResult<()> + 'a;

#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions, dataset coordinates.
    pub positions: Vec<[f64; 3]>,
    /// sRGB, one per position.
    pub colors: Vec<[u8; 3]>,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct RawScene {
    /// The scene's own folder, which may contain `masks/`; empty if the scene was not read from files.
    pub root: PathBuf,
    /// Views sorted by name; names are unique.
    pub views: Vec<RawView>,
    pub points: PointCloud,
    /// An existing file of points that the caller must read: a PLY that the dataset names, because this module does not
    /// read PLY; or, with [`ReadOptions::points_later`], the model's own points3D file
    /// ([`super::colmap::stream_points`]).
    pub points_path: Option<PathBuf>,
    /// Everything dropped or repaired, one sentence each, for the user.
    pub warnings: Vec<String>,
}
