//! The output folder of a run: checks it, creates it, locks it, clears it of an earlier run on --overwrite, and marks a run that has begun
//! and has no config.toml yet.
//!
//! A run reads its scene and makes its first pages before config.toml can say what they are. A run that is killed meanwhile, or
//! while it replaces an earlier run, leaves the mark with its settings, so that a resume can begin it again.
//!
//! Invariants: 1. only files with this program's names beside a run's config, and that run's own checkpoint
//! (`ownership`), are removed; 2. the refusal of a folder with a resumable run names the command that resumes it; 3. a run that is refused
//! leaves no mark and no folder that it made; 4. a mark lies only in a folder that was new, empty or a run's that is to be replaced, so
//! everything beside it is a run's.

use super::changes::with_absolute_paths;
use super::request::{Existing, RunRequest};
use crate::base::error::{InputError, InputResult};
use crate::base::identity::RunId;
use crate::base::say::shell_word;
use crate::base::text::{lines_of, own_json, read_text};
use crate::base::units::format_grouped;
use crate::base::whole_file::{folder_of, open_locked, part_path, rename, sync_folder, write_whole};
use crate::config::file::{FILE_BYTES_MAX, TrainConfig, TrainOverrides, read_resolved};
use crate::config::values::checkpoint_folder;
use crate::dataset::loader::Dataset;
use crate::exchange::format::ExportFormat;
use crate::exchange::tensorboard::is_event_file;
use crate::page::folder::spill_dir::SpillDir;
use crate::page::tool::reading::Access;
use crate::photos;
use crate::report::run_files::{
    BEGUN_FILE, CONFIG_FILE, METRICS_FILE, PLY_FILE, RUN_FILES, RunFile, SUMMARY_FILE, Tells, saved_step,
};
use crate::train::error::TrainError;
use crate::train::inputs::machine::absolute;
use crate::train::log::report::StepLine;
use crate::train::stores::ownership::{check_removable, last_state, remove_checkpoint_in};
use serde::{Deserialize, Serialize};
use std::ffi::OsStr;
use std::fs::File;
use std::path::{Path, PathBuf};

/// Lock file of an output folder; it stays there, empty.
const LOCK: &str = ".gsscale-lock";

/// File that shows that an output folder can be written; removed at once.
const PROBE: &str = ".gsscale-probe";

/// Locks an existing output folder for as long as the file is open. On file systems without locks this does nothing.
/// Errors: another process trains into the folder.
pub(crate) fn lock(out: &Path) -> InputResult<Option<File>> {
    match open_locked(&out.join(LOCK)) {
        Ok(None) => {
            let remedy = "wait for it to end, stop it (Ctrl-C commits first), or choose another --out";
            Err(InputError::new(out, "another process trains into this folder", remedy))
        }
        // A folder that cannot be written is an error of whoever writes there.
        opened => Ok(opened.unwrap_or(None)),
    }
}

/// Refuses an output folder in use, without making its lock file.
/// Errors: another process trains into the folder.
pub(super) fn refuse_in_use(out: &Path) -> InputResult<()> {
    if out.join(LOCK).is_file() { lock(out).map(drop) } else { Ok(()) }
}

/// Whether a folder is empty except for what a run leaves that is killed before it has a config.toml ([`is_trace`]).
pub fn is_empty(out: &Path) -> bool {
    std::fs::read_dir(out).is_ok_and(|mut entries| entries.all(|e| e.is_ok_and(|e| is_trace(&e.file_name()))))
}

/// Whether a run that is killed before it has a config.toml can have left a file of this name: the lock, the probe, the mark, or
/// the temporary file of the mark or of config.toml.
pub fn is_trace(name: &OsStr) -> bool {
    let is_part = |file: &str| part_path(Path::new(file)).is_some_and(|part| part.as_os_str() == name);
    name == LOCK || name == PROBE || name == BEGUN_FILE || is_part(BEGUN_FILE) || is_part(CONFIG_FILE)
}

