//! The plan of a city: its cells and their grounds, with a digest of all of it. Which cell a place lies in.
//!
//! Invariants: 1. every place of the ground lies in exactly one leaf; 2. a plan, a list, a prior or poses that were changed after the cut are
//! refused.

use super::{City, toml_of};
use crate::base::error::{InputError, InputResult};
use crate::base::text::read_text;
use crate::base::whole_file::write_whole;
use crate::dataset::model::{Intrinsics, RawScene};
use crate::photos::exposure;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::io::ErrorKind;
use std::path::Path;
use xxhash_rust::xxh3::{Xxh3, xxh3_64};

const PLAN_BYTES_MAX: u64 = 64 << 20;
pub(crate) const LIST_BYTES_MAX: u64 = 4 << 30;

/// The files of a cell that the cut writes.
pub(crate) const CELL_FILES: [&str; 3] = ["cell.toml", "views.txt", "pages.txt"];

/// How many cells a city gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CellCount {
    Cells(usize),
    /// As many as it takes for none to train more Gaussians than this.
    MostGaussians(u64),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CityPlan {
    /// Version of the program that cut it.
    pub version: String,
    /// Digest of the prior's rows.
    pub prior: String,
    /// Gaussians of the prior.
    pub gaussians: u64,
    /// Training views.
    pub views: usize,
    /// What the user asked for. Cells with few views were joined to neighbours.
    pub asked: CellCount,
    /// How many times the prior's Gaussians the scene may have.
    pub growth: f64,
    /// Least share of the blending weight of a view that makes a cell take it.
    pub view_share: f64,
    /// Width of the margin, as a share of the cell's.
    pub margin: f64,
    /// Frame of the prior: `dataset = local * scale + origin`.
    pub origin: [f64; 3],
    pub scale: f64,
    /// The direction of the dataset that is up.
    pub up: [f64; 3],
    /// Two directions along the ground, local frame.
    pub axes: [[f64; 3]; 2],
    pub cells: Vec<CellPlan>,
    pub leaves: Vec<GroundRect>,
}

/// What a cell has to do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellPlan {
    pub train_views: usize,
    pub test_views: usize,
    pub steps: u32,
    pub trained_pages: usize,
    pub frozen_pages: usize,
    /// Gaussians of the prior in them.
    pub trained: u64,
    pub frozen: u64,
    /// Most Gaussians of the cell with its ring.
    pub max_gaussians: u64,
    /// Predicted bytes of its pages at the end.
    pub bytes: u64,
    /// Predicted seconds on the machine of the prior.
    pub seconds: f64,
    /// Digest of its files.
    pub files: String,
    /// Digest of the names, lenses and poses of its photos; empty in the plans of earlier versions.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub poses: String,
}

/// A rectangle of the ground, half-open, in the directions of the axes; infinite at the edge of the city.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroundRect {
    pub cell: usize,
    pub low: [f64; 2],
    pub high: [f64; 2],
}

impl GroundRect {
    pub fn holds(&self, at: [f64; 2]) -> bool {
        (0..2).all(|i| at[i] >= self.low[i] && at[i] < self.high[i])
    }

    /// Whether a box of the ground reaches into it.
    pub fn meets(&self, low: [f64; 2], high: [f64; 2]) -> bool {
        (0..2).all(|i| high[i] >= self.low[i] && low[i] < self.high[i])
    }

    /// The leaf with `by` more on all sides.
    pub fn grown(&self, by: f64) -> GroundRect {
        GroundRect { low: self.low.map(|x| x - by), high: self.high.map(|x| x + by), ..*self }
    }
}

#[derive(Serialize, Deserialize)]
struct Signed {
    digest: String,
    #[serde(flatten)]
    plan: CityPlan,
}

impl CityPlan {
    /// Digest of all of it. `file` is for errors.
    pub(crate) fn digest(&self, file: &Path) -> InputResult<String> {
        Ok(hex(xxh3_64(toml_of(file, self)?.as_bytes())))
    }

    /// Writes plan.toml, which ends a cut.
    /// Errors: the folder cannot be written.
    pub fn write(&self, city: &City) -> InputResult<()> {
        let file = city.plan();
        let signed = Signed { digest: self.digest(&file)?, plan: self.clone() };
        write_whole(&file, toml_of(&file, &signed)?.as_bytes())
    }

