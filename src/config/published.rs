//! Configs of published runs, for comparison with the figures of papers.
//!
//! Such a file is a config with two further kinds of tables: `[published]` (the scene, its sources, published results)
//! and `[tier.NAME]` (densification settings for more or fewer Gaussians). Training ignores both
//! ([`TrainConfig::parse`]); here they are read strictly.
//!
//! The values are GS-Scale's: from the dictionary `configs` at the end of its trainers, from its paper (arXiv
//! 2509.15645) and from the behaviour of its code; comments in each file name the pitfalls.

use super::file::{FILE_BYTES_MAX, KEYS, TABLES, TrainConfig};
use super::limits::schedule_steps;
use crate::base::error::{InputError, InputResult};
use crate::base::text::read_text;
use crate::config::file::ConfigKey;
use crate::config::new_run;
use crate::photos::diagnosis::Remedies;
use crate::render::metrics::SsimVariant;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

pub const BUILT_IN: [(&str, &str); 8] = [
    ("rubble", include_str!("../../configs/rubble.toml")),
    ("building", include_str!("../../configs/building.toml")),
    ("residence", include_str!("../../configs/residence.toml")),
    ("sciart", include_str!("../../configs/sciart.toml")),
    ("lfls", include_str!("../../configs/lfls.toml")),
    ("sziit", include_str!("../../configs/sziit.toml")),
    ("sztu", include_str!("../../configs/sztu.toml")),
    ("aerial", include_str!("../../configs/aerial.toml")),
];

#[derive(Debug, Clone, PartialEq)]
pub struct PublishedRun {
    /// Its name: the file name without extension.
    pub name: String,
    /// Settings of the active tier.
    pub config: TrainConfig,
    pub facts: Published,
    pub tiers: BTreeMap<String, PublishedTier>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Published {
    /// Dataset and scene, as text.
    pub title: String,
    /// Names of the folder layouts in which the scene is available, the best first.
    pub layouts: Vec<String>,
    /// Sources of photos, poses and points.
    pub fetch: Vec<String>,
    /// Files of points inside the scene's folder; the first existing one replaces the model's points.
    #[serde(default)]
    pub clouds: Vec<String>,
    /// Photos of the published set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub views: Option<u32>,
    /// Held-out photos among them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<u32>,
    /// Width and height used in training, pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size: Option<[u32; 2]>,
    #[serde(default)]
    pub notes: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<MemorySaving>,
}

/// Means over the held-out photos: of GS-Scale, and of the original trainer that it modifies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Expected {
    /// PSNR, dB.
    pub psnr: f64,
    pub ssim: f64,
    pub ssim_variant: SsimVariant,
    pub lpips: f64,
    /// Network and input range of LPIPS: `alex, signed`.
    pub lpips_variant: String,
    /// PSNR of the original trainer, dB.
    pub original_psnr: f64,
    pub original_ssim: f64,
    pub original_lpips: f64,
}

/// GPU memory of the original trainer over GS-Scale's, as allocated by PyTorch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct MemorySaving {
    /// On this scene, if the paper states it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saving: Option<f64>,
    /// Least and most over the paper's six scenes.
    pub saving_range: [f64; 2],
    /// Geometric mean over these scenes.
    pub saving_mean: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct PublishedTier {
    /// Mean screen-space gradient above which Gaussians grow.
    pub grow_grad2d: f64,
    /// Size up to which growing Gaussians are cloned, times the scene scale.
    pub grow_scale3d: f64,
    /// Step at which rounds end.
    pub refine_stop: u32,
}

/// The tables besides the settings.
#[derive(Deserialize)]
struct Tables {
    published: Published,
    #[serde(default)]
    tier: BTreeMap<String, PublishedTier>,
}

impl PublishedRun {
    /// Finds a run by its name or its file.
    /// Errors: the name or file does not exist, the file has no `[published]`, or its settings are invalid.
    pub fn find(name_or_file: &Path) -> InputResult<PublishedRun> {
        let built_in = BUILT_IN.iter().find(|(name, _)| Path::new(name) == name_or_file);
        if let Some((name, text)) = built_in {
            return PublishedRun::parse(name, text, name_or_file);
        }
        let names = BUILT_IN.map(|(name, _)| name).join(", ");
        let text = read_text(name_or_file, FILE_BYTES_MAX, "").map_err(|e| {
            let problem = format!("neither a published run nor a readable file: {}", e.problem);
            InputError::new(name_or_file, problem, format!("name one of {names}, or a config file with [published]"))
        })?;
        let stem = name_or_file.file_stem().unwrap_or_default().to_string_lossy();
        PublishedRun::parse(&stem, &text, name_or_file)
    }