/// The output folder where none is named: `runs/NAME` in the working folder, NAME that of the scene's folder, or `demo`
/// without a scene; with `-2`, `-3` and so on where that is taken. And the one without a number.
pub fn default_out(scene: Option<&Path>) -> (PathBuf, PathBuf) {
    let name = scene.map_or_else(|| "demo".to_string(), scene_name);
    let numbered = |n: u32| Path::new("runs").join(if n == 1 { name.clone() } else { format!("{name}-{n}") });
    let is_free = |out: &PathBuf| !out.exists() || (is_empty(out) && refuse_in_use(out).is_ok());
    ((1..=u32::MAX).map(numbered).find(is_free).unwrap_or_else(|| numbered(1)), numbered(1))
}

/// The name of a scene: that of its folder.
pub fn scene_name(scene: &Path) -> String {
    // A name such as `.` or `scans/..` is no name; one that does not exist is refused later.
    let whole = scene.canonicalize().unwrap_or_else(|_| scene.to_path_buf());
    let folder = if whole.is_file() { folder_of(&whole).to_path_buf() } else { whole };
    folder.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}

/// Refuses an output folder in which a run may not begin. Changes nothing, so a dry run asks the same.
/// Errors: the folder cannot be made, is not empty and `existing` refuses it, is in use, or its checkpoint belongs to another run.
pub fn check_usable_out(out: &Path, existing: Existing) -> Result<(), TrainError> {
    if let Some(above) = out.ancestors().find(|above| above.exists()).filter(|above| !above.is_dir()) {
        let problem = format!("the folder cannot be made: {} is a file", above.display());
        return Err(InputError::new(out, problem, "choose another --out").into());
    }
    refuse_in_use(out)?;
    match existing {
        Existing::Refuse if out.exists() && !is_empty(out) => Err(exists_already(out).into()),
        Existing::Overwrite if out.join(CONFIG_FILE).is_file() && !is_run(out) => {
            let remedy = "choose another --out, or move that file away";
            Err(InputError::new(out, "its config.toml is not that of a run, so --overwrite replaces nothing", remedy)
                .into())
        }
        Existing::Overwrite => check_removable(&checkpoint_folder(out), run_in(out)),
        Existing::Refuse | Existing::BeginAgain => Ok(()),
    }
}

/// Refuses the folder of the photos as that of the results, also for `--overwrite`.
pub fn check_apart(out: &Path, scene: &Path) -> InputResult<()> {
    let is_one = out.canonicalize().is_ok_and(|out| scene.canonicalize().is_ok_and(|scene| out == scene));
    if is_one { Err(InputError::new(out, "is the scene itself", "name another folder with --out")) } else { Ok(()) }
}

/// Refuses a folder of photos, and a folder in one, as that of the results. Only the dataset says where the photos are.
pub(super) fn check_apart_from_photos(out: &Path, dataset: &Dataset) -> InputResult<()> {
    dataset.photo_folder_around(out).map_or(Ok(()), |photos| {
        let problem = format!("lies among the photos of the scene, in {}", photos.display());
        Err(InputError::new(out, problem, "name another folder with --out"))
    })
}

/// Identity of the run whose config lies in `out`.
fn run_in(out: &Path) -> RunId {
    read_resolved(&out.join(CONFIG_FILE)).map_or(RunId::UNKNOWN, |resolved| resolved.run)
}

fn exists_already(out: &Path) -> InputError {
    InputError::new(out, "exists already", remedy_of_existing(out))
}

/// The remedy for an existing output folder: resume its run, or another folder. `--overwrite` is proposed only where there
/// is no result to lose.
pub fn remedy_of_existing(out: &Path) -> String {
    let Ok(config) = TrainConfig::read(&out.join(CONFIG_FILE)) else {
        return "choose another --out; --overwrite replaces the results of a run".to_string();
    };
    let residence = config.residence();
    let has_result = has_results(out);
    let shown = shell_word(out);
    match SpillDir::exists_in(&residence.checkpoint_folder(out)) {
        false if has_result => {
            format!("choose another --out, or give its run more steps: gsscale-train --resume {shown} --steps N")
        }
        false => format!(
            "begin this run again, since it had no commit yet: gsscale-train --resume {shown}; replace it with --overwrite, or choose \
             another --out"
        ),
        true if has_result => format!("resume its run with gsscale-train --resume {shown}, or choose another --out"),
        true => {
            let over = match residence.spill_dir() {
                None => "--overwrite".to_string(),
                Some(spill_dir) => format!("--overwrite after removing {}", spill_dir.display()),
            };
            format!(
                "resume its run with gsscale-train --resume {shown}; or choose another --out, or start over with {over}"
            )
        }
    }
}

