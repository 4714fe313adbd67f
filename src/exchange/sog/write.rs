//! Writes Gaussians to a folder of SOGs with levels of detail.
//!
//! The writer takes rows in groups, in the order in which they come. It sorts a group by position, cuts it into leaves and writes its
//! rows as one file of the finest level. It merges each leaf to a quarter, a sixteenth and a sixty-fourth of its rows and adds these to
//! the open file of their level. Giants go to a folder of their own, which viewers always show: in a leaf, the box of a giant would
//! contain every camera. The transform to the dataset's coordinates lies in the folder, so that it moves with it.
//!
//! Invariants: 1. memory is bounded by [`memory_bytes`] for any number of rows; 2. the bytes depend on the rows, their order and
//! the metadata alone, not on the parts in which rows come; 3. the folder appears as a whole; 4. [`is_of_sog`] accepts
//! every file in the folder.

use super::chunk::{META_FILE, PICTURES, write_chunk};
use super::merge::{MERGE_ROW_BYTES, merged};
use super::order::{leaves, order};
use super::symmetric::Symmetric;
use super::tree::{FilePart, Leaf, TREE_FILE, text};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_folder::PartFolder;
use crate::exchange::frames::{ExportRow, ExportRows};
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::sink::{Format, FormatSink, LEVELS_MAX, LevelCounts};
use crate::exchange::transform::{TRANSFORM_ENDING, transform_text};
use crate::scene::rotation::VIEWER_UP;
use rayon::prelude::*;
use std::path::{Component, Path};

/// Number of levels, including the finest.
const LEVELS: usize = LEVELS_MAX;
/// Rows of a level for each row of the next coarser level.
const COARSER: usize = 4;
/// Rows of a group, which is a file of the finest level.
const GROUP_ROWS: usize = 1 << 16;
const LEAF_ROWS: usize = 1 << 13;
/// Rows at which the open file of a coarser level is full.
const FULL_ROWS: usize = 1 << 15;
/// Most giants. Further ones stay in their leaves.
const GIANTS_MAX: usize = 1 << 16;
/// Sigma of a giant, over the extent of the cameras.
const GIANT_RADII: f64 = 0.25;
/// Sigmas of a Gaussian inside the box of its leaf.
const BOX_SIGMAS: f64 = 2.0;
const GIANTS_FOLDER: &str = "env";

/// Most memory of a writer of `rows` rows beside its input, bytes.
pub fn memory_bytes(rows: u64) -> u64 {
    let most = |bound: usize| bound.min(usize::try_from(rows).unwrap_or(usize::MAX));
    let group_leaves = most(GROUP_ROWS).div_ceil(LEAF_ROWS);
    let coarser = GROUP_ROWS / 2 + (LEVELS - 1) * (FULL_ROWS + LEAF_ROWS);
    // Two copies of the SH coefficients of a file, pictures, codebooks.
    let encoding = most(GROUP_ROWS) * 500;
    let merging = rayon::current_num_threads().min(group_leaves) * LEAF_ROWS * MERGE_ROW_BYTES;
    let rows = most(GROUP_ROWS) + most(coarser) + most(GIANTS_MAX);
    (rows * size_of::<ExportRow>() + encoding.max(merging) + (4 << 20)) as u64
}

/// The folder that a path of a `lod-meta.json` names.
/// Errors: the path names no folder.
pub fn folder_of_tree(path: &Path) -> InputResult<&Path> {
    let folder = path.parent().unwrap_or(Path::new(""));
    match folder.components().next_back() {
        Some(Component::Normal(_)) => Ok(folder),
        _ => {
            let problem = format!("{TREE_FILE} needs a folder of its own");
            Err(InputError::new(path, problem, format!("name a new folder: city/{TREE_FILE}")))
        }
    }
}

