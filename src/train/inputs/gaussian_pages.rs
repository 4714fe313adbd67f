//! First pages from any number of Gaussians.
//!
//! Rows pass through files into pages as points do ([`crate::dataset::import`]): the largest 0.5 % in pages of their
//! own, the others by median splits.
//!
//! Invariants: 1. memory stays within the given bound; 2. pages have the rows of [`crate::scene::partition::partition`]
//! in its order; the uid of a row is its number in the file.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::dataset::import::{Grown, PageSpace, Spool, SpoolSpace, SpoolWriter, paginate};
use crate::exchange::frames::to_local;
use crate::exchange::meta::SceneMeta;
use crate::exchange::ply::{ROW_HEAD, gaussians_header, push_row, stream_gaussians, take_row};
use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::log_scales::LogScaleRange;
use crate::scene::partition::Placed;
use crate::scene::state::SceneState;
use std::path::{Path, PathBuf};

/// Gaussians transformed into the local frame together.
const ROWS_AT_ONCE: usize = 1024;

/// A Gaussian with its number in the file.
#[derive(Debug, Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct Row {
    head: [f32; ROW_HEAD],
    sh_n: [[f32; 15]; 3],
    row: u32,
}

impl Placed for Row {
    fn point(&self) -> [f32; 3] {
        [self.head[0], self.head[1], self.head[2]]
    }
    fn row(&self) -> u32 {
        self.row
    }
}

impl Grown for Row {
    fn log_size(&self) -> f32 {
        self.head[7].max(self.head[8]).max(self.head[9])
    }
}

/// A file of Gaussians, read into a run's local frame with at most the run's SH degree.
#[derive(Debug, Clone)]
pub(crate) struct GaussianFile {
    path: PathBuf,
    meta: SceneMeta,
    sh_degree: u8,
    sh_degree_most: u8,
    origin: [f64; 3],
    scale: f64,
    log_scales: LogScaleRange,
}

/// What [`GaussianFile::read`] found besides Gaussians.
#[derive(Debug, Clone)]
pub(crate) struct GaussiansRead {
    pub meta: SceneMeta,
    /// Gaussians dropped because they are too far away for the local frame.
    pub far: u64,
    /// Gaussians dropped because they are too large for the scene.
    pub giants: u64,
}

impl GaussianFile {
    /// Opens the file for a run of at most `sh_degree_most` in the local frame of `origin` and `scale`, with this range of
    /// log-scales.
    /// Errors: the header is invalid.
    pub fn open(
        path: &Path,
        sh_degree_most: u8,
        (origin, scale): ([f64; 3], f64),
        log_scales: LogScaleRange,
    ) -> InputResult<GaussianFile> {
        let (meta, sh_degree) = gaussians_header(path)?;
        Ok(GaussianFile { path: path.to_path_buf(), meta, sh_degree, sh_degree_most, origin, scale, log_scales })
    }

    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Passes the Gaussians to `take` in batches, in the file's order, without those that are too far away or too large.
    /// Errors: the file cannot be read, or `take` failed.
    pub fn read(&self, take: &mut dyn FnMut(&Columns) -> InputResult<()>) -> InputResult<GaussiansRead> {
        let none = || Columns::zeros(0, self.sh_degree);
        let (mut some, mut far, mut giants) = (none(), 0, 0);
        let mut hand_on = |mut columns: Columns| {
            far += to_local(&mut columns, &self.meta, self.origin, self.scale);
            giants += remove_giants(&mut columns, self.log_scales);
            take(&truncate_sh(columns, self.sh_degree_most))
        };
        let meta = stream_gaussians(&self.path, &mut |values| {
            push_row(&mut some, values);
            match some.rows() {
                ROWS_AT_ONCE => hand_on(std::mem::replace(&mut some, none())),
                _ => Ok(()),
            }
        })?;
        hand_on(some)?;
        Ok(GaussiansRead { meta, far, giants })
    }
}

/// Resources for the import of Gaussians.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GaussianSpace<'a> {
    /// An existing folder for temporary files.
    pub folder: &'a Path,
    /// Bytes of memory.
    pub memory: usize,
}

impl<'a> GaussianSpace<'a> {
    fn of_list(&self) -> SpoolSpace<'a> {
        SpoolSpace { folder: self.folder, memory: self.memory / 10 }
    }
}

/// Collects Gaussians while they are read.
pub(crate) struct GaussianWriter<'a> {
    /// The source file, for messages.
    file: &'a Path,
    space: GaussianSpace<'a>,
    rows: SpoolWriter<Row>,
    next: u32,
    width: usize,
}

impl<'a> GaussianWriter<'a> {
    /// An empty writer.
    pub fn new(file: &'a Path, space: GaussianSpace<'a>) -> Self {
        GaussianWriter { file, space, rows: SpoolWriter::new(space.of_list()), next: 0, width: ROW_HEAD }
    }

    /// Adds the rows of `columns`.
    /// Errors: as [`GaussianWriter::push`].
    pub fn push_all(&mut self, columns: &Columns) -> InputResult<()> {
        let mut values = Vec::new();
        (0..columns.rows()).try_for_each(|row| {
            take_row(columns, row, &mut values);
            self.push(&values)
        })
    }

