//! Differences between a run and its resume: the config, key by key, and the dataset.
//!
//! The class of a key ([`Class`]) decides: a key that changes no number of the result may change, with a message; a key
//! that changes numbers is refused unless the user accepts it; a key of the page layout cannot change.

use crate::base::error::{InputError, InputResult};
use crate::base::simd::SimdPath;
use crate::checkpoint::run_state::DatasetPrint;
use crate::config::file::{Class, ConfigKey, KEYS, Resolved, TrainConfig};
use crate::config::limits;
use crate::dataset::loader::Dataset;
use crate::densify::growth::GrowthState;
use serde::Deserialize;
use std::path::Path;

/// The config that a run keeps when it resumes with `config`: that of its file, with the lasting keys of `config`
/// (numbers, length, place of the checkpoint).
/// Errors: none for a valid config.
pub(super) fn kept_config(file: &Path, of_file: &TrainConfig, config: &TrainConfig) -> InputResult<TrainConfig> {
    let broken = |e: String| InputError::new(file, e, "report this as a bug");
    let table = |config: &TrainConfig| toml::Table::try_from(config).map_err(|e| broken(e.to_string()));
    let (of_file, mut kept) = (table(of_file)?, table(config)?);
    for name in KEYS.iter().filter(|key| !key.class.lasts()).map(ConfigKey::name) {
        kept.extend(of_file.get(&name).map(|value| (name, value.clone())));
    }
    let kept = TrainConfig::deserialize(kept).map_err(|e| broken(e.to_string()))?;
    Ok(with_absolute_paths(kept))
}

pub(super) fn with_absolute_paths(config: TrainConfig) -> TrainConfig {
    let absolute = |path: &String| match path.as_str() {
        "" => String::new(),
        path => std::path::absolute(path).map_or(path.to_string(), |p| p.to_string_lossy().into_owned()),
    };
    TrainConfig {
        spill_dir: absolute(&config.spill_dir),
        init_ply: absolute(&config.init_ply),
        pages_file: absolute(&config.pages_file),
        first_appearance: absolute(&config.first_appearance),
        views_file: absolute(&config.views_file),
        ..config
    }
}

/// Views to list of a difference; further ones are only counted.
const LISTED: usize = 10;

/// Differences, one line each.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Changes {
    /// Differences that change no number.
    pub free: Vec<String>,
    /// Differences that change numbers.
    pub numbers: Vec<String>,
    /// Differences with which the run cannot resume.
    pub fixed: Vec<String>,
}

impl Changes {
    /// Warns of a new --quality for a run whose checks have decided its count.
    pub fn warn_of_decided_count(&self, growth: &GrowthState) {
        if growth.is_decided() && self.numbers.iter().any(|line| line.starts_with("quality ")) {
            crate::tell!(
                "warning: the number of Gaussians was decided before, so --quality changes nothing; --max-gaussians sets another"
            );
        }
    }

    /// Compares the keys of `config` with those that were `written`, by a run on the instruction path `simd`.
    /// Errors: what was written cannot be read.
    pub fn of_config(file: &Path, written: &str, simd: &str, config: &TrainConfig) -> InputResult<Changes> {
        let broken = |e: String| InputError::new(file, e, "start the run again");
        let then = TrainConfig::parse(written).map_err(broken)?;
        let written: toml::Table = written.parse().map_err(|e: toml::de::Error| broken(e.to_string()))?;
        let table = |config: &TrainConfig| {
            toml::Table::try_from(config).map_err(|e| InputError::new(file, e.to_string(), "report this as a bug"))
        };
        let (there, here) = (table(&then)?, table(config)?);
        let mut changes = Changes::default();
        for (name, now) in &here {
            let Some(&ConfigKey { class, .. }) = KEYS.iter().find(|key| key.name() == *name) else { continue };
            // A key that the commit lacks counts as a difference, so that the user sees its default.
            let then = there.get(name).filter(|_| written.contains_key(name));
            if class.is_derived() || then == Some(now) {
                continue;
            }
            let lines = match class {
                Class::Layout => &mut changes.fixed,
                class if class.is_free() => &mut changes.free,
                _ => &mut changes.numbers,
            };
            let then = then.map_or_else(|| "absent".to_string(), toml::Value::to_string);
            lines.push(format!("{name} was {then} and is {now}"));
        }
        let [was, is] = [&then, config].map(limits::schedule_steps);
        if was != is {
            changes.numbers.push(format!("schedule-steps was {was} and is {is}"));
        }
        changes.add_path(simd, limits::simd_path(config));
        Ok(changes)
    }

    /// Adds a difference of instruction path. Two paths of the same bits class change no number.
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

