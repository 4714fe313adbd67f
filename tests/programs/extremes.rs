//! Inputs that other trainers turn into infinities, silence or misleading words: extreme numbers, runs in which nothing
//! counts, resets just before the end, budgets and limits that are too small. Through the real binaries.

use crate::support::scenes::{TextModel, city, psnr, stderr, summary, text, train};
use gsscale::config::file::TrainConfig;
use gsscale::scene::columns::Columns;
use gsscale::train::start::first_scene::prepare;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;

/// One thread each, on the CPU: the words and results are those of any machine.
const PLAIN: [&str; 5] = ["--device", "cpu", "--threads", "2", "--quiet"];

fn small_city(folder: &Path) -> PathBuf {
    city(folder, 12, 96, 64, 400)
}

fn run(scene: &Path, out: &Path, more: &[&str]) -> Output {
    train(&[&[text(scene), "--out", text(out)], &PLAIN[..], more].concat())
}

fn done(scene: &Path, out: &Path, more: &[&str]) -> String {
    let output = run(scene, out, more);
    assert!(output.status.success(), "{}", stderr(&output));
    stderr(&output)
}

/// The words of a run that stops with an error.
fn stopped(scene: &Path, out: &Path, more: &[&str]) -> String {
    let output = run(scene, out, more);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    stderr(&output)
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

/// The first Gaussians of a scene as a PLY, changed by `change`, which receives them in dataset coordinates.
fn gaussians(scene: &Path, file: &Path, change: impl Fn(&mut Columns)) {
    let prepared = prepare(scene, &TrainConfig::default()).unwrap();
    let (frame, mut columns) = (prepared.dataset.frame, prepared.columns);
    for mean in columns.means.as_chunks_mut::<3>().0 {
        let world = frame.to_world(glam::Vec3::from_array(*mean).as_dvec3());
        *mean = world.as_vec3().to_array();
    }
    let log_scale = frame.scale.ln() as f32;
    columns.scales.iter_mut().for_each(|s| *s += log_scale);
    change(&mut columns);
    let mut ply = format!("ply\nformat ascii 1.0\nelement vertex {}\n", columns.rows());
    for name in "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(' ') {
        writeln!(ply, "property float {name}").unwrap();
    }
    ply.push_str("end_header\n");
    for row in 0..columns.rows() {
        let of = |values: &[f32], width: usize| values[width * row..width * (row + 1)].to_vec();
        let c = &columns;
        let all = [of(&c.means, 3), of(&c.sh0, 3), of(&c.opacities, 1), of(&c.scales, 3), of(&c.quats, 4)].concat();
        writeln!(ply, "{}", all.iter().map(f32::to_string).collect::<Vec<_>>().join(" ")).unwrap();
    }
    std::fs::write(file, ply).unwrap();
}

/// Every page of every generation is intact and finite.
fn assert_intact(store: &Path) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt")).args(["verify", text(store), "--deep"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn rates_beyond_reason_reach_no_page_with_infinities() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 160, 112, 1500);
    let (out, spill) = (folder.path().join("out"), folder.path().join("pages"));
    // Log-scales drift by hundreds, so the children of a split would lie at infinity.
    let flags = "--scales-lr 20 --refine-start 20 --refine-every 10 --steps 60 --keep-checkpoint --commit-every 0.01";
    let flags: Vec<&str> = flags.split(' ').chain(["--spill-dir", text(&spill)]).collect();
    let said = done(&scene, &out, &flags);
    assert!(said.contains("Gaussians keep their values because"), "skipped rows are warned of: {said}");
    assert!(!said.contains("are not finite and are not in"), "every Gaussian is in the PLY: {said}");
    assert!(summary(&out)["rows_skipped_non_finite"].as_u64() > Some(0));
    assert_intact(&spill);
}

#[test]
fn a_ply_with_absurd_colours_is_named_as_the_cause() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let ply = folder.path().join("bright.ply");
    // f32 still holds 1e20, its square not; at 1e30 gradients are not finite either.
    for brightness in [1e20f32, 1e30] {
        gaussians(&scene, &ply, |columns| columns.sh0[..30].fill(brightness));
        let out = folder.path().join(format!("{brightness:e}"));
        let said = stopped(&scene, &out, &["--steps", "60", "--init-ply", text(&ply)]);
        assert!(said.contains("is skipped: ") && said.contains("the run diverged"), "{said}");
        assert!(said.contains(&format!("check {}", ply.display())) && !said.contains("report this as a bug"), "{said}");
        let summary = summary(&out);
        assert_eq!((&summary["finished"], &summary["steps"]), (&false.into(), &2.into()), "the third step stops it");
    }
}

#[test]
fn a_run_that_fails_twice_names_the_first_cause() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let (ply, out) = (folder.path().join("bright.ply"), folder.path().join("out"));
    gaussians(&scene, &ply, |columns| columns.sh0[..30].fill(1e30));
    // A folder stands where the transform of the last rows is to be written.
    std::fs::create_dir_all(out.join("point_cloud.transform.json")).unwrap();
    let said = stopped(&scene, &out, &["--steps", "60", "--init-ply", text(&ply), "--overwrite"]);
    assert!(said.contains("error: the run diverged"), "what ended the run: {said}");
    assert!(said.contains("warning: ") && said.contains("cannot be written"), "what failed after it: {said}");
}

