//! The program that computes poses: finds COLMAP or pycolmap on the machine, and runs its phases with a log.
//!
//! COLMAP's options have other names in other versions, so they are looked up in its help. Neither a display nor a GPU is needed;
//! COLMAP's GPU code runs only where it was built with CUDA and a GPU answers.
//!
//! Invariant: what a program prints goes to the log, never to the terminal.

use crate::base::error::{InputError, InputResult};
use crate::base::say::shell_word;
use crate::base::text::tail_of;
use serde_json::json;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// Oldest COLMAP whose commands and options are used.
const OLDEST: (u32, u32) = (3, 8);
/// What pycolmap runs.
const SCRIPT: &str = include_str!("../../tools/poses/pycolmap.py");
/// What the script prints before the number of a version that lacks what the phases call.
const OLD_PYCOLMAP: &str = "old pycolmap ";
/// Lines of the log that an error shows.
const LAST_LINES: usize = 6;
/// Most bytes of its log that are looked through for them, and that are read together.
const LOG_BYTES: u64 = 1 << 20;
const LOOK_EVERY: Duration = Duration::from_millis(200);

const INSTALL: &str = "install one of them, and name this folder again:\n  \
    any system:     pip install pycolmap    (or name another Python that has it: gsscale-poses PHOTOS --python PATH)\n  \
    Debian, Ubuntu: apt-get install colmap\n  \
    macOS:          brew install colmap\n  \
    Windows:        https://github.com/colmap/colmap/releases, then gsscale-poses PHOTOS --colmap PATH";

/// One run of the program.
#[derive(Debug, Clone, Copy)]
pub enum Phase {
    /// Finds features in the photos of [`LIST`], which share one camera or have one each.
    Features { camera_model: &'static str, one_camera: bool },
    /// Compares the pairs of [`CHUNK`].
    Matches,
    /// Reconstructs into [`SPARSE`], which exists.
    Model,
}

/// Names of files and folders that phases use, below the folder that they work in.
pub const DATABASE: &str = "database.db";
pub const PHOTOS: &str = "photos";
pub const SPARSE: &str = "sparse";
pub const LIST: &str = "list.txt";
/// Lines `NAME NAME`.
pub const CHUNK: &str = "chunk.txt";
const LOG: &str = "log.txt";

/// What features are sought.
#[derive(Debug, Clone, Copy)]
pub struct FeatureOptions {
    /// Photos are reduced to this longer side first, pixels.
    pub max_image_size: u32,
    /// Most features of a photo.
    pub max_features: u32,
}

/// Where the user says the programs are.
#[derive(Debug, Clone, Default)]
pub struct ProgramPaths {
    pub colmap: Option<PathBuf>,
    pub python: Option<PathBuf>,
}

#[derive(Debug, Clone)]
pub struct Program {
    path: PathBuf,
    /// Name and version.
    pub name: String,
    pub uses_gpu: bool,
    called_as: CalledAs,
}

#[derive(Debug, Clone)]
enum CalledAs {
    /// With the help of its phases for features and matches.
    Colmap {
        features_help: String,
        matches_help: String,
    },
    Pycolmap,
}

impl Program {
    /// A program that is never started.
    #[cfg(test)]
    pub(super) fn unused() -> Program {
        Program { path: PathBuf::new(), name: String::new(), uses_gpu: false, called_as: CalledAs::Pycolmap }
    }

