//! Equal bytes: where pages lie, how they move, threads, budgets, kills and stops change no byte of a result and no logged value.
//!
//! A run has a feature, which decides its result, and a value of each dimension, which must not. Every pair of values, features included,
//! is in some run of the matrix. All runs of a feature are compared with one run in memory that nothing disturbs. A feature that changed
//! nothing would show nothing, so each has flags without which its scene is another.

use crate::support::a_device;
use crate::support::exif::{Settings, add_exif};
use crate::support::scenes::{TextModel, stderr};
use crate::support::workdir::{Running, TRAIN, Workdir, least_memory, send};
use glam::{DQuat, DVec3};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::page::engine::open::{IoEngine, open_engine};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

pub struct Feature {
    pub name: &'static str,
    scene: fn() -> Workdir,
    pub flags: &'static str,
    /// With each of these the scene is another.
    matters: &'static [&'static str],
    /// What the undisturbed run, in `alone`, must show beside.
    shows: fn(&Workdir),
}

/// Flags of all runs, unless the feature has others.
const COMMON: &str = "scene --quiet --device cpu --page-rows 32 --steps 120 --view-order groups:4 --test-every 12 --log-every 3 \
    --prune-scale3d 1000";

/// The features, and a test of each.
macro_rules! features {
    ($($name:ident: $scene:expr, $flags:expr, without [$($other:literal),*], shows $shows:expr;)*) => {
        pub const FEATURES: &[Feature] = &[$(Feature {
            name: stringify!($name),
            scene: $scene,
            flags: $flags,
            matters: &[$($other),*],
            shows: $shows,
        }),*];

        $(#[test]
        fn $name() {
            holds(stringify!($name));
        })*
    };
}

