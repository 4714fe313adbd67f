//! Faulty drives under a real training run. A full drive is waited for and changes no bit; a broken drive ends the run
//! and keeps its last commit; corrupted bytes are reported by name and never used.

use crate::support::faulty_engine::{Fault, Faults, FaultyEngine, Operation};
use crate::support::scenes::{classic, stderr, summary, text, train};
use crate::support::small_drive::Small;
use gsscale::base::identity::RunId;
use gsscale::checkpoint::interval::CommitEvery;
use gsscale::checkpoint::run_state::{Origin, RunIdentity};
use gsscale::config::choice::{Chosen, Device};
use gsscale::config::facts::{Resolved, write_config};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::{RunOptions, simd_path};
use gsscale::config::values::Up;
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::dataset::target_cache::TargetCache;
use gsscale::optim::method::Method;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::{CommitConfig, Commits, RESERVE_NAME};
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::page_layout::capacity_bytes;
use gsscale::schedule::order::Order;
use gsscale::train::commits::checkpoint::Checkpoint;
use gsscale::train::commits::save::save;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::signals::StopFlag;
use gsscale::train::log::progress::Progress;
use gsscale::train::log::report::MetricsLog;
use gsscale::train::run::training_loop::TrainingLoop;
use gsscale::train::start::first_scene::Start;
use gsscale::train::start::first_scene::dataset_print;
use gsscale::train::start::tiers::commit_options;
use gsscale::train::state::trainer::Trainer;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const PAGE_ROWS: u32 = 32;
/// Steps before the first commit, after which faults begin.
const FIRST_STEPS: u32 = 16;

fn config(spill: &Path) -> TrainConfig {
    TrainConfig {
        steps: 60,
        page_rows: PAGE_ROWS,
        grow_grad2d: 0.001,
        refine_start: 20,
        refine_every: 10,
        reset_every: 25,
        sh_every: 15,
        view_order: Chosen(Some(Order::Groups(4))),
        log_every: 7,
        test_every: 24,
        device: Device::Cpu,
        spill_dir: text(spill).into(),
        spill_codec: Chosen(Some(Codec::Raw)),
        commit_every: CommitEvery::Seconds(0.05),
        up: Up::Keep,
        ..TrainConfig::default()
    }
}

fn make_scene(folder: &Path) -> PathBuf {
    let scene = folder.join("scene");
    let (views, width, height, points) = (24, 64, 48, 6000);
    let city = CityOptions {
        seed: 5,
        views,
        width,
        height,
        points,
        blocks: Some(20),
        supersample: 1,
        ..CityOptions::default()
    };
    write_city(&scene, &city, &|_, _| {}).unwrap();
    scene
}

/// One scene, the result of a healthy run of it, and the most pages of a step.
struct World {
    folder: TempDir,
    scene: PathBuf,
    want: Vec<u8>,
    fewest: usize,
    /// Frames of the faulty runs.
    frames: usize,
    commit_every: f64,
    /// The run can continue without its commits.
    is_optional: bool,
    disk_full_wait: f64,
    optimizer: Method,
}

/// The end of a run on a faulty drive.
struct Life {
    result: Result<(), TrainError>,
    out: PathBuf,
}

impl World {
    fn new() -> World {
        World::of(Method::Deferred)
    }

    fn of(optimizer: Method) -> World {
        let folder = TempDir::new().unwrap();
        let scene = make_scene(folder.path());
        let mut world = World {
            folder,
            scene,
            want: Vec::new(),
            fewest: usize::MAX,
            frames: usize::MAX,
            commit_every: 0.05,
            is_optional: false,
            disk_full_wait: 30.0,
            optimizer,
        };
        let life = world.live("healthy", &Faults::new(), |_| {});
        life.result.unwrap();
        world.want = std::fs::read(Trainer::ply_path(&life.out)).unwrap();
        let pinned = std::fs::read_to_string(life.out.join("pinned")).unwrap();
        world.fewest = pinned.parse().unwrap();
        world.frames = world.fewest + 20;
        world
    }