fn failed(path: &Path, doing: &str) -> impl FnOnce(std::io::Error) -> InputError {
    move |e| InputError::io(path, doing, &e)
}

/// Creates the folder durably.
/// Errors: the folder cannot be created.
pub(super) fn make_folder(out: &Path) -> InputResult<()> {
    let is_new = !out.exists();
    std::fs::create_dir_all(out).map_err(failed(out, "making the output folder"))?;
    // The names of new parent folders are not synced.
    if is_new { sync_folder(folder_of(out)).map_err(failed(out, "making the output folder")) } else { Ok(()) }
}

/// Creates the folder, checks that it is writable, and removes an earlier run's files.
/// Errors: the folder cannot be written, or its checkpoint belongs to another run.
pub(crate) fn make(out: &Path, existing: Existing) -> Result<(), TrainError> {
    make_folder(out)?;
    let probe = out.join(PROBE);
    std::fs::write(&probe, b"")
        .and_then(|()| std::fs::remove_file(&probe))
        .map_err(failed(out, "making the output folder"))?;
    // In a folder that is not a run's, files with names of results may be somebody else's (such as the points of a scene).
    if existing == Existing::Refuse || !is_run(out) {
        return Ok(());
    }
    if existing == Existing::BeginAgain {
        // A run that was cut off before its first commit left nothing else; results must stay.
        return Ok(remove_files(out, |tells| tells == Tells::Steps)?);
    }
    // Before anything is removed: without its config the rest would not be taken for a run's.
    ExportFormat::ALL.into_iter().try_for_each(|format| check_results(out, format))?;
    // First, because an active run in the folder makes this fail.
    let checkpoint = checkpoint_folder(out);
    let state = last_state(&checkpoint, Access::Map).ok();
    remove_checkpoint_in(&checkpoint, run_in(out))?;
    if let Some(state) = state {
        let (folder, steps) = (checkpoint.display(), format_grouped(state.trainer.step.into()));
        crate::tell!("warning: --overwrite has removed the checkpoint of {steps} steps in {folder}");
    }
    Ok(remove_files(out, |_| true)?)
}

/// Whether a folder holds what a run or its checkpoint leaves.
pub(super) fn may_be_run(out: &Path) -> bool {
    [CONFIG_FILE, BEGUN_FILE, METRICS_FILE].iter().any(|name| out.join(name).exists())
        || checkpoint_folder(out).exists()
}

/// Whether a folder has the mark or the config.toml of a run. Other programs have files of the latter name; an empty one is nobody's.
fn is_run(out: &Path) -> bool {
    let config = out.join(CONFIG_FILE);
    let is_empty = std::fs::metadata(&config).is_ok_and(|about| about.is_file() && about.len() == 0);
    out.join(BEGUN_FILE).is_file() || is_empty || read_resolved(&config).is_ok()
}

/// Removes the evaluation of an earlier state, since comparisons would use it for this run.
pub(super) fn remove_evaluation(out: &Path) -> InputResult<()> {
    remove_files(out, |tells| tells == Tells::Evaluation)
}

/// Removes the files of [`RUN_FILES`] that tell about `which` parts of an earlier run.
fn remove_files(out: &Path, which: impl Fn(Tells) -> bool) -> InputResult<()> {
    let files = RUN_FILES.iter().filter(|(_, tells)| which(*tells));
    files.map(|(file, _)| file).try_for_each(|file| match file {
        RunFile::File(name) if is_behind_link(out, folder_of(&out.join(name))) => Ok(()),
        RunFile::Events(folder) | RunFile::Pictures(folder) if is_behind_link(out, &out.join(folder)) => Ok(()),
        RunFile::File(name) => remove_file(&out.join(name)),
        RunFile::SavedPlys => saved(out)?.iter().try_for_each(|path| remove_file(path)),
        RunFile::Events(folder) => remove_in(&out.join(folder), is_event_file, false),
        RunFile::Exports => ExportFormat::ALL
            .into_iter()
            .try_for_each(|format| format.beside(&out.join(PLY_FILE)).map_or(Ok(()), |file| format.remove(&file))),
        RunFile::Photos => photos::files().try_for_each(|name| remove_file(&out.join(name))),
        RunFile::Pictures(folder) => {
            remove_in(&out.join(folder), |path| path.extension().is_some_and(|e| e == "png"), true)
        }
    })
}

