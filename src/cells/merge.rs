//! One scene from the cells: each row from the cell in whose ground it lies. Cell by cell and page by page, so memory is bounded for any size
//! of city.
//!
//! A row of the prior that two cells keep stays that of the lower cell. One that no cell keeps, because it has moved out of its owner's ground
//! while the neighbour lost it or moved it the other way, is put back by its owner, the cell in whose ground the middle of its page lay. Rows
//! that came from growth are told by place alone: their identities say nothing about where they came from. So of a row that two cells have split
//! in the same round, both may keep a child; that was one row of 4,200.
//!
//! Invariants: 1. the result is a function of the cells' copies and the plan; 2. no identity of a prior row comes twice; 3. the folder appears
//! as a whole; 4. of rows that may be put back only the pages are kept in memory.

use super::costs::POLISH_SHARE;
use super::cut::remedies_of_prior;
use super::plan::{CityPlan, LIST_BYTES_MAX, hex};
use super::prior::KEY_OF_FIRST_POINTS;
use super::work::{DONE_FILE, check_prior, copy_of, done_of};
use super::{City, config_of, toml_of};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::ids::{PageId, PageNo};
use crate::base::text::{OWN_FILE_MOST, read_text};
use crate::base::whole_file::{folder_of, part_path};
use crate::base::whole_folder::PartFolder;
use crate::config::file::{Resolved, TrainConfig, TrainOverrides, read_resolved, write_config};
use crate::config::new_run;
use crate::config::values::Up;
use crate::exchange::format::ExportFormat;
use crate::exchange::meta::SceneMeta;
use crate::exchange::sink::GaussianSink;
use crate::exchange::transform::transform_path;
use crate::report::run_files::{CONFIG_FILE, PLY_FILE};
use crate::scene::columns::{Column, Columns};
use crate::scene::page_meta::PageMeta;
use crate::scene::rotation::Rotation;
use crate::train::error::TrainError;
use crate::train::inputs::machine::absolute;
use crate::train::memory::host_budget;
use crate::train::stores::StoredStart;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::Xxh3;

/// What was merged, from which plan.
const MERGED_FILE: &str = "merged.toml";
const POLISH_FILE: &str = "polish.toml";
const POLISH_VIEWS_FILE: &str = "polish_views.txt";

#[derive(Debug, Clone)]
pub struct MergeRequest {
    pub city: PathBuf,
    /// The folder of the scene, which does not exist, or holds the same merge.
    pub out: PathBuf,
    /// Memory, bytes; 0 for 70 % of what is free.
    pub host_mem: u64,
}

/// What a merge took from the cells.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Merged {
    /// Digest of the plan.
    pub plan: String,
    /// Digest of what is known of the cells when they are done.
    #[serde(default)]
    pub cells: String,
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

    /// Marks a row; false if it was marked before. Rows that came from growth are never marked.
    fn insert(&mut self, uid: u64) -> bool {
        let Some(word) = usize::try_from(uid / 64).ok().and_then(|word| self.0.get_mut(word)) else { return true };
        let (before, bit) = (*word, 1 << (uid % 64));
        *word |= bit;
        before & bit == 0
    }
}

/// Whether a merge writes a file of this name, or the temporary file of one.
fn is_merged(file: &Path) -> bool {
    let ply = Path::new(PLY_FILE);
    let names = [MERGED_FILE, POLISH_FILE, POLISH_VIEWS_FILE, CONFIG_FILE].map(PathBuf::from);
    let names = names.into_iter().chain([ply.to_path_buf(), transform_path(ply)]);
    names.into_iter().any(|name| name == file || part_path(&name).is_some_and(|part| part == file))
}

