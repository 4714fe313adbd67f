//! Photos that change exposure: what `--appearance` wins back, and what it finds, through the real binaries.

use crate::support::exif::{Settings, add_exif};
use crate::support::gpu;
use crate::support::scenes::{city, eval, psnr, stderr, summary, text, train};
use gsscale::gpu::GpuOptions;
use serde_json::Value;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Photos of the scene; every eighth is held out.
const VIEWS: u32 = 24;

/// Stops by which a training photo is changed: 1.2 up or down, and back.
fn stops(photo: usize) -> f64 {
    [0.6, -1.2, 0.0, 0.9, -0.6, 0.3][photo % 6]
}

/// A city whose training photos have other exposures, with the photos of the training views and their stops by name.
fn flickering_city(folder: &Path) -> (PathBuf, Vec<(String, f64)>) {
    let scene = city(folder, VIEWS, 112, 80, 1500);
    let mut photos: Vec<PathBuf> =
        std::fs::read_dir(scene.join("images")).unwrap().map(|e| e.unwrap().path()).collect();
    photos.sort();
    let mut changed = Vec::new();
    for (i, path) in photos.iter().enumerate().filter(|(i, _)| i % 8 != 0) {
        let mut photo = image::open(path).unwrap().to_rgb8();
        let gain = stops(i).exp2();
        photo.iter_mut().for_each(|byte| *byte = (f64::from(*byte) * gain).round().min(255.0) as u8);
        photo.save(path).unwrap();
        changed.push((path.file_name().unwrap().to_str().unwrap().to_string(), stops(i)));
    }
    (scene, changed)
}

fn run(scene: &Path, out: &Path, more: &[&str]) {
    let args =
        [text(scene), "--out", text(out), "--quiet", "--strategy", "none", "--sh-every", "0", "--sh-degree", "0"];
    let output = train(&[&args, more].concat());
    assert!(output.status.success(), "{}", stderr(&output));
}

/// The exposures of appearance.json, by photo.
fn exposures(out: &Path) -> Vec<(String, f64)> {
    let file: Value = serde_json::from_slice(&std::fs::read(out.join("appearance.json")).unwrap()).unwrap();
    let images = file["images"].as_array().unwrap().iter();
    images.map(|i| (i["name"].as_str().unwrap().to_string(), i["exposure"].as_f64().unwrap())).collect()
}

#[test]
fn exposures_that_change_are_found_and_cost_little() {
    let folder = TempDir::new().unwrap();
    let (scene, changed) = flickering_city(folder.path());
    let [plain, remedied, full] = ["plain", "exposure", "full"].map(|name| folder.path().join(name));
    let steps = ["--steps", "300", "--device", "cpu"];
    run(&scene, &plain, &steps);
    run(&scene, &remedied, &[&steps[..], &["--appearance", "exposure"]].concat());
    run(&scene, &full, &[&steps[..], &["--appearance", "full"]].concat());
    println!("{:.2} dB, with exposures {:.2} dB, all {:.2} dB", psnr(&plain), psnr(&remedied), psnr(&full));
    // Photos of these exposures cost this scene some 3 dB; what is asked here is well below what was seen.
    assert!(psnr(&remedied) > psnr(&plain) + 1.0 && psnr(&full) > psnr(&plain) + 1.0);
    // Exposures count from their mean. White photos hide how bright they would be, so a few tenths are allowed on a
    // photo, and less on average.
    let mean = changed.iter().map(|(_, stops)| stops).sum::<f64>() / changed.len() as f64;
    let found = exposures(&remedied);
    let errors: Vec<f64> = changed
        .iter()
        .zip(&found)
        .map(|((name, stops), (of, found))| {
            assert_eq!(name, of);
            (found - (stops - mean)).abs()
        })
        .collect();
    println!("{errors:.2?}");
    assert!(errors.iter().all(|e| *e < 0.4) && errors.iter().sum::<f64>() / (errors.len() as f64) < 0.15, "{errors:?}");
    // The three figures have three names, and a run without a correction has neither the file nor the figures.
    let test = &summary(&remedied)["test"];
    assert_eq!(test["half_fitted"]["model"], "exposure");
    assert!(test["half_fitted"]["right_psnr"].as_f64().unwrap() > 10.0);
    assert!(test.get("color_corrected").is_none());
    assert!(summary(&plain)["test"].get("half_fitted").is_none() && !plain.join("appearance.json").exists());
    let report = std::fs::read_to_string(remedied.join("report.html")).unwrap();
    assert!(report.contains("Appearance") && report.contains("fitted on the left"));
    // An evaluation of any PLY gives the figure too, and the same one.
    let again = eval(&[text(&remedied), text(&scene)]);
    let again: Value = serde_json::from_slice(&again.stdout).unwrap();
    let [was, is] = [test, &again["test"]].map(|t| t["half_fitted"]["fitted_right_psnr"].as_f64().unwrap());
    // The PLY holds the same Gaussians in another order.
    assert!((was - is).abs() < 0.01, "{was} {is}");
}