features! {
    plain: || Workdir::wide_city(6000),
        "--grow-grad2d 0.001 --refine-start 20 --refine-every 25 --reset-every 45 --sh-every 30 --eval-every 50 --save-every 60",
        without ["--refine-every 1000", "--reset-every 0", "--sh-every 1000", "--prune-opa 0"],
        shows |work| assert_ne!(work.count("alone", "gaussians"), 6000);

    shuffle: || Workdir::wide_city(6000),
        "--view-order shuffle --page-rows 64 --grow-grad2d 0.0005 --refine-start 20 --refine-every 15 --sh-start 3",
        without ["--view-order groups:4", "--sh-start 0"],
        shows |_| ();

    tour: || Workdir::wide_city(6000),
        "--view-order tour --page-rows 128 --simd baseline --grow-grad2d 0.0005 --refine-start 20 --refine-every 15 --steps 90",
        without ["--view-order groups:4"],
        shows |_| ();

    // Almost every view sees almost every page, and the views outgrow any budget. Exposures are dropped after four passes, 56 steps.
    compact: || Workdir::city_of(16, [64, 48], 3000, 2),
        "--grow-grad2d 0.0005 --refine-start 10 --refine-every 10 --reset-every 45 --sh-every 30 --prune-opa 0.05 --steps 70 \
         --appearance if-needed",
        without ["--appearance off", "--appearance exposure"],
        shows |work| {
            assert!(2 * work.count("alone", "pages_pinned_max") > work.count("alone", "pages"));
            assert!(!work.exists("alone/appearance.json"));
        };

    // Rounds follow each other closely, so that most growing pages are unseen between two of them. Nothing is pruned, which would make
    // room again. A histogram bin that does not fit as a whole is left out.
    cap: || Workdir::wide_city(8000),
        "--max-gaussians 8400 --log-every 1 --prune-opa 0 --grow-grad2d 0.001 --refine-start 20 --refine-every 4 --reset-every 45",
        without ["--max-gaussians 8500"],
        shows |work| {
            let rows = work.logged("alone", "gaussians");
            assert!(rows.len() == 121 && rows.iter().all(|&rows| rows <= 8400) && rows[120] + 40 > 8400, "{rows:?}");
        };

    // Views come in groups, so rounds come after whole epochs of 28 steps and recycle 28 / 8 times as much.
    long_axis: || Workdir::wide_city(8000),
        "--strategy long-axis --refine-start 20 --refine-every 8 --recycle 0.01 --growth-score mixed --max-gaussians 8800 --log-every 1 \
         --test-every 24",
        without ["--growth-score gradient", "--recycle 0"],
        shows |work| {
            let rows = work.logged("alone", "gaussians");
            // Step 28, counted from 0, ends the first epoch after --refine-start. By steps, the first round would follow step 24.
            assert!(rows[..=28].iter().all(|&rows| rows == 8000), "a round within an epoch: {rows:?}");
            assert!(rows.windows(2).any(|pair| pair[1] < pair[0]), "nothing was recycled: {rows:?}");
            assert!(rows.iter().max() > Some(&8600) && rows.iter().max() <= Some(&8800), "{rows:?}");
        };

    // Rows begin nearly dead, so that many die between two rounds and all have noise.
    mcmc: || Workdir::wide_city(8000),
        "--strategy mcmc --refine-start 20 --refine-every 8 --prune-opa 0.03 --max-gaussians 8100 --init-opacity 0.05 --log-every 1",
        without ["--strategy default"],
        shows |work| {
            let rows = work.logged("alone", "gaussians");
            let changes = |is_one: fn(&[u64]) -> bool| rows.windows(2).filter(|pair| is_one(pair)).count();
            assert!(changes(|pair| pair[1] < pair[0]) > 0 && changes(|pair| pair[1] > pair[0]) > 0, "{rows:?}");
            assert!(rows.iter().all(|&rows| rows <= 8100), "{rows:?}");
        };

    // Rounds after every fourth step, and a check with every other of them from the seventh on.
    decides: || Workdir::wide_city(800),
        "--strategy long-axis --refine-start 20 --refine-every 4 --quality archive --test-every 24 --appearance off",
        without ["--quality draft", "--max-gaussians 4000"],
        shows |work| {
            let checks = growth(work);
            let (steps, rows): (Vec<u64>, _) = (checks.iter().map(|check| check[0]).collect(), work.count("alone", "gaussians"));
            assert!(steps.len() > 2 && steps.iter().zip([33, 41, 49, 57, 65]).all(|(step, due)| *step == due), "{steps:?}");
            assert!(checks[0][1] == 1600 && rows > 900, "nothing pays: {rows}, {checks:?}");
        };

    // Photos of little but noise: a doubling brings nothing and is undone. Decisions depend on the last bit where values are near a limit, so the
    // instruction path is named.
    trials: || {
            let size = CityOptions { seed: 3, views: 14, width: 48, height: 36, points: 600, noise: 0.3, ..CityOptions::default() };
            let work = Workdir::new();
            write_city(&work.scene(), &CityOptions { supersample: 1, ..size }, &|_, _| {}).unwrap();
            work
        },
        "--schedule run-length --strategy long-axis --steps 200 --page-rows 128 --view-order shuffle --test-every 0 --simd baseline \
         --log-every 1 --seed 1 --prune-scale3d 0.1 --quality archive --sh-every 1 --shn-lr 0.05 --sh0-lr 0.02 --opacities-lr 0.2",
        without [],
        shows |work| {
            let (allowed, rows): (Vec<u64>, _) = (growth(work).iter().map(|c| c[1]).collect(), work.logged("alone", "gaussians"));
            assert_eq!(allowed, [1200, 1200, 1200, 600]);
            assert!(rows.iter().max() > Some(&1150) && (550..=600).contains(rows.last().unwrap()), "{rows:?}");
        };

    // Every row is updated at every step, also in pages that no view of it sees.
    dense: || Workdir::city(60, 48, 32, 4000),
        "--optimizer dense --refine-start 5 --refine-every 6 --refine-stop 20 --reset-every 11 --steps 26 --sh-every 8 \
         --grow-grad2d 0.00005 --view-order tour",
        without ["--optimizer deferred"],
        shows |work| assert!(work.count("alone", "gaussians") > 4050);

    // A scene without points.
    sparse: || {
            let work = Workdir::city_of(20, [64, 48], 3000, 3);
            let mut model = TextModel::of(&work.scene());
            (model.points, model.colors) = (Vec::new(), Vec::new());
            model.write(&work.scene());
            work
        },
        "--optimizer sparse --refine-start 10 --refine-every 10 --grow-grad2d 0.001 --steps 60",
        without ["--optimizer deferred", "--sweep-points=off"],
        shows |work| assert!(work.count("alone", "gaussians") < 50_000, "it began at random points");

    // Photos with EXIF data that state other exposures, which are where the values start. Moments have 16 bits.
    appearance: || {
            let work = Workdir::city_of(24, [64, 48], 3000, 8);
            let photos = work.photos();
            let settings = |i: usize| Settings::brighter_by((i % 5) as f64 - 2.0).tiff();
            photos.iter().enumerate().for_each(|(i, photo)| add_exif(photo, &settings(i)));
            work
        },
        "--appearance full --moments bf16 --refine-start 60 --refine-every 30 --grow-grad2d 0.001 --reset-every 45 --sh-every 30",
        without ["--appearance off", "--appearance exposure", "--moments f32"],
        shows |work| assert_eq!(work.json("alone/appearance.json")["exposures_from_exif"], 22);

    // All that the results of a run may be, upright, of a scene in the axes of structure from motion; and all remedies for photos at once.
    exports: || {
            let work = with_negatives();
            let mut model = TextModel::of(&work.scene());
            model.turn(DQuat::from_axis_angle(DVec3::new(2.0, -1.0, 0.5).normalize(), 1.9));
            model.write(&work.scene());
            work
        },
        "--export spz,sog --strategy long-axis --max-gaussians 2000 --robust-views --robust-pixels --refine-poses --appearance full \
         --refine-start 60 --refine-every 30 --steps 160 --reset-every 80",
        without ["--robust-views=false", "--robust-pixels=false", "--refine-poses=false", "--up keep"],
        shows |work| {
            assert!(work.exists("alone/point_cloud.spz") && work.exists("alone/point_cloud_sog/lod-meta.json"));
            let (summary, poses) = (work.summary("alone"), work.json("alone/poses.json"));
            assert!(summary["outlier_views"].as_array().is_some_and(|views| !views.is_empty()), "{summary}");
            assert!(summary["masked_share"].as_f64() > Some(0.01), "{summary}");
            assert!(poses["refined"].as_u64() > Some(10) && poses["shift"]["largest"].as_f64() > Some(0.0), "{poses}");
        };

    gpu: || Workdir::wide_city(3000),
        "--device gpu --optimizer-on host --steps 28 --refine-start 8 --refine-every 6 --grow-grad2d 0.001 --reset-every 12",
        without ["--refine-every 1000"],
        shows |_| ();

    // Rounds, resets, raises and a cap with pages that are newer on the device than in memory.
    gpu_pages: || Workdir::wide_city(3000),
        "--device gpu --optimizer-on device --steps 28 --refine-start 5 --refine-every 6 --grow-grad2d 0.0005 --reset-every 13 \
         --sh-every 8 --max-gaussians 3500 --log-every 1",
        without ["--reset-every 0"],
        shows |work| {
            assert!(work.count("alone", "gaussians") > 3050);
            let slots = &work.metrics("alone")[27]["slots"];
            assert!(slots["loads"].as_u64() > Some(50), "the device holds no page: {slots}");
            assert!(slots["cleared"].as_u64() > Some(25), "rounds took all pages to the host: {slots}");
        };

    // The device weighs rows, and a round judges them by that. Moments have 16 bits.
    gpu_recycles: || Workdir::wide_city(3000),
        "--device gpu --optimizer-on device --strategy long-axis --steps 28 --refine-start 5 --refine-every 6 --max-gaussians 3150 \
         --recycle 0.05 --view-order shuffle --moments bf16",
        without ["--recycle 0", "--moments f32"],
        shows |work| assert!(work.metrics("alone").last().unwrap()["slots"]["cleared"].as_u64() > Some(0));
}

