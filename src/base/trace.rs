//! A trace of the process: the spans of work of its host threads, with their times, as JSON in Chrome's trace-event format.
//! Perfetto (<https://ui.perfetto.dev>) and `chrome://tracing` open it.
//!
//! A process has at most one trace. Spans are written soon after they end, so a process that is killed leaves a file that viewers still open:
//! the format allows the closing bracket to be missing.
//!
//! Not here: what a device does between two calls; which work is a span (the rooms that do the work).
//!
//! Invariants: 1. without a trace a span costs one load of an atomic; 2. a failed write never disturbs the run: [`finish`] returns the
//! error; 3. a span changes nothing but the file.

use super::error::{InputError, InputResult};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Whether the process has a trace.
static IS_ON: AtomicBool = AtomicBool::new(false);
static SINK: Mutex<Option<Sink>> = Mutex::new(None);
/// The 0-based step that the process is at.
static STEP: AtomicU32 = AtomicU32::new(0);
/// Threads that have written a span.
static THREADS: AtomicU64 = AtomicU64::new(0);

thread_local! {
    /// Number of the thread in the trace.
    static THREAD: u64 = THREADS.fetch_add(1, Ordering::Relaxed) + 1;
}

/// The file of a trace.
struct Sink {
    path: PathBuf,
    file: BufWriter<File>,
    began: Instant,
    is_first: bool,
    failed: Option<std::io::Error>,
}

impl Sink {
    fn write(&mut self, event: &str) {
        if self.failed.is_some() {
            return;
        }
        let separator = if std::mem::take(&mut self.is_first) { "[\n" } else { ",\n" };
        let written = self.file.write_all(separator.as_bytes()).and_then(|()| self.file.write_all(event.as_bytes()));
        self.failed = written.err();
    }
}

fn sink() -> std::sync::MutexGuard<'static, Option<Sink>> {
    SINK.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Begins the trace of the process in a new file. A trace that was begun before ends.
/// Errors: the file exists already, or cannot be created.
pub fn start(path: &Path) -> InputResult<()> {
    let file = File::create_new(path).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => InputError::new(path, "exists already", "name another file, or remove this one"),
        _ => InputError::io(path, "creating the trace", &error),
    })?;
    let file = BufWriter::new(file);
    let path = path.to_path_buf();
    *sink() = Some(Sink { path, file, began: Instant::now(), is_first: true, failed: None });
    IS_ON.store(true, Ordering::Release);
    Ok(())
}

/// Ends the trace; does nothing if none was begun. Removes the file of a trace without a span: the run was refused, and its next
/// attempt may use the name. Errors: a part of the trace could not be written.
pub fn finish() -> InputResult<()> {
    IS_ON.store(false, Ordering::Release);
    let Some(mut trace) = sink().take() else { return Ok(()) };
    let written = match trace.failed.take() {
        Some(error) => Err(error),
        None if trace.is_first => std::fs::remove_file(&trace.path),
        None => trace.file.write_all(b"\n]\n").and_then(|()| trace.file.flush()),
    };
    written.map_err(|error| InputError::io(&trace.path, "writing the trace", &error))
}

/// Says which 0-based step the spans from now on belong to.
pub fn set_step(step: u32) {
    STEP.store(step, Ordering::Relaxed);
}

/// Begins a span, which ends when the result is dropped.
#[must_use]
pub fn span(name: &'static str) -> Span {
    let began = IS_ON.load(Ordering::Acquire).then(Instant::now);
    Span { name, began, notes: String::new() }
}

#[derive(Debug)]
pub struct Span {
    name: &'static str,
    /// `None` without a trace.
    began: Option<Instant>,
    notes: String,
}

impl Span {
    /// The span with a number in its notes.
    #[must_use]
    pub fn with(mut self, key: &'static str, value: u64) -> Span {
        self.note(key, value);
        self
    }

    /// The span with a word in its notes.
    #[must_use]
    pub fn of(mut self, key: &'static str, word: &str) -> Span {
        if self.began.is_some() {
            // Writing to a string does not fail.
            let _ = write!(self.notes, ",\"{key}\":\"{}\"", word.replace(['"', '\\'], "'"));
        }
        self
    }

    pub fn note(&mut self, key: &'static str, value: u64) {
        if self.began.is_some() {
            let _ = write!(self.notes, ",\"{key}\":{value}");
        }
    }
}

impl Drop for Span {
    fn drop(&mut self) {
        let Some(began) = self.began else { return };
        let ended = Instant::now();
        let mut sink = sink();
        let Some(trace) = sink.as_mut() else { return };
        let micros = |from: Instant, to: Instant| to.saturating_duration_since(from).as_nanos() as f64 / 1e3;
        let (name, notes, thread) = (self.name, &self.notes, THREAD.with(|thread| *thread));
        let (at, length, step) = (micros(trace.began, began), micros(began, ended), STEP.load(Ordering::Relaxed));
        trace.write(&format!(
            "{{\"name\":\"{name}\",\"ph\":\"X\",\"pid\":1,\"tid\":{thread},\"ts\":{at:.3},\"dur\":{length:.3},\
             \"args\":{{\"step\":{step}{notes}}}}}"
        ));
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    /// One test, because a process has one trace.
    #[test]
    fn a_trace_is_json_and_an_empty_one_leaves_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        drop(span("before the trace"));
        start(&path).unwrap();
        set_step(7);
        let outer = span("outer").of("what", "a \"word\"");
        drop(span("inner").with("bytes", 12));
        drop(outer);
        finish().unwrap();
        drop(span("after the trace"));
        let events: Vec<serde_json::Value> = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        let names: Vec<&str> = events.iter().map(|event| event["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["inner", "outer"]);
        assert_eq!((events[0]["args"]["bytes"].as_u64(), events[0]["args"]["step"].as_u64()), (Some(12), Some(7)));
        assert_eq!(events[1]["args"]["what"].as_str(), Some("a 'word'"));
        let of = |i: usize, key: &str| events[i][key].as_f64().unwrap();
        assert!(of(1, "ts") <= of(0, "ts") && of(0, "dur") <= of(1, "dur"), "{events:?}");
        let (whole, empty) = (std::fs::read(&path).unwrap(), folder.path().join("empty.json"));
        let error = start(&path).unwrap_err().to_string();
        assert!(error.contains("exists already") && std::fs::read(&path).unwrap() == whole, "{error}");
        start(&empty).unwrap();
        finish().unwrap();
        assert!(!empty.exists(), "a run that was refused leaves no trace");
        let error = start(&folder.path().join("none/trace.json")).unwrap_err().to_string();
        assert!(error.contains("none") && error.contains("remedy: check the path"), "{error}");
    }
}