    /// Adds one Gaussian; all must have the same SH degree.
    /// Errors: the folder cannot be written, or there are 2^32 rows.
    pub fn push(&mut self, values: &[f32]) -> InputResult<()> {
        let mut row = Row { head: [0.0; ROW_HEAD], sh_n: [[0.0; 15]; 3], row: self.next };
        row.head.copy_from_slice(&values[..ROW_HEAD]);
        row.sh_n.as_flattened_mut()[..values.len() - ROW_HEAD].copy_from_slice(&values[ROW_HEAD..]);
        self.rows.push(row)?;
        self.width = values.len();
        let too_many = || InputError::new(self.file, "it has 2^32 Gaussians or more", "thin it out");
        self.next = self.next.checked_add(1).ok_or_else(too_many)?;
        Ok(())
    }

    /// Ends the input.
    /// Errors: the folder cannot be written.
    pub fn finish(self) -> InputResult<GaussianSpool<'a>> {
        let sh_degree = (0..=3).find(|&d| sh_n_width(d) == self.width - ROW_HEAD).unwrap_or(0);
        Ok(GaussianSpool { space: self.space, rows: self.rows.finish()?, sh_degree })
    }
}

/// Gaussians after reading, in memory and temporary files.
pub(crate) struct GaussianSpool<'a> {
    space: GaussianSpace<'a>,
    rows: Spool<Row>,
    sh_degree: u8,
}

impl GaussianSpool<'_> {
    /// Number of Gaussians.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Partitions the Gaussians into pages of at most `fill` rows and passes the pages to `take` in the order of their
    /// ids.
    /// Errors: the folder cannot be written, or `take` failed.
    pub fn for_each_page(
        self,
        fill: usize,
        take: &mut dyn FnMut(PageId, SceneState) -> InputResult<()>,
    ) -> InputResult<()> {
        let GaussianSpool { space, rows, sh_degree } = self;
        let records = (space.memory / 2 / (2 * size_of::<Row>())).max(fill);
        let space = PageSpace { list: space.of_list(), records };
        paginate(rows, fill, space, &mut |id, rows| take(id, state_of(rows, sh_degree)))?;
        Ok(())
    }
}

fn state_of(rows: &[Row], sh_degree: u8) -> SceneState {
    let mut columns = Columns::zeros(0, sh_degree);
    let mut values = [0.0; ROW_HEAD + 45];
    for row in rows {
        values[..ROW_HEAD].copy_from_slice(&row.head);
        values[ROW_HEAD..].copy_from_slice(row.sh_n.as_flattened());
        push_row(&mut columns, &values[..ROW_HEAD + sh_n_width(sh_degree)]);
    }
    let mut state = SceneState::from_columns(columns);
    state.uid.iter_mut().zip(rows).for_each(|(uid, row)| *uid = u64::from(row.row));
    state
}

/// Drops the SH bands above `sh_degree`.
pub(crate) fn truncate_sh(columns: Columns, sh_degree: u8) -> Columns {
    if columns.sh_degree <= sh_degree {
        return columns;
    }
    let (from, to) = (sh_n_width(columns.sh_degree), sh_n_width(sh_degree));
    let sh_n = columns.sh_n.chunks_exact(from).flat_map(|row| &row[..to]).copied().collect();
    Columns { sh_degree, sh_n, ..columns }
}

/// Removes Gaussians that are larger than any of a scene can be; returns how many.
pub(crate) fn remove_giants(columns: &mut Columns, range: LogScaleRange) -> u64 {
    columns.retain_rows(|columns, row| columns.row(Column::Scales, row).iter().all(|&s| s <= range.high))
}

/// The warning about `giants` Gaussians that [`remove_giants`] removed, if any.
pub(crate) fn giants_warning(ply: &Path, giants: u64) -> Option<String> {
    let problem = "Gaussians are larger than 10,000 times the spread of the cameras and are dropped";
    (giants > 0).then(|| format!("{}: {giants} {problem}", ply.display()))
}

/// Warnings about Gaussians read from `file`, of which `far` were dropped by the change of frame.
pub fn file_warnings(file: &Path, meta: &SceneMeta, far: u64) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Some(transform) = &meta.transform {
        let transform = transform.file_name().unwrap_or_default().display();
        let file = file.display();
        warnings.push(format!("{file}: it does not say its frame, which is taken from {transform} beside it"));
    }
    if meta.dropped > 0 {
        warnings.push(format!("{}: {} Gaussians are not finite and are dropped", file.display(), meta.dropped));
    }
    if meta.opacities_clamped > 0 {
        let (file, count) = (file.display(), meta.opacities_clamped);
        warnings.push(format!("{file}: {count} opacities are exactly 0 or 1, and are read as 1e-6 or 0.999999"));
    }
    if far > 0 {
        warnings.push(format!("{}: {far} Gaussians are too far from this scene and are dropped", file.display()));
    }
    if meta.antialiased {
        let file = file.display();
        warnings.push(format!("{file}: trained with opacity compensation (antialiased), which is not rendered here"));
    }
    warnings
}
