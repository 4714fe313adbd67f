//! First pages from any number of Gaussians, and whether these (or points) and the cameras belong together: a file in another frame, or of
//! another scene, is noticed by what the cameras see of it.
//!
//! Rows pass through files into pages as points do ([`crate::dataset::import`]): the largest 0.5 % in pages of their
//! own, the others by median splits. Not here: the frame that a file states ([`crate::exchange`]).
//!
//! Invariants: 1. memory stays within the given bound; 2. pages have the rows of [`crate::scene::partition::partition`]
//! in its order; the uid of a row is its number in the file; 3. the warning depends on the rows, their order and the cameras alone.

use crate::base::error::{InputError, InputResult};
use crate::base::even_sample::EvenSample;
use crate::base::ids::PageId;
use crate::base::units::counted;
use crate::dataset::import::{Budget, Grown, PageSpace, Spool, SpoolWriter, paginate};
use crate::dataset::loader::View;
use crate::exchange::frames::file_to_local;
use crate::exchange::meta::SceneMeta;
use crate::exchange::ply::{ROW_HEAD, gaussians_header, push_row, stream_gaussians, take_row};
use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::frustum::Frustum;
use crate::scene::log_scales::LogScaleRange;
use crate::scene::partition::Placed;
use crate::scene::state::SceneState;
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Gaussians that are transformed together.
const ROWS_AT_ONCE: usize = 1024;

/// A Gaussian with its number in the file.
#[derive(Debug, Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct GaussianRow {
    head: [f32; ROW_HEAD],
    sh_n: [[f32; 15]; 3],
    row: u32,
}

impl Placed for GaussianRow {
    fn point(&self) -> [f32; 3] {
        [self.head[0], self.head[1], self.head[2]]
    }
    fn row(&self) -> u32 {
        self.row
    }
}

impl Grown for GaussianRow {
    fn log_size(&self) -> f32 {
        self.head[7].max(self.head[8]).max(self.head[9])
    }
}

/// A file of Gaussians, read into a run's local frame with at most the run's SH degree.
#[derive(Debug, Clone)]
pub(crate) struct GaussianFile {
    pub path: PathBuf,
    meta: SceneMeta,
    pub sh_degree: u8,
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

    /// Passes the Gaussians to `take` in batches, in the file's order, without those that are too far away or too large.
    /// Errors: the file cannot be read, or `take` failed.
    pub fn read(&self, take: &mut dyn FnMut(&Columns) -> InputResult<()>) -> InputResult<GaussiansRead> {
        let (mut far, mut giants) = (0, 0);
        let meta = stream_columns(&self.path, self.sh_degree, &mut |mut columns| {
            far += file_to_local(&mut columns, &self.meta, self.origin, self.scale);
            giants += remove_giants(&mut columns, self.log_scales);
            take(&truncate_sh(columns, self.sh_degree_most))
        })?;
        Ok(GaussiansRead { meta, far, giants })
    }
}

/// Passes the Gaussians of a file of this SH degree to `take` in batches, in the file's order; the last one may be empty.
/// Errors: the file cannot be read, or `take` failed.
pub(crate) fn stream_columns(
    file: &Path,
    sh_degree: u8,
    take: &mut dyn FnMut(Columns) -> InputResult<()>,
) -> InputResult<SceneMeta> {
    let none = || Columns::zeros(0, sh_degree);
    let mut some = none();
    let meta = stream_gaussians(file, &mut |values| {
        push_row(&mut some, values);
        match some.rows() {
            ROWS_AT_ONCE => take(std::mem::replace(&mut some, none())),
            _ => Ok(()),
        }
    })?;
    take(some)?;
    Ok(meta)
}

/// Collects Gaussians while they are read.
pub(crate) struct GaussianWriter<'a> {
    /// The source file, for messages.
    file: &'a Path,
    budget: Budget<'a>,
    rows: SpoolWriter<GaussianRow>,
    next: u32,
    width: usize,
}

impl<'a> GaussianWriter<'a> {
    pub fn new(file: &'a Path, budget: Budget<'a>) -> Self {
        GaussianWriter { file, budget, rows: SpoolWriter::new(budget.space()), next: 0, width: ROW_HEAD }
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
        let mut row = GaussianRow { head: [0.0; ROW_HEAD], sh_n: [[0.0; 15]; 3], row: self.next };
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
        Ok(GaussianSpool { budget: self.budget, rows: self.rows.finish()?, sh_degree })
    }
}

/// Gaussians after reading, in memory and temporary files.
pub(crate) struct GaussianSpool<'a> {
    budget: Budget<'a>,
    rows: Spool<GaussianRow>,
    pub sh_degree: u8,
}

impl GaussianSpool<'_> {
    /// Number of Gaussians.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    /// Partitions the Gaussians into pages of at most `fill` rows and passes the pages to `take` in the order of their
    /// ids.
    /// Errors: the folder cannot be written, or `take` failed.
    pub fn for_each_page(
        self,
        fill: usize,
        take: &mut dyn FnMut(PageId, SceneState) -> InputResult<()>,
    ) -> InputResult<()> {
        let GaussianSpool { budget, rows, sh_degree } = self;
        let records = (budget.bytes / 2 / (2 * size_of::<GaussianRow>())).max(fill);
        let space = PageSpace { list: budget.space(), records };
        paginate(rows, fill, space, &mut |id, rows| take(id, state_of(rows, sh_degree)))?;
        Ok(())
    }
}

