//! One scene from the cells: each row from the cell in whose ground it lies. Cell by cell and page by page, so memory is bounded for any size
//! of city.
//!
//! A row of the prior that two cells keep stays that of the lower cell. One that no cell keeps, because it has moved out of its owner's ground
//! while the neighbour lost it or moved it the other way, is put back by its owner, the cell in whose ground the middle of its page lay. Rows
//! that came from growth are told by place alone: their identities say nothing about where they came from. So of a row that two cells have split
//! in the same round, both may keep a child; that was one row of 4,200.
//!
//! Invariants: 1. the result is a function of the cells' copies and the plan; 2. no identity of a prior row comes twice; 3. the PLY appears
//! as a whole.

use super::cut::remedies_of_prior;
use super::plan::{CityPlan, LIST_BYTES_MAX};
use super::work::{done_of, newest_copy};
use super::{City, config_of};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::ids::PageId;
use crate::base::text::read_text;
use crate::base::whole_file::write_whole;
use crate::config::file::{Resolved, TrainConfig, TrainOverrides, read_resolved, write_config};
use crate::config::new_run;
use crate::config::values::Up;
use crate::exchange::format::ExportFormat;
use crate::exchange::meta::SceneMeta;
use crate::exchange::sink::GaussianSink;
use crate::report::run_files::{CONFIG_FILE, PLY_FILE};
use crate::scene::columns::{Column, Columns};
use crate::scene::page_meta::PageMeta;
use crate::scene::rotation::Rotation;
use crate::train::error::TrainError;
use crate::train::memory::host_budget;
use crate::train::stores::StoredStart;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The polish takes one in this many of the steps.
const POLISH_SHARE: u32 = 20;

/// Cells to merge.
#[derive(Debug, Clone)]
pub struct MergeRequest {
    pub city: PathBuf,
    /// The folder of the scene, which does not exist.
    pub out: PathBuf,
    /// Memory, bytes; 0 for 70 % of what is free.
    pub host_mem: u64,
}

/// What a merge took from the cells.
#[derive(Debug, Clone, Default)]
pub struct Merged {
    pub gaussians: u64,
    /// Of each cell.
    pub kept: Vec<u64>,
    /// Dropped because they lie in the ground of another cell.
    pub beyond: u64,
    /// Dropped because a lower cell has kept the same row.
    pub twice: u64,
    /// Rows of the prior that their owner put back.
    pub put_back: u64,
}

/// Which rows of the prior are in the scene: a bit for each.
struct KeptRows(Vec<u64>);

impl KeptRows {
    fn new(rows: u64) -> KeptRows {
        KeptRows(vec![0; rows.div_ceil(64) as usize])
    }

    /// The bit of a row of the prior; `None` for a row that came from growth.
    fn bit(&mut self, uid: u64) -> Option<(&mut u64, u64)> {
        self.0.get_mut(usize::try_from(uid / 64).ok()?).map(|word| (word, 1 << (uid % 64)))
    }

    /// Marks a row; false if it was marked before.
    fn insert(&mut self, uid: u64) -> bool {
        self.bit(uid).is_none_or(|(word, bit)| {
            let is_new = *word & bit == 0;
            *word |= bit;
            is_new
        })
    }

    fn holds(&mut self, uid: u64) -> bool {
        self.bit(uid).is_some_and(|(word, bit)| *word & bit != 0)
    }
}

