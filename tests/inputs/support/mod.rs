//! Where the photo scenes are, EXIF data, look-alikes of published datasets, rows of exported files.

#[allow(dead_code)] // the programs use all of it
#[path = "../../support/exif.rs"]
pub mod exif;
#[path = "../../support/lookalike.rs"]
pub mod lookalike;
#[path = "../../support/shared.rs"]
pub mod shared;

use std::collections::BTreeMap;
use std::path::Path;

/// Every file below a folder by its path there.
pub fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut found, mut open) = (BTreeMap::new(), vec![folder.to_path_buf()]);
    while let Some(at) = open.pop() {
        for path in std::fs::read_dir(at).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_string_lossy().replace('\\', "/");
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

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