    /// Trains with the engine behind `faults`; `plan` adds rules after the first commit.
    fn live(&self, name: &str, faults: &Faults, plan: impl FnOnce(&Faults)) -> Life {
        let out = self.folder.path().join(name);
        std::fs::create_dir(&out).unwrap();
        let result = self.train_in(&out, faults, plan);
        Life { result, out }
    }

    fn train_in(&self, out: &Path, faults: &Faults, plan: impl FnOnce(&Faults)) -> Result<(), TrainError> {
        let spill_dir = out.join("spill");
        let commit_every = CommitEvery::Seconds(self.commit_every);
        let disk_full_wait = self.disk_full_wait;
        let config = TrainConfig { optimizer: self.optimizer, commit_every, disk_full_wait, ..config(&spill_dir) };
        let start = Start::read(&self.scene, &config, None)?;
        let print = dataset_print(&start).unwrap();
        let sh_degree_start = start.sh_degree_start;
        let options = RunOptions { sh_degree_start, ..RunOptions::new(&config, start.dataset.scene_scale) };
        let layout = SlotLayout::new(capacity_bytes(PAGE_ROWS as usize, config.sh_degree), 100);
        let spill = SpillDir::create(&spill_dir, layout, false)?;
        let of_commits = CommitConfig { store: spill.format().store, cache_bytes: 1 << 20, reserve_bytes: 1 << 20 };
        let opened = Commits::create(Box::new(DriveFolder::new(&spill_dir)), of_commits)?;
        let engine = open_engine(IoEngine::Pread, &spill_dir, 4)?.store;
        let engine = Box::new(FaultyEngine::new(engine, faults.clone()));
        let store = opened.paged_store(engine, layout, Codec::Raw)?;
        let sizes = PagerConfig {
            frames: self.frames,
            prefetch_bytes: 1 << 20,
            plan_bytes: 1 << 20,
            ..PagerConfig::in_memory(PAGE_ROWS as usize, config.sh_degree)
        };
        let (dataset, scene) = start.into_pages(Pager::new(sizes, store), &options, &config, None)?;
        let mut trainer = Trainer::of_scene(scene, &dataset, Box::new(CpuRenderer::new()), options);
        let resolved = Resolved {
            version: String::new(),
            run: RunId::UNKNOWN,
            scene: self.scene.clone(),
            simd: simd_path(&config).name().to_string(),
            threads: 1,
            device: trainer.renderer.device(),
            train_views: 0,
            test_views: 0,
            gaussians: 0,
            origin: [0.0; 3],
            scale: 1.0,
            scene_scale: 1.0,
            made_spill_dir: false,
        };
        write_config(&out.join("config.toml"), &config, &resolved)?;
        let mut checkpoint = Checkpoint::new(opened.commits, &spill_dir, commit_options(&config));
        checkpoint.set_optional(self.is_optional);
        checkpoint.fill_reserve()?;
        assert!(spill_dir.join(RESERVE_NAME).exists());
        let (simd, text) = (resolved.simd, toml::to_string(&config).unwrap());
        checkpoint.set_origin(Origin {
            config: text,
            simd,
            sh_degree_start,
            dataset: print,
            run: RunIdentity::default(),
        });
        let mut metrics = MetricsLog::create(&out.join("metrics.jsonl"))?;
        let targets = TargetCache::new(&dataset.views, 1 << 26, 1)?;
        for _ in 0..FIRST_STEPS {
            trainer.step(&dataset, &targets)?;
        }
        checkpoint.commit(&mut trainer, &mut metrics)?;
        plan(faults);
        let (mut progress, stop) = (Progress::new(config.steps, true), StopFlag::default());
        let looped = TrainingLoop {
            trainer: &mut trainer,
            dataset: &dataset,
            targets: &targets,
            out,
            metrics: &mut metrics,
            progress: &mut progress,
            stop: &stop,
            checkpoint: Some(&mut checkpoint),
            live: None,
            costs: Default::default(),
        }
        .run();
        if let Err(error) = looped {
            self.after_failure(out, &mut trainer, &dataset, &checkpoint, &error);
            return Err(error);
        }
        save(&mut trainer, &dataset, &Trainer::ply_path(out))?;
        let report = checkpoint.report();
        assert!(
            self.is_optional
                || report.commits > 1 && report.commit_loss_seconds > 0.0 && report.commit_overhead_percent <= 100.0
        );
        std::fs::write(out.join("pinned"), trainer.scene.pager.stats().pinned_max.to_string()).unwrap();
        Ok(())
    }