/// Step and allowed Gaussians of each check of the undisturbed run.
fn growth(work: &Workdir) -> Vec<[u64; 2]> {
    let growth = work.summary("alone")["growth"].clone();
    growth.as_array().unwrap().iter().map(|check| ["step", "allowed"].map(|key| check[key].as_u64().unwrap())).collect()
}

/// A city whose views share much, so that a wrong photo is noticed within two epochs. Two photos are negatives.
fn with_negatives() -> Workdir {
    let work = Workdir::city(24, 64, 48, 1500);
    for photo in [&work.photos()[2], &work.photos()[15]] {
        let mut picture = image::open(photo).unwrap().to_rgb8();
        picture.iter_mut().for_each(|value| *value = 255 - *value);
        picture.save(photo).unwrap();
    }
    work
}

// The dimensions, with the number of their values.
const FEATURE: usize = 0;
/// In memory; the others in a spill directory: with the memory that a run takes by itself, which holds every page, with a frame for each
/// page of the largest view, with a third of these (its steps go in batches), and in the least memory that the program names.
const PLACE: usize = 1;
const THREADS: usize = 2;
const ENGINE: usize = 3;
const CODEC: usize = 4;
const END: usize = 5;
const HABIT: usize = 6;
/// On a GPU: all its memory, half of what the undisturbed run took, and no step in flight.
const DEVICE: usize = 7;
const VALUES: [usize; 8] = [FEATURES.len(), 5, 2, 4, 3, 5, 3, 4];