fn state_of(rows: &[GaussianRow], sh_degree: u8) -> SceneState {
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
    if meta.moved > 0 {
        let (file, moved) = (file.display(), counted(meta.moved, "Gaussian"));
        warnings.push(format!(
            "{file}: positions are kept with 32 bits, and {moved} moved by more than a tenth of their size: subtract the same offset \
             from all positions of the file"
        ));
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

/// Most positions in a sample.
const SAMPLE_MOST: usize = 1 << 15;
/// Positions that are looked for in every camera.
const LOOKED_FOR: usize = 1 << 11;
/// Cameras that are searched for a position.
const CAMERAS_ASKED: usize = 256;
/// Least share of the positions that some camera sees. In four scenes of photos and a generated city it is 0.9 or more; with
/// other axes, another scale or another origin mostly below 0.6.
const SEEN_LEAST: f64 = 2.0 / 3.0;
/// Positions for each camera without which a camera may see none by chance.
const POSITIONS_A_CAMERA: usize = 20;
/// Median distance of the cameras from the box of the positions, in diagonals of the box, beyond which photos show a dot.
const FAR_DIAGONALS: f32 = 20.0;

/// A sample of positions in the local frame.
#[derive(Debug, Clone)]
pub(crate) struct PositionSample(EvenSample<[f32; 3]>);

impl Default for PositionSample {
    fn default() -> PositionSample {
        PositionSample(EvenSample::new(SAMPLE_MOST))
    }
}

impl PositionSample {
    /// Adds the rows of a column of positions.
    pub fn add(&mut self, means: &[f32]) {
        means.as_chunks::<3>().0.iter().for_each(|&position| self.0.add(position));
    }

    /// The lower and upper corner of the box of the sample without a twentieth on each side.
    fn robust_box(&self) -> [[f32; 3]; 2] {
        let of_axis = |axis: usize| {
            let mut values: Vec<f32> = self.0.kept.iter().map(|p| p[axis]).collect();
            values.sort_unstable_by(f32::total_cmp);
            let cut = values.len() / 20;
            (values[cut], values[values.len() - 1 - cut])
        };
        let axes = [0, 1, 2].map(of_axis);
        [axes.map(|(low, _)| low), axes.map(|(_, high)| high)]
    }

    /// Half the diagonal of the box that holds nine tenths of the rows on each axis: the size of the scene where no cameras
    /// state it. `None` without rows, or if all are in one place.
    pub fn radius(&self) -> Option<f32> {
        if self.0.kept.is_empty() {
            return None;
        }
        let [low, high] = self.robust_box();
        Some(distance(low, high) / 2.0).filter(|radius| radius.is_normal())
    }

    /// The warning that the rows of `file` and the cameras of the views do not fit each other, if they do not.
    pub fn warning(&self, file: &Path, views: &[View]) -> Option<String> {
        if self.0.kept.is_empty() || views.is_empty() {
            return None;
        }
        let frustums: Vec<Frustum> = views.iter().map(|view| Frustum::new(&view.camera)).collect();
        let step = self.0.kept.len().div_ceil(LOOKED_FOR);
        let looked_for: Vec<[f32; 3]> = self.0.kept.iter().step_by(step).copied().collect();
        let seen = looked_for.par_iter().filter(|&&p| frustums.iter().any(|f| f.may_draw(p, 0.0))).count();
        let seen = seen as f64 / looked_for.len() as f64;
        let asked: Vec<&Frustum> = frustums.iter().step_by(views.len().div_ceil(CAMERAS_ASKED)).collect();
        let blind = asked.par_iter().filter(|f| !self.0.kept.iter().any(|&p| f.may_draw(p, 0.0))).count();
        let blind = blind as f64 / asked.len() as f64;
        let blind_by_chance = self.0.stride > 1 && self.0.kept.len() < POSITIONS_A_CAMERA * views.len();
        let away = self.diagonals_away(views);
        let problem = match () {
            () if seen < SEEN_LEAST => format!("only {:.0} % of its rows are in view of any camera", 100.0 * seen),
            () if blind > 0.5 && !blind_by_chance => {
                format!("{:.0} % of the cameras see none of its rows", 100.0 * blind)
            }
            () if away > FAR_DIAGONALS => format!("most cameras stand {away:.0} times its size away from it"),
            () => return None,
        };
        Some(format!(
            "{}: it does not fit the cameras: {problem}. It may be of another scene, or in another frame: a file that an editor \
             saved has lost the comments that say its frame, so keep the transform.json of the original beside it",
            file.display()
        ))
    }

    /// Median distance of the cameras from the box, in its diagonals; 0 for a box without extent.
    fn diagonals_away(&self, views: &[View]) -> f32 {
        let [low, high] = self.robust_box();
        let diagonal = distance(low, high);
        if !diagonal.is_normal() {
            return 0.0;
        }
        let mut away: Vec<f32> = views
            .iter()
            .map(|view| {
                let centre = view.camera.centre();
                let nearest = [0, 1, 2].map(|k| centre[k].max(low[k]).min(high[k]));
                distance(centre, nearest) / diagonal
            })
            .collect();
        let middle = away.len() / 2;
        *away.select_nth_unstable_by(middle, f32::total_cmp).1
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    [0, 1, 2].map(|k| (a[k] - b[k]) * (a[k] - b[k])).iter().sum::<f32>().sqrt()
}
