//! Works on one cell: begins its run, goes on with it here or from the copy of another machine, and publishes what it has.
//!
//! The run goes in legs. Between two of them the last commit is copied to the city, so a machine that is lost costs a leg. A leg ends as a
//! stop by a signal does, which changes no byte of the result.
//!
//! | in `cells/K/` | is |
//! | --- | --- |
//! | `run-MACHINE/` | the run's own folder and pages, without `--spill-dir`; a machine that was started anew has another one |
//! | `copy/N/` | a commit; the largest N that can be read counts |
//! | `copy/of-.../` | a copy that its worker has not finished, or not named |
//! | `done.toml` | the last step is in the copy |
//!
//! Invariants: 1. `done.toml` comes after the copy of the last commit; 2. only stores that are whole, and only under the cell's lock, get
//! their name in `copy/`; 3. stores are removed by their identity.

use super::lock::{CellLock, owner_of};
use super::plan::{CellPlan, CityPlan, LIST_BYTES_MAX, poses_digest, prior_digest};
use super::{AnyRun, City, begin_or_resume, check_machine_keys, check_range, config_of, toml_of};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use crate::base::machine::system_name;
use crate::base::text::{OWN_FILE_MOST, read_text};
use crate::base::whole_file::{rename, sync_folder, write_whole};
use crate::config::file::{TrainConfig, TrainOverrides};
use crate::config::limits;
use crate::config::new_run;
use crate::config::values::ByteSize;
use crate::dataset::model::ReadOptions;
use crate::dataset::read::read_scene;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::tool::new_store::part_of;
use crate::page::tool::reading::Access;
use crate::page::tool::uncommitted::is_uncommitted;
use crate::page::versions::slots::SlotLayout;
use crate::train::error::TrainError;
use crate::train::inputs::machine::absolute;
use crate::train::inputs::signals::StopFlag;
use crate::train::memory::host_budget;
use crate::train::run::out_folder;
use crate::train::run::request::Existing;
use crate::train::stores::ownership::last_state;
use crate::train::stores::{StoredStart, clone_store, find_store};
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Exit code: another attempt may succeed, here or elsewhere.
pub const AGAIN: i32 = 75;
/// Exit code: another process has the cell. Waiting for it is no attempt.
pub const TAKEN: i32 = 76;
/// Exit code: no further attempt will succeed.
pub const NEVER: i32 = 2;

/// The file that says that a cell is done.
pub(crate) const DONE_FILE: &str = "done.toml";
/// Beginnings of the names of a copy that has no number yet, and of the folder of a run in the city.
const UNNAMED: &str = "of-";
const RUN: &str = "run-";

/// Usual seconds between copies.
pub const COPY_EVERY: f64 = 900.0;

/// An error of a worker, and the exit code that it gives.
#[derive(Debug)]
pub struct WorkError {
    pub error: TrainError,
    pub code: i32,
}

impl<E: Into<TrainError>> From<E> for WorkError {
    fn from(error: E) -> WorkError {
        let error = error.into();
        WorkError { code: code_of(&error), error }
    }
}

impl WorkError {
    /// The error of a run. A machine may lack its drive, its memory or the photos, so another attempt can succeed, unless the run diverged.
    fn of_run(error: TrainError) -> WorkError {
        let code = if matches!(error, TrainError::NonFinite { .. }) { NEVER } else { AGAIN };
        WorkError { error, code }
    }
}

/// Work on a cell.
#[derive(Debug, Clone)]
pub struct WorkRequest {
    pub city: PathBuf,
    pub cell: usize,
    /// The scene, if it is not where the prior found it.
    pub scene: Option<PathBuf>,
    /// Keys of this machine.
    pub keys: TrainOverrides,
    /// Seconds between copies; 0 = one copy, at the end.
    pub copy_every: f64,
    pub quiet: bool,
}

/// What `done.toml` says of a cell.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Done {
    /// Digest of the cell's files.
    pub files: String,
    pub copy: u32,
    pub steps: u32,
    pub gaussians: u64,
    pub seconds: f64,
    /// PSNR on the held-out views of the cell, if it has any.
    pub psnr: Option<f64>,
}