/// The value 0 is for runs in memory. For moments of 16 bits their own codec stands for `raw`.
pub const ENGINES: [&str; 4] = ["", "uring", "pread", "mmap"];
pub const CODECS: [&str; 3] = ["", "raw", "zstd:1"];
/// The signal, if any, and whether the run goes on with other threads and in another place.
const ENDS: [(&str, bool); 5] = [("", false), ("KILL", false), ("KILL", true), ("INT", false), ("INT", true)];
pub const HABITS: [&str; 3] =
    ["", "--image-cache 1KiB --evict lru --prefetch-bytes 1MiB", "--transfers demand --commit-every 0.01"];

type Row = [usize; 8];

/// A drive has an engine and a codec, a GPU has memory.
fn is_possible(row: &Row) -> bool {
    let feature = &FEATURES[row[FEATURE]];
    (row[PLACE] == 0) == (row[ENGINE] == 0)
        && (row[PLACE] == 0) == (row[CODEC] == 0)
        && (row[DEVICE] == 0) != feature.flags.contains("--device gpu")
        // What a driver takes of the host's memory varies.
        && (row[DEVICE] == 0 || row[PLACE] != 4)
}

/// Every pair of values of two dimensions in a row, as a number.
fn pairs(row: &Row) -> impl Iterator<Item = usize> {
    let value = |i: usize| 32 * i + row[i];
    (0..row.len()).flat_map(move |a| (a + 1..row.len()).map(move |b| 256 * value(a) + value(b)))
}

fn possible_rows() -> Vec<Row> {
    let rows = (0..VALUES.iter().product()).map(|mut i: usize| {
        VALUES.map(|values| {
            let value = i % values;
            i /= values;
            value
        })
    });
    rows.filter(is_possible).collect()
}

/// The rows of the matrix: one after the other, each the possible row with the most pairs that no row before it has. Of rows
/// with equally many, a remainder of their number picks one: 11 gives 96 rows, the last of them 98.
fn matrix() -> Vec<Row> {
    let possible = possible_rows();
    let (mut is_open, mut rows) = (vec![false; 1 << 16], Vec::new());
    possible.iter().flat_map(pairs).for_each(|pair| is_open[pair] = true);
    while is_open.contains(&true) {
        let gain = |(i, row): &(usize, &Row)| (pairs(row).filter(|pair| is_open[*pair]).count(), i % 11);
        let (_, best) = possible.iter().enumerate().max_by_key(gain).unwrap();
        pairs(best).for_each(|pair| is_open[pair] = false);
        rows.push(*best);
    }
    rows
}

