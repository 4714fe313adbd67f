//! What is other than it was when a run goes on: its config, key by key, and its dataset.
//!
//! A key's class ([`Class`]) stands beside the key. Keys that change no number of the result may be given anew, which is only
//! said; keys that do are refused unless the user accepts it; keys that the stored pages are laid out by cannot change.

use super::dataset_print::{DatasetChanges, dataset_changes};
use crate::base::error::{InputError, InputResult};
use crate::base::simd::SimdPath;
use crate::checkpoint::run_state::{DatasetPrint, RunState};
use crate::config::file::{KEYS, TrainConfig};
use crate::config::key::{Class, Key};
use crate::config::limits;
use crate::dataset::loader::Dataset;
use serde::Deserialize;
use std::path::Path;

/// The config that a run keeps when it goes on with `config`: that of its file, with what changes numbers and how far it
/// goes and where its checkpoint is as they are now.
///
/// # Errors
/// None that a config can cause.
pub(super) fn kept_config(file: &Path, of_file: &TrainConfig, config: &TrainConfig) -> InputResult<TrainConfig> {
    let broken = |e: String| InputError::new(file, e, "report this as a bug");
    let table = |config: &TrainConfig| toml::Table::try_from(config).map_err(|e| broken(e.to_string()));
    let (of_file, mut kept) = (table(of_file)?, table(config)?);
    for name in KEYS.iter().filter(|key| !key.class.lasts()).map(Key::name) {
        kept.extend(of_file.get(&name).map(|value| (name, value.clone())));
    }
    let kept = TrainConfig::deserialize(kept).map_err(|e| broken(e.to_string()))?;
    Ok(with_absolute_paths(kept))
}

/// The config with paths that do not depend on where the program was started.
pub(super) fn with_absolute_paths(config: TrainConfig) -> TrainConfig {
    let absolute = |path: &String| match path.as_str() {
        "" => String::new(),
        path => std::path::absolute(path).map_or(path.to_string(), |p| p.to_string_lossy().into_owned()),
    };
    TrainConfig { spill_dir: absolute(&config.spill_dir), init_ply: absolute(&config.init_ply), ..config }
}

/// Refuses to go on from pages that were trained with too small an epsilon: their bounds do not hold, and another epsilon
/// from now on does not bring them back. No earlier check can: the config in the run's folder may be another by now.
fn check_eps_of_commit(file: &Path, then: &TrainConfig) -> InputResult<()> {
    let Err(error) = then.check_adam_eps() else { return Ok(()) };
    let problem = format!("the last commit was trained with an --adam-eps that is refused by now: {}", error.problem);
    let remedy = "start a new run from its Gaussians: gsscale-ckpt export, then --init-ply with that file";
    Err(InputError::new(file, problem, remedy))
}

/// What is other than it was, a line each.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Changes {
    /// What changes no number.
    pub free: Vec<String>,
    /// What changes numbers.
    pub numbers: Vec<String>,
    /// What cannot change.
    pub fixed: Vec<String>,
}

impl Changes {
    /// The keys of `config` beside those of the last commit.
    ///
    /// # Errors
    /// The config of the commit cannot be read.
    pub fn of_config(file: &Path, state: &RunState, config: &TrainConfig) -> InputResult<Changes> {
        let broken = |e: String| InputError::new(file, e, "start the run again");
        let written: toml::Table = state.config.parse().map_err(|e: toml::de::Error| broken(e.to_string()))?;
        let then = TrainConfig::parse(&state.config).map_err(broken)?;
        let table = |config: &TrainConfig| {
            toml::Table::try_from(config).map_err(|e| InputError::new(file, e.to_string(), "report this as a bug"))
        };
        let (there, here) = (table(&then)?, table(config)?);
        let mut changes = Changes::default();
        for (name, now) in &here {
            let Some(class) = KEYS.iter().find(|key| key.name() == *name).map(|key| key.class) else { continue };
            // A key that an older commit did not know has the default since, and the user hears of it.
            let then = there.get(name).filter(|_| written.contains_key(name));
            if class.is_derived() || then == Some(now) {
                continue;
            }
            let lines = match class {
                Class::Layout => &mut changes.fixed,
                class if class.is_free() => &mut changes.free,
                _ => &mut changes.numbers,
            };
            let then = then.map_or_else(|| "not there".to_string(), toml::Value::to_string);
            lines.push(format!("{name} was {then} and is {now}"));
        }
        check_eps_of_commit(file, &then)?;
        let [was, is] = [&then, config].map(limits::schedule_steps);
        if was != is {
            changes.numbers.push(format!("schedule-steps was {was} and is {is}"));
        }
        changes.add_path(&state.simd, limits::simd_path(config));
        Ok(changes)
    }

