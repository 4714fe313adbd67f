//! Reads a folder of Streamed SOG, level by level: what a viewer shows if it shows one level everywhere.
//!
//! Not here: one SOG ([`super::read_chunk`]).
//!
//! Invariants: 1. memory follows from the rows of the level and the largest SOG, not from numbers that a file states; 2. no name
//! leaves the folder.

use super::read_chunk::{malformed, named_in, read_chunk, read_json};
use super::tree::{Part, TREE_FILE};
use crate::base::error::InputResult;
use crate::base::whole_file::folder_of;
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::transform::TRANSFORM_ENDING;
use crate::scene::columns::{Column, Columns};
use crate::scene::rotation::Rotation;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Largest deviation of the transform from a rotation and a scale, over the scale.
const TRANSFORM_TOLERANCE: f64 = 1e-9;

#[derive(Deserialize)]
struct TreeText {
    #[serde(rename = "lodLevels")]
    levels: u32,
    filenames: Vec<String>,
    environment: Option<String>,
    tree: Node,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Node>,
    /// By level.
    #[serde(default)]
    lods: BTreeMap<u32, PartText>,
}

#[derive(Deserialize)]
struct PartText {
    file: usize,
    offset: usize,
    count: usize,
}

#[derive(Deserialize)]
struct Transform {
    up_in_dataset: Option<[f64; 3]>,
    file_to_dataset: [[f64; 4]; 4],
}

/// A folder that is open for reading.
#[derive(Debug)]
pub struct SogReader {
    path: PathBuf,
    files: Vec<PathBuf>,
    always_shown: Option<PathBuf>,
    /// The parts of each level, in the order of files.
    parts: Vec<Vec<Part>>,
}

impl SogReader {
    /// Opens the folder of the `lod-meta.json` at `path`.
    ///
    /// # Errors
    /// The file cannot be read, or is not as the format says.
    pub fn open(path: &Path) -> InputResult<SogReader> {
        let text: TreeText = read_json(path)?;
        let files: Vec<PathBuf> =
            text.filenames.iter().map(|name| named_in(path, name)).collect::<InputResult<Vec<PathBuf>>>()?;
        let always_shown = text.environment.map(|name| named_in(path, &name)).transpose()?;
        let mut by_level: BTreeMap<u32, Vec<Part>> = BTreeMap::new();
        let mut open = vec![text.tree];
        while let Some(node) = open.pop() {
            for (level, part) in node.lods {
                if part.file >= files.len() || level >= text.levels {
                    let problem = format!("a leaf names file {} of {} at level {level}", part.file, files.len());
                    return Err(malformed(path, problem));
                }
                by_level.entry(level).or_default().push(Part { file: part.file, first: part.offset, rows: part.count });
            }
            open.extend(node.children);
        }
        let mut parts: Vec<Vec<Part>> = by_level.into_values().collect();
        if parts.is_empty() {
            return Err(malformed(path, "has no leaf with Gaussians"));
        }
        parts.iter_mut().for_each(|parts| parts.sort_unstable_by_key(|part| (part.file, part.first)));
        Ok(SogReader { path: path.to_path_buf(), files, always_shown, parts })
    }

    /// Number of levels.
    pub fn levels(&self) -> usize {
        self.parts.len()
    }

    /// The rows of a level, the finest is 0, with the rows that are always shown, in the coordinates of the files.
    ///
    /// # Errors
    /// A file cannot be read, or is not as the format says.
    pub fn level(&self, level: usize) -> InputResult<Columns> {
        let mut rows = match &self.always_shown {
            Some(file) => read_chunk(file)?,
            None => Columns::zeros(0, 0),
        };
        for of_file in self.parts[level].chunk_by(|a, b| a.file == b.file) {
            let file = &self.files[of_file[0].file];
            let mut chunk = read_chunk(file)?;
            if rows.sh_degree < chunk.sh_degree {
                rows.raise_sh_degree(chunk.sh_degree);
            }
            chunk.raise_sh_degree(rows.sh_degree);
            for part in of_file {
                append(&mut rows, &chunk, part).ok_or_else(|| {
                    let (first, count) = (part.first, part.rows);
                    malformed(&self.path, format!("rows {first} to {first} + {count} are not in {}", file.display()))
                })?;
            }
        }
        Ok(rows)
    }

    /// How the coordinates of the files relate to those of the dataset: as the folder's transform says, and as a file of the
    /// dataset's coordinates without one.
    ///
    /// # Errors
    /// The transform cannot be read, or is no rotation with a scale and an offset.
    pub fn meta(&self) -> InputResult<SceneMeta> {
        let path = folder_of(&self.path).join(TRANSFORM_ENDING);
        if !path.exists() {
            return Ok(SceneMeta::default());
        }
        let Transform { up_in_dataset, file_to_dataset: matrix } = read_json(&path)?;
        let upright = up_in_dataset.and_then(Rotation::upright);
        let squares = matrix[..3].iter().flat_map(|row| &row[..3]).map(|x| x * x).sum::<f64>();
        let scale = libm::sqrt(squares / 3.0);
        let back = upright.unwrap_or(Rotation::IDENTITY).inverse().matrix();
        let off = |i: usize, j: usize| (matrix[i][j] - scale * back[i][j]).abs() / scale;
        let is_known = (0..9).all(|k| off(k / 3, k % 3) <= TRANSFORM_TOLERANCE);
        let origin = [0, 1, 2].map(|i| matrix[i][3]);
        if !is_known || !origin.iter().all(|x| x.is_finite()) {
            return Err(malformed(&path, "is not the transform of an export"));
        }
        Ok(SceneMeta { origin, scale, frame: ExportFrame::Local, upright, scene_radius: scale, ..SceneMeta::default() })
    }
}

/// Appends a part of a file; `None` if the file lacks rows of it.
fn append(rows: &mut Columns, chunk: &Columns, part: &Part) -> Option<()> {
    let end = part.first.checked_add(part.rows)?;
    if end > chunk.rows() {
        return None;
    }
    for column in Column::ALL {
        let width = column.width(chunk.sh_degree);
        rows.column_mut(column).extend_from_slice(&chunk.column(column)[width * part.first..width * end]);
    }
    Some(())
}

/// Whether `path` is named like the `lod-meta.json` of a folder.
pub fn is_tree(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == TREE_FILE)
}