#[test]
fn log_scales_and_opacities_of_a_ply_are_brought_into_range_and_said() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let ply = folder.path().join("odd.ply");
    gaussians(&scene, &ply, |columns| {
        // A giant, another one, and a row that is only too small.
        (columns.scales[1], columns.scales[3], columns.scales[6]) = (20.0, 1e38, -200.0);
        columns.opacities[5] = f32::INFINITY;
        columns.opacities[6] = f32::NEG_INFINITY;
    });
    let assert_said = |said: &str| {
        for words in
            ["2 opacities are exactly 0 or 1", "odd.ply: 2 Gaussians are larger than", "1 log-scales of the first"]
        {
            assert!(said.contains(words), "{words}: {said}");
        }
    };
    let spill = folder.path().join("pages");
    let memory = folder.path().join("in memory");
    let said = done(&scene, &memory, &["--steps", "20", "--init-ply", text(&ply)]);
    assert_said(&said);
    let streamed = folder.path().join("streamed");
    let more = ["--steps", "20", "--init-ply", text(&ply), "--keep-checkpoint", "--spill-dir", text(&spill)];
    let said = done(&scene, &streamed, &more);
    assert_said(&said);
    assert!(bytes(&memory.join("point_cloud.ply")) == bytes(&streamed.join("point_cloud.ply")));
    assert_intact(&spill);
    let rows = |out: &Path| summary(out)["gaussians"].as_u64();
    assert_eq!(rows(&memory), Some(398), "giants are dropped");
}

#[test]
fn a_reset_just_before_the_end_is_left_out() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let ply = |name: &str, more: &[&str]| {
        let out = folder.path().join(name);
        done(&scene, &out, &[&["--refine-start", "50", "--refine-every", "50"], more].concat());
        bytes(&out.join("point_cloud.ply"))
    };
    // Step 200 is the last but one of these, and a third of the interval is 66 steps.
    let never = ply("never", &["--steps", "201", "--reset-every", "0"]);
    assert!(ply("at the end", &["--steps", "201", "--reset-every", "200"]) == never);
    let longer = ply("longer without", &["--steps", "267", "--reset-every", "0"]);
    assert!(ply("longer", &["--steps", "267", "--reset-every", "200"]) != longer, "this reset has time to recover");
}

#[test]
fn saves_and_evaluations_show_the_scene_before_a_reset() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let shown = |name: &str, every: &str| {
        let out = folder.path().join(name);
        let steps = ["--steps", "140", "--save-every", "60", "--eval-every", "60", "--reset-every", every];
        done(&scene, &out, &[&["--refine-start", "50", "--refine-every", "50"], &steps[..]].concat());
        let lines = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
        let lines = lines.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        let test = lines.filter(|line| line["step"] == 60).map(|line| line["test"]["psnr"].as_f64().unwrap());
        (bytes(&out.join("point_cloud_000060.ply")), test.collect::<Vec<f64>>(), psnr(&out))
    };
    let (with, without) = (shown("with", "60"), shown("without", "0"));
    assert!(with.0 == without.0 && with.1 == without.1 && with.1.len() == 1, "{:?} {:?}", with.1, without.1);
    assert_ne!(with.2, without.2, "there was no reset, so the test shows nothing");
}

#[test]
fn a_run_whose_masks_are_all_black_stops() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let masks = scene.join("masks");
    std::fs::create_dir(&masks).unwrap();
    for view in TextModel::of(&scene).views {
        let name = Path::new(&view.name).with_extension("png");
        image::GrayImage::new(96, 64).save(masks.join(name)).unwrap();
    }
    let said = stopped(&scene, &folder.path().join("out"), &["--steps", "1000"]);
    assert!(said.contains("exclude every pixel") && said.contains("--invert-masks"), "{said}");
    assert!(said.contains("images: step "), "the message names folder and step: {said}");
    done(&scene, &folder.path().join("inverted"), &["--steps", "60", "--invert-masks"]);
}

#[test]
fn a_run_whose_views_see_nothing_is_refused() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let ply = folder.path().join("above.ply");
    // The cameras look down on the city.
    gaussians(&scene, &ply, |columns| columns.means.as_chunks_mut::<3>().0.iter_mut().for_each(|mean| mean[2] += 1e5));
    let out = folder.path().join("out");
    let said = stopped(&scene, &out, &["--steps", "1000", "--init-ply", text(&ply)]);
    assert!(said.contains("training views sees any of the 400 Gaussians") && said.contains("remedy: "), "{said}");
    assert!(!out.exists(), "refused before anything is written");
}

