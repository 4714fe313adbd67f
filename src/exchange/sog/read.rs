//! Reads a folder of Streamed SOG, level by level: what a viewer shows if it shows one level everywhere.
//!
//! Not here: one SOG ([`super::read_chunk`]).
//!
//! Invariants: 1. a level has each row of a file at most once, so its memory follows from files that exist, not from numbers in
//! `lod-meta.json`; 2. no name leaves the folder.

use super::read_chunk::{SogChunk, malformed, path_in_folder, read_json, unsupported};
use super::tree::FilePart;
use crate::base::error::InputResult;
use crate::base::room;
use crate::base::whole_file::folder_of;
use crate::exchange::meta::SceneMeta;
use crate::exchange::transform::{TRANSFORM_ENDING, Transform};
use crate::scene::columns::{Column, Columns};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::Path;

#[derive(Deserialize)]
struct TreeText {
    version: Option<u32>,
    asset: Option<Asset>,
    filenames: Vec<String>,
    environment: Option<String>,
    tree: Node,
}

#[derive(Deserialize)]
struct Asset {
    generator: Option<String>,
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

/// A level: its number, the finest is 0, and its parts in the order of files.
#[derive(Debug)]
struct Level {
    number: u32,
    parts: Vec<FilePart>,
}

/// A folder that is open for reading.
#[derive(Debug)]
pub struct SogReader {
    files: Vec<SogChunk>,
    always_shown: Option<SogChunk>,
    levels: Vec<Level>,
    meta: SceneMeta,
}

impl SogReader {
    /// Opens the folder of the `lod-meta.json` at `path`, and reads everything but the pictures.
    /// Errors: a file cannot be read, or is not as the format says.
    pub fn open(path: &Path) -> InputResult<SogReader> {
        let text: TreeText = read_json(path)?;
        if let Some(version) = text.version.filter(|version| *version > 1) {
            return Err(
                unsupported(path, format!("version {version} of Streamed SOG; version 1 is read")).at("version")
            );
        }
        let mut named = BTreeSet::new();
        let mut open = |name: &String| {
            let file = path_in_folder(path, name)?;
            match named.insert(file.clone()) {
                true => SogChunk::open(&file),
                false => Err(malformed(path, format!("names the file '{name}' twice"))),
            }
        };
        let files: Vec<SogChunk> = text.filenames.iter().map(&mut open).collect::<InputResult<_>>()?;
        let always_shown = text.environment.as_ref().map(&mut open).transpose()?;
        let levels = levels_of(path, text.tree, &files)?;
        let is_ours = text.asset.and_then(|asset| asset.generator).is_some_and(|name| name.starts_with("gsscale"));
        let antialiased = files.iter().chain(&always_shown).any(SogChunk::is_antialiased);
        // A folder of gsscale has a transform.
        let transform = folder_of(path).join(TRANSFORM_ENDING);
        let meta = match read_json::<Transform>(&transform) {
            Err(e) if e.kind == Some(ErrorKind::NotFound) && !is_ours => SceneMeta::default(),
            read => read?.meta(&transform)?,
        };
        let meta = SceneMeta { antialiased, ..meta };
        Ok(SogReader { files, always_shown, levels, meta })
    }

    /// The numbers of the levels, at least one, ascending; the finest level is 0.
    pub fn levels(&self) -> Vec<u32> {
        self.levels.iter().map(|level| level.number).collect()
    }

    /// The rows of the level at `index` in [`SogReader::levels`], with the rows that are always shown, in the coordinates of the
    /// files.
    /// Errors: a picture cannot be read, or is not as the format says.
    pub fn rows(&self, index: usize) -> InputResult<Columns> {
        let mut rows = match &self.always_shown {
            Some(file) => file.read()?,
            None => Columns::zeros(0, 0),
        };
        for of_file in self.levels[index].parts.chunk_by(|a, b| a.file == b.file) {
            let mut chunk = self.files[of_file[0].file].read()?;
            if rows.sh_degree < chunk.sh_degree {
                rows.raise_sh_degree(chunk.sh_degree);
            }
            chunk.raise_sh_degree(rows.sh_degree);
            of_file.iter().for_each(|part| append(&mut rows, &chunk, part));
        }
        Ok(rows)
    }

    /// How the coordinates of the files relate to those of the dataset, as the folder's transform says. Without a transform the files
    /// are taken to be in the coordinates of the dataset.
    pub fn meta(&self) -> &SceneMeta {
        &self.meta
    }
}

fn levels_of(path: &Path, tree: Node, files: &[SogChunk]) -> InputResult<Vec<Level>> {
    let mut by_level: BTreeMap<u32, Vec<FilePart>> = BTreeMap::new();
    let mut open = vec![tree];
    while let Some(node) = open.pop() {
        for (level, PartText { file, offset, count }) in node.lods {
            let end = offset.checked_add(count);
            if files.get(file).zip(end).is_none_or(|(file, end)| end > file.rows()) {
                let problem =
                    format!("a leaf has rows {offset} to {offset} + {count} of file {file}, which do not exist");
                return Err(malformed(path, problem).at(format!("level {level}")));
            }
            by_level.entry(level).or_default().push(FilePart { file, first: offset, rows: count });
        }
        open.extend(node.children);
    }
    let mut levels: Vec<Level> = by_level.into_iter().map(|(number, parts)| Level { number, parts }).collect();
    if levels.is_empty() {
        return Err(malformed(path, "has no leaf with Gaussians"));
    }
    for Level { number, parts } in &mut levels {
        parts.sort_unstable_by_key(|part| (part.file, part.first));
        let twice = parts.array_windows().find(|[a, b]| a.file == b.file && b.first < a.first + a.rows);
        if let Some([_, part]) = twice {
            let problem = format!("two leaves have row {} of file {}", part.first, part.file);
            return Err(malformed(path, problem).at(format!("level {number}")));
        }
    }
    Ok(levels)
}

fn append(rows: &mut Columns, chunk: &Columns, part: &FilePart) {
    let end = part.first + part.rows;
    for column in Column::ALL {
        let width = column.width(chunk.sh_degree);
        room::extend(rows.column_mut(column), &chunk.column(column)[width * part.first..width * end]);
    }
}