    /// A step that failed after its first update leaves nothing that may be exported, and completes the cut before it. With
    /// commits as often as possible, a cut is begun after every second step at least; a failed write gives it up.
    fn after_failure(
        &self,
        out: &Path,
        trainer: &mut Trainer,
        dataset: &Dataset,
        checkpoint: &Checkpoint,
        error: &TrainError,
    ) {
        if !matches!(error, TrainError::Torn { .. }) {
            return;
        }
        let path = out.join("torn.ply");
        let refused = save(trainer, dataset, &path).expect_err("pages of two steps are no result").to_string();
        assert!(refused.contains("failed half-way") && refused.contains("--resume") && !path.exists(), "{refused}");
        let (step, last) = (trainer.steps_done(), checkpoint.last_step().unwrap());
        let is_read = error.to_string().contains("cannot be read");
        assert!(
            last + if is_read { 1 } else { 2 } >= step,
            "torn in step {step}, committed up to step {last}: {error}"
        );
    }

    /// Resumes the run in `out` with the real program on a healthy drive, and compares its bytes.
    fn goes_on(&self, out: &Path, what: &str) {
        let output = train(&["--resume", text(out), "--frames", &(self.fewest + 30).to_string(), "--quiet"]);
        assert!(output.status.success(), "{what}: {}", stderr(&output));
        assert!(std::fs::read(Trainer::ply_path(out)).unwrap() == self.want, "{what}: the scene is another");
    }
}

#[test]
fn a_full_drive_is_waited_for_and_changes_no_bit() {
    let world = World::new();
    let full = Fault::Error(ErrorKind::StorageFull);
    for (i, (on, after, calls)) in [
        (Operation::Write, 0, 1),
        (Operation::Write, 37, 4),
        (Operation::Write, 150, 40),
        (Operation::Write, 301, 2),
        (Operation::Create, 0, 3),
    ]
    .into_iter()
    .enumerate()
    {
        let faults = Faults::new();
        let life = world.live(&format!("full-{i}"), &faults, |faults| {
            let first = faults.count(on) + after;
            (first..first + calls).for_each(|n| faults.add(on, n, false, full));
        });
        life.result.unwrap_or_else(|error| panic!("case {i}: {error}"));
        assert!(faults.count(on) > after, "case {i}: nothing failed");
        assert!(std::fs::read(Trainer::ply_path(&life.out)).unwrap() == world.want, "case {i}: the scene is another");
    }
}

#[test]
fn a_drive_that_fails_ends_the_run_and_its_last_commit_stands() {
    let world = World::new();
    let io = Fault::Error(ErrorKind::Other);
    let cases = [
        (Operation::Write, 3, io),
        (Operation::Write, 200, io),
        (Operation::Write, 11, Fault::Short),
        (Operation::Sync, 0, io),
        (Operation::Sync, 2, io),
        (Operation::Read, 5, io),
        (Operation::Read, 60, Fault::Short),
        (Operation::Read, 20, Fault::FlipBit(50_000)),
        (Operation::Read, 33, Fault::Torn),
    ];
    for (i, (on, after, fault)) in cases.into_iter().enumerate() {
        let life = world.live(&format!("broken-{i}"), &Faults::new(), |faults| {
            faults.add(on, faults.count(on) + after, true, fault);
        });
        let error = life.result.expect_err("the drive fails for ever").to_string();
        let names = match (on, fault) {
            (Operation::Write, _) => ["writing page", "check the drive"],
            (Operation::Read, Fault::FlipBit(_) | Fault::Torn) => ["is damaged", "seg-"],
            (Operation::Read, _) => ["cannot be read", "seg-"],
            _ => ["could not make writes durable", "check the drive"],
        };
        assert!(names.iter().all(|name| error.contains(name)), "case {i}: {error}");
        assert!(error.contains("remedy"), "case {i}: {error}");
        world.goes_on(&life.out, &format!("case {i}"));
    }
}