/// Refuses an output folder in which the PLY or the export `format` of a run cannot be replaced.
/// Errors: as [`ExportFormat::check_removable`].
pub(super) fn check_results(out: &Path, format: ExportFormat) -> InputResult<()> {
    let ply = out.join(PLY_FILE);
    ExportFormat::Ply.check_removable(&ply)?;
    format.beside(&ply).map_or(Ok(()), |file| format.check_removable(&file))
}

fn remove_file(path: &Path) -> InputResult<()> {
    match std::fs::remove_file(path) {
        Err(e) if path.is_file() => Err(failed(path, "removing the earlier run's file")(e)),
        _ => Ok(()),
    }
}

/// Whether a symbolic link below `out` leads to `folder`: a run makes none, so the files behind it are somebody's.
fn is_behind_link(out: &Path, folder: &Path) -> bool {
    folder.ancestors().take_while(|part| *part != out).any(Path::is_symlink)
}

/// Removes the files that are ours from `folder`, and from its subfolders if `is_deep`; then folders that are empty.
/// TensorBoard would draw curves that stay into those of the new run.
fn remove_in(folder: &Path, is_ours: fn(&Path) -> bool, is_deep: bool) -> InputResult<()> {
    if !folder.is_dir() {
        return Ok(());
    }
    let entries = std::fs::read_dir(folder).map_err(failed(folder, "listing the folder"))?;
    for entry in entries.flatten() {
        let path = entry.path();
        match entry.file_type() {
            Ok(kind) if kind.is_dir() && is_deep => remove_in(&path, is_ours, is_deep)?,
            Ok(kind) if kind.is_file() && is_ours(&path) => remove_file(&path)?,
            _ => {}
        }
    }
    let _ = std::fs::remove_dir(folder);
    Ok(())
}

/// Whether a new start would destroy something of the run in `out`: a result, or a logged commit whose checkpoint may
/// lie elsewhere.
fn has_results_beside_saved(out: &Path) -> bool {
    let lines = || lines_of(&out.join(METRICS_FILE));
    let commits = |line: Vec<u8>| serde_json::from_slice::<StepLine>(&line).ok()?.commits.map(|report| report.commits);
    let has = |name: &str| out.join(name).exists();
    let has_result = match own_json::<serde_json::Value>(&out.join(SUMMARY_FILE)) {
        // A run that an error ended before its first commit wrote the Gaussians that it had. Beginning again passes through them.
        Some(summary) => summary["finished"] != false || summary["commits"] != 0,
        // A PLY beside metrics but without a summary comes from a run without commits that was killed while it wrote its
        // results. Beginning again gives the same PLY, which replaces the old one as a whole.
        None => has(SUMMARY_FILE) || (has(PLY_FILE) && lines().next().is_none()),
    };
    has_result || lines().filter_map(commits).any(|commits| commits > 0)
}

/// As [`has_results_beside_saved`], with the files of `--save-every`.
pub(super) fn has_results(out: &Path) -> bool {
    has_results_beside_saved(out) || saved(out).is_ok_and(|saved| !saved.is_empty())
}

/// Refuses to begin a run again that left results. `has_empty_store`: the store of the run is here and holds no commit. Files of
/// `--save-every` are no obstacle then: the run was cut off between its first such file and the commit of that step, and writes the file again.
/// Errors: there are results, which would be replaced.
pub(super) fn check_restart(out: &Path, has_empty_store: bool) -> InputResult<()> {
    if !has_results_beside_saved(out) && (has_empty_store || !has_results(out)) {
        return Ok(());
    }
    let newest = |name: &PathBuf| saved_step(name.file_name()?.to_str()?);
    let result = Some(out.join(PLY_FILE)).filter(|ply| ply.is_file());
    let result = result.or_else(|| saved(out).ok()?.into_iter().max_by_key(newest));
    let problem = "the run left results but no commit to resume from: a run that ends without --keep-checkpoint \
                   removes its checkpoint";
    let remedy = format!(
        "start a new run from its Gaussians with another --out and --init-ply {}",
        shell_word(result.unwrap_or_else(|| out.join(PLY_FILE)))
    );
    Err(InputError::new(out, problem, remedy))
}

