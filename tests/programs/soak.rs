//! Lives of runs in which much goes wrong, at random, for as long as it is told: kills and requests to stop at any moment, processes that
//! stand still, full drives of pages and of results, other budgets and threads, moved and cloned folders, earlier generations, damaged
//! copies. Every run must end with the bytes of a run that nothing disturbs, and no copy may end with others.
//!
//! `GSSCALE_SOAK_MINUTES=120 GSSCALE_SOAK_SEED=1 cargo nextest run --release --test programs --run-ignored only -E 'test(soak)' --no-capture`

use crate::matrix::{CODECS, ENGINES, FEATURES, HABITS, World, engine};
use crate::support::a_device;
use crate::support::scenes::stderr;
use crate::support::small_drive::Small;
use crate::support::workdir::{CKPT, TRAIN, copy_folder, send};
use gsscale::base::rng::{Purpose, Stream};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

#[test]
#[ignore = "runs for as long as it is told"]
fn soak() {
    let number = |name: &str, default: u64| std::env::var(name).map_or(default, |value| value.parse().unwrap());
    let (minutes, seed) = (number("GSSCALE_SOAK_MINUTES", 10), number("GSSCALE_SOAK_SEED", 1));
    let end = Instant::now() + Duration::from_secs(60 * minutes);
    let has_gpu = a_device().is_some();
    let features: Vec<_> =
        FEATURES.iter().filter(|feature| has_gpu || !feature.flags.contains("--device gpu")).collect();
    let (mut worlds, mut counts) = (BTreeMap::new(), BTreeMap::new());
    let mut lives = 0;
    while Instant::now() < end {
        let mut dice = Dice(Stream::new(seed, Purpose::Test, lives, 0));
        let feature = dice.pick(&features);
        let world = worlds.entry(feature.name).or_insert_with(|| SoakWorld::of(World::of(feature)));
        println!("life {lives} of seed {seed}: {}", feature.name);
        Life::begin(world, dice, &mut counts).live();
        lives += 1;
    }
    println!("{lives} runs ended with the bytes of undisturbed runs, after {counts:?}");
    assert!(lives > 0, "no run ended");
}

struct Dice(Stream);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        (self.0.next_u64() % n as u64) as usize
    }

    fn pick<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }

    fn is(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }

    /// At most `seconds`, mostly less.
    fn pause(&mut self, seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds * self.0.uniform() * self.0.uniform())
    }
}

/// A scene with its undisturbed run, and two drives that can be full.
struct SoakWorld {
    // Unmounted before their folder is removed.
    pages_drive: Option<Small>,
    results_drive: Option<Small>,
    seconds: f64,
    world: World,
}

impl SoakWorld {
    fn of(world: World) -> SoakWorld {
        let seconds = world.work.summary("alone")["train_seconds"].as_f64().unwrap();
        let mount = |name: &str| Small::mount(&world.work.path(name), 256 << 20);
        SoakWorld { pages_drive: mount("pages"), results_drive: mount("results"), seconds, world }
    }
}

/// One run, from its first step to its last, however many processes that takes.
struct Life<'a> {
    world: &'a SoakWorld,
    dice: Dice,
    counts: &'a mut BTreeMap<&'static str, u64>,
    /// The output folder, from the working folder.
    out: String,
    /// The spill directory, if the run has one.
    spill: Option<String>,
    first_command: String,
    is_on_small_drive: [bool; 2],
    /// What was done so far.
    told: Vec<String>,
}

