//! Gaussians as first pages, however many there are.
//!
//! Rows go through files into pages as points do ([`crate::dataset::import`]): the largest 0.5 % apart, the others by median
//! splits.
//!
//! Invariants: 1. memory is bounded by what is given; 2. pages have the rows of [`crate::scene::partition::partition`], in
//! its order, and each row the number that it was read with.

use super::prepare::cut_sh;
use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::dataset::import::{Grown, PageSpace, Spool, SpoolSpace, SpoolWriter, paginate};
use crate::exchange::ply::{PlyMeta, ROW_HEAD, gaussians_header, push_row, stream_gaussians, take_row, to_local};
use crate::scene::columns::{Columns, sh_n_width};
use crate::scene::partition::Placed;
use crate::scene::state::SceneState;
use std::path::{Path, PathBuf};

/// Gaussians that are moved into another frame together.
const ROWS_AT_ONCE: usize = 1024;

/// A Gaussian with its number, on its way into a page.
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

/// Gaussians of a file as a run starts from them: in its local frame, with no more bands than it has.
#[derive(Debug, Clone)]
pub(super) struct GaussianFile {
    path: PathBuf,
    meta: PlyMeta,
    /// Degree of the file.
    sh_degree: u8,
    sh_degree_most: u8,
    origin: [f64; 3],
    scale: f64,
}

impl GaussianFile {
    /// The file, for a run with bands up to `sh_degree_most` in the local frame of `origin` and `scale`.
    ///
    /// # Errors
    /// Its header cannot be understood.
    pub fn open(path: &Path, sh_degree_most: u8, (origin, scale): ([f64; 3], f64)) -> InputResult<GaussianFile> {
        let (meta, sh_degree) = gaussians_header(path)?;
        Ok(GaussianFile { path: path.to_path_buf(), meta, sh_degree, sh_degree_most, origin, scale })
    }

    /// Degree of the file.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Hands on the Gaussians in the file's order, some at a time. Returns what the file said, and how many were too far away
    /// for the local frame and are left out.
    ///
    /// # Errors
    /// The file cannot be read, or `take` failed.
    pub fn read(&self, take: &mut dyn FnMut(&Columns) -> InputResult<()>) -> InputResult<(PlyMeta, u64)> {
        let none = || Columns::zeros(0, self.sh_degree);
        let (mut some, mut far) = (none(), 0);
        let mut hand_on = |mut columns: Columns| {
            far += to_local(&mut columns, &self.meta, self.origin, self.scale);
            take(&cut_sh(columns, self.sh_degree_most))
        };
        let meta = stream_gaussians(&self.path, &mut |values| {
            push_row(&mut some, values);
            match some.rows() {
                ROWS_AT_ONCE => hand_on(std::mem::replace(&mut some, none())),
                _ => Ok(()),
            }
        })?;
        hand_on(some)?;
        Ok((meta, far))
    }
}

/// What the way of Gaussians into pages may take.
#[derive(Debug, Clone, Copy)]
pub(super) struct GaussianSpace<'a> {
    /// An existing folder for what does not fit in memory.
    pub folder: &'a Path,
    /// Bytes of memory.
    pub memory: usize,
}

impl<'a> GaussianSpace<'a> {
    fn of_list(&self) -> SpoolSpace<'a> {
        SpoolSpace { folder: self.folder, memory: self.memory / 10 }
    }
}

/// Gaussians being read, as [`push_row`] takes them.
pub(super) struct GaussianWriter<'a> {
    /// What they are read from, for messages.
    file: &'a Path,
    space: GaussianSpace<'a>,
    rows: SpoolWriter<Row>,
    next: u32,
    width: usize,
}

impl<'a> GaussianWriter<'a> {
    /// None yet.
    pub fn new(file: &'a Path, space: GaussianSpace<'a>) -> Self {
        GaussianWriter { file, space, rows: SpoolWriter::new(space.of_list()), next: 0, width: ROW_HEAD }
    }

    /// Takes the next ones.
    ///
    /// # Errors
    /// As [`GaussianWriter::push`].
    pub fn push_all(&mut self, columns: &Columns) -> InputResult<()> {
        let mut values = Vec::new();
        (0..columns.rows()).try_for_each(|row| {
            take_row(columns, row, &mut values);
            self.push(&values)
        })
    }

    /// Takes the next one; all of them have the same bands.
    ///
    /// # Errors
    /// The folder cannot be written, or there are 2^32 rows.
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

    /// All were read.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn finish(self) -> InputResult<GaussianSpool<'a>> {
        let sh_degree = (0..=3).find(|&d| sh_n_width(d) == self.width - ROW_HEAD).unwrap_or(0);
        Ok(GaussianSpool { space: self.space, rows: self.rows.finish()?, sh_degree })
    }
}

/// Gaussians that were read.
pub(super) struct GaussianSpool<'a> {
    space: GaussianSpace<'a>,
    rows: Spool<Row>,
    sh_degree: u8,
}

impl GaussianSpool<'_> {
    /// How many.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    /// The degree of their bands.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Divides them into pages of at most `fill` rows and hands these out in the order of their names.
    ///
    /// # Errors
    /// The folder cannot be written, or `take` failed.
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