#[test]
fn a_black_photo_spoils_nothing_of_a_run_with_appearance() {
    let folder = TempDir::new().unwrap();
    let (scene, changed) = flickering_city(folder.path());
    let black = scene.join("images").join(&changed[2].0);
    image::RgbImage::new(112, 80).save(&black).unwrap();
    let out = folder.path().join("out");
    run(&scene, &out, &["--steps", "210", "--device", "cpu", "--appearance", "full"]);
    let found = exposures(&out);
    assert!(found.iter().all(|(_, stops)| stops.is_finite() && stops.abs() <= 8.0), "{found:?}");
    assert!(psnr(&out) > 12.0 && summary(&out)["rows_skipped_non_finite"] == 0, "{}", psnr(&out));
}

#[test]
fn a_gpu_finds_the_exposures_of_the_cpu() {
    if gpu::open(&GpuOptions::default()).is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let (scene, _) = flickering_city(folder.path());
    let [on_cpu, on_gpu] = ["cpu", "gpu"].map(|name| folder.path().join(name));
    for (out, device) in [(&on_cpu, "cpu"), (&on_gpu, "gpu")] {
        run(&scene, out, &["--steps", "63", "--appearance", "full", "--device", device]);
    }
    let (want, got) = (psnr(&on_cpu), psnr(&on_gpu));
    println!("{want:.3} dB on the CPU, {got:.3} dB on the GPU");
    // As without a correction: rounding differences grow with every step, in both directions.
    assert!((want - got).abs() < 0.1, "{got} dB, on the CPU {want} dB");
    // The values are optima of pictures that agree within rounding: a hundredth of a stop is a change of .7 %.
    for ((name, want), (_, got)) in exposures(&on_cpu).into_iter().zip(exposures(&on_gpu)) {
        assert!((want - got).abs() < 0.01, "{name}: {got} stops, on the CPU {want}");
    }
}

#[test]
fn threads_and_frames_give_the_same_bytes_with_appearance() {
    let folder = TempDir::new().unwrap();
    let (scene, _) = flickering_city(folder.path());
    let [one, two, paged, spill] = ["one", "two", "paged", "spill"].map(|name| folder.path().join(name));
    let flags = ["--steps", "45", "--appearance", "full", "--device", "cpu", "--page-rows", "64"];
    run(&scene, &one, &[&flags[..], &["--threads", "1"]].concat());
    run(&scene, &two, &[&flags[..], &["--threads", "2"]].concat());
    // Fewer frames than a view has pages: its steps go in batches.
    let frames = (summary(&one)["pages_pinned_max"].as_u64().unwrap() / 3).max(2).to_string();
    let of_drive = ["--frames", &frames, "--spill-dir", text(&spill), "--spill-codec", "raw"];
    run(&scene, &paged, &[&flags[..], &of_drive, &["--view-order", "shuffle"]].concat());
    for file in ["point_cloud.ply", "appearance.json"] {
        let [one, two, paged] = [&one, &two, &paged].map(|out| std::fs::read(out.join(file)).unwrap());
        assert!(one == two, "one thread and two threads differ: {file}");
        assert!(one == paged, "batches differ: {file}");
    }
}

/// Photos of a [`flickering_city`] get EXIF data that fit their stops, for each of the photos that `chosen` takes by number.
/// Values of photos have a gamma, so a stop of them is 2.2 stops of light.
fn add_settings(scene: &Path, changed: &[(String, f64)], chosen: impl Fn(usize) -> bool) {
    for (_, (name, stops)) in changed.iter().enumerate().filter(|(i, _)| chosen(*i)) {
        add_exif(&scene.join("images").join(name), &Settings::brighter_by(2.2 * stops).tiff());
    }
}

