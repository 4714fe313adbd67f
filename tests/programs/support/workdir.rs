//! A folder in which the programs run, as at a user's prompt: paths in flags are relative to it, and the flags of a call are one text.

#[cfg(target_os = "linux")]
use super::memory_group::MemoryGroup;
use super::scenes::{self, TextModel, classic, stderr, told};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::{PlyContent, read_ply};
#[cfg(unix)]
use gsscale::page::{
    engine::open::{IoEngine, open_engine},
    folder::{protocol_files::DriveFolder, spill_dir::SpillDir},
    format::codec::Codec,
    map::opening::Opened,
    tool::reading::commit_config,
    versions::paged_store::PagedStore,
};
use gsscale::scene::columns::Columns;
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

pub const TRAIN: &str = env!("CARGO_BIN_EXE_gsscale-train");
pub const EVAL: &str = env!("CARGO_BIN_EXE_gsscale-eval");
pub const CKPT: &str = env!("CARGO_BIN_EXE_gsscale-ckpt");
pub const POSES: &str = env!("CARGO_BIN_EXE_gsscale-poses");
pub const VIEW: &str = env!("CARGO_BIN_EXE_gsscale-view");
pub const BENCH: &str = env!("CARGO_BIN_EXE_gsscale-bench");

/// The output of a program, which must have succeeded.
#[track_caller]
pub fn succeeded(output: Output) -> Output {
    assert!(output.status.success(), "{}", told(&output));
    output
}

/// A temporary folder; its scene, if it has one, is `scene`.
pub struct Workdir(TempDir);

/// The words of flags. Of a flag that is there several times the last one counts.
pub fn words(flags: &str) -> Vec<&str> {
    let mut items: Vec<Vec<&str>> = vec![Vec::new()];
    for word in flags.split_whitespace() {
        if word.starts_with("--") {
            items.push(Vec::new());
        }
        items.last_mut().unwrap().push(word);
    }
    let key = |item: &[&str]| item.first().and_then(|word| word.split('=').next()).unwrap_or_default().to_string();
    let is_last = |i: &usize| items[i + 1..].iter().all(|later| key(later) != key(&items[*i]));
    (0..items.len()).filter(is_last).flat_map(|i| items[i].clone()).collect()
}

/// The memory, MiB, that a refusal names as the least.
pub fn least_memory(said: &str) -> f64 {
    let least = said.split("give at least ").nth(1).unwrap_or_else(|| panic!("no memory is named: {said}"));
    assert_eq!(least.split(' ').nth(1).map(|unit| &unit[..3]), Some("MiB"), "{said}");
    least.split(' ').next().unwrap().parse().unwrap()
}

/// The header of a PLY, with its last line, and its rows.
pub fn split_ply(bytes: &[u8]) -> (&str, &[u8]) {
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    (std::str::from_utf8(&bytes[..end]).unwrap(), &bytes[end..])
}

/// The rows of a PLY without lists as bytes, sorted.
pub fn sorted_rows(ply: &[u8]) -> Vec<&[u8]> {
    let (header, bytes) = split_ply(ply);
    let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().parse::<usize>().unwrap();
    let mut rows: Vec<&[u8]> = bytes.chunks(bytes.len() / count).collect();
    rows.sort_unstable();
    assert_eq!(rows.len(), count);
    rows
}

pub fn says(text: &str, words: &[&str]) {
    for word in words {
        assert!(text.contains(word), "'{word}' is not in: {text}");
    }
}

impl Workdir {
    pub fn new() -> Workdir {
        Workdir(TempDir::new().unwrap())
    }

    /// With a city of `views` photos of `width` x `height`.
    pub fn city(views: u32, width: u32, height: u32, points: u32) -> Workdir {
        let work = Workdir::new();
        scenes::city(work.0.path(), views, width, height, points);
        work
    }

    /// With a city of which a view sees less than half.
    pub fn wide_city(points: u32) -> Workdir {
        Workdir::city_of(30, [48, 36], points, 12)
    }

