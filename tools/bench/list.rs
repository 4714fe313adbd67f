//! The list of a sweep: a TOML file of a base, groups of runs and a view; and the runs that it plans for a scene.
//!
//! Not here: training the runs ([`super::runs`]).
//!
//! Invariants: 1. the keys of a run override flags, which override `--config`, which overrides the base of the list; keys that
//! none of them gives follow the length of the run, as in any other run; 2. no two planned runs are the same; 3. a run that needs
//! fewer frames than pages is left out, with a warning, if a view needs all pages, unless it is the reference.

use super::city::CityCut;
use super::facts::Facts;
use super::record::RunRecord;
use super::runs::{MadeScene, Place, Planned, PlannedCity, Surroundings, use_drive};
use super::sweep_page::View;
use gsscale::base::error::{InputError, InputResult};
use gsscale::base::text::read_text;
use gsscale::config::file::{FILE_BYTES_MAX, TrainConfig};
use gsscale::config::limits::load_options;
use gsscale::config::new_run;
use gsscale::config::values::ByteSize;
use gsscale::dataset::disturb::{Disturbance, plan};
use gsscale::dataset::loader::Dataset;
use gsscale::train::error::TrainError;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use toml::{Table, Value};

/// The lists of this project, by name.
pub const BUILT_IN: [(&str, &str); 6] = [
    ("cells", include_str!("../../configs/sweeps/cells.toml")),
    ("pareto", include_str!("../../configs/sweeps/pareto.toml")),
    ("ladder", include_str!("../../configs/sweeps/ladder.toml")),
    ("ladder-gpu", include_str!("../../configs/sweeps/ladder-gpu.toml")),
    ("speed", include_str!("../../configs/sweeps/speed.toml")),
    ("stability", include_str!("../../configs/sweeps/stability.toml")),
];
/// First letters of the environment variables that a list may set.
const OWN_VARIABLES: &str = "GSSCALE_";

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct List {
    /// Config keys of all runs.
    #[serde(default)]
    pub base: Table,
    /// Frames in percent of the pages; 0 = all pages in memory.
    #[serde(default)]
    pub share: f64,
    pub seeds: Vec<u64>,
    /// How many of these seeds the other runs have; all without.
    #[serde(default)]
    pub other_seeds: Option<usize>,
    pub view: View,
    /// Runs that every group has.
    #[serde(default)]
    each: Vec<Entry>,
    #[serde(rename = "group")]
    groups: Vec<Group>,
    /// Results of other programs.
    #[serde(default)]
    known: Vec<Known>,
}

/// The result of another program, measured elsewhere.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Known {
    /// Group and name, as those of runs.
    name: String,
    /// Folder of the scene that it was measured on.
    scene: String,
    psnr: f64,
    ssim: f64,
    cpu_seconds: f64,
    gaussians: u64,
}

/// Runs that belong together.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Group {
    name: String,
    /// Disturbs the scene of its runs.
    disturb: Option<Disturbance>,
    #[serde(default)]
    runs: Vec<Entry>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Entry {
    name: String,
    /// Keys of its config.
    #[serde(default)]
    set: Table,
    /// Factors of keys of the base.
    #[serde(default)]
    times: BTreeMap<String, f64>,
    share: Option<f64>,
    #[serde(default)]
    environment: BTreeMap<String, String>,
    /// Runs of one class and seed must end with the same bits.
    #[serde(default)]
    bits: String,
    /// Train the scene in cells.
    city: Option<CityCut>,
}

/// The runs of a scene.
pub struct Plan {
    /// The settings that runs change.
    pub base: TrainConfig,
    pub reference: TrainConfig,
    /// The runs: those of the reference with all seeds, then all others seed by seed.
    pub runs: Vec<Planned>,
    /// The scene, if runs train disturbed ones.
    pub dataset: Option<Dataset>,
}