/// Views of several batches, so that the faults come in the pass in, between the passes, and in the pass out.
#[test]
fn a_drive_that_fails_in_either_pass_loses_one_step_at_most() {
    let mut world = World::new();
    (world.frames, world.commit_every) = (world.fewest / 3, 1e-9);
    // Whether the steps were torn.
    let case = |on: Operation, i: u64| {
        let name = format!("passes-{}-{i}", if on == Operation::Read { "read" } else { "write" });
        let life = world.live(&name, &Faults::new(), |faults| {
            faults.add(on, faults.count(on) + 5 + 61 * (i % 7) + 9 * (i / 7), true, Fault::Error(ErrorKind::Other));
        });
        let error = life.result.expect_err("the drive fails for ever");
        world.goes_on(&life.out, &name);
        matches!(error, TrainError::Torn { .. })
    };
    // Which pass the fault meets is a matter of timing: some two of seven reads are those of the pass out. So there are more
    // cases, if need be, until one was.
    let reads: Vec<bool> = (0..7).map(|i| case(Operation::Read, i)).collect();
    assert!(reads.contains(&true) || (7..40).any(|i| case(Operation::Read, i)), "no fault met the pass out");
    assert!(reads.contains(&false) || (7..40).any(|i| !case(Operation::Read, i)), "no fault met the pass in");
    // A failed write is left to the next step while clean pages can be evicted.
    let writes: Vec<bool> = (0..7).map(|i| case(Operation::Write, i)).collect();
    assert!(writes.contains(&false), "each of 7 failed writes tore its step");
}

#[test]
fn transient_io_errors_do_not_change_results() {
    let world = World::new();
    let life = world.live("once", &Faults::new(), |faults| {
        let reads = faults.count(Operation::Read);
        let ways = [Fault::Error(ErrorKind::Other), Fault::Short, Fault::FlipBit(70_001), Fault::Torn];
        // The faults lie further apart than transfers in flight, so that the second try of a read succeeds.
        (0..16).for_each(|i| faults.add(Operation::Read, reads + 5 + 150 * i, false, ways[i as usize % 4]));
        faults.reorder(3);
    });
    life.result.unwrap();
    assert!(std::fs::read(Trainer::ply_path(&life.out)).unwrap() == world.want);
}

/// A drive that silently flips a bit of a page or writes half of it.
#[test]
fn a_page_that_is_not_what_was_written_is_named_and_never_used() {
    let world = World::new();
    for (i, fault) in [Fault::FlipBit(60_000), Fault::Torn, Fault::Lost].into_iter().enumerate() {
        let life = world.live(&format!("decay-{i}"), &Faults::new(), |faults| {
            let first = faults.count(Operation::Write);
            (first..first + 400).for_each(|n| faults.add(Operation::Write, n, false, fault));
        });
        let error = life.result.expect_err("damaged pages are read again").to_string();
        assert!(["is damaged", "page ", "generation", "seg-", "remedy"].iter().all(|w| error.contains(w)), "{error}");
        assert!(!Trainer::ply_path(&life.out).exists(), "nothing is exported from damaged pages");
    }
}