    /// With a city of this size and of these many blocks.
    pub fn city_of(views: u32, [width, height]: [u32; 2], points: u32, blocks: u32) -> Workdir {
        let work = Workdir::new();
        let size = CityOptions { seed: 5, views, width, height, points, ..CityOptions::default() };
        write_city(&work.scene(), &CityOptions { blocks: Some(blocks), supersample: 1, ..size }, &|_, _| {}).unwrap();
        work
    }

    pub fn small_model() -> (Workdir, TextModel) {
        let work = Workdir::city(12, 96, 64, 400);
        let model = TextModel::of(&work.scene());
        model.write(&work.scene());
        (work, model)
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn scene(&self) -> PathBuf {
        self.path("scene")
    }

    /// The photos of the scene, sorted by name.
    pub fn photos(&self) -> Vec<PathBuf> {
        let photos = std::fs::read_dir(self.path("scene/images")).unwrap();
        let mut photos: Vec<PathBuf> = photos.map(|entry| entry.unwrap().path()).collect();
        photos.sort();
        photos
    }

    pub fn command(&self, program: &str, flags: &str) -> Command {
        let (mut command, flags) = (Command::new(program), words(flags));
        // A program that Cargo has started says how to install the others.
        command.args(&flags).current_dir(self.0.path()).env_remove("CARGO");
        if program == TRAIN {
            command.args(classic(&flags));
        }
        command
    }

    /// The trainer under a limit of the shell (`ulimit`), where the system has such limits.
    pub fn limited(&self, limit: &str, flags: &str) -> Command {
        if cfg!(not(unix)) {
            return self.command(TRAIN, flags);
        }
        let mut command = Command::new("sh");
        let (trainer, flags) = (format!("ulimit {limit}; exec \"$0\" \"$@\""), words(flags));
        command.args(["-c", &trainer, TRAIN]).args(&flags).args(classic(&flags)).current_dir(self.0.path());
        command
    }

    /// Runs the trainer in a group with a limit on memory.
    #[cfg(target_os = "linux")]
    pub fn within(&self, group: &MemoryGroup, program: &str, flags: &str) -> Output {
        let command = self.command(program, flags);
        let args: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
        group.command(Path::new(program), &args).current_dir(self.0.path()).output().unwrap()
    }

    pub fn output(&self, program: &str, flags: &str) -> Output {
        self.command(program, flags).output().unwrap()
    }

    /// Runs a program, which must succeed.
    pub fn succeeds(&self, program: &str, flags: &str) -> Output {
        let output = self.output(program, flags);
        assert!(output.status.success(), "{flags}: {}", told(&output));
        output
    }

    /// What a program that succeeds prints.
    pub fn printed(&self, program: &str, flags: &str) -> String {
        String::from_utf8(self.succeeds(program, flags).stdout).unwrap()
    }

    /// Runs the trainer, which must succeed; returns stderr.
    pub fn train(&self, flags: &str) -> String {
        stderr(&self.succeeds(TRAIN, flags))
    }

    /// Trains `scene` into `out` quietly, on the CPU unless the flags say otherwise; returns the Gaussians.
    pub fn run(&self, out: &str, flags: &str) -> Vec<u8> {
        self.train(&format!("scene --out {out} --quiet --device cpu {flags}"));
        self.ply(out)
    }

    /// Runs the trainer, which must end with an error that has all of `words` and a remedy; returns stderr.
    pub fn refuses(&self, flags: &str, words: &[&str]) -> String {
        self.refuses_with(TRAIN, flags, words)
    }

    /// Like [`Workdir::refuses`], for another program.
    pub fn refuses_with(&self, program: &str, flags: &str, words: &[&str]) -> String {
        let output = self.output(program, flags);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{flags}: {said}");
        says(&said, &[words, &["remedy"]].concat());
        assert!(!said.contains("panicked"), "{said}");
        said
    }

    /// What a program that succeeds prints as JSON, and what it says.
    pub fn json_and_words(&self, program: &str, flags: &str) -> (Value, String) {
        let output = self.succeeds(program, flags);
        (serde_json::from_slice(&output.stdout).unwrap(), stderr(&output))
    }

    pub fn json_of(&self, program: &str, flags: &str) -> Value {
        self.json_and_words(program, flags).0
    }

    /// The PSNR of the held-out photos that `gsscale-eval` finds.
    pub fn eval_psnr(&self, flags: &str) -> f64 {
        self.json_of(EVAL, flags)["test"]["psnr"].as_f64().unwrap()
    }

    pub fn begin(&self, flags: &str) -> Running<'_> {
        Running::spawn(self, &mut self.command(TRAIN, flags))
    }