/// Whether a writer makes a file of this path inside its folder.
pub fn is_of_sog(inside: &Path) -> bool {
    let names: Vec<&str> = inside.iter().filter_map(|name| name.to_str()).collect();
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    let is_level = |folder: &str| folder.split_once('_').is_some_and(|(a, b)| is_number(a) && is_number(b));
    match names[..] {
        [file] => file == TREE_FILE || file == TRANSFORM_ENDING,
        [folder, file] => {
            (folder == GIANTS_FOLDER || is_level(folder)) && (file == META_FILE || PICTURES.contains(&file))
        }
        _ => false,
    }
}

/// The file of a level that is being filled.
#[derive(Default)]
struct LevelFile {
    rows: Vec<ExportRow>,
    number: usize,
}

pub struct SogWriter {
    folder: PartFolder,
    frame: ExportFrame,
    meta: SceneMeta,
    sh_degree: u8,
    giant_log_scale: f64,
    group: Vec<ExportRow>,
    giants: Vec<ExportRow>,
    open: [LevelFile; LEVELS],
    /// Files of each level so far, for their names.
    files_of: [usize; LEVELS],
    files: Vec<String>,
    leaves: Vec<Leaf>,
    rows: [u64; LEVELS],
}

impl SogWriter {
    /// Starts the folder `path` of rows with the bands of `sh_degree`, beside its target. `meta` is that of a PLY of the same rows:
    /// both have the same axes.
    /// Errors: the disk fails, or the folder `path` holds files that are not of an export.
    pub fn create(path: &Path, sh_degree: u8, meta: &SceneMeta) -> InputResult<FormatSink<SogWriter>> {
        let to_file = ExportRows::new(meta);
        let unit = if to_file.frame() == ExportFrame::Local { meta.scale } else { 1.0 };
        let writer = SogWriter {
            folder: PartFolder::create(path, is_of_sog)?,
            frame: to_file.frame(),
            giant_log_scale: libm::log(GIANT_RADII * meta.scene_radius / unit),
            meta: meta.clone(),
            sh_degree,
            group: Vec::new(),
            giants: Vec::new(),
            open: std::array::from_fn(|_| LevelFile::default()),
            files_of: [0; LEVELS],
            files: Vec::new(),
            leaves: Vec::new(),
            rows: [0; LEVELS],
        };
        Ok(FormatSink::new(path, sh_degree, to_file, writer))
    }

    fn new_file(&mut self, level: usize) -> usize {
        self.files.push(format!("{level}_{}/{META_FILE}", self.files_of[level]));
        self.files_of[level] += 1;
        self.files.len() - 1
    }

    fn write_file(&mut self, number: usize, rows: &mut Vec<ExportRow>) -> InputResult<()> {
        let inside = Path::new(&self.files[number]).parent().unwrap_or(Path::new("")).to_path_buf();
        write_chunk(&mut self.folder, &inside, rows, self.sh_degree)?;
        rows.clear();
        Ok(())
    }

    /// Makes leaves of the group, and a file of its rows.
    fn close_group(&mut self) -> InputResult<()> {
        if self.group.is_empty() {
            return Ok(());
        }
        let positions: Vec<[f64; 3]> = self.group.iter().map(|row| row.position.map(f64::from)).collect();
        let order = order(&positions);
        let mut ordered: Vec<ExportRow> = order.iter().map(|&row| self.group[row as usize]).collect();
        // Allocated again for the next group: rows, their order and what comes of them would be too much at once.
        self.group = Vec::new();
        let file = self.new_file(0);
        let ranges = leaves(ordered.len(), LEAF_ROWS);
        let coarser_levels = |range: &std::ops::Range<usize>| {
            let mut levels: Vec<Vec<ExportRow>> = Vec::with_capacity(LEVELS - 1);
            for _ in 1..LEVELS {
                let finer = levels.last().map_or(&ordered[range.clone()], Vec::as_slice);
                levels.push(merged(finer, finer.len().div_ceil(COARSER)));
            }
            levels
        };
        let coarser: Vec<Vec<Vec<ExportRow>>> = ranges.par_iter().map(coarser_levels).collect();
        for (range, coarser) in ranges.into_iter().zip(coarser) {
            let mut parts = vec![FilePart { file, first: range.start, rows: range.len() }];
            for (level, rows) in (1..).zip(coarser) {
                parts.push(self.add(level, rows)?);
            }
            parts.iter().zip(&mut self.rows).for_each(|(part, sum)| *sum += part.rows as u64);
            let (low, high) = box_of(&ordered[range]);
            self.leaves.push(Leaf { low, high, parts });
        }
        self.write_file(file, &mut ordered)
    }