/// Writes the scene of all cells as a folder that `gsscale-eval`, viewers and `--init-ply` take.
/// Errors: a cell is not done, or a copy cannot be read, or `out` exists or cannot be written.
pub fn merge(request: &MergeRequest) -> Result<Merged, TrainError> {
    let city = City(request.city.clone());
    let plan = CityPlan::read(&city)?;
    if request.out.exists() {
        return Err(InputError::new(&request.out, "exists already", "name a folder that does not exist").into());
    }
    let mut open = Vec::new();
    for cell in 0..plan.cells.len() {
        if done_of(&plan, &city, cell)?.is_none() {
            open.push(cell.to_string());
        }
    }
    if !open.is_empty() {
        let problem = format!("cells {} are not done", open.join(", "));
        return Err(InputError::new(&city.0, problem, "run them: gsscale-cells run CITY --cell K").into());
    }
    let keys = new_run::given_keys(Some(&city.keys()), &TrainOverrides::default())?;
    let config = config_of(&city.keys(), keys, &TrainOverrides::default())?;
    let facts = read_resolved(&city.prior_run().join(CONFIG_FILE))?;
    std::fs::create_dir_all(&request.out).map_err(|e| InputError::io(&request.out, "making the folder", &e))?;
    let meta = meta_of(&plan, &config, &facts);
    let most: u64 = plan.cells.iter().map(|cell| cell.max_gaussians).sum();
    let mut sink = ExportFormat::Ply.create(&request.out.join(PLY_FILE), config.sh_degree, most, &meta)?;
    let memory = host_budget(request.host_mem).unwrap_or(1 << 30);
    let mut prior = StoredStart::open(&city.prior_store(), memory, 2)?;
    let owner = |page: &PageMeta| (page.id, plan.cell_at(plan.ground(page.bounds.centre())));
    let owners = prior.scene().pager.index().iter().map(owner).collect();
    drop(prior);
    let (kept, astray, done) = (KeptRows::new(plan.gaussians), BTreeMap::new(), Merged::default());
    let mut merged = Merging { plan: &plan, city: &city, owners, kept, astray, done };
    for cell in 0..plan.cells.len() {
        merged.add_cell(cell, memory, &mut *sink)?;
    }
    merged.put_back(&mut *sink)?;
    let written = sink.finish()?;
    ExportFormat::Ply.write_transform(&request.out.join(PLY_FILE), &meta, written.frame)?;
    let facts = Resolved { run: RunId::UNKNOWN, gaussians: written.rows, made_spill_dir: false, ..facts };
    write_config(&request.out.join(CONFIG_FILE), &config, &facts)?;
    write_polish(&plan, &city, &request.out)?;
    Ok(Merged { gaussians: written.rows, ..merged.done })
}

struct Merging<'a> {
    plan: &'a CityPlan,
    city: &'a City,
    /// The cell in whose ground the middle of each page of the prior lies.
    owners: BTreeMap<PageId, usize>,
    kept: KeptRows,
    /// Rows of the prior that lie beyond the ground of their owner, by identity.
    astray: BTreeMap<u64, Columns>,
    done: Merged,
}

impl Merging<'_> {
    /// Writes the rows that lie in the ground of a cell.
    fn add_cell(&mut self, cell: usize, memory: u64, sink: &mut dyn GaussianSink) -> Result<(), TrainError> {
        let folder = self.city.cell(cell);
        let owned = self.owned_pages(&folder, cell)?;
        let (_, copy) = newest_copy(&folder).ok_or_else(|| {
            InputError::new(folder.join("copy"), "the copy of the cell is not there", "run the cell again")
        })?;
        let mut store = StoredStart::open(&copy, memory, 2)?;
        let frame = (self.plan.origin, self.plan.scale);
        let mut kept_rows = 0;
        for (page, id) in store.pages().into_iter().filter(|(_, id)| !id.is_frozen()) {
            let (uids, mut columns) = store.rows_of(page, frame)?;
            let is_own = owned.get(id.origin() as usize).copied().unwrap_or(false);
            let keeps: Vec<bool> =
                uids.iter().enumerate().map(|(row, &uid)| self.keeps(cell, is_own, uid, &columns, row)).collect();
            columns.retain_rows(|_, row| keeps[row]);
            kept_rows += columns.rows() as u64;
            sink.write(&columns)?;
        }
        self.done.kept.push(kept_rows);
        Ok(())
    }

    /// Whether a cell owns each of the pages that it trains, by their numbers in its run.
    fn owned_pages(&self, folder: &Path, cell: usize) -> InputResult<Vec<bool>> {
        let file = folder.join("pages.txt");
        let text = read_text(&file, LIST_BYTES_MAX, "restore the files of the cell")?;
        let trained = text.lines().filter_map(|line| line.parse::<PageId>().ok());
        Ok(trained.map(|page| self.owners.get(&page) == Some(&cell)).collect())
    }

    fn keeps(&mut self, cell: usize, is_own: bool, uid: u64, columns: &Columns, row: usize) -> bool {
        let mean = columns.row(Column::Means, row);
        if self.plan.cell_at(self.plan.ground([mean[0], mean[1], mean[2]])) == cell {
            let is_new = self.kept.insert(uid);
            self.done.twice += u64::from(!is_new);
            return is_new;
        }
        self.done.beyond += 1;
        if is_own && uid < self.plan.gaussians {
            let mut one = Columns::zeros(0, columns.sh_degree);
            Column::ALL.into_iter().for_each(|c| one.column_mut(c).extend_from_slice(columns.row(c, row)));
            self.astray.insert(uid, one);
        }
        false
    }

    /// Writes the rows astray that no cell has kept.
    fn put_back(&mut self, sink: &mut dyn GaussianSink) -> Result<(), TrainError> {
        for (uid, columns) in std::mem::take(&mut self.astray) {
            if !self.kept.holds(uid) {
                sink.write(&columns)?;
                self.done.put_back += 1;
            }
        }
        Ok(())
    }
}