fn args<'a>(scene: &'a Path, out: &'a Path, spill: &'a Path) -> Vec<&'a str> {
    let mut args = vec![text(scene), "--out", text(out), "--spill-dir", text(spill), "--spill-codec", "raw"];
    args.extend(["--steps", "60", "--page-rows", "32", "--refine-start", "1000", "--max-gaussians", "7000"]);
    args.extend(["--view-order", "groups:4", "--test-every", "24", "--device", "cpu", "--log-every", "7"]);
    args.extend(classic(&args));
    args
}

/// A drive with room for the pages once, but not for the versions of two commits.
fn small_drive(folder: &Path) -> Option<Small> {
    let capacity = capacity_bytes(32, 3);
    // Pages of up to 7,000 rows, filled to 70 percent.
    let segment = SlotLayout::new(capacity, 7000 / 22 + 1).segment_bytes();
    Small::mount(folder, segment + segment / 2 + (4 << 20))
}

/// The space needed is known before the first write; pages written by the import count once.
#[test]
fn a_drive_is_refused_only_if_it_is_too_small_and_at_once() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let Some(drive) = small_drive(&folder.path().join("drive")) else { return };
    let (out, spill) = (folder.path().join("out"), drive.0.join("spill"));
    // The import writes the pages beyond the frames: more than the drive has free afterwards.
    let mut few = args(&scene, &out, &spill);
    let steps = few.iter().position(|arg| *arg == "60").unwrap();
    few[steps] = "2";
    few.extend(["--frames", "200"]);
    let output = train(&few);
    assert!(output.status.success(), "{}", stderr(&output));
    drive.resize(4 << 20);
    let output = train(&[&few[..], &["--overwrite"]].concat());
    let said = stderr(&output);
    assert!(!output.status.success() && said.contains("the drive has") && said.contains("free space on it"), "{said}");
    assert!(!spill.exists() && Trainer::ply_path(&out).exists(), "it took something away or left something behind");
}

#[test]
fn a_really_full_drive_pauses_the_run_until_there_is_space() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let (alone, out) = (folder.path().join("alone"), folder.path().join("out"));
    let elsewhere = folder.path().join("elsewhere");
    let output = train(&[&args(&scene, &alone, &elsewhere)[..], &["--quiet"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let Some(drive) = small_drive(&folder.path().join("drive")) else { return };
    let spill = drive.0.join("spill");
    let more = ["--commit-every", "0.02", "--disk-full-wait", "120"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_gsscale-train"))
        .args([&args(&scene, &out, &spill)[..], &more].concat())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let said = Arc::new(Mutex::new(String::new()));
    let (mut pipe, into) = (child.stderr.take().unwrap(), Arc::clone(&said));
    let reader = std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        while let Ok(n @ 1..) = pipe.read(&mut bytes) {
            into.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..n]));
        }
    });
    let (began, mut was_paused) = (Instant::now(), false);
    while !was_paused && child.try_wait().unwrap().is_none() && began.elapsed() < Duration::from_secs(300) {
        was_paused = said.lock().unwrap().contains("paused:");
        std::thread::sleep(Duration::from_millis(20));
    }
    let before = said.lock().unwrap().clone();
    assert!(was_paused, "{before}");
    std::thread::sleep(Duration::from_millis(300));
    assert!(child.try_wait().unwrap().is_none(), "it waits");
    drive.resize(200 << 20);
    let status = child.wait().unwrap();
    reader.join().unwrap();
    let said = said.lock().unwrap().clone();
    assert!(status.success(), "{said}");
    for words in ["No space", "needs", "free", "--disk-full-wait", "training goes on"] {
        assert!(said.contains(words), "{words} in: {said}");
    }
    let ply = |out: &Path| std::fs::read(Trainer::ply_path(out)).unwrap();
    assert!(ply(&out) == ply(&alone), "waiting changed the scene");
    assert!(summary(&out)["commits"].as_u64().unwrap() > 1 && summary(&out)["commit_interval"] == 0.02);
}

/// The whole run is in memory: where its results have room, a drive that stays full for commits costs these and nothing else.
#[test]
fn a_run_in_memory_goes_on_when_the_drive_of_its_commits_is_full() {
    loses_commits_alone(World::new());
}