/// Works on a cell until it is done, or a signal stops it. Returns the exit code.
/// Errors: those of a run.
pub fn work(request: &WorkRequest) -> Result<i32, WorkError> {
    // A request to stop counts from the beginning.
    let stop = StopFlag::listen().map_err(|e| InputError::io("signals", "listening for Ctrl-C", &e))?;
    let city = City(request.city.clone());
    check_machine_keys(&request.keys)?;
    check_range("--copy-every", request.copy_every, 0.0..=1e9)?;
    let drive = request.keys.spill_dir.as_deref().filter(|drive| !drive.is_empty());
    if drive.is_none() && request.keys.frames.is_some_and(|frames| frames > 0) {
        let problem =
            "without --spill-dir a run with --frames makes no commits, so nothing of the cell would be copied";
        return Err(InputError::new("--frames", problem, "add --spill-dir, or limit memory with --host-mem").into());
    }
    let plan = CityPlan::read(&city)?;
    let planned = plan.cell(&city, request.cell)?;
    let folder = city.cell(request.cell);
    let digest = plan.digest(&city.plan())?;
    let place = WorkPlace::of(request.cell, drive, &digest, &city);
    let is_done = || done_of(&plan, &city, request.cell).map(|done| done.is_some());
    let report_done = || {
        crate::say!("cell {} is done", request.cell);
        // A process that was killed behind its last word left them.
        place.clear_all(&folder).map_err(WorkError::of_run).map(|()| 0)
    };
    if is_done()? {
        return report_done();
    }
    let memory = host_budget(request.keys.host_mem.unwrap_or(ByteSize(0)).0).unwrap_or(1 << 30);
    check_prior(&plan, &city, memory)?;
    if drive.is_some() {
        let others = (0..plan.cells.len()).filter(|&other| other != request.cell);
        let is_done = |&other: &usize| matches!(done_of(&plan, &city, other), Ok(Some(_)));
        // Pages that their workers left on this drive. Pages in use stay.
        others.filter(is_done).for_each(|other| drop(WorkPlace::of(other, drive, &digest, &city).clear()));
    }
    let lock = match CellLock::take(&folder)? {
        Ok(lock) => lock,
        Err(owner) => {
            crate::tell!("another process works on cell {}: {owner}", request.cell);
            return Ok(TAKEN);
        }
    };
    // The owner before may have ended in the meantime.
    if is_done()? {
        return report_done();
    }
    let scene = request.scene.clone().map_or_else(|| city.scene(), Ok)?;
    let keys = place.keys(&city, &folder, &request.keys);
    let config = config_of(&folder.join("cell.toml"), keys_of_cell(&folder)?, &keys)?;
    check_scene(planned, &folder, &scene, &config)?;
    let train = || -> Result<i32, TrainError> {
        let mut has_begun = place.fetch(&folder)?;
        while stop.exit_code().is_none() {
            let leg = (request.copy_every > 0.0).then(|| Duration::from_secs_f64(request.copy_every));
            let (config, keys) = (TrainConfig { keep_checkpoint: true, ..config.clone() }, keys.clone());
            let (out, quiet) = (place.out.as_path(), request.quiet);
            let outcome = begin_or_resume(AnyRun { scene: &scene, out, has_begun, config, keys, leg, quiet })?;
            has_begun = true;
            let Some(copy) = publish(&folder, &place.out, &lock)? else { break };
            if let Some(summary) = outcome.summary.filter(|summary| summary.finished) {
                let psnr = summary.test.map(|test| test.psnr);
                let (steps, gaussians, seconds) = (summary.steps, summary.gaussians, summary.train_seconds);
                let (file, files) = (folder.join(DONE_FILE), planned.files.clone());
                let done = Done { files, copy, steps, gaussians, seconds, psnr };
                write_whole(&file, toml_of(&file, &done)?.as_bytes())?;
                place.clear_all(&folder)?;
                return Ok(0);
            }
        }
        if !lock.is_held() {
            let owner = owner_of(&folder).unwrap_or_default();
            crate::tell!("another process has taken cell {} over: {owner}", request.cell);
            return Ok(TAKEN);
        }
        Ok(AGAIN)
    };
    train().map_err(WorkError::of_run)
}

