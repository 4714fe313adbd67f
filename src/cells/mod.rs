//! A city in cells: what `gsscale-cells` does, so that several machines, or one machine with a small drive, train a scene that is too large
//! for one.
//!
//! ```text
//! prior  the whole scene, coarse, on one machine       city/keys.toml, prior/
//! cut    the ground into cells of equal work           city/plan.toml, cells/K/{cell.toml, views.txt, pages.txt}
//! run    one cell, anywhere; as often as needed        city/cells/K/{lock, copy/N/, done.toml}
//! merge  the rows of each cell's own ground            runs/city/point_cloud.ply
//! seam   what the borders cost
//! ```
//!
//! Every command is one ordinary run underneath, or none. No machine talks to another: all state lies in the folder of the city, which all
//! machines see. Any scheduler can start the commands (`tools/cells/`).
//!
//! A cell starts from the prior's rows. It trains the pages that reach into its ground, and a margin around it, whose rows the merge drops.
//! What its photos show beyond is a ring of frozen pages ([`crate::base::ids::PageId::frozen`]): rendered, never changed. All cells may grow
//! by the same factor of the prior's rows, so both sides of a border get the same density.
//!
//! Invariants: 1. a cell's result is a function of the plan, the prior, the photos, and the kind of device (a GPU and a CPU give other last
//! bits); machines, budgets, kills and schedulers change no byte; 2. a command that is repeated goes on or says that it is done; 3. nothing is
//! published in the city but under the lock of its cell, and only complete: `done.toml` is the last.

pub mod costs;
pub mod cut;
pub mod lock;
pub mod merge;
pub mod plan;
pub mod prior;
mod ring;
pub mod seam;
mod views;
pub mod work;

use crate::base::error::{InputError, InputResult};
use crate::config::file::{ConfigKey, KEYS, TrainConfig, TrainOverrides};
use crate::config::new_run;
use crate::train::error::TrainError;
use crate::train::run::begin::run;
use crate::train::run::request::{Existing, RunOutcome, RunRequest};
use crate::train::run::resume::{ResumeRequest, go_on, resume};
use serde::Serialize;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Restarts of a run whose device was lost, as those of `gsscale-train`.
const RESTARTS: u32 = 3;

/// A run that may have begun already.
pub(crate) struct AnyRun<'a> {
    pub scene: &'a Path,
    pub out: &'a Path,
    /// There is something in `out`, or a commit, to go on from. Otherwise `out` holds no results.
    pub has_begun: bool,
    /// Of a new run.
    pub config: TrainConfig,
    /// Of a resumed run: what may differ from machine to machine.
    pub keys: TrainOverrides,
    pub leg: Option<Duration>,
    pub quiet: bool,
}

/// Begins the run, or goes on with it.
/// Errors: those of a run.
pub(crate) fn begin_or_resume(any: AnyRun<'_>) -> Result<RunOutcome, TrainError> {
    let AnyRun { scene, out, has_begun, config, keys, leg, quiet } = any;
    let (out, scene) = (out.to_path_buf(), scene.to_path_buf());
    let again = ResumeRequest {
        out: out.clone(),
        keys,
        scene: Some(scene.clone()),
        accept_changes: false,
        quiet,
        live: None,
        leg,
    };
    let done = match has_begun {
        true => resume(&again),
        false => {
            let (existing, dry_run, live) = (Existing::BeginAgain, false, None);
            run(&RunRequest { scene, out, config, dry_run, existing, quiet, live, leg })
        }
    };
    go_on(done, &again, RESTARTS)
}

/// Keys of what a run prints and writes on its way, and of memory for photos.
const KEYS_OF_WATCHING: [&str; 6] = ["image_cache", "eval_every", "save_every", "log_every", "log", "export"];

/// Whether a key may differ from machine to machine. The others decide the bytes of a city, also those that a resumed run may change
/// because they act at its beginning or at its end alone, such as `schedule` and `up`.
pub(crate) fn is_of_machine(key: &ConfigKey) -> bool {
    let is_listed = ["Memory and disk", "Machine"].contains(&key.heading) || KEYS_OF_WATCHING.contains(&key.field);
    is_listed && key.class.is_free()
}