/// Its steps change more rows after those of their view.
#[test]
fn so_does_a_run_in_memory_that_updates_every_row() {
    loses_commits_alone(World::of(Method::Dense));
}

fn loses_commits_alone(mut world: World) {
    (world.fewest, world.frames, world.is_optional) = (usize::MAX, usize::MAX, true);
    world.disk_full_wait = 0.2;
    for (i, (on, after, calls)) in [(Operation::Write, 0, 100_000), (Operation::Write, 37, 30)].into_iter().enumerate()
    {
        let faults = Faults::new();
        let life = world.live(&format!("memory-{i}"), &faults, |faults| {
            let first = faults.count(on) + after;
            (first..first + calls).for_each(|n| faults.add(on, n, false, Fault::Error(ErrorKind::StorageFull)));
        });
        life.result.unwrap_or_else(|error| panic!("case {i}: {error}"));
        assert!(faults.count(on) > after, "case {i}: nothing failed");
        assert!(std::fs::read(Trainer::ply_path(&life.out)).unwrap() == world.want, "case {i}: the scene is another");
    }
}

#[test]
fn a_drive_that_stays_full_stops_the_run_which_can_go_on() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let (alone, out) = (folder.path().join("alone"), folder.path().join("out"));
    let elsewhere = folder.path().join("elsewhere");
    let output = train(&[&args(&scene, &alone, &elsewhere)[..], &["--quiet"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let Some(drive) = small_drive(&folder.path().join("drive")) else { return };
    let spill = drive.0.join("spill");
    let more = ["--commit-every", "0.02", "--disk-full-wait", "0.2", "--quiet"];
    let output = train(&[&args(&scene, &out, &spill)[..], &more].concat());
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for words in ["is full: it needs", "the commit after step", "remedy: free space", "gsscale-train --resume"] {
        assert!(said.contains(words), "{words} in: {said}");
    }
    drive.resize(200 << 20);
    let output = train(&["--resume", text(&out), "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let ply = |out: &Path| std::fs::read(Trainer::ply_path(out)).unwrap();
    assert!(ply(&out) == ply(&alone), "the scene is another");
}

#[test]
fn few_open_files_are_enough_and_when_commits_happen_changes_no_bit() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let plys: Vec<Vec<u8>> = [("auto", "64"), ("0", "1024"), ("0.01", "1024"), ("3600", "1024")]
        .into_iter()
        .map(|(every, files)| {
            let (out, spill) = (folder.path().join(format!("out-{every}")), folder.path().join("spill"));
            let more = ["--commit-every", every, "--quiet"];
            let output = Command::new("sh")
                .args(["-c", &format!("ulimit -n {files}; exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_gsscale-train")])
                .args([&args(&scene, &out, &spill)[..], &more].concat())
                .output()
                .unwrap();
            assert!(output.status.success(), "{every}: {}", stderr(&output));
            std::fs::read(Trainer::ply_path(&out)).unwrap()
        })
        .collect();
    assert!(plys.windows(2).all(|pair| pair[0] == pair[1]));
}

/// The system sends a signal with its refusal; the process must not end without a message. The refusal counts as
/// missing space.
#[test]
fn a_limit_on_the_size_of_files_is_an_error_that_names_the_file() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let (out, spill) = (folder.path().join("out"), folder.path().join("spill"));
    let output = Command::new("sh")
        .args(["-c", "ulimit -f 8000; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_gsscale-train")])
        .args([&args(&scene, &out, &spill)[..], &["--commit-every", "0.02", "--disk-full-wait", "0.1"]].concat())
        .output()
        .unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(["paused:", "seg-", "File too large", "remedy"].iter().all(|word| said.contains(word)), "{said}");
    assert!(Trainer::ply_path(&out).exists() && !spill.exists(), "what was trained is there, nothing was committed");
}

/// Files of `--save-every` are not needed to continue.
#[test]
fn a_drive_without_room_for_a_saved_ply_costs_that_file_alone() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let out = folder.path().join("out");
    let output = Command::new("sh")
        .args(["-c", "ulimit -f 1000; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_gsscale-train")])
        .args([text(&scene), "--out", text(&out), "--steps", "30", "--save-every", "10", "--commit-every", "0"])
        .args(["--device", "cpu", "--test-every", "24", "--log-every", "7", "--quiet", "--disk-full-wait", "0.2"])
        .output()
        .unwrap();
    let said = stderr(&output);
    assert!(
        said.contains("point_cloud_000010.ply is not written") && said.contains("point_cloud_000020.ply"),
        "{said}"
    );
    let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    assert!(metrics.lines().last().unwrap().starts_with("{\"step\":30,"), "all steps were done: {metrics}");
}

