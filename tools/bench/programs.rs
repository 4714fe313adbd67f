//! Our own programs as processes of a sweep.
//!
//! Invariant: a process holds the lock of the sweep while it lives.

use gsscale::base::error::{InputError, InputResult};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::File;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

/// Longest message of a failed run, characters.
const PROBLEM_MAX: usize = 600;

/// Runs a program that is part of this program, or lies in its folder, to its end. Its standard input is the file `lock`, so the lock stays
/// held while the program lives.
/// Errors: the program is missing, or cannot be started.
pub fn start(
    program: &str,
    arguments: &[impl AsRef<OsStr>],
    environment: &BTreeMap<String, String>,
    lock: &File,
) -> InputResult<Output> {
    let (path, command) = beside(program)?;
    let held = lock.try_clone().map_err(|e| InputError::io(&path, "handing on the lock", &e))?;
    let mut started = Command::new(&path);
    started
        .args(command)
        .args(arguments)
        .envs(environment)
        .stdin(Stdio::from(held))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    if program == "gsscale-train" {
        started.arg("--quiet");
    }
    started.output().map_err(|e| InputError::io(&path, "starting the program", &e))
}

/// Path of a program and its first argument: this program with a command if it is `gsscale`, else one in the same folder.
pub fn beside(program: &str) -> InputResult<(PathBuf, Option<&str>)> {
    let own = std::env::current_exe().map_err(|e| InputError::io(program, "finding this program", &e))?;
    if let (Some("gsscale"), Some(command)) =
        (own.file_stem().and_then(OsStr::to_str), program.strip_prefix("gsscale-"))
    {
        return Ok((own, Some(command)));
    }
    let path = own.with_file_name(format!("{program}{}", std::env::consts::EXE_SUFFIX));
    match path.is_file() {
        true => Ok((path, None)),
        false => Err(InputError::new(&path, "is missing", "build all programs: cargo build --release")),
    }
}

/// The last error message of a failed program, or its exit status.
/// Errors: the program was interrupted, which is no result: the sweep ends too, and the next call repeats this run.
pub fn problem(output: &Output) -> InputResult<String> {
    let said = String::from_utf8_lossy(&output.stderr);
    // A cell that a signal has stopped ends with 75, and one that another process has with 76; one that lacks something says an error.
    let is_interrupted = match output.status.code() {
        Some(75 | 76) => !said.contains("error: "),
        code => matches!(code, Some(130 | 143)),
    };
    if is_interrupted {
        return Err(InputError::new("the sweep", "was interrupted", "start it again to continue"));
    }
    let errors = said.rfind("error: ").map_or(said.trim(), |at| said[at..].trim());
    let text = if errors.is_empty() { output.status.to_string() } else { errors.replace('\n', " ") };
    Ok(text.chars().take(PROBLEM_MAX).collect())
}