    /// The program that `places` names; otherwise the best of COLMAP with a GPU, pycolmap, COLMAP on the CPU.
    /// Errors: none is there, which says how to install one; or the named one does not run or is too old.
    pub fn find(places: &ProgramPaths) -> InputResult<Program> {
        // Phases run in another folder. A name alone is searched for on the PATH.
        let whole = |path: &PathBuf| match path.components().count() {
            1 => path.clone(),
            _ => std::path::absolute(path).unwrap_or_else(|_| path.clone()),
        };
        let of_user = |found: InputResult<Program>, flag: &str| {
            found.map_err(|error| match error.kind {
                Some(std::io::ErrorKind::NotFound) => {
                    let remedy = format!("correct the path, or leave {flag} out: programs of the PATH are found");
                    InputError { problem: format!("{flag}: there is no such program"), remedy, ..error }
                }
                _ => error,
            })
        };
        if let Some(path) = &places.colmap {
            return of_user(Program::colmap(&whole(path)), "--colmap");
        }
        if let Some(path) = &places.python {
            return of_user(Program::pycolmap(&whole(path)), "--python");
        }
        let colmap = Program::colmap(Path::new("colmap"));
        if colmap.as_ref().is_ok_and(|program| program.uses_gpu) {
            return colmap;
        }
        let named = std::env::var_os("GSSCALE_PYTHON").map(|path| Program::pycolmap(&whole(&PathBuf::from(path))));
        if let Some(Err(error)) = &named
            && error.kind == Some(std::io::ErrorKind::NotFound)
        {
            return of_user(Err(error.clone()), "GSSCALE_PYTHON");
        }
        let others = ["python3", "python"].into_iter().map(|python| Program::pycolmap(Path::new(python)));
        // One that is there and does not work is told before one that is not there.
        let (mut found, mut broken) = (None, None);
        for python in named.into_iter().chain(others) {
            match python {
                Ok(program) => {
                    found = Some(program);
                    break;
                }
                Err(error) if error.problem.contains(OLD_PYCOLMAP) || is_broken(&error) => {
                    broken.get_or_insert(error);
                }
                _ => {}
            }
        }
        found.map_or(colmap, Ok).map_err(|mut error| {
            if error.kind == Some(std::io::ErrorKind::NotFound) {
                if let Some(broken) = broken {
                    return broken;
                }
                error.problem = "neither COLMAP nor a Python with pycolmap is on this machine".to_string();
            }
            error
        })
    }

    fn colmap(path: &Path) -> InputResult<Program> {
        let first = said_by(path, &["help"])?;
        let version = colmap_version(&first);
        if version.is_none_or(|version| version < OLDEST) {
            let line = first.lines().find(|line| !line.trim().is_empty()).unwrap_or("nothing");
            let problem = format!("COLMAP {}.{} or newer is needed; this says: {line}", OLDEST.0, OLDEST.1);
            return Err(InputError::new(path, problem, INSTALL));
        }
        let (major, minor) = version.unwrap_or(OLDEST);
        let has_cuda = first.contains("with CUDA");
        let called_as = CalledAs::Colmap {
            features_help: said_by(path, &["feature_extractor", "-h"])?,
            matches_help: said_by(path, &["matches_importer", "-h"])?,
        };
        let uses_gpu = has_cuda && has_gpu();
        Ok(Program { path: path.to_path_buf(), name: format!("COLMAP {major}.{minor}"), uses_gpu, called_as })
    }

    fn pycolmap(python: &Path) -> InputResult<Program> {
        let said = said_by(python, &["-c", SCRIPT, "version", "{}"])?;
        if let Some(old) = said.lines().find_map(|line| line.strip_prefix(OLD_PYCOLMAP)) {
            let problem = format!("{OLD_PYCOLMAP}{old} is there, and 3.13 or newer is needed");
            let remedy = format!("{} -m pip install --upgrade pycolmap", shell_word(python));
            return Err(InputError::new(python, problem, remedy));
        }
        let Some(name) = said.lines().find(|line| line.starts_with("pycolmap ")) else {
            let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("nothing");
            return Err(InputError::new(
                python,
                format!("this Python has no pycolmap that can be used: {last}"),
                INSTALL,
            ));
        };
        let (path, name) = (python.to_path_buf(), name.trim().to_string());
        let uses_gpu = name.ends_with("CUDA") && has_gpu();
        Ok(Program { path, uses_gpu, name, called_as: CalledAs::Pycolmap })
    }

    /// About how many seconds of one core a pair of photos takes to compare, for 8,192 features each.
    pub fn seconds_a_pair(&self) -> f64 {
        match &self.called_as {
            _ if self.uses_gpu => 0.02,
            CalledAs::Pycolmap => 0.2,
            // Options of this name came with faster comparison.
            CalledAs::Colmap { matches_help, .. } if matches_help.contains("--FeatureMatching.") => 0.2,
            CalledAs::Colmap { .. } => 0.9,
        }
    }