/// Every feature meets every value, and every value those of the other dimensions, where both can be.
#[test]
fn the_matrix_has_every_pair() {
    let (rows, possible) = (matrix(), possible_rows());
    let has = |rows: &[Row], [a, b]: [usize; 2], [x, y]: [usize; 2]| rows.iter().any(|row| row[a] == x && row[b] == y);
    for (a, b) in (0..8).flat_map(|a| (a + 1..8).map(move |b| (a, b))) {
        for (x, y) in (0..VALUES[a]).flat_map(|x| (0..VALUES[b]).map(move |y| (x, y))) {
            assert_eq!(
                has(&rows, [a, b], [x, y]),
                has(&possible, [a, b], [x, y]),
                "dimensions {a} {b}, values {x} {y}"
            );
        }
    }
    println!("{} of {} rows", rows.len(), possible.len());
    assert!(rows.len() < 100, "{} rows take too long", rows.len());
}

/// The files of a run that tell no time, and the logged values that do not.
fn results(work: &Workdir, out: &str) -> (BTreeMap<PathBuf, Vec<u8>>, Vec<Value>) {
    let values = |line: &Value| {
        let keys = ["step", "loss", "psnr", "gaussians", "growth", "test", "outlier_views", "masked_share"];
        json!(keys.map(|key| &line[key]))
    };
    let lines = work.metrics(out);
    (work.results(out), lines.iter().chain([&work.summary(out)]).map(values).collect())
}

/// What the undisturbed run of a feature took.
pub struct Alone {
    pub pages: u64,
    /// The most pages of a step.
    pub pinned: u64,
    device_bytes: u64,
}

/// A feature's scene, and its run that nothing disturbs, in `alone`.
pub struct World {
    pub work: Workdir,
    pub flags: String,
    want: (BTreeMap<PathBuf, Vec<u8>>, Vec<Value>),
    pub alone: Alone,
}

impl World {
    pub fn of(feature: &Feature) -> World {
        let (work, flags) = ((feature.scene)(), format!("{COMMON} {}", feature.flags));
        work.train(&format!("{flags} --out alone"));
        let want = results(&work, "alone");
        let peaks = work.metrics("alone").into_iter().filter_map(|line| line["device_bytes_peak"].as_u64());
        let [pages, pinned] = ["pages", "pages_pinned_max"].map(|key| work.count("alone", key));
        let alone = Alone { pages, pinned, device_bytes: peaks.max().unwrap() };
        World { work, flags, want, alone }
    }

    /// The results in `out` are those of the run that nothing disturbs.
    #[track_caller]
    pub fn is_matched_by(&self, out: &str, what: &str) {
        let (got, want) = (results(&self.work, out), &self.want);
        assert!(got.0.keys().eq(want.0.keys()), "{what}: {:?} instead of {:?}", got.0.keys(), want.0.keys());
        let differ: Vec<_> =
            got.0.iter().filter(|(file, bytes)| &want.0[*file] != *bytes).map(|(file, _)| file).collect();
        assert!(differ.is_empty(), "{what}: other bytes in {differ:?}");
        assert_eq!(got.1, want.1, "{what}: other values");
    }
}

fn holds(name: &str) {
    let (number, feature) = FEATURES.iter().enumerate().find(|(_, feature)| feature.name == name).unwrap();
    if feature.flags.contains("--device gpu") && a_device().is_none() {
        return;
    }
    let world = World::of(feature);
    let World { work, flags, alone, .. } = &world;
    (feature.shows)(work);
    for other in feature.matters {
        work.train(&format!("{flags} --out other --overwrite {other}"));
        assert!(work.ply("other") != work.ply("alone"), "{name} {other} changes nothing, so the rows show little");
    }
    let mut moved = 0;
    for row in matrix().into_iter().filter(|row| row[FEATURE] == number) {
        let what = live(work, flags, &row, alone);
        world.is_matched_by("out", &what);
        let [frames, pages, evictions] = ["frames", "pages", "evictions"].map(|key| work.count("out", key));
        assert!(frames >= pages || evictions > 0, "{what}: no page left its frame");
        moved += evictions;
        assert!(!work.exists("spill/FORMAT"), "{what}: pages are left over");
        work.remove("out");
        work.remove("spill");
    }
    assert!(moved > 0, "{name}: no page of any run left its frame");
}

