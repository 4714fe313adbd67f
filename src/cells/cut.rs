//! Cuts a city into cells: median splits of the ground until the cells have equal work and bytes, the views of each cell by blending weight,
//! its margin and its ring, and what it will cost.
//!
//! Invariants: 1. every page has one owner, by its middle; every training view is in some cell; 2. every cell has `VIEWS_LEAST` training
//! views, or there is only one cell; 3. `plan.toml` is written last; a city is cut once.

use super::costs::{AsIf, Basis, PhaseCost};
use super::plan::{CELL_FILES, CellCount, CellPlan, CityPlan, GroundRect, files_digest, poses_digest, prior_digest};
use super::prior::KEY_OF_FIRST_POINTS;
use super::ring::pages_of_cell;
use super::views::{Seen, SeenView, see};
use super::{City, check_machine_keys, check_range, config_of, toml_of};
use crate::base::error::{InputError, InputResult};
use crate::base::text::{OWN_FILE_MOST, read_text};
use crate::base::whole_file::write_whole;
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::config::limits;
use crate::dataset::model::ReadOptions;
use crate::dataset::read::read_scene;
use crate::photos::outlier::blocks::MASKED_SHARE;
use crate::report::run_files::{CONFIG_FILE, SUMMARY_FILE};
use crate::scene::state::row_bytes;
use crate::train::error::TrainError;
use crate::train::log::report::Summary;
use crate::train::stores::ListedPage;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Keys that a run may decide by its diagnosis.
const REMEDIES: [&str; 4] = ["appearance", "robust-views", "robust-pixels", "refine-poses"];
/// A cell with fewer training views is joined to a neighbour.
const VIEWS_LEAST: usize = 8;
/// Pages are this full on average.
const FILL: f64 = 0.7;

#[derive(Debug, Clone)]
pub struct CutRequest {
    pub scene: PathBuf,
    pub city: PathBuf,
    pub cells: CellCount,
    pub view_share: f64,
    pub margin: f64,
    /// Bytes a second of the network, for the costs.
    pub network: u64,
    /// Machines that work on cells, for the costs; 0 for one for each cell.
    pub machines: usize,
    /// Plan for this larger scene of the same kind; with `dry_run`.
    pub as_if: Option<AsIf>,
    /// Keys of this machine.
    pub keys: TrainOverrides,
    pub dry_run: bool,
    pub quiet: bool,
}

/// A cell before it is written.
pub(crate) struct Draft {
    pub train: Vec<usize>,
    pub test: Vec<usize>,
    /// Places of pages.
    pub trained: Vec<usize>,
    pub frozen: Vec<usize>,
}