fn meta_of(plan: &CityPlan, config: &TrainConfig, facts: &Resolved) -> SceneMeta {
    let up = match config.up {
        Up::Auto => Some(plan.up),
        Up::Along(up) => Some(up),
        Up::Keep => None,
    };
    SceneMeta {
        origin: plan.origin,
        scale: plan.scale,
        scene_radius: facts.scene_scale,
        frame: config.export_frame,
        upright: up.and_then(Rotation::upright),
        ..SceneMeta::default()
    }
}

/// Writes the config of a short run that polishes the merged scene: the views that several cells trained on, the rates with which the cells
/// ended, no growth.
fn write_polish(plan: &CityPlan, city: &City, out: &Path) -> InputResult<()> {
    let mut cells_of: BTreeMap<String, usize> = BTreeMap::new();
    for cell in 0..plan.cells.len() {
        let text = read_text(&city.cell(cell).join("views.txt"), LIST_BYTES_MAX, "restore the files of the cell")?;
        text.lines().for_each(|name| *cells_of.entry(name.to_string()).or_default() += 1);
    }
    let crossing = cells_of.iter().filter(|(_, cells)| **cells > 1 || plan.cells.len() == 1);
    let names: String = crossing.map(|(name, _)| format!("{name}\n")).collect();
    let (views, file) = (out.join("polish_views.txt"), out.join("polish.toml"));
    write_whole(&views, names.as_bytes())?;
    let mut keys = new_run::given_keys(Some(&city.keys()), &TrainOverrides::default())?;
    let whole = config_of(&city.keys(), keys.clone(), &TrainOverrides::default())?;
    let of_cell = new_run::given_keys(Some(&city.cell(0).join("cell.toml")), &TrainOverrides::default())?;
    let ended = config_of(&city.cell(0), of_cell, &TrainOverrides::default())?;
    keys.extend(remedies_of_prior(city)?);
    keys.remove("max-gaussians");
    keys.insert("steps".into(), i64::from((whole.steps / POLISH_SHARE).max(1)).into());
    for (key, word) in [("strategy", "none"), ("schedule", "classic")] {
        keys.insert(key.into(), word.into());
    }
    let mut paths = vec![("init-ply", out.join(PLY_FILE)), ("views-file", views)];
    if city.prior_appearance().is_file() {
        paths.push(("first-appearance", city.prior_appearance()));
    }
    for (key, path) in paths {
        let path = std::path::absolute(&path).unwrap_or(path);
        keys.insert(key.into(), path.to_string_lossy().into_owned().into());
    }
    let others = ended.others_lr_final;
    for (key, rate) in [
        ("means-lr", ended.means_lr * ended.means_lr_final),
        ("means-lr-final", 1.0),
        ("scales-lr", ended.scales_lr * others),
        ("quats-lr", ended.quats_lr * others),
        ("opacities-lr", ended.opacities_lr * others),
        ("sh0-lr", ended.sh0_lr * others),
        ("shn-lr", ended.shn_lr * others),
        ("others-lr-final", 0.1),
    ] {
        keys.insert(key.into(), rate.into());
    }
    keys.insert("sh-every".into(), 0.into());
    let text = toml::to_string(&keys).map_err(|e| InputError::new(&file, e.to_string(), "report this as a bug"))?;
    write_whole(&file, text.as_bytes())
}