/// The drive of the results is full and the drive of the pages is not: the run names and waits for the drive of the
/// results.
#[test]
fn a_full_drive_of_results_is_named_and_costs_no_reserve() {
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let Some(drive) = Small::mount(&folder.path().join("results"), 4 << 20) else { return };
    let (out, spill) = (drive.0.join("out"), folder.path().join("spill"));
    let mut flags = args(&scene, &out, &spill);
    flags.extend(["--commit-every", "0.02", "--disk-full-wait", "0.2", "--quiet"]);
    for (usual, here) in [("7", "1"), ("60", "300")] {
        let at = flags.iter().position(|arg| *arg == usual).unwrap();
        flags[at] = here;
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_gsscale-train"));
    let command = command.args(&flags);
    let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let began = Instant::now();
    let commits = |line: &str| serde_json::from_str::<serde_json::Value>(line).ok()?["commits"].as_u64();
    let metrics = || std::fs::read_to_string(out.join("metrics.jsonl")).unwrap_or_default();
    while !metrics().lines().filter_map(commits).any(|commits| commits > 0) {
        assert!(began.elapsed() < Duration::from_secs(120), "the run does not commit");
        std::thread::sleep(Duration::from_millis(1));
    }
    // A drive that is full at the beginning is refused.
    let mut other = std::fs::File::create(drive.0.join("other")).unwrap();
    while other.write_all(&[0; 4096]).is_ok() {}
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("the drive of {} is full", out.display())), "{said}");
    assert!(!said.contains("the reserve is used up") && said.contains("--resume"), "{said}");
    assert!(spill.join(RESERVE_NAME).exists());
    drive.resize(200 << 20);
    let output = train(&["--resume", text(&out), "--quiet"]);
    assert!(output.status.success(), "{}", stderr(&output));
}

/// Containers forbid io_uring with a seccomp filter; a child process inherits the filter of the thread that starts it.
#[cfg(target_os = "linux")]
#[test]
fn a_run_without_io_uring_says_so_and_trains() {
    use seccompiler::{BpfProgram, SeccompAction, SeccompFilter, apply_filter};
    const SETUP: i64 = 425;
    let folder = TempDir::new().unwrap();
    let scene = make_scene(folder.path());
    let run = std::thread::spawn(move || {
        let rules = [(SETUP, Vec::new())].into_iter().collect();
        let machine = std::env::consts::ARCH.try_into().unwrap();
        let filter = SeccompFilter::new(rules, SeccompAction::Allow, SeccompAction::Errno(1), machine);
        let program: BpfProgram = filter.unwrap().try_into().unwrap();
        apply_filter(&program).unwrap();
        let (out, spill) = (folder.path().join("out"), folder.path().join("spill"));
        let output = train(&args(&scene, &out, &spill));
        (stderr(&output), output.status.code(), summary(&out)["finished"].clone())
    });
    let (said, code, finished) = run.join().unwrap();
    assert_eq!((code, finished), (Some(0), serde_json::Value::Bool(true)), "{said}");
    assert!(said.contains("io_uring is refused here") && said.contains("by pread"), "{said}");
}