    /// Runs a phase in the folder `work` and waits for it. `watch` gets every line that it prints. `lock` is the locked file of the folder:
    /// the program gets it as its input, so that the folder stays locked should the program outlive this process.
    /// Errors: the program cannot be started, or says that it failed: then the error shows its last lines.
    pub fn run(
        &self,
        phase: Phase,
        features: &FeatureOptions,
        (work, lock): (&Path, &File),
        watch: &mut dyn FnMut(&str),
    ) -> InputResult<()> {
        let log = work.join(LOG);
        let io = |e: &std::io::Error| InputError::io(&log, "writing the log", e);
        let file = File::create(&log).map_err(|e| io(&e))?;
        let twin = file.try_clone().map_err(|e| io(&e))?;
        let mut command = Command::new(&self.path);
        command.args(self.arguments(phase, features)).current_dir(work);
        // Of Qt, on which COLMAP's window is built.
        command.env("QT_QPA_PLATFORM", "offscreen").env("PYTHONUNBUFFERED", "1");
        command.stdin(lock.try_clone().map_err(|e| io(&e))?).stdout(file).stderr(twin);
        end_with_this_process(&mut command);
        let mut child = command.spawn().map_err(|e| InputError::io(&self.path, "starting the program", &e))?;
        let mut lines = GrowingLog { file: File::open(&log).map_err(|e| io(&e))?, begun: Vec::new() };
        let status = loop {
            let ended = child.try_wait().map_err(|e| InputError::io(&self.path, "waiting for the program", &e))?;
            lines.new_ones(watch).map_err(|e| io(&e))?;
            match ended {
                Some(status) => break status,
                None => std::thread::sleep(LOOK_EVERY),
            }
        };
        let text = tail_of(&log, LOG_BYTES);
        // Photos without a model are no failure of the program; pycolmap ends without an error then.
        if status.success() || matches!(phase, Phase::Model) && text.contains("failed to create") {
            return Ok(());
        }
        let last: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
        let last = last[last.len().saturating_sub(LAST_LINES)..].join("\n    ");
        let remedy = "name the folder again to go on with this phase; for less memory: gsscale-poses PHOTOS --max-resolution 1000";
        let problem = format!("{} stopped with {status}; its last lines:\n    {last}", self.name);
        Err(InputError::new(log, problem, remedy))
    }

    fn arguments(&self, phase: Phase, features: &FeatureOptions) -> Vec<String> {
        match &self.called_as {
            CalledAs::Colmap { features_help, matches_help } => {
                self.colmap_arguments(phase, features, features_help, matches_help)
            }
            CalledAs::Pycolmap => {
                let (name, values) = match phase {
                    Phase::Features { camera_model, one_camera } => {
                        let values = json!({
                            "database": DATABASE, "photos": PHOTOS, "list_file": LIST,
                            "camera_model": camera_model, "one_camera": one_camera,
                            "max_image_size": features.max_image_size, "max_num_features": features.max_features,
                            "uses_gpu": self.uses_gpu,
                        });
                        ("features", values)
                    }
                    Phase::Matches => {
                        ("matches", json!({ "database": DATABASE, "pairs": CHUNK, "uses_gpu": self.uses_gpu }))
                    }
                    Phase::Model => ("model", json!({ "database": DATABASE, "photos": PHOTOS, "model": SPARSE })),
                };
                ["-c", SCRIPT, name, &values.to_string()].map(String::from).to_vec()
            }
        }
    }