/// Cuts the city; returns the plan, and what the city costs by phase. Of a city that is cut already in the same way only the plan.
/// Errors: it is cut in another way, there is no prior, or it has too few pages.
pub fn cut(request: &CutRequest) -> Result<(CityPlan, Vec<PhaseCost>), TrainError> {
    let city = City(request.city.clone());
    check_machine_keys(&request.keys)?;
    check_range("--margin", request.margin, 0.0..=10.0)?;
    check_range("--view-share", request.view_share, 0.0..=1.0)?;
    if matches!(request.cells, CellCount::Cells(0) | CellCount::MostGaussians(0)) {
        let problem = "a city has one cell at least, with one Gaussian at least";
        return Err(InputError::new("--cells", problem, "give a number from 1 on").into());
    }
    if request.network == 0 {
        return Err(InputError::new("--network", "0 bytes a second", "give its rate, such as 125MB").into());
    }
    if !request.dry_run && city.plan().exists() {
        let plan = CityPlan::read(&city)?;
        if (plan.asked, plan.view_share, plan.margin) == (request.cells, request.view_share, request.margin) {
            crate::tell!("the city in {} is cut", city.0.display());
            return Ok((plan, Vec::new()));
        }
        let problem = "the city is cut already, in another way";
        return Err(InputError::new(city.plan(), problem, "go on with gsscale-cells run, or begin another city").into());
    }
    let mut keys = city.given_keys()?;
    keys.extend(remedies_of_prior(&city)?);
    // The rows of the prior are no poor points.
    keys.entry("poor-points").or_insert_with(|| "off".into());
    keys.remove(KEY_OF_FIRST_POINTS);
    // What `auto` stands for depends on the memory of a machine.
    if keys.get("view-order").is_none_or(|order| order.as_str() == Some("auto")) {
        keys.insert("view-order".into(), "shuffle".into());
    }
    let mut whole = config_of(&city.keys(), keys.clone(), &TrainOverrides::default())?;
    whole.image_cache = request.keys.image_cache.unwrap_or(whole.image_cache);
    let seen = see(&request.scene, &city, &request.keys, request.quiet)?;
    let gaussians: u64 = seen.pages.iter().map(|page| page.rows).sum();
    // Without a cap the prior has decided how many pay in its smaller photos.
    let decided = (gaussians as f64 * seen.detail) as u64;
    let most = if whole.max_gaussians == 0 { decided } else { whole.max_gaussians };
    let growth = (most as f64 / gaussians as f64).max(1.0);
    let (leaves, drafts) = fitting_cells(&seen, request, growth)?;
    let views = seen.views.iter().filter(|view| view.is_train).count();
    let past = past_of(&city)?;
    let raw = read_scene(&request.scene, &ReadOptions { points_later: true, ..limits::read_options(&whole) })?;
    let mut cells = Vec::new();
    for (number, draft) in drafts.iter().enumerate() {
        let mut planned = plan_cell(&seen, draft, &whole, growth, views, past);
        if !request.dry_run {
            let names = write_cell(&city, number, &seen, draft, keys.clone(), &planned)?;
            planned.files = files_digest(&city.cell(number))?;
            planned.poses = poses_digest(&raw, &names);
        }
        cells.push(planned);
    }
    let mut plan = CityPlan {
        version: env!("CARGO_PKG_VERSION").to_string(),
        prior: prior_digest(&city, seen.digest)?,
        gaussians,
        views,
        asked: request.cells,
        growth,
        view_share: request.view_share,
        margin: request.margin,
        origin: seen.origin,
        scale: seen.scale,
        up: seen.up,
        axes: seen.axes,
        cells,
        leaves,
    };
    if !request.dry_run {
        plan.write(&city)?;
    }
    let mut basis = Basis {
        whole: &whole,
        photo: seen.photo,
        step_seconds: past,
        steps: whole.steps.into(),
        prior_degree: seen.sh_degree,
        network: request.network as f64,
        machines: if request.machines == 0 { plan.cells.len() } else { request.machines },
    };
    if let Some(larger) = request.as_if.filter(|_| request.dry_run) {
        basis.enlarge(&mut plan, larger);
    }
    let phases = basis.phases(&plan);
    Ok((plan, phases))
}

/// The remedies that the prior has decided on: its diagnosis saw all photos, and every cell shall have the same. `robust-pixels = "auto"` is what
/// the prior came to, since cells begin from Gaussians.
pub(crate) fn remedies_of_prior(city: &City) -> InputResult<toml::Table> {
    let file = city.prior_run().join(CONFIG_FILE);
    let config = toml::Table::try_from(TrainConfig::read(&file)?);
    let mut config = config.map_err(|e| InputError::new(&file, e.to_string(), "report this as a bug"))?;
    config.retain(|key, _| REMEDIES.contains(&key));
    let masks = config.entry("robust-pixels").or_insert("off".into());
    if masks.as_str() == Some("auto") {
        let has_masked = summary_of_prior::<serde_json::Map<String, Value>>(city)?.contains_key(MASKED_SHARE);
        *masks = (if has_masked { "on" } else { "off" }).into();
    }
    Ok(config)
}

