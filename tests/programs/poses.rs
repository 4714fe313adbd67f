//! Poses with noise: what `--refine-poses` wins back, and what it finds, through the real binaries.

use crate::support::gpu;
use crate::support::scenes::{city, psnr, stderr, summary, text, train};
use gsscale::config::file::TrainConfig;
use gsscale::dataset::disturb::{Disturbance, plan, write_disturbed};
use gsscale::gpu::GpuOptions;
use gsscale::train::start::first_scene::prepare;
use serde_json::Value;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Half a percent of the scene along each axis: what costs this scene some 4 dB.
const NOISE: Disturbance = Disturbance::PoseNoise { share: 0.005 };

/// The scene with noise on its training poses, and the value of `--test-after` that holds out its other photos.
fn with_noise(folder: &Path, noise: &Disturbance, points: u32) -> (PathBuf, String) {
    let scene = folder.join("scene");
    let scene = if scene.exists() { scene } else { city(folder, 32, 160, 112, points) };
    let dataset = prepare(&scene, &TrainConfig::default()).unwrap().dataset;
    let to = folder.join(if *noise == NOISE { "noise" } else { "clean" });
    write_disturbed(&to, &dataset, noise, 3).unwrap();
    (to, plan(&dataset, noise, 3).unwrap().test_after.to_string())
}

fn run((scene, test_after): &(PathBuf, String), out: &Path, more: &[&str]) {
    let output = train(&[&[text(scene), "--out", text(out), "--quiet", "--test-after", test_after], more].concat());
    assert!(output.status.success(), "{}", stderr(&output));
}

fn poses(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("poses.json")).unwrap()).unwrap()
}

/// The positions of cameras by photo.
fn centres(scene: &Path) -> Vec<(String, glam::DVec3)> {
    let raw = gsscale::dataset::read::read_scene(scene, &gsscale::dataset::read::ReadOptions::default()).unwrap();
    raw.views.iter().map(|view| (view.name.clone(), view.pose.centre())).collect()
}

#[test]
fn refined_poses_win_back_what_noise_costs_and_lie_nearer_to_the_truth() {
    let folder = TempDir::new().unwrap();
    let clean = with_noise(folder.path(), &Disturbance::Nothing, 3000);
    let noisy = with_noise(folder.path(), &NOISE, 3000);
    let [plain, refined] = ["plain", "refined"].map(|name| folder.path().join(name));
    let steps = ["--steps", "900", "--schedule", "run-length", "--strategy", "none", "--device", "cpu"];
    run(&noisy, &plain, &steps);
    run(&noisy, &refined, &[&steps[..], &["--refine-poses"]].concat());
    println!("{:.2} dB, refined {:.2} dB", psnr(&plain), psnr(&refined));
    // 1.1 dB were seen after these few steps without growth; half of that is asked, since the scene's draws are one sample.
    assert!(psnr(&refined) > psnr(&plain) + 0.5);
    let file = poses(&refined);
    let (truth, given) = (centres(&clean.0), centres(&noisy.0));
    let of = |list: &[(String, glam::DVec3)], name: &str| list.iter().find(|(of, _)| of == name).unwrap().1;
    let mut squares = [0.0; 2];
    for image in file["images"].as_array().unwrap() {
        let name = image["name"].as_str().unwrap();
        let centre: Vec<f64> = image["centre"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
        let is = of(&truth, name);
        squares[0] += (of(&given, name) - is).length_squared();
        squares[1] += (glam::DVec3::from_slice(&centre) - is).length_squared();
    }
    println!("squares of errors {squares:.3?}");
    assert!(squares[1] < 0.5 * squares[0], "{squares:?}");
    assert!(!plain.join("poses.json").exists());
    let report = std::fs::read_to_string(refined.join("report.html")).unwrap();
    assert!(report.contains("--refine-poses") && report.contains("poses.json"));
}

#[test]
fn threads_and_frames_give_the_same_bytes_with_refined_poses() {
    let folder = TempDir::new().unwrap();
    let scene = with_noise(folder.path(), &NOISE, 1500);
    let [one, two, paged, spill] = ["one", "two", "paged", "spill"].map(|name| folder.path().join(name));
    let flags = ["--steps", "90", "--refine-poses", "--device", "cpu", "--page-rows", "64", "--strategy", "none"];
    run(&scene, &one, &[&flags[..], &["--threads", "1"]].concat());
    run(&scene, &two, &[&flags[..], &["--threads", "2"]].concat());
    // Fewer frames than a view has pages: its steps go in batches.
    let frames = (summary(&one)["pages_pinned_max"].as_u64().unwrap() / 3).max(2).to_string();
    let of_drive = ["--frames", &frames, "--spill-dir", text(&spill), "--spill-codec", "raw"];
    run(&scene, &paged, &[&flags[..], &of_drive, &["--view-order", "shuffle"]].concat());
    for file in ["point_cloud.ply", "poses.json"] {
        let [one, two, paged] = [&one, &two, &paged].map(|out| std::fs::read(out.join(file)).unwrap());
        assert!(one == two, "one thread and two threads differ: {file}");
        assert!(one == paged, "batches differ: {file}");
    }
    assert!(poses(&one)["refined"].as_u64().unwrap() > 10 && poses(&one)["shift"]["largest"].as_f64().unwrap() > 0.0);
}

#[test]
fn a_gpu_refines_poses_as_the_cpu_does() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let scene = with_noise(folder.path(), &NOISE, 1500);
    let [on_cpu, on_gpu] = ["cpu", "gpu"].map(|name| folder.path().join(name));
    for (out, device) in [(&on_cpu, "cpu"), (&on_gpu, "gpu")] {
        run(&scene, out, &["--steps", "84", "--refine-poses", "--strategy", "none", "--device", device]);
    }
    // One step of a pose is .1 % of the scene: rounding turns none of them around.
    let [want, got] = [&on_cpu, &on_gpu].map(|out| poses(out)["shift"]["median"].as_f64().unwrap());
    println!("{want} on the CPU, {got} on the GPU");
    assert!((want - got).abs() < 0.05 * want && want > 0.0, "{got}, on the CPU {want}");
    let output = train(&[
        text(&scene.0),
        "--out",
        text(&folder.path().join("refused")),
        "--refine-poses",
        "--optimizer-on",
        "device",
    ]);
    assert!(stderr(&output).contains("leave out --refine-poses, or --optimizer-on host"), "{}", stderr(&output));
}