impl List {
    /// Reads a list: the name of one of [`BUILT_IN`], or a file. Errors: the file cannot be read, or is no list.
    pub fn read(path: &Path) -> InputResult<List> {
        let text = match BUILT_IN.iter().find(|(name, _)| path.as_os_str() == *name) {
            Some((_, text)) => (*text).to_string(),
            None => read_text(path, FILE_BYTES_MAX, "").map_err(|e| {
                let problem = format!("neither a list of this program nor a readable file: {}", e.problem);
                let names = BUILT_IN.map(|(name, _)| name).join(", ");
                InputError::new(path, problem, format!("name one of {names}, or a TOML file"))
            })?,
        };
        let refused = |problem: String| InputError::new(path, problem, "see \"Sweeps\" in configs/README.md");
        let list: List = toml::from_str(&text).map_err(|e| refused(e.to_string()))?;
        let mut names = BTreeSet::new();
        for (group, entry) in list.entries() {
            let name = name_of(group, entry);
            // A disturbed scene lies in a folder that is named after its group.
            if group.name.contains(['/', '\\', ':']) || group.name.starts_with('.') {
                let problem =
                    format!("the group '{}' cannot name a folder: it begins with . or contains / \\ or :", group.name);
                return Err(refused(problem));
            }
            if name.contains(',') {
                return Err(refused(format!("the name '{name}' has a comma, which separates names in --only")));
            }
            if let Some(variable) = entry.environment.keys().find(|v| !v.starts_with(OWN_VARIABLES)) {
                return Err(refused(format!("{name} sets {variable}, which does not begin with {OWN_VARIABLES}")));
            }
            if entry.city.is_some() {
                let refused_with = match () {
                    () if group.disturb.is_some() => Some("a disturbed scene"),
                    () if entry.share.is_some() => Some("a share"),
                    () if name == list.view.reference => Some("the place of the reference"),
                    () => None,
                };
                if let Some(what) = refused_with {
                    return Err(refused(format!("{name} is a city in cells, which cannot have {what}")));
                }
            }
            if !names.insert(name.clone()) {
                return Err(refused(format!("the list has two runs {name}")));
            }
        }
        if let Some(known) = list.known.iter().find(|known| names.contains(&known.name)) {
            return Err(refused(format!("a run and a known result have the name {}", known.name)));
        }
        match names.contains(&list.view.reference) {
            true => Ok(list),
            false => Err(refused(format!("the reference {} is no run of the list", list.view.reference))),
        }
    }

    fn entries(&self) -> impl Iterator<Item = (&Group, &Entry)> {
        self.groups.iter().flat_map(|group| self.each.iter().chain(&group.runs).map(move |entry| (group, entry)))
    }

    /// Keeps the reference and the runs that `only` names by group, by name, or by both (`group/name`).
    /// Errors: no run has one of these names.
    pub fn keep(&mut self, only: &[String]) -> InputResult<()> {
        let is_named = |group: &Group, entry: &Entry, name: &str| {
            [&group.name, &entry.name, &name_of(group, entry)].into_iter().any(|own| own == name)
        };
        if let Some(name) = only.iter().find(|name| !self.entries().any(|(g, e)| is_named(g, e, name))) {
            let names: Vec<String> = self.entries().map(|(group, entry)| name_of(group, entry)).collect();
            let problem = format!("the list has no group and no run {name}");
            return Err(InputError::new("--only", problem, format!("possible values: {}", names.join(", "))));
        }
        let (each, reference) = (std::mem::take(&mut self.each), self.view.reference.clone());
        for group in &mut self.groups {
            let runs = each.iter().cloned().chain(std::mem::take(&mut group.runs));
            let is_kept =
                |e: &Entry| name_of(group, e) == reference || only.iter().any(|name| is_named(group, e, name));
            group.runs = runs.filter(is_kept).collect();
        }
        Ok(())
    }

    /// The runs for a scene. `given` are the keys of a config file and flags.
    /// Errors: the scene cannot be read, or a run has an invalid config.
    pub fn plan(&self, place: &Place, given: &Table) -> Result<Plan, TrainError> {
        let base = config_of("the base", over(&self.base, given))?;
        let dataset = match self.groups.iter().any(|group| group.disturb.is_some()) {
            true if !base.init_ply.is_empty() => {
                let problem = "the points of the scene are disturbed, not a PLY";
                return Err(InputError::new("--init-ply", problem, "leave it out").into());
            }
            true => Some(gsscale::train::start::first_scene::prepare(&place.scene, &base)?.dataset),
            false => None,
        };
        let mut planner =
            Planner { list: self, place, given, base, dataset, facts: BTreeMap::new(), references: Vec::new() };
        let is_reference = |(group, entry): &(&Group, &Entry)| name_of(group, entry) == self.view.reference;
        let mut planned = Vec::new();
        for seed in &self.seeds {
            for (group, entry) in self.entries().filter(is_reference) {
                let run = planner.run(group, entry, *seed)?.map_err(|e| InputError::new(&place.scene, e, SMALLER))?;
                planner.references.push(run.clone());
                planned.push(run);
            }
        }
        for seed in self.seeds.iter().take(self.other_seeds.unwrap_or(usize::MAX)) {
            for (group, entry) in self.entries().filter(|e| !is_reference(e)) {
                match planner.run(group, entry, *seed)? {
                    Ok(run) => planned.push(run),
                    Err(problem) => gsscale::tell!("warning: {} is left out: {problem}", name_of(group, entry)),
                }
            }
        }
        let surroundings = Surroundings::of(place, &planner.base)?;
        let mut keys = BTreeSet::new();
        planned.retain(|run| keys.insert(run.key(&surroundings)));
        let reference = planned.first().map(|run| run.config.clone());
        let reference = reference.ok_or_else(|| InputError::new("--seeds", "no seed is given", "use --seeds 1,2,3"))?;
        Ok(Plan { base: planner.base, reference, runs: planned, dataset: planner.dataset })
    }