/// One run of the matrix, in `out`, from its first step to its last; returns its words.
fn live(work: &Workdir, flags: &str, row: &Row, alone: &Alone) -> String {
    let frames = |frames: u64| format!("--frames {}", frames.max(2));
    let drive = || {
        let codec = if flags.contains("bf16") {
            CODECS[row[CODEC]].replace("raw", "halves")
        } else {
            CODECS[row[CODEC]].into()
        };
        format!("--spill-dir spill --io {} --spill-codec {codec}", engine(ENGINES[row[ENGINE]]))
    };
    let (signal, changes) = ENDS[row[END]];
    let mut run = format!("{flags} --out out --threads {} {}", row[THREADS] + 1, HABITS[row[HABIT]]);
    if signal == "KILL" {
        run += " --commit-every 0.02";
    }
    if row[DEVICE] == 2 {
        run += &format!(" --device-mem {}", alone.device_bytes / 2);
    }
    if row[PLACE] > 0 {
        run += &format!(" {}", drive());
    }
    run = match row[PLACE] {
        0 | 1 => run,
        2 => format!("{run} {}", frames(alone.pinned)),
        3 => format!("{run} {}", frames(alone.pinned / 3)),
        _ => {
            let said = work.refuses(&format!("{run} --host-mem 12MiB"), &[]);
            format!("{run} --host-mem {}MiB", least_memory(&said).ceil())
        }
    };
    if signal.is_empty() {
        // Few open files are enough.
        let output = in_flight(row, &mut work.limited("-n 64", &run)).output().unwrap();
        assert!(output.status.success(), "{run}: {}", stderr(&output));
        return run;
    }
    // A fast machine may have done all steps before the signal comes.
    let is_ended = (0..9).any(|_| {
        work.remove("out");
        work.remove("spill");
        let begun = Running::spawn(work, in_flight(row, &mut work.command(TRAIN, &run)));
        ends_early(begun.after_lines("out", work.lines("alone") * 2 / 5), signal)
    });
    assert!(is_ended, "{run}: the run ended before each signal");
    let other_place = match row[PLACE] {
        0 | 1 => frames(alone.pinned / 2),
        2 => "--frames 0".to_string(),
        3 => frames(alone.pages),
        _ => "--host-mem 2GiB --frames 0".to_string(),
    };
    let more = if changes { format!("--threads {} {other_place}", 2 - row[THREADS]) } else { String::new() };
    work.train(&format!("--resume out --quiet {more}"));
    format!("{run}, {signal}, {more}")
}

/// The command, without steps in flight on a device if the row is so.
fn in_flight<'a>(row: &Row, command: &'a mut Command) -> &'a mut Command {
    match row[DEVICE] {
        3 => command.env("GSSCALE_STEPS_IN_FLIGHT", "0"),
        _ => command,
    }
}

/// Whether the signal ended the run before its last step.
fn ends_early(mut run: Running, signal: &str) -> bool {
    match signal {
        "KILL" => drop(run.child.kill()),
        _ => drop(send(&run.child, signal)),
    }
    let output = run.end();
    match output.status.code() {
        Some(0) => false,
        None | Some(130) => true,
        code => panic!("{code:?}: {}", stderr(&output)),
    }
}

/// The engine, if it works here: containers often forbid io_uring.
pub fn engine(name: &'static str) -> &'static str {
    let folder = tempfile::tempdir().unwrap();
    if open_engine(IoEngine::from_name(name).unwrap(), folder.path(), 4).is_ok() {
        return name;
    }
    println!("SKIPPED: {name} does not work here; pread takes its place");
    "pread"
}