    fn colmap_arguments(
        &self,
        phase: Phase,
        features: &FeatureOptions,
        features_help: &str,
        matches_help: &str,
    ) -> Vec<String> {
        let gpu = u8::from(self.uses_gpu).to_string();
        let mut arguments: Vec<String> = Vec::new();
        let mut add = |flag: &str, value: &str| arguments.extend([flag.to_string(), value.to_string()]);
        // An option that this version lacks is left at its default.
        let command = match phase {
            Phase::Features { camera_model, one_camera } => {
                add("--image_path", PHOTOS);
                add("--image_list_path", LIST);
                add("--ImageReader.camera_model", camera_model);
                let cameras = if one_camera { "single_camera" } else { "single_camera_per_image" };
                add(&format!("--ImageReader.{cameras}"), "1");
                let sizes = [features.max_image_size, features.max_features].map(|n| n.to_string());
                for (name, value) in [("use_gpu", &gpu), ("max_image_size", &sizes[0]), ("max_num_features", &sizes[1])]
                {
                    if let Some(flag) = option_of(features_help, name) {
                        add(&flag, value);
                    }
                }
                "feature_extractor"
            }
            Phase::Matches => {
                add("--match_list_path", CHUNK);
                add("--match_type", "pairs");
                if let Some(flag) = option_of(matches_help, "use_gpu") {
                    add(&flag, &gpu);
                }
                "matches_importer"
            }
            Phase::Model => {
                add("--image_path", PHOTOS);
                add("--output_path", SPARSE);
                "mapper"
            }
        };
        add("--database_path", DATABASE);
        arguments.insert(0, command.to_string());
        arguments
    }
}

/// Whether a GPU of NVIDIA answers.
fn has_gpu() -> bool {
    said_by(Path::new("nvidia-smi"), &["-L"]).is_ok_and(|said| said.starts_with("GPU"))
}

/// What a program prints, whatever it says of its success: COLMAP's help does not agree with itself.
fn said_by(path: &Path, arguments: &[&str]) -> InputResult<String> {
    let mut command = Command::new(path);
    command.args(arguments).env("QT_QPA_PLATFORM", "offscreen").stdin(Stdio::null());
    let output = command
        .output()
        .map_err(|e| InputError { remedy: INSTALL.to_string(), ..InputError::io(path, "starting the program", &e) })?;
    Ok([output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).join("\n"))
}

/// Whether the error is of a pycolmap that is installed and cannot be loaded.
fn is_broken(error: &InputError) -> bool {
    error.problem.contains("Error: ") && !error.problem.contains("No module named 'pycolmap'")
}

/// Major and minor version in the first line of COLMAP's help: `COLMAP 3.12.0.dev0 -- Structure-from-Motion ...`.
fn colmap_version(text: &str) -> Option<(u32, u32)> {
    let mut numbers = text[text.find("COLMAP ")? + 7..].split(|c: char| !c.is_ascii_digit());
    Some((numbers.next()?.parse().ok()?, numbers.next()?.parse().ok()?))
}

/// The option with this name in COLMAP's help, in whatever group: `--SiftExtraction.use_gpu`, `--FeatureExtraction.use_gpu`.
fn option_of(help: &str, name: &str) -> Option<String> {
    let mut options = help.split_whitespace().filter(|word| word.starts_with("--"));
    options.find(|word| word.ends_with(&format!(".{name}"))).map(String::from)
}

/// Asks the system to send the program SIGTERM when the thread that started it ends, also after a SIGKILL. On other systems than Linux
/// the program works on, and its lock keeps others out of the folder.
#[cfg(target_os = "linux")]
#[allow(unsafe_code)]
fn end_with_this_process(command: &mut Command) {
    use rustix::process::{Signal, set_parent_process_death_signal};
    use std::os::unix::process::CommandExt;
    // SAFETY: between fork and exec the closure makes one system call, and neither allocates nor takes a lock.
    unsafe { command.pre_exec(|| set_parent_process_death_signal(Some(Signal::TERM)).map_err(std::io::Error::from)) };
}

#[cfg(not(target_os = "linux"))]
fn end_with_this_process(_: &mut Command) {}

/// The lines of a file that another process writes.
struct GrowingLog {
    file: File,
    /// The start of a line whose end is not written yet.
    begun: Vec<u8>,
}

impl GrowingLog {
    fn new_ones(&mut self, take: &mut dyn FnMut(&str)) -> std::io::Result<()> {
        while (&self.file).take(LOG_BYTES).read_to_end(&mut self.begun)? > 0 {
            let end = self.begun.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
            // A line of this length says nothing of the search.
            let end = if self.begun.len() as u64 > LOG_BYTES { self.begun.len() } else { end };
            let whole: Vec<u8> = self.begun.drain(..end).collect();
            String::from_utf8_lossy(&whole).lines().for_each(&mut *take);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_read_from_the_first_line_and_options_from_the_help() {
        let texts = [
            ("COLMAP 3.8 -- Structure-from-Motion and Multi-View Stereo\n (Commit Unknown without CUDA)", Some((3, 8))),
            ("\nCOLMAP 3.12.0.dev0 -- Structure-from-Motion", Some((3, 12))),
            ("COLMAP 4.0.1 (Commit abc on 2026-01-01 with CUDA)", Some((4, 0))),
            ("COLMAP -- Structure-from-Motion", None),
            ("colmap: command not found", None),
        ];
        for (text, version) in texts {
            assert_eq!(colmap_version(text), version, "{text}");
        }
        assert!((3, 7) < OLDEST && (3, 10) > OLDEST);
        let old = "  --SiftExtraction.num_threads arg (=-1)\n  --SiftExtraction.use_gpu arg (=1)\n";
        assert_eq!(option_of(old, "use_gpu").as_deref(), Some("--SiftExtraction.use_gpu"));
        let new = "  --FeatureExtraction.use_gpu arg (=1)\n  --SiftExtraction.max_num_features arg (=8192)\n";
        assert_eq!(option_of(new, "use_gpu").as_deref(), Some("--FeatureExtraction.use_gpu"));
        assert_eq!(option_of(new, "max_image_size"), None);
    }
}