impl<'a> Life<'a> {
    fn begin(world: &'a SoakWorld, mut dice: Dice, counts: &'a mut BTreeMap<&'static str, u64>) -> Life<'a> {
        let on_small = [&world.pages_drive, &world.results_drive].map(|drive| drive.is_some() && dice.is(0.4));
        let spill = dice.is(0.7).then(|| if on_small[0] { "pages/spill" } else { "spill" }.to_string());
        let out = if on_small[1] { "results/out" } else { "out" }.to_string();
        let flags = &world.world.flags;
        let commits = dice.pick(&["0.02", "0.1", "1", "0"]);
        let mut command = format!("{flags} --out {out} --commit-every {commits} {}", dice.pick(&HABITS));
        if let Some(spill) = &spill {
            let codec = if flags.contains("bf16") { "halves" } else { dice.pick(&CODECS[1..]) };
            let io = engine(dice.pick::<&str>(&ENGINES[1..]));
            command += &format!(" --spill-dir {spill} --io {io} --spill-codec {codec}");
        }
        let mut life = Life {
            world,
            dice,
            counts,
            out,
            spill,
            first_command: String::new(),
            is_on_small_drive: on_small,
            told: vec![],
        };
        let budget = life.other_budget();
        life.first_command = format!("{command} {budget}");
        life
    }

    /// Threads, and frames or memory, of the next process.
    fn other_budget(&mut self) -> String {
        let alone = &self.world.world.alone;
        let frames =
            *self.dice.pick(&[0, alone.pages, alone.pinned, alone.pinned * 2 / 3, (alone.pinned / 3).max(2), 2]);
        let threads = 1 + self.dice.below(3);
        // A run that begins with frames and without a drive makes no commits, also where it begins again.
        match self.spill.is_some() || self.store().is_some() && !self.generations().is_empty() {
            true => format!("--threads {threads} --frames {frames}"),
            false => format!("--threads {threads}"),
        }
    }

    fn live(mut self) {
        for _ in 0..24 {
            if self.process(true) {
                return self.ends_as_undisturbed(&self.out, self.spill.as_deref());
            }
            for _ in 0..self.dice.below(3) {
                self.change();
            }
        }
        assert!(self.process(false), "{self}: the run does not end");
        self.ends_as_undisturbed(&self.out, self.spill.as_deref());
    }

    fn count(&mut self, what: &'static str) {
        *self.counts.entry(what).or_default() += 1;
        self.told.push(what.into());
    }

    fn path(&self, name: &str) -> PathBuf {
        self.world.world.work.path(name)
    }

    /// One process of the run, disturbed or not; whether it did the last step.
    fn process(&mut self, is_disturbed: bool) -> bool {
        let work = &self.world.world.work;
        let flags = match self.path(&self.out).join("config.toml").exists() {
            true => {
                let spill = self.spill.as_ref().map_or(String::new(), |spill| format!("--spill-dir {spill}"));
                let budget = self.other_budget();
                format!("--resume {} --quiet {spill} {budget}", self.out)
            }
            false => self.first_command.clone(),
        };
        self.told.push(flags.clone());
        let log = File::create(work.path("log")).unwrap();
        let mut child = work.command(TRAIN, &flags).stdout(Stdio::null()).stderr(log).spawn().unwrap();
        let mut is_full = false;
        if is_disturbed {
            std::thread::sleep(self.dice.pause(2.0 * self.world.seconds));
            is_full = self.disturb(&mut child);
        }
        let started = Instant::now();
        let code = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break status.code();
            }
            if started.elapsed() > Duration::from_secs(300) {
                let _ = child.kill();
                panic!("{self}: the process hangs");
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        let said = work.text("log");
        self.told.push(format!("ended with {code:?}: {said}"));
        assert!(!said.contains("panicked"), "{self}");
        match code {
            Some(0) => true,
            None | Some(130 | 143) => false,
            Some(1) if is_full && said.contains("remedy") => false,
            _ => panic!("{self}: no such end was asked for"),
        }
    }

    /// Does one thing to a process. Whether a drive was full.
    fn disturb(&mut self, child: &mut Child) -> bool {
        let seconds = self.world.seconds;
        match self.dice.below(10) {
            0..3 => {
                self.count("kill");
                let _ = child.kill();
            }
            3..5 => {
                self.count("stop");
                send(child, self.dice.pick::<&str>(&["INT", "TERM"]));
            }
            5 => {
                self.count("stop, then kill");
                send(child, "INT");
                std::thread::sleep(self.dice.pause(0.3));
                let _ = child.kill();
            }
            6 => {
                self.count("stand still");
                send(child, "STOP");
                std::thread::sleep(self.dice.pause(1.0));
                send(child, "CONT");
            }
            _ => return self.fill(child, seconds),
        }
        false
    }

    /// Fills a drive of the run for a while.
    fn fill(&mut self, child: &mut Child, seconds: f64) -> bool {
        let world = self.world;
        let which = self.dice.below(2);
        let drive = match which {
            0 if self.spill.is_some() => &world.pages_drive,
            0 => &None,
            _ => &world.results_drive,
        };
        let Some(drive) = drive.as_ref().filter(|_| self.is_on_small_drive[which]) else { return false };
        self.count(["full drive of pages", "full drive of results"][which]);
        drive.fill(*self.dice.pick(&[0, 0, 1 << 12, 1 << 16, 1 << 18]));
        std::thread::sleep(self.dice.pause(seconds.max(0.5)));
        match self.dice.below(4) {
            0 => {
                self.count("kill on a full drive");
                let _ = child.kill();
            }
            1 => {
                self.count("stop on a full drive");
                send(child, "INT");
                std::thread::sleep(self.dice.pause(0.5));
            }
            _ => {}
        }
        drive.free();
        true
    }

    /// The store of the run, if a process has made one.
    fn store(&self) -> Option<String> {
        let store = self.spill.clone().unwrap_or_else(|| format!("{}/checkpoint", self.out));
        self.path(&store).join("FORMAT").exists().then_some(store)
    }

    fn generations(&self) -> Vec<u64> {
        let output = self.world.world.work.output(CKPT, &format!("ls {} --json", self.store().unwrap()));
        let list: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        let of = |generation: &Value| generation["generation"].as_u64();
        list["generations"].as_array().map_or(vec![], |list| list.iter().filter_map(of).collect())
    }

    /// Changes something between two processes.
    fn change(&mut self) {
        let work = &self.world.world.work;
        // Without a config, the next process begins the run again, where it was to begin.
        let Some(store) = self.store().filter(|_| self.path(&self.out).join("config.toml").exists()) else { return };
        // A process that was killed at its very end may have begun to remove the store.
        let summary = std::fs::read(self.path(&self.out).join("summary.json")).unwrap_or_default();
        if serde_json::from_slice(&summary).is_ok_and(|summary: Value| summary["finished"] == true) {
            return;
        }
        let generations = self.generations();
        match self.dice.below(8) {
            0 if self.spill.is_some() => {
                self.count("move the pages");
                // A drive of pages can be another one afterwards.
                let to = format!("spill-{}", self.told.len());
                match self.is_on_small_drive[0] {
                    true => {
                        copy_folder(&self.path(&store), &self.path(&to));
                        std::fs::remove_dir_all(self.path(&store)).unwrap();
                        self.is_on_small_drive[0] = false;
                    }
                    false => std::fs::rename(self.path(&store), self.path(&to)).unwrap(),
                }
                self.spill = Some(to);
            }
            1 if !self.is_on_small_drive[1] => {
                self.count("move the results");
                let to = format!("out-{}", self.told.len());
                std::fs::rename(self.path(&self.out), self.path(&to)).unwrap();
                self.out = to;
            }
            2 => {
                self.count("verify");
                let output = work.output(CKPT, &format!("verify {store} --deep"));
                assert!(output.status.success() || generations.is_empty(), "{self}: {}", stderr(&output));
            }
            3 if !generations.is_empty() => {
                self.count("export");
                let output = work.output(CKPT, &format!("export {store} --out exported.ply"));
                assert!(output.status.success(), "{self}: {}", stderr(&output));
            }
            4 if generations.len() > 1 => {
                self.count("earlier generation");
                let generation = self.dice.pick(&generations);
                let output = work.output(CKPT, &format!("rollback {store} {generation} --yes"));
                assert!(output.status.success(), "{self}: {}", stderr(&output));
            }
            5 if self.spill.is_some() && !generations.is_empty() => {
                self.count("go on in a clone");
                let to = format!("spill-{}", self.told.len());
                let output = work.output(CKPT, &format!("clone {store} {to}"));
                assert!(output.status.success(), "{self}: {}", stderr(&output));
                std::fs::remove_dir_all(self.path(&store)).unwrap();
                (self.spill, self.is_on_small_drive[0]) = (Some(to), false);
            }
            6 => {
                self.count("refused resume");
                let output = work.output(TRAIN, &format!("--resume {} --quiet --device no-such-card", self.out));
                assert_eq!(output.status.code(), Some(1), "{self}: {}", stderr(&output));
            }
            _ => self.damage_a_copy(&store),
        }
    }

    /// Damages a file of a copy of the store: the copy is refused with a remedy, or goes on to the same bytes.
    fn damage_a_copy(&mut self, store: &str) {
        let work = &self.world.world.work;
        copy_folder(&self.path(&self.out), &self.path("copy"));
        let in_copy = match self.spill {
            Some(_) => {
                copy_folder(&self.path(store), &self.path("copy-spill"));
                "copy-spill"
            }
            None => "copy/checkpoint",
        };
        let files: Vec<PathBuf> = files_below(&self.path(in_copy));
        let file = self.dice.pick(&files).clone();
        let what = damage(&file, &mut self.dice);
        self.count("damaged copy");
        self.told.push(format!("{what} {}", file.display()));
        let spill = self.spill.as_ref().map_or("", |_| "--spill-dir copy-spill");
        let output = work.output(TRAIN, &format!("--resume copy --quiet {spill}"));
        let said = stderr(&output);
        match output.status.code() {
            Some(0) => self.ends_as_undisturbed("copy", None),
            Some(1) if said.contains("remedy") && !said.contains("panicked") => {
                self.count("refused a damaged copy");
                let output = work.output(CKPT, &format!("salvage {in_copy} --out salvaged"));
                let said = stderr(&output);
                assert!(matches!(output.status.code(), Some(0 | 1)) && !said.contains("panicked"), "{self}: {said}");
            }
            code => panic!("{self}: the damaged copy ends with {code:?}: {said}"),
        }
        ["copy", "copy-spill", "salvaged"].iter().for_each(|folder| work.remove(folder));
    }

    /// The results in `out` are those of the undisturbed run, and no pages are left.
    fn ends_as_undisturbed(&self, out: &str, spill: Option<&str>) {
        let work = &self.world.world.work;
        assert!(work.path(out).join("metrics.jsonl").exists(), "{self}: no metrics");
        self.world.world.is_matched_by(out, &self.to_string());
        if let Some(spill) = spill {
            assert!(!work.path(spill).join("FORMAT").exists(), "{self}: pages are left over");
            work.remove(spill);
        }
        work.remove(out);
    }
}

impl std::fmt::Display for Life<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.told.join("\n  "))
    }
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let (mut files, mut folders) = (vec![], vec![folder.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            if path.is_dir() { folders.push(path) } else { files.push(path) }
        }
    }
    files.sort();
    files
}

/// Damages a file; returns how.
fn damage(path: &Path, dice: &mut Dice) -> &'static str {
    let mut file = File::options().read(true).write(true).open(path).unwrap();
    let bytes = file.metadata().unwrap().len();
    let at = dice.below(bytes.max(1) as usize) as u64;
    match dice.below(4) {
        0 => {
            drop(file);
            std::fs::remove_file(path).unwrap();
            "removed"
        }
        1 => {
            file.set_len(at).unwrap();
            "cut off"
        }
        2 => {
            let at = at / 4096 * 4096;
            file.seek(SeekFrom::Start(at)).unwrap();
            file.write_all(&vec![0; (bytes - at).min(4096) as usize]).unwrap();
            "zeros in"
        }
        _ if bytes > 0 => {
            let mut byte = [0];
            file.seek(SeekFrom::Start(at)).unwrap();
            file.read_exact(&mut byte).unwrap();
            file.seek(SeekFrom::Start(at)).unwrap();
            file.write_all(&[byte[0] ^ (1 << dice.below(8))]).unwrap();
            "flipped a bit of"
        }
        _ => "left empty",
    }
}