/// The keys that may differ from machine to machine, as flags.
pub fn machine_flags(keys: &toml::Table) -> Vec<String> {
    let flag = |(name, value): (&String, &toml::Value)| {
        let is_listed = KEYS.iter().any(|key| key.name() == *name && is_of_machine(key));
        is_listed.then(|| format!("--{name}={}", value.as_str().map_or_else(|| value.to_string(), str::to_string)))
    };
    keys.iter().filter_map(flag).collect()
}

/// The flags that may differ from machine to machine.
pub(crate) fn machine_keys(keys: &TrainOverrides) -> TrainOverrides {
    keys.clone().only(|field| KEYS.iter().any(|key| key.field == field && is_of_machine(key)))
}

/// Refuses a number out of range, and what is no number.
/// Errors: it is.
pub(crate) fn check_range(flag: &str, value: f64, range: RangeInclusive<f64>) -> InputResult<()> {
    if range.contains(&value) {
        return Ok(());
    }
    let remedy = format!("use a number from {} to {}", range.start(), range.end());
    Err(InputError::new(flag, format!("{value} is out of range"), remedy))
}

/// Refuses flags that decide the bytes of a city.
/// Errors: there is one.
pub(crate) fn check_machine_keys(keys: &TrainOverrides) -> InputResult<()> {
    let given = keys.given();
    match KEYS.iter().find(|key| given.contains(&key.field) && !is_of_machine(key)) {
        None => Ok(()),
        Some(key) => {
            let problem = "it decides what is trained, which is the same for all cells";
            Err(InputError::new(format!("--{}", key.name()), problem, "give it to gsscale-cells prior"))
        }
    }
}

/// A config of the keys of a city with those of this machine.
/// Errors: a key is unknown or out of range.
pub(crate) fn config_of(file: &Path, mut keys: toml::Table, machine: &TrainOverrides) -> InputResult<TrainConfig> {
    keys.extend(new_run::given_keys(None, machine)?);
    let config = new_run::of_given(keys)
        .map_err(|problem| InputError::new(file, problem, "restore the file, or begin another city"))?;
    config.check()?;
    Ok(config)
}

/// The text of a TOML file.
pub(crate) fn toml_of(file: impl AsRef<Path>, values: &impl Serialize) -> InputResult<String> {
    toml::to_string(values).map_err(|e| InputError::new(file, e.to_string(), "report this as a bug"))
}

/// The folder of a city.
#[derive(Debug, Clone)]
pub struct City(pub PathBuf);

impl City {
    /// The keys that the user gave, which decide the bytes of the whole scene; usable as `--config`.
    pub fn keys(&self) -> PathBuf {
        self.0.join("keys.toml")
    }

    /// The keys in that file.
    /// Errors: there is no prior, or the file is none of keys.
    pub fn given_keys(&self) -> InputResult<toml::Table> {
        new_run::given_keys(Some(&self.keys()), &TrainOverrides::default()).map_err(|error| match error.kind {
            Some(std::io::ErrorKind::NotFound) => InputError { remedy: NO_PRIOR.to_string(), ..error },
            _ => error,
        })
    }

    /// The output folder of the prior's run.
    pub fn prior_run(&self) -> PathBuf {
        self.0.join("prior/run")
    }

    /// The rows of the prior, as a store without history.
    pub fn prior_store(&self) -> PathBuf {
        self.0.join("prior/store")
    }

    /// What the prior found of the photos, with --appearance.
    pub fn prior_appearance(&self) -> PathBuf {
        self.prior_run().join(crate::photos::exposure::FILE)
    }

    pub fn plan(&self) -> PathBuf {
        self.0.join("plan.toml")
    }

    pub fn cell(&self, cell: usize) -> PathBuf {
        self.0.join(format!("cells/{cell}"))
    }

    /// The scene that the prior was trained on.
    /// Errors: there is no prior.
    pub fn scene(&self) -> InputResult<PathBuf> {
        let config = self.prior_run().join(crate::report::run_files::CONFIG_FILE);
        let resolved = crate::config::file::read_resolved(&config);
        resolved.map(|facts| facts.scene).map_err(|e| InputError { remedy: NO_PRIOR.to_string(), ..e })
    }
}

/// The remedy for a city without a prior.
pub(crate) const NO_PRIOR: &str = "begin the city: gsscale-cells prior SCENE --out CITY";