    fn parse(name: &str, text: &str, file: &Path) -> InputResult<PublishedRun> {
        let refuse = |problem: String| {
            InputError::new(file, problem, "configs/rubble.toml is an example of a published run's config")
        };
        let mut config = TrainConfig::parse(text).map_err(refuse)?;
        config.check()?;
        // No published run has a remedy that its config does not name.
        new_run::adapt_to_photos(&mut config, &Remedies::default());
        let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| refuse(e.to_string()))?;
        table.retain(|key, _| TABLES.contains(&key));
        if !table.contains_key("published") {
            return Err(refuse("it has no table [published]".to_string()));
        }
        let Tables { published, tier } = Tables::deserialize(table).map_err(|e| refuse(e.to_string()))?;
        Ok(PublishedRun { name: name.to_string(), config, facts: published, tiers: tier })
    }

    /// Applies the settings of a tier to the config. Errors: the tier does not exist.
    pub fn use_tier(&mut self, name: &str) -> InputResult<()> {
        let Some(tier) = self.tiers.get(name) else {
            let names: Vec<&str> = self.tiers.keys().map(String::as_str).collect();
            let problem = format!("{} has no tier '{name}'", self.name);
            return Err(InputError::new("--tier", problem, format!("use one of: {}", names.join(", "))));
        };
        self.config.grow_grad2d = tier.grow_grad2d;
        self.config.grow_scale3d = tier.grow_scale3d;
        self.config.refine_stop = tier.refine_stop;
        Ok(())
    }

    /// Name of the tier with the config's settings.
    pub fn tier_of(&self, config: &TrainConfig) -> Option<&str> {
        let of = |t: &PublishedTier| (t.grow_grad2d, t.grow_scale3d, t.refine_stop);
        let used = (config.grow_grad2d, config.grow_scale3d, config.refine_stop);
        self.tiers.iter().find(|(_, tier)| of(tier) == used).map(|(name, _)| name.as_str())
    }
}

/// Settings of `used` that differ from `published` and matter: `steps = 200 instead of 200000`.
pub fn differences(published: &TrainConfig, used: &TrainConfig) -> Vec<String> {
    let [before, after] = [published, used].map(|c| toml::Table::try_from(c).unwrap_or_default());
    // An extended run has the resolved number written instead of 0.
    let is_same_schedule = schedule_steps(published) == schedule_steps(used);
    // A run writes the place that auto chose.
    let [theirs, ours] = [published, used].map(|config| config.optimizer_on.0.unwrap_or_default());
    let is_free = |name: &str| {
        let same_run = |key: &ConfigKey| key.name() == name && !key.class.makes_another_run();
        KEYS.iter().any(same_run)
            || (name == "schedule-steps" && is_same_schedule)
            || (name == "optimizer-on" && theirs == ours)
    };
    let changed = after.iter().filter(|(key, value)| !is_free(key.as_str()) && before.get(*key) != Some(*value));
    changed
        .map(|(key, v)| {
            format!("{key} = {v} instead of {}", before.get(key).map_or("none".into(), ToString::to_string))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::values::ByteSize;
    use super::*;
    use crate::checkpoint::interval::CommitEvery;
    use crate::paging::prefetch::Transfers;

    #[test]
    fn keys_that_never_change_results_make_no_difference() {
        let published = TrainConfig { steps: 200, ..TrainConfig::default() };
        let used = TrainConfig {
            keep_checkpoint: true,
            disk_full_wait: 5.0,
            transfers: Transfers::Demand,
            commit_every: CommitEvery::Seconds(0.0),
            host_mem: ByteSize(1 << 30),
            schedule_steps: 200,
            ..published.clone()
        };
        assert_eq!(differences(&published, &used), Vec::<String>::new());
        let other = TrainConfig { ssim_variant: SsimVariant::Valid, schedule_steps: 100, seed: 7, ..used };
        let want = [
            "schedule-steps = 100 instead of 0",
            "seed = 7 instead of 42",
            "ssim-variant = \"valid\" instead of \"same\"",
        ];
        assert_eq!(differences(&published, &other), want);
        // The shorter schedule of fewer steps follows from them.
        let fewer = TrainConfig { steps: 50, ..published.clone() };
        assert_eq!(differences(&published, &fewer), ["steps = 50 instead of 200"]);
    }

    #[test]
    fn the_classes_agree_with_what_the_keys_say() {
        for key in KEYS {
            let meaning = key.meaning.split_whitespace().collect::<Vec<_>>().join(" ");
            let says_so = meaning.contains("Never changes results");
            assert!(!says_so || !key.class.makes_another_run(), "{} is {:?}", key.name(), key.class);
        }
    }
}
