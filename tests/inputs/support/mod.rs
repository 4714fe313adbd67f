//! Where the photo scenes are, EXIF data, rows of exported files.

#[allow(dead_code)] // the programs use all of it
#[path = "../../support/exif.rs"]
pub mod exif;
#[path = "../../support/shared.rs"]
pub mod shared;

/// A Gaussian as a reader of an exported file gives it, in the axes of a PLY.
#[derive(Clone)]
pub struct ExportedRow {
    pub position: [f64; 3],
    pub alpha: f64,
    pub sh0: [f64; 3],
    pub log_scales: [f64; 3],
    /// w first.
    pub quat: [f64; 4],
    pub sh_n: Vec<f64>,
}