/// Cells of the number asked for or, if that is a number of Gaussians, the fewest whose trained rows stay below it.
fn fitting_cells(seen: &Seen, request: &CutRequest, growth: f64) -> InputResult<(Vec<GroundRect>, Vec<Draft>)> {
    let (mut cells, most) = match request.cells {
        CellCount::Cells(cells) => (cells, u64::MAX),
        CellCount::MostGaussians(most) => (1, most),
    };
    // The smallest largest cell so far, and the number of cells that were asked for.
    let mut smallest = (u64::MAX, cells);
    loop {
        if cells > seen.pages.len() {
            let problem = format!("the prior has {} pages, too few for {cells} cells", seen.pages.len());
            return Err(InputError::new(
                "--cells",
                problem,
                "ask for fewer or larger cells, or begin a city with smaller --page-rows",
            ));
        }
        let (leaves, drafts) = drafts(seen, leaves_of(seen, cells), request);
        let rows = |draft: &Draft| draft.trained.iter().map(|&page| seen.pages[page].rows).sum::<u64>();
        let largest = drafts.iter().map(rows).max().unwrap_or(0);
        if largest as f64 * growth <= most as f64 {
            return Ok((leaves, drafts));
        }
        if largest < smallest.0 {
            smallest = (largest, cells);
        } else if cells > 2 * smallest.1 + 8 {
            let least = (smallest.0 as f64 * growth).ceil() as u64;
            let problem = format!("{most} Gaussians are too few for a cell with its margin and {VIEWS_LEAST} photos");
            return Err(InputError::new(
                "--max-gaussians-per-cell",
                problem,
                format!("give at least {least}, or cut with a smaller --margin"),
            ));
        }
        cells += 1;
    }
}

/// The leaves of `cells` cells: halves of equal work, again and again, across the longest axis.
fn leaves_of(seen: &Seen, cells: usize) -> Vec<GroundRect> {
    // Bytes are rows, and work is the rows that views draw; each counts half.
    let mut drawn = vec![0u64; seen.pages.len()];
    let drawing = seen.views.iter().filter(|view| view.is_train).flat_map(|view| &view.weights);
    drawing.for_each(|&(page, _)| drawn[page] += seen.pages[page].rows);
    let [rows, drawings] =
        [seen.pages.iter().map(|page| page.rows).sum::<u64>(), drawn.iter().sum()].map(|sum| sum.max(1) as f64);
    let work: Vec<f64> =
        seen.pages.iter().zip(&drawn).map(|(page, &drawn)| page.rows as f64 / rows + drawn as f64 / drawings).collect();
    let all = GroundRect { cell: 0, low: [f64::NEG_INFINITY; 2], high: [f64::INFINITY; 2] };
    let mut leaves = Vec::new();
    halve(seen, &work, &mut (0..seen.pages.len()).collect::<Vec<_>>(), cells, all, &mut leaves);
    leaves
}

fn halve(seen: &Seen, work: &[f64], pages: &mut [usize], cells: usize, leaf: GroundRect, leaves: &mut Vec<GroundRect>) {
    if cells == 1 {
        return leaves.push(GroundRect { cell: leaves.len(), ..leaf });
    }
    let extent = |axis: usize| {
        let along = pages.iter().map(|&page| seen.pages[page].middle[axis]);
        along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
    };
    let axis = usize::from(extent(1) > extent(0));
    let along = |page: usize| seen.pages[page].middle[axis];
    pages.sort_unstable_by(|&a, &b| along(a).total_cmp(&along(b)).then(a.cmp(&b)));
    let low_cells = cells / 2;
    let share: f64 = pages.iter().map(|&page| work[page]).sum::<f64>() * low_cells as f64 / cells as f64;
    let mut below = 0.0;
    let at = pages.iter().position(|&page| {
        below += work[page];
        below > share
    });
    // Each side keeps a page for each of its cells.
    let at = at.unwrap_or(0).clamp(low_cells, pages.len() - (cells - low_cells));
    let plane = 0.5 * (along(pages[at - 1]) + along(pages[at]));
    let (mut low, mut high) = (leaf, leaf);
    (low.high[axis], high.low[axis]) = (plane, plane);
    let (low_pages, high_pages) = pages.split_at_mut(at);
    halve(seen, work, low_pages, low_cells, low, leaves);
    halve(seen, work, high_pages, cells - low_cells, high, leaves);
}