    /// What other programs reached on the scene in this folder, if runs like `reference` see its photos as they are and hold every eighth out.
    pub fn known(&self, scene: &Path, reference: &TrainConfig) -> Vec<RunRecord> {
        if load_options(reference) != load_options(&TrainConfig::default()) {
            return Vec::new();
        }
        let is_of_scene = |known: &&Known| scene.file_name().is_some_and(|name| name == known.scene.as_str());
        let record = |known: &Known| RunRecord {
            name: known.name.clone(),
            psnr: Some(known.psnr),
            ssim: Some(known.ssim),
            seconds: f64::NAN,
            cpu_seconds: Some(known.cpu_seconds),
            gaussians: known.gaussians,
            ..RunRecord::default()
        };
        self.known.iter().filter(is_of_scene).map(record).collect()
    }

    /// Runs in the order of the list, with the seeds of a run together.
    pub fn in_order(&self, runs: &[Planned]) -> Vec<Planned> {
        let of = |(group, entry)| {
            let name = name_of(group, entry);
            runs.iter().filter(move |run| run.name == name).cloned()
        };
        self.entries().flat_map(of).collect()
    }
}

const SMALLER: &str = "use smaller --page-rows, or a scene whose views see a smaller part";

/// What plans runs for a scene.
struct Planner<'a> {
    list: &'a List,
    place: &'a Place,
    given: &'a Table,
    base: TrainConfig,
    dataset: Option<Dataset>,
    /// Facts of the scene by rows of a page.
    facts: BTreeMap<u32, Facts>,
    /// The runs of the reference so far, one for each seed.
    references: Vec<Planned>,
}

impl Planner<'_> {
    /// A run; a message if a view needs all pages.
    fn run(&mut self, group: &Group, entry: &Entry, seed: u64) -> Result<Result<Planned, String>, TrainError> {
        let name = name_of(group, entry);
        let mut keys = over(&over(&self.list.base, self.given), &entry.set);
        let of_base = Table::try_from(&self.base).unwrap_or_default();
        for (key, factor) in &entry.times {
            let value = of_base.get(key).and_then(|value| times(value, *factor));
            let problem = || InputError::new(&name, format!("{key} is no number"), "give times keys that are numbers");
            keys.insert(key.clone(), value.ok_or_else(problem)?);
        }
        keys.insert("seed".into(), Value::Integer(seed as i64));
        let mut config = config_of(&name, keys.clone())?;
        (config.seed, config.spill_dir, config.frames) = (seed, String::new(), 0);
        let scene = self.disturbed(group, &mut config)?;
        config.check()?;
        // A run in cells keeps all pages in memory.
        let share = if entry.city.is_some() { 0.0 } else { entry.share.unwrap_or(self.list.share) };
        if share > 0.0 {
            let facts = match self.facts.remove(&config.page_rows) {
                Some(facts) => facts,
                None => Facts::of(&self.place.scene, &config)?,
            };
            let frames = facts.frames(share);
            self.facts.insert(config.page_rows, facts);
            match frames {
                Ok(frames) => use_drive(&mut config, frames),
                Err(problem) => return Ok(Err(problem)),
            }
        }
        let (environment, bits) = (entry.environment.clone(), entry.bits.clone());
        keys.retain(|key, _| key != "spill-dir" && key != "frames");
        let reference = self.references.iter().find(|run| run.config.seed == seed);
        let city = entry.city.clone().zip(reference).map(|(cut, reference)| PlannedCity {
            cut,
            keys,
            reference: Box::new(reference.clone()),
        });
        // Cities are compared with the reference at their borders.
        let keeps_ply = name == self.list.view.reference && self.list.entries().any(|(_, entry)| entry.city.is_some());
        Ok(Ok(Planned { name, config, scene, environment, bits, city, keeps_ply }))
    }

    /// The scene of a group, and the keys that suit it: its photos have training size and their own split.
    fn disturbed(&self, group: &Group, config: &mut TrainConfig) -> InputResult<Option<MadeScene>> {
        let (Some(disturbance), Some(dataset)) = (group.disturb, &self.dataset) else { return Ok(None) };
        let made = plan(dataset, &disturbance, config.seed)?;
        let plain = TrainConfig::default();
        (config.data_factor, config.max_resolution) = (plain.data_factor, plain.max_resolution);
        (config.images, config.masks) = (plain.images, true);
        (config.invert_masks, config.allow_missing) = (false, false);
        config.test_after = i64::from(made.test_after);
        let folder = self.place.out.join("scenes").join(format!("{}-seed{}", group.name, config.seed));
        let how = format!("{disturbance:?} seed {} {:?}", config.seed, load_options(&self.base));
        Ok(Some(MadeScene { folder, how, disturbance, wrong: made.wrong }))
    }
}