/// The exit code for an error: [`NEVER`] for bad input and for a run that diverges, which it will do again; [`AGAIN`] for what another
/// machine, or another hour, may not have, such as a file that cannot be read.
pub fn code_of(error: &TrainError) -> i32 {
    match error {
        TrainError::Input(input) | TrainError::Photo(input) if input.kind.is_none() => NEVER,
        TrainError::NonFinite { .. } => NEVER,
        _ => AGAIN,
    }
}

/// What the city knows of a cell that is done; `None` for one that is not, or whose copy is gone.
/// Errors: it was done under another plan, or the file cannot be read.
pub(crate) fn done_of(plan: &CityPlan, city: &City, cell: usize) -> InputResult<Option<Done>> {
    let folder = city.cell(cell);
    let file = folder.join(DONE_FILE);
    let again = "remove the file and the cell's folder copy, and run the cell again";
    let text = match read_text(&file, OWN_FILE_MOST, again) {
        Err(e) if e.kind == Some(ErrorKind::NotFound) => return Ok(None),
        read => read?,
    };
    let done: Done = toml::from_str(&text).map_err(|e| InputError::new(&file, e.to_string(), again))?;
    if done.files == plan.cells[cell].files {
        return Ok(Some(done).filter(|done| copy_of(&folder, done.copy).is_dir()));
    }
    Err(InputError::new(&file, "the cell was trained under another plan", again))
}

pub(crate) fn copy_of(folder: &Path, number: u32) -> PathBuf {
    folder.join("copy").join(number.to_string())
}

/// The copies of a cell with their numbers, the newest first.
/// Errors: they cannot be listed.
fn copies_of(folder: &Path) -> InputResult<Vec<(u32, PathBuf)>> {
    let mut copies: Vec<(u32, PathBuf)> = Vec::new();
    for path in listed(&folder.join("copy"))? {
        let number = path.file_name().and_then(|name| name.to_str()?.parse().ok());
        copies.extend(number.map(|number| (number, path)));
    }
    copies.sort_unstable_by(|a, b| b.cmp(a));
    Ok(copies)
}

/// What is in a folder; nothing where it does not exist.
/// Errors: it cannot be listed.
fn listed(folder: &Path) -> InputResult<Vec<PathBuf>> {
    let failed = |e: std::io::Error| InputError::io(folder, "listing the copies", &e);
    match std::fs::read_dir(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        entries => entries.map_err(failed)?.map(|entry| Ok(entry.map_err(failed)?.path())).collect(),
    }
}

/// Whether the last part of a path begins with `beginning`.
fn name_begins_with(path: &Path, beginning: &str) -> bool {
    path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(beginning))
}

/// Steps of the last commit in a store.
fn steps_in(store: &Path) -> Result<u32, TrainError> {
    last_state(store, Access::Map).map(|state| state.trainer.step)
}

/// Steps of the newest copy of a cell that can be read.
fn copied_steps(folder: &Path) -> Option<u32> {
    copies_of(folder).ok()?.iter().find_map(|(_, copy)| steps_in(copy).ok())
}

/// Compares the prior with the one that was cut. `memory` is in bytes.
/// Errors: it is another one, which no further attempt changes; or it cannot be read in this memory.
pub(crate) fn check_prior(plan: &CityPlan, city: &City, memory: u64) -> Result<(), WorkError> {
    let prior = StoredStart::open(&city.prior_store(), memory, 2).map_err(WorkError::of_run)?;
    if prior_digest(city, prior.digest()?)? == plan.prior {
        return Ok(());
    }
    let problem = "it is not the prior that was cut";
    Err(InputError::new(city.prior_store(), problem, "restore it, or cut again in another folder").into())
}

/// Compares the photos of a cell with those for which the city was cut.
/// Errors: other names, lenses or poses, which no further attempt changes; or the scene cannot be read here.
fn check_scene(planned: &CellPlan, folder: &Path, scene: &Path, config: &TrainConfig) -> Result<(), WorkError> {
    let options = ReadOptions { points_later: true, ..limits::read_options(config) };
    let raw = read_scene(scene, &options).map_err(|error| WorkError::of_run(error.into()))?;
    let names = read_text(&folder.join("views.txt"), LIST_BYTES_MAX, "restore the files of the cell")?;
    if planned.poses.is_empty() || poses_digest(&raw, &names) == planned.poses {
        return Ok(());
    }
    let problem = "the names, lenses or poses of the cell's photos have changed since the city was cut";
    Err(InputError::new(scene, problem, "restore them, or begin another city").into())
}