/// Writes the scene of all cells as a folder that `gsscale-eval`, viewers and `--init-ply` take; of cells that are merged there already it
/// only says what was.
/// Errors: a cell is not done, or a copy cannot be read, or `out` holds something else or cannot be written.
pub fn merge(request: &MergeRequest) -> Result<Merged, TrainError> {
    let city = City(request.city.clone());
    let plan = CityPlan::read(&city)?;
    let digest = plan.digest(&city.plan())?;
    let (mut open, mut copies, mut cells) = (Vec::new(), Vec::new(), Xxh3::new());
    for cell in 0..plan.cells.len() {
        plan.cell(&city, cell)?;
        match done_of(&plan, &city, cell)? {
            Some(done) => {
                copies.push(copy_of(&city.cell(cell), done.copy));
                cells.update(toml_of(DONE_FILE, &done)?.as_bytes());
            }
            None => open.push(cell.to_string()),
        }
    }
    if !open.is_empty() {
        let problem = match open.as_slice() {
            [cell] => format!("cell {cell} is not done"),
            _ => format!("cells {} are not done", open.join(", ")),
        };
        return Err(InputError::new(&city.0, problem, "run them: gsscale-cells run CITY --cell K").into());
    }
    let cells = hex(cells.digest());
    if request.out.exists() {
        let before = read_text(&request.out.join(MERGED_FILE), OWN_FILE_MOST, "").ok();
        let before = before.and_then(|text| toml::from_str::<Merged>(&text).ok());
        let is_of_plan = before.as_ref().is_some_and(|merged| merged.plan == digest);
        let is_same = |merged: &Merged| is_of_plan && merged.cells == cells && request.out.join(PLY_FILE).is_file();
        let problem = match is_of_plan {
            true => "it holds an earlier merge: cells were trained again since, or the PLY is gone",
            false => "exists already",
        };
        let refused = || InputError::new(&request.out, problem, "name a folder that does not exist");
        return Ok(before.filter(is_same).ok_or_else(refused)?);
    }
    let memory = host_budget(request.host_mem).unwrap_or(1 << 30);
    check_prior(&plan, &city, memory).map_err(|refused| refused.error)?;
    let keys = city.given_keys()?;
    let config = config_of(&city.keys(), keys, &TrainOverrides::default())?;
    let facts = read_resolved(&city.prior_run().join(CONFIG_FILE))?;
    let above = folder_of(&request.out);
    std::fs::create_dir_all(above).map_err(|e| InputError::io(above, "making the folder", &e))?;
    let mut folder = PartFolder::create(&request.out, is_merged)?;
    let (meta, ply) = (meta_of(&plan, &config, &facts), folder.path().join(PLY_FILE));
    let most: u64 = plan.cells.iter().map(|cell| cell.max_gaussians).sum();
    let mut sink = ExportFormat::Ply.create(&ply, config.sh_degree, most, &meta)?;
    let owner = |page: &PageMeta| (page.id, plan.cell_at(plan.ground(page.bounds.centre())));
    let mut prior = StoredStart::open(&city.prior_store(), memory, 2)?;
    let owners = prior.scene().pager.index().iter().map(owner).collect();
    drop(prior);
    let (kept, done) = (KeptRows::new(plan.gaussians), Merged { plan: digest, cells, ..Merged::default() });
    let mut merging = Merging { plan: &plan, owners, kept, done };
    let mut astray = Vec::new();
    for (cell, copy) in copies.iter().enumerate() {
        let owned = merging.owned_pages(&city.cell(cell), cell)?;
        let added =
            StoredStart::open(copy, memory, 2).and_then(|copy| merging.add_cell(cell, &owned, copy, &mut *sink));
        astray.push(added.map_err(|error| of_copy(&city, cell, copy, error))?);
    }
    for (cell, (copy, pages)) in copies.iter().zip(astray).enumerate().filter(|(_, (_, pages))| !pages.is_empty()) {
        let put_back =
            StoredStart::open(copy, memory, 2).and_then(|copy| merging.put_back(cell, &pages, copy, &mut *sink));
        put_back.map_err(|error| of_copy(&city, cell, copy, error))?;
    }
    let written = sink.finish()?;
    ExportFormat::Ply.write_transform(&ply, &meta, written.frame)?;
    let facts = Resolved { run: RunId::UNKNOWN, gaussians: written.rows, made_spill_dir: false, ..facts };
    write_config(&folder.path().join(CONFIG_FILE), &config, &facts)?;
    write_polish(&plan, &city, &request.out, &mut folder)?;
    let merged = Merged { gaussians: written.rows, ..merging.done };
    folder.write(Path::new(MERGED_FILE), toml_of(MERGED_FILE, &merged)?.as_bytes())?;
    folder.finish()?;
    Ok(merged)
}

/// An error of reading the copy of a cell.
fn of_copy(city: &City, cell: usize, copy: &Path, error: TrainError) -> TrainError {
    match error {
        TrainError::Paging(_) => {
            let again = city.cell(cell).join(DONE_FILE);
            let remedy = format!(
                "try again; if that fails, remove {} and its folder copy, and run the cell again",
                again.display()
            );
            InputError::new(copy, format!("the copy of cell {cell} cannot be read: {error}"), remedy).into()
        }
        other => other,
    }
}

struct Merging<'a> {
    plan: &'a CityPlan,
    /// The cell in whose ground the middle of each page of the prior lies.
    owners: BTreeMap<PageId, usize>,
    kept: KeptRows,
    done: Merged,
}