/// Gives the result in `out` a second name. The first one stays, where viewers look for it, until the new result replaces it as a whole.
pub(super) fn keep_result(out: &Path, kept: &Path) -> InputResult<()> {
    let result = out.join(PLY_FILE);
    let doing = "keeping the result under the name of its step";
    let failed = |error: std::io::Error| InputError::io(&result, doing, &error);
    let beside = out.join(".kept.ply.part");
    let _ = std::fs::remove_file(&beside);
    // A second name costs no space; some file systems have none.
    if std::fs::hard_link(&result, &beside).is_err()
        && let Err(error) = std::fs::copy(&result, &beside)
    {
        let _ = std::fs::remove_file(&beside);
        return Err(failed(error));
    }
    rename(&beside, kept).map_err(failed)?;
    // Where folders cannot be synced, the name is durable with the next sync of a file.
    let _ = sync_folder(out);
    Ok(())
}

/// The PLY files that `--save-every` wrote.
pub(crate) fn saved(out: &Path) -> InputResult<Vec<PathBuf>> {
    let entries = std::fs::read_dir(out).map_err(failed(out, "listing the folder"))?;
    let is_saved =
        |path: &PathBuf| path.file_name().and_then(|name| name.to_str()).is_some_and(|name| saved_step(name).is_some());
    Ok(entries.flatten().map(|entry| entry.path()).filter(is_saved).collect())
}

/// The mark of a run that has begun, and the lock of its folder: no other run changes the folder before the first step. Dropping it
/// removes the mark and the folders that were made for it, if nothing else lies there.
pub(super) struct Beginning {
    out: PathBuf,
    /// Held to the end of the run; `None` on file systems without locks.
    lock: Option<File>,
    /// The lock file was there before.
    had_lock: bool,
    /// Folders that did not exist, the innermost first.
    folders: Vec<PathBuf>,
    /// An earlier process made the mark: it stays if this one is refused.
    was_there: bool,
}

/// What a mark holds beside the settings, in the table of config.toml.
#[derive(Serialize, Deserialize)]
struct BegunMark {
    resolved: Facts,
}

#[derive(Serialize, Deserialize)]
struct Facts {
    scene: PathBuf,
}

impl Beginning {
    /// Locks and marks the output folder of a request, if it is new, empty, or marked already.
    /// Errors: the folder cannot be written, another process trains into it, or has trained into it since it was checked.
    pub fn mark(request: &RunRequest) -> InputResult<Option<Beginning>> {
        let out = request.out.clone();
        if request.dry_run || (out.exists() && !is_empty(&out) && !is_marked(&out)) {
            return if request.dry_run || request.existing != Existing::Refuse {
                Ok(None)
            } else {
                Err(exists_already(&out))
            };
        }
        let is_new = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let folders = out.ancestors().take_while(is_new).map(Path::to_path_buf).collect();
        make_folder(&out)?;
        let had_lock = out.join(LOCK).exists();
        let lock = lock(&out)?;
        if !is_empty(&out) && !is_marked(&out) {
            return Err(exists_already(&out));
        }
        let beginning = Beginning { was_there: is_marked(&out), lock, had_lock, folders, out };
        write_mark(request)?;
        Ok(Some(beginning))
    }

    /// Whether the folder is locked.
    pub fn holds_lock(&self) -> bool {
        self.lock.is_some()
    }
}

impl Drop for Beginning {
    fn drop(&mut self) {
        // Folders that hold something stay. Where nothing can be removed, the mark costs the next run nothing.
        if !self.was_there {
            remove_mark(&self.out);
            if !self.had_lock && !self.out.join(CONFIG_FILE).exists() {
                let _ = std::fs::remove_file(self.out.join(LOCK));
            }
            self.folders.iter().take_while(|folder| std::fs::remove_dir(folder).is_ok()).for_each(drop);
        }
    }
}