    pub fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    pub fn text(&self, name: &str) -> String {
        String::from_utf8(self.bytes(name)).unwrap()
    }

    pub fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.bytes(name)).unwrap()
    }

    pub fn exists(&self, name: &str) -> bool {
        self.path(name).exists()
    }

    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// Removes a folder, if it is there.
    pub fn remove(&self, name: &str) {
        if self.exists(name) {
            std::fs::remove_dir_all(self.path(name)).unwrap();
        }
    }

    pub fn ply(&self, out: &str) -> Vec<u8> {
        self.bytes(&format!("{out}/point_cloud.ply"))
    }

    /// The Gaussians of a PLY, and its frame.
    pub fn gaussians(&self, ply: &str) -> (Columns, SceneMeta) {
        let PlyContent::Gaussians { columns, meta } = read_ply(&self.path(ply)).unwrap() else {
            panic!("{ply} has points")
        };
        (columns, meta)
    }

    pub fn summary(&self, out: &str) -> Value {
        self.json(&format!("{out}/summary.json"))
    }

    pub fn count(&self, out: &str, key: &str) -> u64 {
        let summary = self.summary(out);
        summary[key].as_u64().unwrap_or_else(|| panic!("{key}: {summary}"))
    }

    pub fn psnr(&self, out: &str) -> f64 {
        self.summary(out)["test"]["psnr"].as_f64().unwrap()
    }

    /// The lines of metrics.jsonl of a run.
    pub fn metrics(&self, out: &str) -> Vec<Value> {
        let lines = self.text(&format!("{out}/metrics.jsonl"));
        lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// A number of each line of metrics.jsonl.
    pub fn logged(&self, out: &str, key: &str) -> Vec<u64> {
        self.metrics(out).iter().map(|line| line[key].as_u64().unwrap_or_else(|| panic!("{key}: {line}"))).collect()
    }

    /// Lines of metrics.jsonl so far.
    pub fn lines(&self, out: &str) -> usize {
        std::fs::read_to_string(self.path(out).join("metrics.jsonl")).map_or(0, |text| text.lines().count())
    }

    /// The files of a run by their paths, with the bytes of those that tell no time.
    pub fn results(&self, out: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut files = self.files(out);
        for name in ["report.html", "summary.json", "metrics.jsonl", "config.toml", "pages.json"] {
            files.entry(name.into()).and_modify(Vec::clear);
        }
        files
    }

    /// Whether a line of the metrics of a run tells of a commit.
    pub fn has_committed(&self, out: &str) -> bool {
        let metrics = std::fs::read_to_string(self.path(out).join("metrics.jsonl")).unwrap_or_default();
        let commits = |line: &str| serde_json::from_str::<Value>(line).ok()?["commits"].as_u64();
        metrics.lines().filter_map(commits).any(|commits| commits > 0)
    }

    /// Every file below a folder by its path in it, with its bytes. The lock of a store, which names the last process, is left out.
    pub fn files(&self, name: &str) -> BTreeMap<PathBuf, Vec<u8>> {
        let (top, mut files, mut folders) = (self.path(name), BTreeMap::new(), vec![self.path(name)]);
        while let Some(folder) = folders.pop() {
            for path in std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()) {
                if path.is_dir() {
                    folders.push(path);
                } else if path.file_name().is_some_and(|name| name != "LOCK") {
                    files.insert(path.strip_prefix(&top).unwrap().to_path_buf(), std::fs::read(&path).unwrap());
                }
            }
        }
        files
    }
}