    fn add(&mut self, level: usize, rows: Vec<ExportRow>) -> InputResult<FilePart> {
        if self.open[level].rows.is_empty() {
            self.open[level].number = self.new_file(level);
        }
        let open = &mut self.open[level];
        open.rows.reserve_exact((FULL_ROWS + LEAF_ROWS).saturating_sub(open.rows.len()));
        let part = FilePart { file: open.number, first: open.rows.len(), rows: rows.len() };
        open.rows.extend(rows);
        if open.rows.len() >= FULL_ROWS {
            self.close_file(level)?;
        }
        Ok(part)
    }

    fn close_file(&mut self, level: usize) -> InputResult<()> {
        let mut rows = std::mem::take(&mut self.open[level].rows);
        if !rows.is_empty() {
            self.write_file(self.open[level].number, &mut rows)?;
        }
        self.open[level].rows = rows;
        Ok(())
    }
}

impl Format for SogWriter {
    fn put(&mut self, row: &ExportRow) -> InputResult<bool> {
        let longest = row.log_scales.iter().fold(f32::NEG_INFINITY, |most, &s| most.max(s));
        if self.giants.len() < GIANTS_MAX && f64::from(longest) > self.giant_log_scale {
            self.giants.push(*row);
            return Ok(true);
        }
        // Doubling would end at up to twice as many.
        if self.group.is_empty() {
            self.group.reserve_exact(GROUP_ROWS);
        }
        self.group.push(*row);
        if self.group.len() == GROUP_ROWS {
            self.close_group()?;
        }
        Ok(true)
    }

    fn complete(mut self) -> InputResult<(u64, Option<LevelCounts>)> {
        // A viewer needs a leaf.
        if self.group.is_empty() && self.leaves.is_empty() {
            self.group = std::mem::take(&mut self.giants);
        }
        self.close_group()?;
        for level in 1..LEVELS {
            self.close_file(level)?;
        }
        let giants = self.giants.len() as u64;
        if giants > 0 {
            write_chunk(&mut self.folder, Path::new(GIANTS_FOLDER), &self.giants, self.sh_degree)?;
        }
        let environment = format!("{GIANTS_FOLDER}/{META_FILE}");
        let tree = text(&mut self.leaves, &self.files, (giants > 0).then_some(&environment), LEVELS);
        let up = self.meta.upright.map(|_| VIEWER_UP);
        let transform = transform_text(Path::new(TREE_FILE), &self.meta, self.frame, up)?;
        self.folder.write(Path::new(TRANSFORM_ENDING), transform.as_bytes())?;
        self.folder.write(Path::new(TREE_FILE), tree.as_bytes())?;
        let bytes = self.folder.bytes();
        self.folder.finish()?;
        Ok((bytes, Some(LevelCounts { rows: self.rows, always_shown: giants })))
    }
}

fn box_of(rows: &[ExportRow]) -> ([f64; 3], [f64; 3]) {
    let mut bound = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for row in rows {
        let variances = row.log_scales.map(|s| libm::exp(2.0 * f64::from(s)));
        let spread = Symmetric::turned(row.quat.map(f64::from), variances).diagonal();
        for i in 0..3 {
            let (at, reach) = (f64::from(row.position[i]), BOX_SIGMAS * libm::sqrt(spread[i].max(0.0)));
            bound.0[i] = bound.0[i].min(at - reach);
            bound.1[i] = bound.1[i].max(at + reach);
        }
    }
    bound
}
