//! Faulty drives under a real training run. A full drive is waited for and changes no bit; a broken drive ends the run
//! and keeps its last commit; corrupted bytes are reported by name and never used.

use crate::support::faulty_engine::{Fault, Faults, FaultyEngine, Operation};
use crate::support::scenes::{stderr, text};
use crate::support::small_drive::Small;
use crate::support::workdir::{Workdir, says};
use gsscale::base::identity::RunId;
use gsscale::checkpoint::interval::CommitEvery;
use gsscale::checkpoint::run_state::{Origin, RunIdentity};
use gsscale::config::file::{Resolved, TrainConfig, write_config};
use gsscale::config::limits::{RunOptions, simd_path};
use gsscale::dataset::loader::Dataset;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::optim::method::Method;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::{CommitConfig, RESERVE_NAME};
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::page_layout::capacity_bytes;
use gsscale::train::commits::checkpoint::Checkpoint;
use gsscale::train::commits::results::save;
use gsscale::train::error::TrainError;
use gsscale::train::inputs::signals::StopFlag;
use gsscale::train::log::progress::RunProgress;
use gsscale::train::log::report::MetricsLog;
use gsscale::train::run::training_loop::TrainingLoop;
use gsscale::train::start::first_scene::{Start, dataset_print};
use gsscale::train::start::tiers::commit_options;
use gsscale::train::state::trainer::Trainer;
use std::io::ErrorKind;
use std::path::Path;

const PAGE_ROWS: u32 = 32;
/// Steps before the first commit, after which faults begin.
const FIRST_STEPS: u32 = 16;

const CONFIG: &str = r#"steps = 60, page-rows = 32, grow-grad2d = 0.001, refine-start = 20, refine-every = 10, reset-every = 25,
    sh-every = 15, view-order = "groups:4", log-every = 7, test-every = 24, device = "cpu", spill-codec = "raw", up = "keep",
    export-clean = "off""#;

fn make_scene() -> Workdir {
    Workdir::city_of(24, [64, 48], 6000, 20)
}

/// One scene, the result of a healthy run of it, and the most pages of a step.
struct World {
    work: Workdir,
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

impl World {
    fn new() -> World {
        World::of(Method::Deferred)
    }

    fn of(optimizer: Method) -> World {
        let mut world = World {
            work: make_scene(),
            want: Vec::new(),
            fewest: usize::MAX,
            frames: usize::MAX,
            commit_every: 0.05,
            is_optional: false,
            disk_full_wait: 30.0,
            optimizer,
        };
        world.live("healthy", &Faults::new(), |_| {}).unwrap();
        world.want = world.work.ply("healthy");
        world.fewest = world.work.text("healthy/pinned").parse().unwrap();
        world.frames = world.fewest + 20;
        world
    }

    /// Trains into `name` with the engine behind `faults`; `plan` adds rules after the first commit.
    fn live(&self, name: &str, faults: &Faults, plan: impl FnOnce(&Faults)) -> Result<(), TrainError> {
        let out = self.work.path(name);
        std::fs::create_dir(&out).unwrap();
        self.train_in(&out, faults, plan)
    }

    /// A drive that is full for some operations from the one `after` the first commit on costs no bit.
    fn is_the_same_on_a_full_drive(&self, on: Operation, after: u64, calls: u64) {
        let (name, faults) = (format!("full-{on:?}-{after}-{calls}"), Faults::new());
        let life = self.live(&name, &faults, |faults| {
            let first = faults.count(on) + after;
            (first..first + calls).for_each(|n| faults.add(on, n, false, Fault::Error(ErrorKind::StorageFull)));
        });
        life.unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(faults.count(on) > after, "{name}: nothing failed");
        assert!(self.work.ply(&name) == self.want, "{name}: the scene is another");
    }