#[test]
fn a_run_that_loses_all_gaussians_or_draws_none_stops() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let out = folder.path().join("pruned");
    let prunes = ["--prune-opa", "0.4", "--refine-start", "1", "--refine-every", "2", "--steps", "1000"];
    let said = stopped(&scene, &out, &prunes);
    assert!(said.contains("no Gaussian is left") && said.contains("--prune-opa"), "{said}");
    assert!(said.contains("images: step 3: "), "at once: {said}");
    // Alpha below 1/255 is not drawn, so no gradient raises it.
    let faint = ["--init-opacity", "0.001", "--strategy", "none", "--steps", "1000"];
    let said = stopped(&scene, &folder.path().join("faint"), &faint);
    assert!(said.contains("too transparent") && said.contains("--init-opacity"), "{said}");
}

#[test]
fn numbers_that_f32_rounds_to_a_limit_are_refused_by_name() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    for (flag, value) in [("--init-opacity", "0.99999998"), ("--max-alpha", "0.99999998")] {
        let said = stopped(&scene, &folder.path().join("out"), &[flag, value]);
        assert!(said.contains(flag) && said.contains("remedy: "), "{said}");
    }
    // Each step took as long as twenty others while the clamp was searched float by float.
    done(&scene, &folder.path().join("sharp"), &["--steps", "30", "--max-alpha", "0.999999"]);
}

#[test]
fn remedies_name_what_helps() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let ply = folder.path().join("first.ply");
    gaussians(&scene, &ply, |_| {});
    for spill in [None, Some(folder.path().join("pages"))] {
        let spill = spill.as_deref().map_or(Vec::new(), |folder| vec!["--spill-dir", text(folder)]);
        let flags = [&["--init-ply", text(&ply), "--max-gaussians", "399"], &spill[..]].concat();
        let said = stopped(&scene, &folder.path().join("capped"), &flags);
        assert!(said.starts_with(&format!("error: {}", ply.display())), "the PLY is too large, not the scene: {said}");
    }
    let out = folder.path().join("threads");
    let output = train(&[text(&scene), "--out", text(&out), "--device", "cpu", "--steps", "2", "--threads", "1024"]);
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("--threads 1024: ") && said.contains("are started"), "{said}");
}

#[cfg(unix)]
#[test]
fn a_limit_on_open_files_is_told_from_a_broken_drive() {
    let folder = TempDir::new().unwrap();
    let scene = small_city(folder.path());
    let mut told = 0;
    for files in 5..14 {
        let (out, spill) = (folder.path().join(format!("out{files}")), folder.path().join(format!("pages{files}")));
        let command = format!(
            "ulimit -n {files}; exec {} {} --out {} --spill-dir {} --steps 30 --commit-every 0.01 {}",
            env!("CARGO_BIN_EXE_gsscale-train"),
            text(&scene),
            text(&out),
            text(&spill),
            PLAIN.join(" ")
        );
        let output = Command::new("sh").args(["-c", &command]).output().unwrap();
        let said = stderr(&output);
        if said.contains("Too many open files") {
            told += 1;
            assert!(said.contains("ulimit -n"), "{files} files: {said}");
            let wrong = ["check the drive", "check the disk", "gsscale-ckpt salvage"];
            assert!(wrong.iter().all(|words| !said.contains(words)), "{files} files: {said}");
        }
    }
    assert!(told > 3, "no run lacked files, so the test shows nothing");
}

/// Lists of intersections would take 16,384 tiles x 2,000 splats x 44 bytes, 1.4 GB.
#[cfg(target_os = "linux")]
#[test]
fn splats_that_fill_large_photos_stay_within_the_memory() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene");
    std::fs::create_dir_all(scene.join("images")).unwrap();
    let side = 2048;
    for name in ["a.png", "b.png"] {
        image::GrayImage::from_pixel(side, side, image::Luma([128])).save(scene.join("images").join(name)).unwrap();
    }
    let view = |name: &str, x: f64| crate::support::scenes::TextView {
        name: name.to_string(),
        qvec: [1.0, 0.0, 0.0, 0.0],
        tvec: [x, 0.0, 0.0],
    };
    let model = TextModel {
        size: [side; 2],
        pinhole: [2000.0, 2000.0, 1024.0, 1024.0],
        views: vec![view("a.png", 0.0), view("b.png", 0.5)],
        points: (0..2000).map(|i| [0.0, 0.0, 4.0 + f64::from(i) * 1e-3]).collect(),
        colors: vec![[90, 100, 110]; 2000],
    };
    model.write(&scene);
    let ply = folder.path().join("giants.ply");
    gaussians(&scene, &ply, |columns| {
        columns.scales.fill(3.0);
        // Nearly opaque, so that the pixels end after a few of them and the test is quick.
        columns.opacities.fill(4.0);
    });
    let out = folder.path().join("out");
    let flags = "--steps 1 --test-every 0 --strategy none --image-cache 16MiB --host-mem 512MiB";
    done(&scene, &out, &[&flags.split(' ').collect::<Vec<_>>()[..], &["--init-ply", text(&ply)]].concat());
    let peak = summary(&out)["host_bytes_peak"].as_u64().unwrap();
    assert!(peak > 0 && peak <= 512 << 20, "{peak} bytes");
}