/// Group and name of a run; the name alone if the group has none.
fn name_of(group: &Group, entry: &Entry) -> String {
    if group.name.is_empty() { entry.name.clone() } else { format!("{}/{}", group.name, entry.name) }
}

/// The keys of `b` over those of `a`.
fn over(a: &Table, b: &Table) -> Table {
    a.iter().chain(b).map(|(key, value)| (key.clone(), value.clone())).collect()
}

fn config_of(name: &str, keys: Table) -> InputResult<TrainConfig> {
    new_run::of_given(keys)
        .map_err(|e| InputError::new(name, e, "see configs/default.toml for every key and its meaning"))
}

/// A number or a number of bytes times a factor.
fn times(value: &Value, factor: f64) -> Option<Value> {
    Some(match value {
        Value::Integer(value) => Value::Integer((*value as f64 * factor).ceil() as i64),
        Value::Float(value) => Value::Float(value * factor),
        Value::String(text) => {
            let size: ByteSize = text.parse().ok()?;
            Value::try_from(ByteSize((size.0 as f64 * factor) as u64)).ok()?
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lists_of_this_project_have_configs_that_hold() {
        for (name, _) in BUILT_IN {
            let list = List::read(Path::new(name)).unwrap();
            for (group, entry) in list.entries() {
                let run = name_of(group, entry);
                config_of(&run, over(&list.base, &entry.set)).and_then(|config| config.check()).unwrap();
                let base = Table::try_from(TrainConfig::default()).unwrap();
                assert!(entry.times.iter().all(|(key, factor)| times(&base[key], *factor).is_some()), "{name} {run}");
            }
        }
    }

    #[test]
    fn known_results_are_shown_for_their_scene_and_size_alone() {
        let list = List::read(Path::new("speed")).unwrap();
        let (scene, config) = (Path::new("data/sheffield_cross_395"), TrainConfig::default());
        let known = list.known(scene, &config);
        assert!(
            known.len() == 3 && known.iter().all(|record| record.seconds.is_nan() && record.cpu_seconds > Some(600.0))
        );
        assert!(list.known(Path::new("data/sheffield_cross"), &config).is_empty());
        assert!(list.known(scene, &TrainConfig { max_resolution: 200, ..config }).is_empty(), "photos of another size");
    }

    #[test]
    fn numbers_and_sizes_have_multiples() {
        assert_eq!(times(&Value::Integer(3), 0.5), Some(Value::Integer(2)));
        assert_eq!(times(&Value::String("6MiB".into()), 0.5), Some(Value::String("3MiB".into())));
        assert_eq!(times(&Value::String("shuffle".into()), 0.5), None);
    }

    #[test]
    fn only_keeps_groups_runs_and_the_reference() {
        let kept = |only: &[&str]| {
            let mut list = List::read(Path::new("stability")).unwrap();
            list.keep(&only.iter().map(|name| name.to_string()).collect::<Vec<_>>()).unwrap();
            list.entries().map(|(group, entry)| name_of(group, entry)).collect::<Vec<_>>()
        };
        assert_eq!(kept(&["jpeg20"]), ["clean/none", "jpeg20/none", "jpeg20/auto", "jpeg20/all"]);
        assert_eq!(kept(&["boxes/own", "third/none"]), ["clean/none", "boxes/own", "third/none"]);
        assert!(List::read(Path::new("stability")).unwrap().keep(&["fog".into()]).is_err());
    }
}