    fn train_in(&self, out: &Path, faults: &Faults, plan: impl FnOnce(&Faults)) -> Result<(), TrainError> {
        let spill_dir = out.join("spill");
        let config = TrainConfig {
            optimizer: self.optimizer,
            commit_every: CommitEvery::Seconds(self.commit_every),
            disk_full_wait: self.disk_full_wait,
            spill_dir: text(&spill_dir).into(),
            ..TrainConfig::parse(&CONFIG.replace(',', "\n")).unwrap()
        };
        let start = Start::read(&self.work.scene(), &config, None)?;
        let print = dataset_print(&start).unwrap();
        let sh_degree_start = start.sh_degree_start;
        let options = RunOptions { sh_degree_start, ..RunOptions::new(&config, start.dataset.scene_scale) };
        let layout = SlotLayout::new(capacity_bytes(PAGE_ROWS as usize, config.sh_degree), 100);
        let spill = SpillDir::create(&spill_dir, layout, false)?;
        let of_commits = CommitConfig { store: spill.format().store, cache_bytes: 1 << 20, reserve_bytes: 1 << 20 };
        let opened = Opened::create(Box::new(DriveFolder::new(&spill_dir)), of_commits)?;
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
            scene: self.work.scene(),
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
        checkpoint.is_optional = self.is_optional;
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
        let (mut progress, stop) = (RunProgress::new(0, config.steps, true), StopFlag::default());
        let looped = TrainingLoop {
            lacks_space: false,
            trainer: &mut trainer,
            dataset: &dataset,
            targets: &targets,
            out,
            metrics: &mut metrics,
            progress: &mut progress,
            stop: &stop,
            checkpoint: Some(&mut checkpoint),
            live: None,
            forecast: None,
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
        let (step, last) = (trainer.steps_done(), checkpoint.last_step.unwrap());
        let is_read = error.to_string().contains("cannot be read");
        assert!(
            last + if is_read { 1 } else { 2 } >= step,
            "torn in step {step}, committed up to step {last}: {error}"
        );
    }

    /// Resumes a run with the real program on a healthy drive, and compares its bytes.
    fn goes_on(&self, name: &str) {
        self.work.train(&format!("--resume {name} --quiet --frames {}", self.fewest + 30));
        assert!(self.work.ply(name) == self.want, "{name}: the scene is another");
    }
}

#[test]
fn a_full_drive_is_waited_for_and_changes_no_bit() {
    let world = World::new();
    for (after, calls) in [(0, 1), (37, 4), (150, 40), (301, 2)] {
        world.is_the_same_on_a_full_drive(Operation::Write, after, calls);
    }
    world.is_the_same_on_a_full_drive(Operation::Create, 0, 3);
}

/// The whole run is in memory: where its results have room, a drive that stays full for commits costs these and nothing else. So it is
/// where steps change more rows after those of their view.
#[test]
fn a_run_in_memory_goes_on_when_the_drive_of_its_commits_is_full() {
    for optimizer in [Method::Deferred, Method::Dense] {
        let mut world = World::of(optimizer);
        (world.fewest, world.frames, world.is_optional) = (usize::MAX, usize::MAX, true);
        world.disk_full_wait = 0.2;
        for (after, calls) in [(0, 100_000), (37, 30)] {
            world.is_the_same_on_a_full_drive(Operation::Write, after, calls);
        }
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
        let name = format!("broken-{i}");
        let life = world.live(&name, &Faults::new(), |faults| {
            faults.add(on, faults.count(on) + after, true, fault);
        });
        let error = life.expect_err(&format!("the drive fails for ever: {on:?} {after} {fault:?}")).to_string();
        let names = match (on, fault) {
            (Operation::Write, _) => ["writing page", "check the drive"],
            (Operation::Read, Fault::FlipBit(_) | Fault::Torn) => ["is damaged", "seg-"],
            (Operation::Read, _) => ["cannot be read", "seg-"],
            _ => ["could not make writes durable", "check the drive"],
        };
        assert!(names.iter().chain(&["remedy"]).all(|name| error.contains(name)), "case {i}: {error}");
        world.goes_on(&name);
    }
}

/// Views of several batches, so that the faults come in the pass in, between the passes, and in the pass out.
#[test]
fn a_drive_that_fails_in_either_pass_loses_one_step_at_most() {
    let mut world = World::new();
    (world.frames, world.commit_every) = (world.fewest / 3, 1e-9);
    // Whether the steps were torn.
    let case = |on: Operation, i: u64| {
        let name = format!("passes-{on:?}-{i}");
        let life = world.live(&name, &Faults::new(), |faults| {
            faults.add(on, faults.count(on) + 5 + 61 * (i % 7) + 9 * (i / 7), true, Fault::Error(ErrorKind::Other));
        });
        let error = life.expect_err("the drive fails for ever");
        world.goes_on(&name);
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

/// Flags of runs through the program.
const FLAGS: &str = "scene --spill-codec raw --steps 60 --page-rows 32 --refine-start 1000 --max-gaussians 7000 --view-order groups:4 \
    --test-every 24 --device cpu --log-every 7";
const TO_SPILL: &str = "--out out --spill-dir spill";
/// With a drive in `drive`.
const TO_DRIVE: &str = "--out out --spill-dir drive/spill --commit-every 0.02";

/// A drive with room for the pages once, but not for the versions of two commits.
fn small_drive(work: &Workdir) -> Option<Small> {
    let capacity = capacity_bytes(32, 3);
    // Pages of up to 7,000 rows, filled to 70 percent.
    let segment = SlotLayout::new(capacity, 7000 / 22 + 1).segment_bytes();
    Small::mount(&work.path("drive"), segment + segment / 2 + (4 << 20))
}

/// The space needed is known before the first write; pages written by the import count once.
#[test]
fn a_drive_is_refused_only_if_it_is_too_small_and_at_once() {
    let work = make_scene();
    let Some(drive) = small_drive(&work) else { return };
    // The import writes the pages beyond the frames: more than the drive has free afterwards.
    let few = format!("{FLAGS} --out out --spill-dir drive/spill --steps 2 --frames 200");
    work.train(&few);
    drive.resize(4 << 20);
    work.refuses(&format!("{few} --overwrite"), &["the drive has", "free space on it"]);
    let is_kept = !work.exists("drive/spill") && work.exists("out/point_cloud.ply");
    assert!(is_kept, "it took something away or left something behind");
}

#[test]
fn a_drive_that_stays_full_stops_the_run_which_can_go_on() {
    let work = make_scene();
    let Some(drive) = small_drive(&work) else { return };
    work.train(&format!("{FLAGS} --out alone --quiet"));
    let words = ["is full: it needs", "the commit after step", "remedy: free space", "gsscale-train --resume"];
    work.refuses(&format!("{FLAGS} {TO_DRIVE} --disk-full-wait 0.2 --quiet"), &words);
    drive.resize(200 << 20);
    work.train("--resume out --quiet");
    assert!(work.ply("out") == work.ply("alone"), "the scene is another");
}

/// The system sends a signal with its refusal; the process must not end without a message. The refusal counts as
/// missing space.
#[test]
fn a_limit_on_the_size_of_files_is_an_error_that_names_the_file() {
    let work = make_scene();
    let flags = format!("{FLAGS} {TO_SPILL} --commit-every 0.02 --disk-full-wait 0.1");
    let output = work.limited("-f 8000", &flags).output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(["paused:", "seg-", "File too large", "remedy"].iter().all(|word| said.contains(word)), "{said}");
    // Its resume begins again by the mark of the store.
    let is_there = work.exists("out/point_cloud.ply") && work.files("spill").len() == 1;
    assert!(is_there, "what was trained is there, nothing was committed");
}

/// Files of `--save-every` are not needed to continue.
#[test]
fn a_drive_without_room_for_a_saved_ply_costs_that_file_alone() {
    let work = make_scene();
    let flags = "scene --out out --steps 30 --save-every 10 --commit-every 0 --device cpu --test-every 24 --log-every 7 --quiet \
        --disk-full-wait 0.2 --schedule run-length --strategy long-axis";
    let said = stderr(&work.limited("-f 1000", flags).output().unwrap());
    says(&said, &["point_cloud_000010.ply is not written", "point_cloud_000020.ply"]);
    assert_eq!(work.logged("out", "step").last(), Some(&30), "all steps were done");
}

/// The drive of the results is full and the drive of the pages is not: the run names and waits for the drive of the
/// results.
#[test]
fn a_full_drive_of_results_is_named_and_costs_no_reserve() {
    let work = make_scene();
    let Some(drive) = Small::mount(&work.path("results"), 4 << 20) else { return };
    let more = "--log-every 1 --steps 300 --commit-every 0.02 --disk-full-wait 0.2 --quiet";
    let run = work.begin(&format!("{FLAGS} --out results/out --spill-dir spill {more}"));
    let run = run.once(|| work.has_committed("results/out"));
    // A drive that is full at the beginning is refused.
    drive.fill(0);
    let said = run.ends(1);
    assert!(said.contains("the drive of results/out is full"), "{said}");
    assert!(!said.contains("the reserve is used up") && said.contains("--resume"), "{said}");
    assert!(work.exists("spill") && work.path("spill").join(RESERVE_NAME).exists());
    drive.resize(200 << 20);
    work.train("--resume results/out --quiet");
}

/// Containers forbid io_uring with a seccomp filter; a child process inherits the filter of the thread that starts it.
#[cfg(target_os = "linux")]
#[test]
fn a_run_without_io_uring_says_so_and_trains() {
    use seccompiler::{BpfProgram, SeccompAction, SeccompFilter, apply_filter};
    const SETUP: i64 = 425;
    let work = make_scene();
    let run = std::thread::spawn(move || {
        let rules = [(SETUP, Vec::new())].into_iter().collect();
        let machine = std::env::consts::ARCH.try_into().unwrap();
        let filter = SeccompFilter::new(rules, SeccompAction::Allow, SeccompAction::Errno(1), machine);
        let program: BpfProgram = filter.unwrap().try_into().unwrap();
        apply_filter(&program).unwrap();
        (work.train(&format!("{FLAGS} {TO_SPILL}")), work.summary("out")["finished"].clone())
    });
    let (said, finished) = run.join().unwrap();
    assert_eq!(finished, serde_json::Value::Bool(true), "{said}");
    assert!(said.contains("io_uring is refused here") && said.contains("by pread"), "{said}");
}
