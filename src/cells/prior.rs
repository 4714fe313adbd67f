//! The prior: the whole scene, coarsely, as an ordinary run on one machine; then its rows as a store without history, from which all cells
//! start.
//!
//! Invariants: 1. the keys of the city are fixed here; 2. the store appears last, so a city that has it has a finished prior.

use super::work::remove_store;
use super::{AnyRun, City, begin_or_resume, config_of, is_of_machine, machine_keys, toml_of};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::config::file::{KEYS, TrainConfig, TrainOverrides};
use crate::config::new_run;
use crate::page::format::codec::Codec;
use crate::page::tool::new_store::part_of;
use crate::train::error::TrainError;
use crate::train::inputs::signals::StopFlag;
use crate::train::memory::host_budget;
use crate::train::run::out_folder::{check_apart, is_empty};
use crate::train::state::trainer::Trainer;
use crate::train::stores::{ImportRequest, import};
use std::path::PathBuf;

/// The prior takes this part of the steps, and of the Gaussians if they are capped.
pub(crate) const STEPS_SHARE: u32 = 4;
const GAUSSIANS_SHARE: u64 = 5;
/// A key that has no meaning for cells, which begin from Gaussians.
pub(crate) const KEY_OF_FIRST_POINTS: &str = "sweep-points";
/// Longest side of its photos, pixels.
const RESOLUTION_MOST: u32 = 800;
const SH_DEGREE_MOST: u8 = 1;

#[derive(Debug, Clone)]
pub struct PriorRequest {
    pub scene: PathBuf,
    pub city: PathBuf,
    /// Config file of the whole scene; flags override it.
    pub config: Option<PathBuf>,
    /// Keys of the whole scene, and of this machine.
    pub keys: TrainOverrides,
    pub quiet: bool,
}

/// Begins the prior, goes on with it, or says that it is done. Returns the exit code: 0, or that of a stop request.
/// Errors: those of a run; the city was begun with other keys.
pub fn prior(request: &PriorRequest) -> Result<i32, TrainError> {
    let city = City(request.city.clone());
    check_apart(&city.0, &request.scene)?;
    let mut keys = new_run::given_keys(request.config.as_deref(), &request.keys)?;
    let of_machine = |name: &str| KEYS.iter().any(|key| key.name() == name && is_of_machine(key));
    let machine: toml::Table = keys.clone().into_iter().filter(|(name, _)| of_machine(name)).collect();
    keys.retain(|name, _| !machine.contains_key(name));
    let whole = config_of(&city.keys(), keys.clone(), &TrainOverrides::default())?;
    let of_prior = keys.clone().into_iter().chain(machine).chain(keys_of_prior(&whole)).collect();
    let config = config_of(&city.keys(), of_prior, &TrainOverrides::default())?;
    check_keys_of_cells(&city, keys.clone())?;
    fix_keys(&city, &keys)?;
    if city.prior_store().is_dir() {
        crate::say!("the prior in {} is done, of the scene {}", city.0.display(), city.scene()?.display());
        return Ok(0);
    }
    let (out, page_rows) = (city.prior_run(), config.page_rows);
    let budget = host_budget(config.host_mem.0);
    let (scene, quiet) = (&request.scene, request.quiet);
    let has_begun = out.exists() && !is_empty(&out);
    let any = AnyRun { scene, out: &out, has_begun, config, keys: machine_keys(&request.keys), leg: None, quiet };
    let outcome = begin_or_resume(any)?;
    if outcome.exit_code != 0 {
        return Ok(outcome.exit_code);
    }
    // What a killed process has left.
    remove_store(&part_of(&city.prior_store()))?;
    let request = ImportRequest {
        file: Trainer::ply_path(&out),
        out: city.prior_store(),
        host_mem: budget.unwrap_or(1 << 30),
        page_rows,
        codec: Codec::Raw,
    };
    let rows = import(&request, &StopFlag::default())?;
    crate::say!("the prior in {} is done: {} Gaussians in {} pages", city.0.display(), rows.gaussians, rows.pages);
    Ok(0)
}

/// Errors: every cell would refuse a key.
fn check_keys_of_cells(city: &City, mut keys: toml::Table) -> InputResult<()> {
    keys.remove(KEY_OF_FIRST_POINTS);
    for path in ["init-ply", "views-file", "pages-file"] {
        keys.insert(path.into(), path.into());
    }
    let remedy = "leave it out: cells begin from the prior's Gaussians, and keep those around them as they are";
    config_of(&city.keys(), keys, &TrainOverrides::default())
        .map(|_| ())
        .map_err(|error| InputError { remedy: remedy.to_string(), ..error })
}

/// Keeps the keys of the whole scene, or compares them with those that the city has. They may change until the prior's run has begun.
/// Errors: the city was begun with other keys.
fn fix_keys(city: &City, keys: &toml::Table) -> InputResult<()> {
    let file = city.keys();
    let text = toml_of(&file, keys)?;
    if !file.exists() || !city.prior_run().exists() {
        std::fs::create_dir_all(&city.0).map_err(|e| InputError::io(&city.0, "making the folder", &e))?;
        return write_whole(&file, text.as_bytes());
    }
    let before = new_run::given_keys(Some(&file), &TrainOverrides::default())?;
    if before == *keys {
        return Ok(());
    }
    let remedy = "give the flags with which it was begun, or another --out";
    Err(InputError::new(&file, "the city was begun with other keys", remedy))
}

/// What makes the prior of a scene with this config coarse, and what lets its PLY keep all bits.
pub(crate) fn keys_of_prior(whole: &TrainConfig) -> toml::Table {
    let resolution =
        Some(whole.max_resolution).filter(|&most| most > 0).map_or(RESOLUTION_MOST, |most| most.min(RESOLUTION_MOST));
    let mut keys = toml::toml! {
        export-frame = "local"
        export-clean = "off"
        up = "keep"
        keep-checkpoint = false
    };
    keys.insert("steps".into(), i64::from((whole.steps / STEPS_SHARE).max(1)).into());
    keys.insert("max-resolution".into(), i64::from(resolution).into());
    keys.insert("sh-degree".into(), i64::from(whole.sh_degree.min(SH_DEGREE_MOST)).into());
    keys.insert("sh-start".into(), i64::from(whole.sh_start.min(SH_DEGREE_MOST)).into());
    if whole.max_gaussians > 0 {
        keys.insert("max-gaussians".into(), (whole.max_gaussians.div_ceil(GAUSSIANS_SHARE) as i64).into());
    }
    keys
}