fn keys_of_cell(folder: &Path) -> InputResult<toml::Table> {
    new_run::given_keys(Some(&folder.join("cell.toml")), &TrainOverrides::default())
}

/// Where this machine works on a cell.
struct WorkPlace {
    out: PathBuf,
    /// The spill directory; `None` for a run in memory, whose checkpoint lies in `out`.
    pages: Option<PathBuf>,
}

impl WorkPlace {
    /// Machines that share a folder, and cities that share a drive, have places of their own.
    /// `digest` is that of the plan.
    fn of(cell: usize, drive: Option<&str>, digest: &str, city: &City) -> WorkPlace {
        let Some(drive) = drive else {
            let out = city.cell(cell).join(format!("{RUN}{}", system_name()));
            return WorkPlace { out, pages: None };
        };
        let own = absolute(Path::new(drive)).join(format!("cell-{cell}-{digest}"));
        WorkPlace { out: own.join("run"), pages: Some(own.join("pages")) }
    }

    fn store(&self) -> PathBuf {
        self.pages.clone().unwrap_or_else(|| self.out.join("checkpoint"))
    }

    /// The keys of this machine with the places of the cell's inputs.
    fn keys(&self, city: &City, folder: &Path, machine: &TrainOverrides) -> TrainOverrides {
        let text = |path: &Path| Some(path.to_string_lossy().into_owned());
        TrainOverrides {
            init_ply: text(&city.prior_store()),
            views_file: text(&folder.join("views.txt")),
            pages_file: text(&folder.join("pages.txt")),
            spill_dir: self.pages.as_deref().and_then(text),
            first_appearance: Some(city.prior_appearance()).filter(|file| file.is_file()).as_deref().and_then(text),
            ..machine.clone()
        }
    }

    /// Takes the newest copy of the cell as the checkpoint of this machine, unless it has one that is as new. Returns whether there is
    /// something to go on from.
    /// Errors: the copy is damaged, or the drive is not there or cannot be written.
    fn fetch(&self, folder: &Path) -> Result<bool, TrainError> {
        let store = self.store();
        let parent = store.parent().unwrap_or(&self.out);
        // Not its parents: the folder that the user named may be a drive that is not mounted.
        if !parent.is_dir() {
            std::fs::create_dir(parent).map_err(|e| {
                let remedy = "make the folder that --spill-dir names, or mount its drive";
                InputError { remedy: remedy.into(), ..InputError::io(parent, "making the folder of the cell", &e) }
            })?;
        }
        // A store that cannot be read may hold the only steps of the cell: the error names what saves them.
        let has_commit = SpillDir::exists_in(&store) && !is_uncommitted(&store)?;
        let own = has_commit.then(|| steps_in(&store)).transpose()?;
        let (mut copy, mut unreadable) = (None, None);
        for (_, path) in copies_of(folder)? {
            match steps_in(&path) {
                Ok(steps) => copy = Some((steps, path)),
                Err(error) => {
                    crate::tell!("warning: the copy in {} is passed over: {error}", path.display());
                    unreadable.get_or_insert(path);
                    continue;
                }
            }
            break;
        }
        if own.is_some() && own >= copy.as_ref().map(|(steps, _)| *steps) {
            return Ok(true);
        }
        if let (None, Some(copy)) = (&copy, unreadable) {
            let remedy = "try again where it can be read; remove it to begin the cell again";
            return Err(InputError::new(copy, "the cell has no copy that can be read", remedy).into());
        }
        // What lies here is of a run that the other machine did not go on with.
        self.clear()?;
        if self.out.is_dir() {
            let _lock = out_folder::lock(&self.out)?;
            out_folder::make(&self.out, Existing::Overwrite)?;
            // A run that was killed before its first step left its mark, and with it the next run would begin again.
            out_folder::remove_mark(&self.out);
        }
        copy.as_ref().map_or(Ok(()), |(_, copy)| clone_into(copy, &store))?;
        Ok(copy.is_some())
    }

    /// Removes the pages of the cell here; its results stay.
    fn clear(&self) -> Result<(), TrainError> {
        remove_store(&self.store())
    }