/// Gives the cells their views and pages. Cells with few views are joined to the neighbour that shares most of these views.
fn drafts(seen: &Seen, mut leaves: Vec<GroundRect>, request: &CutRequest) -> (Vec<GroundRect>, Vec<Draft>) {
    loop {
        let cells = leaves.iter().map(|leaf| leaf.cell + 1).max().unwrap_or(0);
        let cell_at = |at: [f64; 2]| leaves.iter().find(|leaf| leaf.holds(at)).map_or(0, |leaf| leaf.cell);
        let owner: Vec<usize> = seen.pages.iter().map(|page| cell_at(page.middle)).collect();
        let shares: Vec<Vec<f64>> = seen.views.iter().map(|view| shares_of(view, &owner, cells)).collect();
        let largest = |shares: &Vec<f64>| (0..cells).rev().max_by(|&a, &b| shares[a].total_cmp(&shares[b]));
        let own: Vec<[Option<usize>; 2]> =
            shares.iter().zip(&seen.views).map(|(shares, view)| [largest(shares), Some(cell_at(view.at))]).collect();
        let takes =
            |view: usize, cell: usize| shares[view][cell] >= request.view_share || own[view].contains(&Some(cell));
        let views = |cell: usize, is_train: bool| -> Vec<usize> {
            (0..seen.views.len()).filter(|&view| seen.views[view].is_train == is_train && takes(view, cell)).collect()
        };
        let train: Vec<Vec<usize>> = (0..cells).map(|cell| views(cell, true)).collect();
        let fewest = (0..cells).min_by_key(|&cell| train[cell].len()).unwrap_or(0);
        if cells == 1 || train[fewest].len() >= VIEWS_LEAST {
            let draft = |cell: usize| {
                let test = views(cell, false);
                let (trained, frozen) =
                    pages_of_cell(seen, &leaves, &owner, cell, train[cell].iter().chain(&test), request.margin);
                Draft { train: train[cell].clone(), test, trained, frozen }
            };
            let drafts = (0..cells).map(draft).collect();
            return (leaves, drafts);
        }
        let to = neighbour(seen, &leaves, &owner, fewest, &train[fewest], &shares);
        for leaf in &mut leaves {
            let cell = if leaf.cell == fewest { to } else { leaf.cell };
            leaf.cell = cell - usize::from(cell > fewest);
        }
    }
}

/// The share of each cell in the blending weight of a view.
fn shares_of(view: &SeenView, owner: &[usize], cells: usize) -> Vec<f64> {
    let all: f64 = view.weights.iter().map(|(_, weight)| weight).sum();
    let mut shares = vec![0.0; cells];
    view.weights.iter().for_each(|&(page, weight)| shares[owner[page]] += weight / all);
    shares
}

/// The cell that has most of the weight of these views beside `cell`; without views the one that owns the nearest page.
fn neighbour(
    seen: &Seen,
    leaves: &[GroundRect],
    owner: &[usize],
    cell: usize,
    views: &[usize],
    shares: &[Vec<f64>],
) -> usize {
    let mut sums: BTreeMap<usize, f64> = BTreeMap::new();
    for leaf in leaves.iter().filter(|leaf| leaf.cell != cell) {
        let shared: f64 = views.iter().map(|&view| shares[view][leaf.cell]).sum();
        sums.insert(leaf.cell, shared);
    }
    if let Some((&other, _)) =
        sums.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0))).filter(|(_, shared)| **shared > 0.0)
    {
        return other;
    }
    let own: Vec<[f64; 2]> =
        (0..owner.len()).filter(|&page| owner[page] == cell).map(|page| seen.pages[page].middle).collect();
    let apart = |page: usize| {
        let to = |from: &[f64; 2]| (0..2).map(|i| (from[i] - seen.pages[page].middle[i]).powi(2)).sum::<f64>();
        own.iter().map(to).fold(f64::INFINITY, f64::min)
    };
    let others = (0..owner.len()).filter(|&page| owner[page] != cell);
    others.min_by(|&a, &b| apart(a).total_cmp(&apart(b))).map_or(usize::from(cell == 0), |page| owner[page])
}