    /// Adds the differences of `dataset`, whose print is `here`, from `there`, the print with which the run began.
    pub fn add_dataset(&mut self, dataset: &Dataset, there: &DatasetPrint, here: &DatasetPrint) {
        let lines = &mut self.numbers;
        if there.views.len() == here.views.len() {
            let name = |v: usize| format!("view {} ({})", v + 1, dataset.views[v].name);
            let pairs = || there.views.iter().zip(&here.views).enumerate();
            let poses: Vec<usize> = pairs().filter(|(_, (a, b))| a.pose != b.pose).map(|(v, _)| v).collect();
            let photos: Vec<usize> = pairs().filter(|(_, (a, b))| a.photo != b.photo).map(|(v, _)| v).collect();
            for (views, what) in [(poses, "another name, set, size or pose"), (photos, "another photo or mask")] {
                lines.extend(views.iter().take(LISTED).map(|&v| format!("{} has {what}", name(v))));
                if views.len() > LISTED {
                    lines.push(format!("{} more views have {what}", views.len() - LISTED));
                }
            }
        } else if there.views.is_empty() {
            lines
                .push("the photos of the run are unknown: its state was lost, and its pages were salvaged".to_string());
        } else {
            lines.push(format!("the dataset had {} views and has {}", there.views.len(), here.views.len()));
        }
        if there.first_rows != here.first_rows {
            lines.push(format!("the dataset gave {} first Gaussians and gives {}", there.first_rows, here.first_rows));
        } else if there.points != here.points {
            lines.push("the points that the first Gaussians are made from are others".to_string());
        }
        if there.scene_scale.to_bits() != here.scene_scale.to_bits() {
            lines.push(format!("the scene scale was {} and is {}", there.scene_scale, here.scene_scale));
        }
        let bits = |p: &DatasetPrint| [p.origin[0], p.origin[1], p.origin[2], p.scale].map(f64::to_bits);
        if bits(there) != bits(here) {
            self.fixed.push(format!(
                "the local frame was at {:?} with scale {} and is at {:?} with scale {}",
                there.origin, there.scale, here.origin, here.scale
            ));
        }
    }

    /// Adds the differences of `dataset` from that of a finished run, of which only the facts of its config.toml are left.
    pub fn add_facts(&mut self, then: &Resolved, dataset: &Dataset) {
        let counts = |train: usize, test: usize| format!("{train} photos to train on and {test} held out");
        let there = counts(then.train_views, then.test_views);
        let here = counts(dataset.train_views().len(), dataset.test_views().len());
        if there != here {
            self.numbers.push(format!("the scene had {there} and has {here}"));
        }
        // The scale may follow from points, which a run that goes on from Gaussians does not read.
        let origin = dataset.frame.origin.to_array();
        if then.origin.map(f64::to_bits) != origin.map(f64::to_bits) {
            let line =
                format!("it is another scene: its cameras stood around {:?} and stand around {origin:?}", then.origin);
            self.fixed.push(line);
        }
    }

    /// Refuses differences that exclude a resume, and differences in numbers without `accept`.
    /// Errors: there is such a difference.
    pub fn check(&self, place: &Path, accept: bool) -> InputResult<()> {
        let list = |lines: &[String]| lines.iter().map(|line| format!("\n    {line}")).collect::<String>();
        if !self.fixed.is_empty() {
            let all = [self.fixed.as_slice(), &self.numbers].concat();
            let problem = format!("the Gaussians of this run do not fit these changes:{}", list(&all));
            let remedy = "undo the changes, or start a new run from the Gaussians: --init-ply with its point_cloud.ply";
            return Err(InputError::new(place, problem, remedy));
        }
        if accept || self.numbers.is_empty() {
            return Ok(());
        }
        let problem = format!("these changes would change the numbers of the run:{}", list(&self.numbers));
        let remedy = "undo the changes, accept them with --accept-changes, or start a new run with another --out";
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

    /// Another program may have written the commit.
    #[test]
    fn a_key_that_the_commit_lacks_is_a_difference() {
        let config = TrainConfig::default();
        let text = toml::to_string(&config).unwrap();
        let without: String =
            text.lines().filter(|line| !line.starts_with("appearance")).map(|line| format!("{line}\n")).collect();
        assert!(without.len() < text.len());
        let simd = limits::simd_path(&config).name();
        let changes = Changes::of_config(Path::new("config.toml"), &without, simd, &config).unwrap();
        assert_eq!(changes.numbers, ["appearance was absent and is \"auto\""]);
        assert!(changes.free.is_empty() && changes.fixed.is_empty());
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