    /// As [`WorkPlace::clear`], and removes pages that workers of the cell in `folder` left in the city. Pages in use stay.
    fn clear_all(&self, folder: &Path) -> Result<(), TrainError> {
        for run in listed(folder)?.iter().filter(|path| name_begins_with(path, RUN)) {
            drop(remove_store(&run.join("checkpoint")));
        }
        self.clear()
    }
}

/// Copies the last commit of the run in `out` into the city; returns the number of the copy, `None` if the cell has another owner by now.
/// Errors: the commit is damaged, or the city cannot be written.
fn publish(folder: &Path, out: &Path, lock: &CellLock) -> Result<Option<u32>, TrainError> {
    if !lock.is_held() {
        return Ok(None);
    }
    let copies = folder.join("copy");
    std::fs::create_dir_all(&copies).map_err(|e| InputError::io(&copies, "making the folder of copies", &e))?;
    // What others left that were killed, or were taken for lost. One that still writes has it in use.
    listed(&copies)?.iter().filter(|path| name_begins_with(path, UNNAMED)).for_each(|path| drop(remove_store(path)));
    let before = copies_of(folder)?;
    let number = before.first().map_or(0, |(number, _)| number + 1);
    let (made, copy) = (copies.join(format!("{UNNAMED}{:032x}", draw_identity())), copy_of(folder, number));
    // A copy is part of what a stopped worker leaves.
    clone_store(&find_store(out)?, &made, &StopFlag::default())?;
    // Copying takes long. Another owner's copy of this number stays: no folder is renamed over one with files.
    let named = if lock.is_held() { rename(&made, &copy) } else { Err(ErrorKind::Other.into()) };
    if let Err(error) = named {
        remove_store(&made)?;
        if lock.is_held() {
            return Err(InputError::io(&copy, "naming the copy", &error).into());
        }
        return Ok(None);
    }
    sync_folder(&copies).map_err(|e| InputError::io(&copies, "naming the copy", &e))?;
    let steps = steps_in(&copy)?;
    for (_, older) in before {
        let removed = match steps_in(&older) {
            Ok(older_steps) if older_steps > steps || !lock.is_held() => Ok(()),
            Ok(_) => remove_store(&older),
            Err(error) => Err(error),
        };
        if let Err(error) = removed {
            crate::tell!("warning: an older copy stays: {error}");
        }
    }
    Ok(Some(number))
}

/// Copies a store to the folder `to`, which does not exist; what a killed process left of such a copy goes.
/// Errors: the store is damaged or in use, or `to` cannot be written.
fn clone_into(from: &Path, to: &Path) -> Result<(), TrainError> {
    remove_store(&part_of(to))?;
    clone_store(&find_store(from)?, to, &StopFlag::default()).map(drop)
}

/// Removes a store and its folder, if there is one.
/// Errors: it is no store, or in use.
pub(crate) fn remove_store(store: &Path) -> Result<(), TrainError> {
    if !store.is_dir() {
        return Ok(());
    }
    let mut spill = match SpillDir::exists_in(store) {
        true => SpillDir::open(store, true)?,
        // A process that was killed before it made the first file left a lock at most, which a new store takes.
        false => SpillDir::create(store, SlotLayout::new(1, 1), true)?,
    };
    spill.adopt_folder();
    spill.remove()?;
    Ok(())
}

/// The state of a cell as the folder of the city tells it.
#[derive(Debug, Clone)]
pub struct CellStatus {
    /// An error if what the city says of the cell cannot be read, or is of another plan.
    pub done: InputResult<Option<Done>>,
    /// Steps that the city has a copy of.
    pub copied: u32,
    /// Who works on it now.
    pub owner: Option<String>,
}

/// The state of every cell.
/// Errors: there is no plan.
pub fn status(city: &Path) -> InputResult<(CityPlan, Vec<CellStatus>)> {
    let city = City(city.to_path_buf());
    let plan = CityPlan::read(&city)?;
    let of = |cell: usize| {
        let (done, folder) = (done_of(&plan, &city, cell), city.cell(cell));
        let steps = done.as_ref().ok().and_then(|done| Some(done.as_ref()?.steps));
        let copied = steps.or_else(|| copied_steps(&folder)).unwrap_or(0);
        CellStatus { done, copied, owner: owner_of(&folder) }
    };
    let cells = (0..plan.cells.len()).map(of).collect();
    Ok((plan, cells))
}