    /// Reads the plan of a city.
    /// Errors: there is none, or it was changed.
    pub fn read(city: &City) -> InputResult<CityPlan> {
        let file = city.plan();
        let remedy = "cut the city: gsscale-cells cut SCENE --out CITY --cells N";
        let text = read_text(&file, PLAN_BYTES_MAX, remedy).map_err(|e| InputError { remedy: remedy.into(), ..e })?;
        let changed = "restore it, or cut again in another folder";
        let Signed { digest, plan } =
            toml::from_str(&text).map_err(|e| InputError::new(&file, e.to_string(), changed))?;
        let is_whole = plan.leaves.iter().all(|leaf| leaf.cell < plan.cells.len()) && !plan.leaves.is_empty();
        if digest != plan.digest(&file)? || !is_whole {
            return Err(InputError::new(&file, "it was changed after the cut: its digest differs", changed));
        }
        Ok(plan)
    }

    /// The cell with this number.
    /// Errors: there is none, or its files were changed.
    pub fn cell(&self, city: &City, cell: usize) -> InputResult<&CellPlan> {
        let Some(planned) = self.cells.get(cell) else {
            let problem = format!("there is no cell {cell}");
            return Err(InputError::new(city.plan(), problem, format!("name one of 0 to {}", self.cells.len() - 1)));
        };
        if files_digest(&city.cell(cell))? == planned.files {
            return Ok(planned);
        }
        let problem = format!("one of {} was changed after the cut", CELL_FILES.join(", "));
        Err(InputError::new(city.cell(cell), problem, "restore them, or cut again in another folder"))
    }

    /// The place on the ground of a position in the local frame.
    pub fn ground(&self, position: [f32; 3]) -> [f64; 2] {
        ground(&self.axes, position)
    }

    /// The cell in whose ground a place lies; the first one for a place that is not finite.
    pub fn cell_at(&self, at: [f64; 2]) -> usize {
        self.leaves.iter().find(|leaf| leaf.holds(at)).map_or(0, |leaf| leaf.cell)
    }
}

/// The place of a position along two directions.
pub(crate) fn ground(axes: &[[f64; 3]; 2], position: [f32; 3]) -> [f64; 2] {
    axes.map(|axis| (0..3).map(|i| axis[i] * f64::from(position[i])).sum())
}

pub(crate) fn hex(digest: u64) -> String {
    format!("{digest:016x}")
}

/// Digest of a prior whose rows have the digest `rows`: of these, and of what it found of photos, if anything.
/// Errors: that cannot be read.
pub(crate) fn prior_digest(city: &City, rows: u64) -> InputResult<String> {
    let file = city.prior_appearance();
    let found = match read_text(&file, exposure::FILE_BYTES_MAX, "train the prior again") {
        Err(e) if e.kind == Some(ErrorKind::NotFound) => String::new(),
        read => read?,
    };
    Ok(format!("{}{}", hex(rows), hex(xxh3_64(found.as_bytes()))))
}

/// Digest of the names, lenses and poses of the photos of a scene that are listed in `names`, one a line.
pub(crate) fn poses_digest(scene: &RawScene, names: &str) -> String {
    let listed: BTreeSet<&str> = names.lines().collect();
    let mut digest = Xxh3::new();
    for view in scene.views.iter().filter(|view| listed.contains(view.name.as_str())) {
        let Intrinsics { width, height, fx, fy, cx, cy, lens } = &view.intrinsics;
        let (rotation, translation) = (view.pose.rotation.to_cols_array(), view.pose.translation.to_array());
        digest.update(view.name.as_bytes());
        digest.update(&[width.to_le_bytes(), height.to_le_bytes()].concat());
        let numbers = [fx, fy, cx, cy].into_iter().chain(lens.coefficients()).chain(&rotation).chain(&translation);
        numbers.for_each(|number| digest.update(&number.to_bits().to_le_bytes()));
    }
    hex(digest.digest())
}

/// Digest of the files of a cell.
/// Errors: a file cannot be read.
pub(crate) fn files_digest(folder: &Path) -> InputResult<String> {
    let mut digest = Xxh3::new();
    for name in CELL_FILES {
        let text = read_text(&folder.join(name), LIST_BYTES_MAX, "restore the files of the cell")?;
        digest.update(&(text.len() as u64).to_le_bytes());
        digest.update(text.as_bytes());
    }
    Ok(hex(digest.digest()))
}