/// A trainer at work.
pub struct Running<'a> {
    work: &'a Workdir,
    pub child: Child,
    /// What it has said so far, as far as a test has listened.
    said: String,
}

impl<'a> Running<'a> {
    pub fn spawn(work: &'a Workdir, command: &mut Command) -> Running<'a> {
        Running {
            work,
            child: command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap(),
            said: String::new(),
        }
    }

    /// Listens until the run says `words`; fails the test if it ends before. Returns all that it has said.
    pub fn says(&mut self, words: &str) -> &str {
        let mut bytes = [0; 4096];
        while !self.said.contains(words) {
            match self.child.stderr.as_mut().unwrap().read(&mut bytes).unwrap() {
                0 => panic!("'{words}' was not said: {}", self.said),
                n => self.said.push_str(&String::from_utf8_lossy(&bytes[..n])),
            }
        }
        &self.said
    }

    /// Waits until the run in `out` has logged more than `lines` lines, or has ended.
    pub fn after_lines(self, out: &str, lines: usize) -> Running<'a> {
        let work = self.work;
        self.once(|| work.lines(out) > lines)
    }

    /// Waits until something is so, or the run has ended.
    pub fn once(self, is_so: impl Fn() -> bool) -> Running<'a> {
        self.once_quickly(|| {
            let is_now = is_so();
            if !is_now {
                std::thread::sleep(Duration::from_millis(2));
            }
            is_now
        })
    }

    /// Like [`Running::once`], without a pause between two looks.
    pub fn once_quickly(mut self, is_so: impl Fn() -> bool) -> Running<'a> {
        let started = Instant::now();
        while !is_so() && self.child.try_wait().unwrap().is_none() {
            assert!(started.elapsed() < Duration::from_secs(240), "the run does not get on");
        }
        self
    }

    /// Sends a signal to a run that must still go on.
    pub fn signal(self, name: &str) -> Running<'a> {
        if send(&self.child, name) {
            return self;
        }
        panic!("the run ended before the signal: {}", stderr(&self.end()))
    }

    pub fn end(self) -> Output {
        self.child.wait_with_output().unwrap()
    }

    /// Waits for an end with this code; returns stderr.
    pub fn ends(mut self, code: i32) -> String {
        let said = std::mem::take(&mut self.said);
        let output = self.end();
        let said = said + &stderr(&output);
        assert_eq!(output.status.code(), Some(code), "{said}");
        said
    }

    /// Asks a run that must still go on to stop, as Ctrl-C does; returns stderr.
    pub fn stop(self) -> String {
        self.signal("INT").ends(130)
    }

    /// Ends the run by kill -9, if it has not ended. Whether it was killed.
    pub fn kill(mut self) -> bool {
        let _ = self.child.kill();
        self.end().status.code().is_none()
    }
}

/// Sends a signal; false if the process has ended.
pub fn send(child: &Child, signal: &str) -> bool {
    Command::new("kill").args([&format!("-{signal}"), &child.id().to_string()]).status().unwrap().success()
}

/// The store of a run that has ended, opened as the trainer opens it.
#[cfg(unix)]
pub fn open_store(folder: &Path) -> (SpillDir, Opened, PagedStore) {
    let spill = SpillDir::open(folder, true).unwrap();
    let opened = Opened::open(Box::new(DriveFolder::new(folder)), commit_config(spill.format().store)).unwrap();
    let engine = open_engine(IoEngine::Pread, folder, 2).unwrap().store;
    let store = opened.paged_store(engine, spill.format().layout, Codec::Raw).unwrap();
    (spill, opened, store)
}

pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy_folder(&entry.path(), &to),
            false => std::fs::copy(entry.path(), to).map(|_| ()).unwrap(),
        }
    }
}