impl Merging<'_> {
    /// Writes the rows that lie in the ground of a cell, which owns some of its first pages (`owned`). Returns the pages with rows of the prior
    /// that lie beyond the ground of their owner.
    fn add_cell(
        &mut self,
        cell: usize,
        owned: &[bool],
        mut store: StoredStart,
        sink: &mut dyn GaussianSink,
    ) -> Result<Vec<PageNo>, TrainError> {
        let (mut kept_rows, mut astray) = (0, Vec::new());
        for (page, id) in store.pages().into_iter().filter(|(_, id)| !id.is_frozen()) {
            let (uids, mut columns) = store.rows_of(page, self.frame())?;
            let is_own = owned.get(id.origin() as usize).copied().unwrap_or(false);
            let mut has_astray = false;
            let keeps = |row: usize| {
                let is_inside = self.lies_in(cell, &columns, row);
                let is_new = is_inside && self.kept.insert(uids[row]);
                self.done.beyond += u64::from(!is_inside);
                self.done.twice += u64::from(is_inside && !is_new);
                has_astray |= !is_inside && is_own && uids[row] < self.plan.gaussians;
                is_new
            };
            let keeps: Vec<bool> = (0..uids.len()).map(keeps).collect();
            astray.extend(has_astray.then_some(page));
            columns.retain_rows(|_, row| keeps[row]);
            kept_rows += columns.rows() as u64;
            sink.write(&columns)?;
        }
        self.done.kept.push(kept_rows);
        Ok(astray)
    }

    /// Writes the rows of the prior in these pages of their owner that lie beyond its ground and that no cell has kept.
    fn put_back(
        &mut self,
        cell: usize,
        pages: &[PageNo],
        mut store: StoredStart,
        sink: &mut dyn GaussianSink,
    ) -> Result<(), TrainError> {
        for &page in pages {
            let (uids, mut columns) = store.rows_of(page, self.frame())?;
            let goes_back = |row: usize| {
                let is_prior = uids[row] < self.plan.gaussians;
                is_prior && !self.lies_in(cell, &columns, row) && self.kept.insert(uids[row])
            };
            let goes_back: Vec<bool> = (0..uids.len()).map(goes_back).collect();
            columns.retain_rows(|_, row| goes_back[row]);
            self.done.put_back += columns.rows() as u64;
            sink.write(&columns)?;
        }
        Ok(())
    }

    fn frame(&self) -> ([f64; 3], f64) {
        (self.plan.origin, self.plan.scale)
    }

    fn lies_in(&self, cell: usize, columns: &Columns, row: usize) -> bool {
        let mean = columns.row(Column::Means, row);
        self.plan.cell_at(self.plan.ground([mean[0], mean[1], mean[2]])) == cell
    }

    /// Whether a cell owns each of the pages that it trains, by their numbers in its run.
    fn owned_pages(&self, folder: &Path, cell: usize) -> InputResult<Vec<bool>> {
        let file = folder.join("pages.txt");
        let text = read_text(&file, LIST_BYTES_MAX, "restore the files of the cell")?;
        let trained = text.lines().filter_map(|line| line.parse::<PageId>().ok());
        Ok(trained.map(|page| self.owners.get(&page) == Some(&cell)).collect())
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

/// Writes the config of a short run that polishes the merged scene, which will lie in `out`: the views that several cells trained on, or all
/// if there is none, the rates with which the cells ended, no growth.
fn write_polish(plan: &CityPlan, city: &City, out: &Path, folder: &mut PartFolder) -> InputResult<()> {
    let mut cells_of: BTreeMap<String, usize> = BTreeMap::new();
    for cell in 0..plan.cells.len() {
        let text = read_text(&city.cell(cell).join("views.txt"), LIST_BYTES_MAX, "restore the files of the cell")?;
        text.lines().for_each(|name| *cells_of.entry(name.to_string()).or_default() += 1);
    }
    let most = cells_of.values().copied().max().unwrap_or(0);
    let crossing = cells_of.iter().filter(|(_, cells)| **cells > 1 || most == 1);
    let names: String = crossing.map(|(name, _)| format!("{name}\n")).collect();
    folder.write(Path::new(POLISH_VIEWS_FILE), names.as_bytes())?;
    let mut keys = city.given_keys()?;
    let whole = config_of(&city.keys(), keys.clone(), &TrainOverrides::default())?;
    let of_cell = new_run::given_keys(Some(&city.cell(0).join("cell.toml")), &TrainOverrides::default())?;
    let ended = config_of(&city.cell(0), of_cell, &TrainOverrides::default())?;
    keys.extend(remedies_of_prior(city)?);
    keys.remove("max-gaussians");
    keys.remove(KEY_OF_FIRST_POINTS);
    keys.insert("steps".into(), i64::from((whole.steps / POLISH_SHARE).max(1)).into());
    // Most Gaussians are on few of these photos, or on none.
    for (key, word) in [("strategy", "none"), ("schedule", "classic"), ("export-clean", "off")] {
        keys.insert(key.into(), word.into());
    }
    let mut paths = vec![("init-ply", out.join(PLY_FILE)), ("views-file", out.join(POLISH_VIEWS_FILE))];
    if city.prior_appearance().is_file() {
        paths.push(("first-appearance", city.prior_appearance()));
    }
    for (key, path) in paths {
        keys.insert(key.into(), absolute(&path).to_string_lossy().into_owned().into());
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
    folder.write(Path::new(POLISH_FILE), toml_of(POLISH_FILE, &keys)?.as_bytes())
}