    /// Adds another instruction path than that of the last commit: one of the same bits changes no number.
    fn add_path(&mut self, there: &str, here: SimdPath) {
        if there == here.name() {
            return;
        }
        let line = format!("simd was {there} and is {}", here.name());
        let has_same_bits = SimdPath::from_name(there).is_some_and(|path| path.bits_class() == here.bits_class());
        if has_same_bits {
            self.free.push(format!("{line} (the same bits)"));
        } else {
            self.numbers.push(line);
        }
    }

    /// Adds what is other in the dataset.
    pub fn add_dataset(&mut self, dataset: &Dataset, there: &DatasetPrint, here: &DatasetPrint) {
        let DatasetChanges { lines, fixed } = dataset_changes(dataset, there, here);
        self.numbers.extend(lines);
        self.fixed.extend(fixed);
    }

    /// Refuses what a run cannot go on with, or not without `accept`.
    ///
    /// # Errors
    /// There is such a change.
    pub fn check(&self, place: &Path, accept: bool) -> InputResult<()> {
        let list = |lines: &[String]| lines.iter().map(|line| format!("\n    {line}")).collect::<String>();
        if !self.fixed.is_empty() {
            let all = [self.fixed.as_slice(), &self.numbers].concat();
            let problem = format!("the Gaussians of this run cannot follow what changed:{}", list(&all));
            let remedy = "bring it back as it was, or start a new run from them: --init-ply with its point_cloud.ply";
            return Err(InputError::new(place, problem, remedy));
        }
        if accept || self.numbers.is_empty() {
            return Ok(());
        }
        let problem = format!("the run would go on with other numbers than it began with:{}", list(&self.numbers));
        let remedy = "bring it back as it was, go on all the same with --accept-changes, or start a new run with another \
                      --out";
        Err(InputError::new(place, problem, remedy))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn another_path_changes_numbers_where_its_bits_are_others() {
        let changes = |there: &str, here: SimdPath| {
            let mut changes = Changes::default();
            changes.add_path(there, here);
            [changes.free.len(), changes.numbers.len(), changes.fixed.len()]
        };
        for path in SimdPath::ALL {
            assert_eq!(changes(path.name(), path), [0, 0, 0]);
            // A path that only another program knows.
            assert_eq!(changes("neon", path), [0, 1, 0]);
        }
        assert_eq!(changes("avx512", SimdPath::Avx2), [1, 0, 0]);
        assert_eq!(changes("avx2", SimdPath::Avx512), [1, 0, 0]);
        for fused in [SimdPath::Avx2, SimdPath::Avx512] {
            assert_eq!(changes("baseline", fused), [0, 1, 0]);
            assert_eq!(changes(fused.name(), SimdPath::Baseline), [0, 1, 0]);
        }
    }

    #[test]
    fn what_lasts_is_kept() {
        let of_file = TrainConfig { threads: 3, frames: 7, seed: 1, ..TrainConfig::default() };
        let now = TrainConfig { threads: 1, steps: 9, seed: 2, keep_checkpoint: true, ..TrainConfig::default() };
        let kept = kept_config(Path::new("config.toml"), &of_file, &now).unwrap();
        assert_eq!(kept, TrainConfig { threads: 3, frames: 7, ..now.clone() });
        // The folder of its pages goes with the run, wherever a later life is started.
        let now = TrainConfig { spill_dir: "copy".into(), ..now };
        let kept = kept_config(Path::new("config.toml"), &of_file, &now).unwrap();
        assert!(Path::new(&kept.spill_dir).is_absolute() && kept.spill_dir.ends_with("copy"), "{}", kept.spill_dir);
    }
}
