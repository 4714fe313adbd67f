//! The formats of exported Gaussians: file names, sinks, and the files that a run keeps.
//!
//! Invariant: everything that follows from a format is a `match` in this file, so that the compiler lists what a new format needs.

use super::meta::{ExportFrame, SceneMeta};
use super::ply::{PlyWriter, holds_gaussians};
use super::sink::GaussianSink;
use super::sog::{SogWriter, TREE_FILE, folder_of_tree, is_of_sog, is_tree, memory_bytes};
use super::spz::{SPZ_UP, SpzWriter};
use super::transform::{is_transform, transform_path, write_transform};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::check_replaceable;
use crate::base::whole_folder::{check_ours, remove_ours};
use crate::scene::rotation::VIEWER_UP;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportFormat {
    /// All values as they are; the only one that training reads.
    Ply,
    /// About a tenth of the bytes.
    Spz,
    /// A folder that viewers load in parts, with levels of detail; named by the path of its [`TREE_FILE`].
    Sog,
}

/// What a run writes for viewers: always a PLY, and these beside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Exports {
    pub spz: bool,
    pub sog: bool,
}

impl Exports {
    /// The formats, the PLY first.
    pub fn formats(self) -> impl Iterator<Item = ExportFormat> {
        ExportFormat::ALL.into_iter().filter(move |format| match format {
            ExportFormat::Ply => true,
            ExportFormat::Spz => self.spz,
            ExportFormat::Sog => self.sog,
        })
    }
}

impl ExportFormat {
    pub const ALL: [ExportFormat; 3] = [ExportFormat::Ply, ExportFormat::Spz, ExportFormat::Sog];

    /// The file names of the formats, for help and remedies.
    pub const NAMES: &str = ".ply, .spz, or lod-meta.json in a folder of its own (SOG with levels of detail)";

    /// The format of a file, by the ending of its name or the whole name.
    /// Errors: no format has this name.
    pub fn of_path(path: &Path) -> InputResult<ExportFormat> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        let is = |word: &str| ending.eq_ignore_ascii_case(word);
        match () {
            () if is("ply") => Ok(ExportFormat::Ply),
            () if is("spz") => Ok(ExportFormat::Spz),
            () if is_tree(path) => Ok(ExportFormat::Sog),
            () => {
                let remedy = format!("use {}", ExportFormat::NAMES);
                Err(InputError::new(path, "no export format has this file name", remedy))
            }
        }
    }

    /// Most memory of the format's sink for `rows` rows beside its input, bytes; a few MiB count as none.
    pub fn memory_bytes(self, rows: u64) -> u64 {
        match self {
            ExportFormat::Ply | ExportFormat::Spz => 0,
            ExportFormat::Sog => memory_bytes(rows),
        }
    }

    /// The export that a run writes beside its PLY; `None` for the PLY itself.
    pub fn beside(self, ply: &Path) -> Option<PathBuf> {
        match self {
            ExportFormat::Ply => None,
            ExportFormat::Spz => Some(ply.with_extension("spz")),
            ExportFormat::Sog => {
                let mut folder = ply.file_stem().unwrap_or_default().to_os_string();
                folder.push("_sog");
                Some(ply.with_file_name(folder).join(TREE_FILE))
            }
        }
    }

    /// Checks that [`ExportFormat::remove`] may remove the export `file`.
    /// Errors: a folder has the name of the file, or the folder of the export holds files that no export wrote, or cannot be listed.
    pub fn check_removable(self, file: &Path) -> InputResult<()> {
        match self {
            ExportFormat::Ply | ExportFormat::Spz if file.is_dir() => Err(InputError::new(
                file,
                "is a folder where a file of the results belongs",
                "move or rename the folder",
            )),
            ExportFormat::Ply | ExportFormat::Spz => Ok(()),
            ExportFormat::Sog => check_ours(folder_of_tree(file)?, is_of_sog),
        }
    }

    /// Checks that an export for a user may write `file` and its transform: a slip in a command must not cost a scan or a model.
    /// Errors: as [`ExportFormat::check_removable`], or one of the two exists and no export writes such a file.
    pub fn check_replaceable(self, flag: &str, file: &Path) -> InputResult<()> {
        self.check_removable(file)?;
        match self {
            // Points that somebody has scanned are PLY files, too.
            ExportFormat::Ply => check_replaceable(flag, file, |file| holds_gaussians(file).unwrap_or(false))?,
            ExportFormat::Spz => check_replaceable(flag, file, is_gzip)?,
            ExportFormat::Sog => return Ok(()),
        }
        check_replaceable(flag, &transform_path(file), is_transform)
    }

    /// Removes the export `file` and its transform, if they exist.
    /// Errors: as [`ExportFormat::check_removable`], or the drive fails.
    pub fn remove(self, file: &Path) -> InputResult<()> {
        let remove_file = |path: &Path| match std::fs::remove_file(path) {
            Err(e) if path.is_file() => Err(InputError::io(path, "removing the earlier run's file", &e)),
            _ => Ok(()),
        };
        match self {
            ExportFormat::Ply | ExportFormat::Spz => {
                remove_file(file)?;
                remove_file(&transform_path(file))
            }
            ExportFormat::Sog => remove_ours(folder_of_tree(file)?, is_of_sog),
        }
    }

    /// Starts a file of at most `rows_at_most` rows with the bands of `sh_degree`.
    /// Errors: the disk fails, or `path` names no file.
    pub fn create(
        self,
        path: &Path,
        sh_degree: u8,
        rows_at_most: u64,
        meta: &SceneMeta,
    ) -> InputResult<Box<dyn GaussianSink>> {
        Ok(match self {
            ExportFormat::Ply => Box::new(PlyWriter::create(path, sh_degree, rows_at_most, meta)?),
            ExportFormat::Spz => Box::new(SpzWriter::create(path, sh_degree, meta)?),
            ExportFormat::Sog => Box::new(SogWriter::create(folder_of_tree(path)?, sh_degree, meta)?),
        })
    }

    /// Writes the transform from a file of this format to the dataset's coordinates, beside the file. `meta` is that of a PLY. A folder of
    /// SOGs holds its own already.
    /// Errors: the folder cannot be written.
    pub fn write_transform(self, path: &Path, meta: &SceneMeta, frame: ExportFrame) -> InputResult<()> {
        match self {
            ExportFormat::Ply => write_transform(path, meta, frame, meta.upright.map(|_| VIEWER_UP)),
            ExportFormat::Sog => Ok(()),
            ExportFormat::Spz => write_transform(path, &SpzWriter::spz_meta(meta), frame, meta.upright.map(|_| SPZ_UP)),
        }
    }
}

/// Whether a file begins as gzip does.
fn is_gzip(file: &Path) -> bool {
    let mut magic = [0; 2];
    File::open(file).and_then(|mut file| file.read_exact(&mut magic)).is_ok() && magic == [0x1f, 0x8b]
}