/// The files whose bytes a run must keep.
fn results(out: &Path) -> [Vec<u8>; 2] {
    ["point_cloud.ply", "appearance.json"].map(|file| std::fs::read(out.join(file)).unwrap())
}

fn from_exif(out: &Path) -> u64 {
    let file: Value = serde_json::from_slice(&std::fs::read(out.join("appearance.json")).unwrap()).unwrap();
    file["exposures_from_exif"].as_u64().unwrap()
}

#[test]
fn exposures_start_from_exif_data() {
    let folder = TempDir::new().unwrap();
    let (scene, changed) = flickering_city(folder.path());
    // One pass over the photos, so that no photo is seen twice.
    let steps = ["--steps", "21", "--device", "cpu", "--appearance", "exposure"];
    let [without, with] = ["without", "with"].map(|name| folder.path().join(name));
    run(&scene, &without, &steps);
    add_settings(&scene, &changed, |_| true);
    let args = [text(&scene), "--out", text(&with), "--strategy", "none", "--sh-every", "0", "--sh-degree", "0"];
    let output = train(&[&args[..], &steps].concat());
    assert!(output.status.success() && !stderr(&output).contains("warning: "), "{}", stderr(&output));
    assert!(stderr(&output).contains("21 exposures start from EXIF data"), "{}", stderr(&output));
    let mean = changed.iter().map(|(_, stops)| stops).sum::<f64>() / changed.len() as f64;
    let error = |out: &Path| {
        let found = exposures(out);
        let errors = changed.iter().zip(&found).map(|((_, stops), (_, found))| (found - (stops - mean)).abs());
        errors.sum::<f64>() / found.len() as f64
    };
    println!("mean error {:.3} and {:.3} stops", error(&without), error(&with));
    println!("{:.2} and {:.2} dB", psnr(&without), psnr(&with));
    assert!(error(&with) < 0.6 * error(&without) && psnr(&with) > psnr(&without) + 0.1);
    assert_eq!((from_exif(&without), from_exif(&with)), (0, 21));
    let report = |out: &Path| std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(report(&with).contains("21 exposures started from EXIF data"));
    assert!(!report(&without).contains("EXIF"));
}

#[test]
fn exif_data_of_too_few_photos_and_of_runs_without_appearance_change_no_byte() {
    let folder = TempDir::new().unwrap();
    let (scene, changed) = flickering_city(folder.path());
    let steps = ["--steps", "21", "--device", "cpu"];
    let on = [&steps[..], &["--appearance", "exposure"]].concat();
    let [without, few, off, off_with] = ["without", "few", "off", "off_with"].map(|name| folder.path().join(name));
    run(&scene, &without, &on);
    run(&scene, &off, &steps);
    add_settings(&scene, &changed, |i| i < 10);
    let args = [text(&scene), "--out", text(&few), "--strategy", "none", "--sh-every", "0", "--sh-degree", "0"];
    let said = stderr(&train(&[&args[..], &on].concat()));
    assert!(said.contains("warning: only 10 of 21 training photos state their exposure in EXIF data"), "{said}");
    assert!(results(&few) == results(&without));
    add_settings(&scene, &changed, |i| i >= 10);
    run(&scene, &off_with, &steps);
    let [off, off_with] = [&off, &off_with].map(|out| std::fs::read(out.join("point_cloud.ply")).unwrap());
    assert!(off == off_with);
}

#[test]
fn damaged_exif_data_are_named_in_one_warning_and_ignored() {
    let folder = TempDir::new().unwrap();
    let (scene, changed) = flickering_city(folder.path());
    add_settings(&scene, &changed, |i| i >= 5);
    for (name, _) in &changed[..5] {
        add_exif(&scene.join("images").join(name), b"II*\0\xff\xff\xff\x7f");
    }
    let out = folder.path().join("out");
    let args = [text(&scene), "--out", text(&out), "--steps", "2", "--device", "cpu", "--appearance", "full"];
    let output = train(&args);
    let said = stderr(&output);
    assert!(output.status.success() && said.matches("warning: ").count() == 1, "{said}");
    assert!(said.contains(&format!("damaged EXIF data are ignored: {} (", changed[0].0)), "{said}");
    assert!(said.contains(&format!("{}, {}, and 2 more", changed[1].0, changed[2].0)), "{said}");
    assert_eq!(from_exif(&out), 16);
}