/// Whether a run has begun in this folder that has no config.toml.
pub(super) fn is_marked(out: &Path) -> bool {
    out.join(BEGUN_FILE).is_file() && !out.join(CONFIG_FILE).exists()
}

/// Writes the mark into an existing folder.
/// Errors: the folder cannot be written.
pub(super) fn write_mark(request: &RunRequest) -> InputResult<()> {
    let path = request.out.join(BEGUN_FILE);
    let fail = |e: toml::ser::Error| {
        let remedy = "choose another name for the folder whose name is not UTF-8";
        InputError::new(&path, e.to_string(), remedy)
    };
    let config = toml::to_string(&with_absolute_paths(request.config.clone())).map_err(fail)?;
    let facts = toml::to_string(&BegunMark { resolved: Facts { scene: absolute(&request.scene) } }).map_err(fail)?;
    write_whole(&path, format!("{config}\n{facts}").as_bytes())
}

/// Removes the mark of a run that has a config.toml or a commit now. One that stays is ignored.
pub(crate) fn remove_mark(out: &Path) {
    let _ = std::fs::remove_file(out.join(BEGUN_FILE));
}

/// The settings and the scene of a run that has only a mark, with those that are given now; `None` without a mark.
/// Errors: the file is not such a mark, or the settings do not fit together.
pub(super) fn settings_of_mark(
    out: &Path,
    keys: &TrainOverrides,
    scene: Option<&Path>,
) -> InputResult<Option<(TrainConfig, PathBuf)>> {
    if !is_marked(out) {
        return Ok(None);
    }
    let path = out.join(BEGUN_FILE);
    let remedy = "remove the file, and start the run again with its first command";
    let refuse = |problem: String| InputError::new(&path, problem, remedy);
    let text = read_text(&path, FILE_BYTES_MAX, remedy)?;
    let mut config = TrainConfig::parse(&text).map_err(refuse)?;
    let BegunMark { resolved } = toml::from_str(&text).map_err(|e| refuse(e.to_string()))?;
    keys.clone().apply(&mut config);
    config.check()?;
    Ok(Some((config, scene.map_or(resolved.scene, Path::to_path_buf))))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::exchange::meta::{ExportFrame, SceneMeta};
    use crate::exchange::tensorboard::EventFile;

    #[test]
    fn curves_of_an_earlier_run_go_and_others_files_stay() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        let events = out.join("tensorboard");
        for _ in 0..2 {
            EventFile::create(&events, None).unwrap().write(1, &[("loss/train", 0.5)]).unwrap();
        }
        let count = || std::fs::read_dir(&events).map_or(0, Iterator::count);
        make(out, Existing::Overwrite).unwrap();
        std::fs::write(out.join(CONFIG_FILE), "baseURL = \"https://example.org\"").unwrap();
        make(out, Existing::Overwrite).unwrap();
        let refused = check_usable_out(out, Existing::Overwrite).unwrap_err().to_string();
        assert!(refused.contains("not that of a run"), "{refused}");
        assert_eq!(count(), 2, "no run's config, so they are not a run's");
        std::fs::write(out.join("config.toml"), "").unwrap();
        std::fs::write(events.join("events.out.tfevents.0123456789.host.1.0"), "of another program").unwrap();
        make(out, Existing::Overwrite).unwrap();
        assert_eq!(count(), 1);
        std::fs::remove_file(events.join("events.out.tfevents.0123456789.host.1.0")).unwrap();
        std::fs::write(out.join("config.toml"), "").unwrap();
        for name in ["evaluated.json", "evaluated-as.toml"] {
            std::fs::write(out.join(name), "of the earlier run").unwrap();
        }
        make(out, Existing::Overwrite).unwrap();
        assert!(!events.exists());
        assert!(!out.join("evaluated.json").exists() && !out.join("evaluated-as.toml").exists());
    }

    #[cfg(unix)]
    #[test]
    fn files_behind_links_stay() {
        for link in ["renders", "renders/test", "renders/test/deep", "tensorboard"] {
            let (folder, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
            let (out, link) = (folder.path(), folder.path().join(link));
            let deep = elsewhere.path().join("test/deep");
            std::fs::create_dir_all(&deep).unwrap();
            EventFile::create(elsewhere.path(), None).unwrap().write(1, &[("loss/train", 0.5)]).unwrap();
            for name in ["a.png", "test/a.png", "test/views.json", "views.json", "test/deep/a.png"] {
                std::fs::write(elsewhere.path().join(name), "somebody's").unwrap();
            }
            let count = || {
                [elsewhere.path(), &elsewhere.path().join("test"), &deep]
                    .map(|at| std::fs::read_dir(at).unwrap().count())
            };
            let before = count();
            std::fs::create_dir_all(folder_of(&link)).unwrap();
            std::os::unix::fs::symlink(elsewhere.path(), &link).unwrap();
            std::fs::write(out.join(CONFIG_FILE), "").unwrap();
            make(out, Existing::Overwrite).unwrap();
            assert!(link.is_symlink() && count() == before, "{}: {before:?}, now {:?}", link.display(), count());
            assert!(!out.join(CONFIG_FILE).exists(), "the run's own files go");
        }
    }

    #[test]
    fn traces_of_a_kill_before_the_config_leave_a_folder_empty() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        for name in [LOCK, PROBE, BEGUN_FILE, "..gsscale-begun.toml.part", ".config.toml.part"] {
            std::fs::write(out.join(name), "").unwrap();
            check_usable_out(out, Existing::Refuse).unwrap();
        }
        std::fs::write(out.join("notes.txt.part"), "somebody's").unwrap();
        assert!(check_usable_out(out, Existing::Refuse).is_err());
    }

    /// For every format, so that none can be left out.
    #[test]
    fn exports_of_an_earlier_run_go_in_every_format() {
        for format in ExportFormat::ALL {
            let folder = tempfile::tempdir().unwrap();
            let out = folder.path();
            let file = format.beside(&out.join(PLY_FILE)).unwrap_or_else(|| out.join(PLY_FILE));
            std::fs::create_dir_all(folder_of(&file)).unwrap();
            std::fs::write(&file, "of the earlier run").unwrap();
            format.write_transform(&file, &SceneMeta::default(), ExportFrame::Dataset).unwrap();
            std::fs::write(out.join(CONFIG_FILE), "").unwrap();
            make(out, Existing::Overwrite).unwrap();
            assert!(is_empty(out), "{format:?}: {:?}", std::fs::read_dir(out).unwrap().collect::<Vec<_>>());
        }
    }

    #[test]
    fn folders_in_the_place_of_results_are_refused() {
        for name in [PLY_FILE, "point_cloud.spz"] {
            let folder = tempfile::tempdir().unwrap();
            let out = folder.path();
            std::fs::write(out.join(CONFIG_FILE), "").unwrap();
            std::fs::create_dir(out.join(name)).unwrap();
            let refused = make(out, Existing::Overwrite).unwrap_err().to_string();
            assert!(refused.contains(name) && refused.contains("move or rename"), "{refused}");
            assert!(out.join(CONFIG_FILE).is_file());
            assert_eq!(check_results(out, ExportFormat::Ply).is_err(), name == PLY_FILE);
            assert!(check_results(out, ExportFormat::Spz).is_err());
        }
    }

    /// Another run may have begun and ended since the folder was checked.
    #[test]
    fn a_run_does_not_begin_in_a_folder_that_is_used_meanwhile() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("new/out");
        let request = RunRequest {
            scene: folder.path().to_path_buf(),
            out: out.clone(),
            config: TrainConfig::default(),
            dry_run: false,
            existing: Existing::Refuse,
            quiet: true,
            live: None,
            leg: None,
        };
        let first = Beginning::mark(&request).unwrap().unwrap();
        let refused = Beginning::mark(&request).err().unwrap().to_string();
        assert!(refused.contains("another process trains"), "{refused}");
        assert!(refuse_in_use(&out).is_err());
        drop(first);
        assert!(!out.exists() && !folder.path().join("new").exists(), "a refused run leaves nothing");
        make_folder(&out).unwrap();
        std::fs::write(out.join(CONFIG_FILE), "").unwrap();
        let refused = Beginning::mark(&request).err().unwrap().to_string();
        assert!(refused.contains("exists already"), "{refused}");
        assert!(out.join(CONFIG_FILE).exists());
    }
}