fn summary_of_prior<T: DeserializeOwned>(city: &City) -> InputResult<T> {
    let file = city.prior_run().join(SUMMARY_FILE);
    let remedy = "finish the prior with the command that began it: gsscale-cells prior SCENE --out CITY";
    let text = read_text(&file, OWN_FILE_MOST, remedy).map_err(|e| InputError { remedy: remedy.into(), ..e })?;
    serde_json::from_str(&text).map_err(|e| InputError::new(&file, e.to_string(), "train the prior again"))
}

/// Seconds of a step of the prior.
fn past_of(city: &City) -> InputResult<f64> {
    let summary: Summary = summary_of_prior(city)?;
    Ok(summary.train_seconds / f64::from(summary.steps.max(1)))
}

/// What a cell has to do. Equal steps a view: a cell with a third of the training views takes a third of the steps.
fn plan_cell(
    seen: &Seen,
    draft: &Draft,
    whole: &TrainConfig,
    growth: f64,
    views: usize,
    step_seconds: f64,
) -> CellPlan {
    let rows = |pages: &[usize]| pages.iter().map(|&page| seen.pages[page].rows).sum::<u64>();
    let (trained, frozen) = (rows(&draft.trained), rows(&draft.frozen));
    let steps = (u64::from(whole.steps) * draft.train.len() as u64).div_ceil(views as u64) as u32;
    let grown = (trained as f64 * growth).ceil() as u64;
    CellPlan {
        train_views: draft.train.len(),
        test_views: draft.test.len(),
        steps,
        trained_pages: draft.trained.len(),
        frozen_pages: draft.frozen.len(),
        trained,
        frozen,
        max_gaussians: grown + frozen,
        bytes: ((grown + frozen) as f64 * row_bytes(whole.sh_degree) as f64 / FILL) as u64,
        // A step draws up to `growth` times the rows of the prior's.
        seconds: f64::from(steps) * step_seconds * (1.0 + growth) / 2.0,
        files: String::new(),
        poses: String::new(),
    }
}

/// Writes the files of a cell; returns the names of its photos, one a line.
fn write_cell(
    city: &City,
    number: usize,
    seen: &Seen,
    draft: &Draft,
    mut keys: toml::Table,
    planned: &CellPlan,
) -> InputResult<String> {
    let folder = city.cell(number);
    std::fs::create_dir_all(&folder).map_err(|e| InputError::io(&folder, "making the folder of the cell", &e))?;
    keys.insert("steps".into(), i64::from(planned.steps).into());
    keys.insert("max-gaussians".into(), (planned.max_gaussians as i64).into());
    let text = toml_of(&folder, &keys)?;
    let mut views: Vec<usize> = draft.train.iter().chain(&draft.test).copied().collect();
    views.sort_unstable_by_key(|&view| &seen.views[view].name);
    let names: String = views.iter().map(|&view| format!("{}\n", seen.views[view].name)).collect();
    let line = |(&page, is_frozen): (&usize, bool)| ListedPage { page: seen.pages[page].id, is_frozen }.line();
    let trained = draft.trained.iter().map(|page| (page, false));
    let pages: String = trained.chain(draft.frozen.iter().map(|page| (page, true))).map(line).collect();
    for (name, text) in CELL_FILES.iter().zip([&text, &names, &pages]) {
        write_whole(&folder.join(name), text.as_bytes())?;
    }
    Ok(names)
}
