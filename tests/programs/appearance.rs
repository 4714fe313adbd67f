//! Photos that change exposure: what `--appearance` wins back, and what it finds, through the real binaries.

use crate::support::a_device;
use crate::support::exif::{Settings, add_exif};
use crate::support::scenes::TextModel;
use crate::support::workdir::{EVAL, TRAIN, Workdir};
use std::collections::BTreeMap;
use std::path::Path;

/// Stops by which a training photo is changed: 1.2 up or down, and back.
fn stops(photo: usize) -> f64 {
    [0.6, -1.2, 0.0, 0.9, -0.6, 0.3][photo % 6]
}

fn brighten(path: &Path, photo: usize) {
    let mut pixels = image::open(path).unwrap().to_rgb8();
    let gain = stops(photo).exp2();
    pixels.iter_mut().for_each(|byte| *byte = (f64::from(*byte) * gain).round().min(255.0) as u8);
    pixels.save(path).unwrap();
}

/// A city of 24 photos whose training photos (every eighth is held out) have other exposures, with the names of these photos and their
/// stops.
fn flickering_city() -> (Workdir, Vec<(String, f64)>) {
    let work = Workdir::city(24, 112, 80, 1500);
    let mut changed = Vec::new();
    for (i, path) in work.photos().iter().enumerate().filter(|(i, _)| i % 8 != 0) {
        brighten(path, i);
        changed.push((path.file_name().unwrap().to_str().unwrap().to_string(), stops(i)));
    }
    (work, changed)
}

const FLAGS: &str = "--strategy none --sh-every 0 --sh-degree 0";

fn run(work: &Workdir, out: &str, more: &str) {
    work.run(out, &format!("{FLAGS} {more}"));
}

/// Like [`run`], and returns what it said.
fn said(work: &Workdir, out: &str, more: &str) -> String {
    work.train(&format!("scene --out {out} --device cpu {FLAGS} {more}"))
}

/// The exposures of appearance.json, by photo.
fn exposures(work: &Workdir, out: &str) -> Vec<(String, f64)> {
    let file = work.json(&format!("{out}/appearance.json"));
    let images = file["images"].as_array().unwrap().iter();
    images.map(|i| (i["name"].as_str().unwrap().to_string(), i["exposure"].as_f64().unwrap())).collect()
}

/// By how much the exposures of a run differ from the true ones. They count from their mean.
fn errors(work: &Workdir, out: &str, changed: &[(String, f64)]) -> Vec<f64> {
    let mean = changed.iter().map(|(_, stops)| stops).sum::<f64>() / changed.len() as f64;
    let pairs = changed.iter().zip(exposures(work, out));
    let error = |((name, stops), (of, found)): (&(String, f64), (String, f64))| {
        assert_eq!(*name, of);
        (found - (stops - mean)).abs()
    };
    pairs.map(error).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Nothing is known of photos before training where the scene has no points.
#[test]
fn without_points_the_run_finds_out_whether_exposures_differ() {
    let (work, changed) = flickering_city();
    let without_points = |work: &Workdir| {
        let mut model = TextModel::of(&work.scene());
        (model.points, model.colors) = (Vec::new(), Vec::new());
        model.write(&work.scene());
    };
    without_points(&work);
    // Four passes of 21 photos.
    let flags = "--steps 90 --init-points 1500 --sweep-points=off";
    let told = said(&work, "flickering", flags);
    assert!(told.contains("no points to examine them by") && told.contains("has --appearance if-needed;"), "{told}");
    assert!(told.contains("stops between photos: they stay corrected"), "{told}");
    let errors = errors(&work, "flickering", &changed);
    // A pass over random points finds less than one over the points of the scene.
    assert!(mean(&errors) < 0.3, "{errors:?}");
    let evaluated = work.output(EVAL, "flickering --device cpu --json flickering.json");
    assert!(
        evaluated.status.success() && work.json("flickering.json")["test"]["predicted"].is_object(),
        "exposures are not used"
    );
    let clean = Workdir::city(24, 112, 80, 1500);
    without_points(&clean);
    let told = said(&clean, "clean", flags);
    assert!(told.contains("stops between photos: they are no longer corrected"), "{told}");
    assert!(!clean.exists("clean/appearance.json") && clean.summary("clean")["test"]["predicted_psnr"].is_null());
    // More steps of a run whose checkpoint is gone find it out again.
    let told = clean.train("--resume clean --steps 180 --device cpu");
    assert!(told.contains("its Gaussians") && told.contains("they are no longer corrected"), "{told}");
    assert!(!clean.exists("clean/appearance.json"));
}

/// Exposures of another run, whose mean is held, are part of a commit: a run that goes on needs no file.
#[test]
fn a_run_that_goes_on_keeps_the_mean_of_given_exposures() {
    let (work, _) = flickering_city();
    run(&work, "given", "--steps 60 --appearance exposure");
    let flags = "--steps 90 --appearance exposure --first-appearance given/appearance.json";
    run(&work, "whole", flags);
    run(&work, "other", "--steps 90 --appearance exposure");
    assert!(work.ply("other") != work.ply("whole"), "given exposures change nothing, so the test shows little");
    let cut = format!("scene --quiet --out cut --device cpu {FLAGS} {flags} --commit-every 0.01 --log-every 1");
    assert!(work.begin(&cut).after_lines("cut", 40).kill());
    let resumed = work.output(TRAIN, "--resume cut --quiet --device cpu --first-appearance=");
    assert!(resumed.status.success() && work.ply("cut") == work.ply("whole"), "the mean of given exposures is lost");
    // A file that a resume names is not read, and not written down as if it had been.
    let named = |out: &str| {
        std::fs::read_to_string(work.path(out).join("config.toml")).unwrap().contains("given/appearance.json")
    };
    assert!(named("whole") && named("cut"));
    // More steps without a checkpoint go on from the exposures that the run has learnt.
    let exposures = |out: &str| {
        let file = std::fs::read(work.path(out).join("appearance.json")).unwrap();
        let file: serde_json::Value = serde_json::from_slice(&file).unwrap();
        let images = file["images"].as_array().unwrap().iter();
        images.map(|image| image["exposure"].as_f64().unwrap()).collect::<Vec<_>>()
    };
    let far = std::fs::read_to_string(work.path("given/appearance.json")).unwrap();
    let mut far: serde_json::Value = serde_json::from_str(&far).unwrap();
    far["images"].as_array_mut().unwrap().iter_mut().enumerate().for_each(|(i, image)| {
        image["exposure"] = if i % 2 == 0 { 1.0 } else { -1.0 }.into();
    });
    std::fs::write(work.path("far.json"), far.to_string()).unwrap();
    run(&work, "learnt", "--steps 240 --appearance exposure --first-appearance far.json");
    let before = exposures("learnt");
    work.train("--resume learnt --steps 242 --quiet --device cpu");
    let moved = before.iter().zip(exposures("learnt")).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // Two steps move an exposure by a few hundredths; those of the file are a stop away.
    assert!(moved < 0.2 && before.iter().any(|exposure| exposure.abs() < 0.7), "{moved}: {before:?}");
}

#[test]
fn exposures_that_change_are_found_and_cost_little() {
    let (work, changed) = flickering_city();
    for (out, more) in
        [("plain", "--appearance off"), ("exposure", "--appearance exposure"), ("full", "--appearance full")]
    {
        run(&work, out, &format!("--steps 300 {more}"));
    }
    let [plain, remedied, full] = ["plain", "exposure", "full"].map(|out| work.psnr(out));
    println!("{plain:.2} dB, with exposures {remedied:.2} dB, all {full:.2} dB");
    // Photos of these exposures cost this scene some 3 dB; what is asked here is well below what was seen.
    assert!(remedied > plain + 1.0 && full > plain + 1.0);
    // White photos hide how bright they would be, so a few tenths are allowed on a photo, and less on average.
    let errors = errors(&work, "exposure", &changed);
    println!("{errors:.2?}");
    assert!(errors.iter().all(|e| *e < 0.4) && mean(&errors) < 0.15, "{errors:?}");
    // The figures have their own names, and a run without a correction has neither the file nor the figures.
    let test = &work.summary("exposure")["test"];
    assert_eq!(test["half_fitted"]["model"], "exposure");
    assert!(test["half_fitted"]["right_psnr"].as_f64().unwrap() > 10.0);
    // Exposures that alternate say nothing about those of held-out photos, so that the mean is predicted.
    let predicted = test["predicted"]["predicted_psnr"].as_f64().unwrap();
    assert!((predicted - test["psnr"].as_f64().unwrap()).abs() < 0.5, "{test}");
    assert_eq!(test["color_corrected"]["method"], "affine");
    assert!(work.summary("plain")["test"].get("half_fitted").is_none() && !work.exists("plain/appearance.json"));
    let report = work.text("exposure/report.html");
    assert!(report.contains("Appearance") && report.contains("fitted on the left"));
    // An evaluation of the run gives the figures too, and the same ones.
    let again = work.json_of(EVAL, "exposure scene");
    for (part, figure) in [
        ("half_fitted", "fitted_right_psnr"),
        ("predicted", "predicted_psnr"),
        ("predicted", "predicted_ssim"),
        ("color_corrected", "cc_psnr"),
    ] {
        let [was, is] = [test, &again["test"]].map(|t| t[part][figure].as_f64().unwrap());
        // The PLY holds the same Gaussians in another order.
        assert!((was - is).abs() < 0.01, "{figure}: {was} {is}");
    }
}

/// Held-out photos flicker, too, and their EXIF data say so, which no neighbour could.
#[test]
fn exif_data_tell_the_exposures_of_held_out_photos() {
    let (work, _) = flickering_city();
    for (i, path) in work.photos().iter().enumerate() {
        if i % 8 == 0 {
            brighten(path, i);
        }
        // Pixels are not linear in light.
        add_exif(path, &Settings::brighter_by(2.2 * stops(i)).tiff());
    }
    run(&work, "exif", "--steps 200 --appearance exposure");
    let test = &work.summary("exif")["test"];
    let [plain, predicted] = [&test["psnr"], &test["predicted"]["predicted_psnr"]].map(|psnr| psnr.as_f64().unwrap());
    println!("{plain:.2} dB as they are, {predicted:.2} dB predicted");
    assert!(predicted > plain + 1.0, "{test}");
}

#[test]
fn a_black_photo_spoils_nothing_of_a_run_with_appearance() {
    let (work, changed) = flickering_city();
    image::RgbImage::new(112, 80).save(work.path("scene/images").join(&changed[2].0)).unwrap();
    run(&work, "out", "--steps 210 --appearance full");
    let found = exposures(&work, "out");
    assert!(found.iter().all(|(_, stops)| stops.is_finite() && stops.abs() <= 8.0), "{found:?}");
    assert!(work.psnr("out") > 12.0 && work.count("out", "rows_skipped_non_finite") == 0, "{}", work.psnr("out"));
}

#[test]
fn a_gpu_finds_the_exposures_of_the_cpu() {
    let Some(()) = a_device() else { return };
    let (work, _) = flickering_city();
    for device in ["cpu", "gpu"] {
        run(&work, device, &format!("--steps 63 --appearance full --device {device}"));
    }
    let (want, got) = (work.psnr("cpu"), work.psnr("gpu"));
    println!("{want:.3} dB on the CPU, {got:.3} dB on the GPU");
    // As without a correction: rounding differences grow with every step, in both directions.
    assert!((want - got).abs() < 0.1, "{got} dB, on the CPU {want} dB");
    // The values are optima of pictures that agree within rounding: a hundredth of a stop is a change of .7 %.
    for ((name, want), (_, got)) in exposures(&work, "cpu").into_iter().zip(exposures(&work, "gpu")) {
        assert!((want - got).abs() < 0.01, "{name}: {got} stops, on the CPU {want}");
    }
}

/// Photos of a [`flickering_city`] get EXIF data that fit their stops, for each of the photos that `chosen` takes by number.
/// Values of photos have a gamma, so a stop of them is 2.2 stops of light.
fn add_settings(work: &Workdir, changed: &[(String, f64)], chosen: impl Fn(usize) -> bool) {
    for (_, (name, stops)) in changed.iter().enumerate().filter(|(i, _)| chosen(*i)) {
        add_exif(&work.path("scene/images").join(name), &Settings::brighter_by(2.2 * stops).tiff());
    }
}

fn from_exif(work: &Workdir, out: &str) -> u64 {
    work.json(&format!("{out}/appearance.json"))["exposures_from_exif"].as_u64().unwrap()
}

#[test]
fn exposures_start_from_exif_data() {
    let (work, changed) = flickering_city();
    // One pass over the photos, so that no photo is seen twice.
    let steps = "--steps 21 --appearance exposure";
    run(&work, "without", steps);
    add_settings(&work, &changed, |_| true);
    let said = said(&work, "with", steps);
    assert!(!said.contains("warning: ") && said.contains("21 exposures start from EXIF data"), "{said}");
    let [without, with] = ["without", "with"].map(|out| (mean(&errors(&work, out, &changed)), work.psnr(out)));
    println!("mean error and dB: {without:.3?} and {with:.3?}");
    assert!(with.0 < 0.6 * without.0 && with.1 > without.1 + 0.1);
    assert_eq!(["without", "with"].map(|out| from_exif(&work, out)), [0, 21]);
    assert!(work.text("with/report.html").contains("21 exposures started from EXIF data"));
    assert!(!work.text("without/report.html").contains("EXIF"));
}

#[test]
fn exif_data_of_too_few_photos_and_of_runs_without_appearance_change_no_byte() {
    let (work, changed) = flickering_city();
    let [on, off] = ["exposure", "off"].map(|mode| format!("--steps 21 --appearance {mode}"));
    run(&work, "without", &on);
    run(&work, "off", &off);
    add_settings(&work, &changed, |i| i < 10);
    let said = said(&work, "few", &on);
    assert!(said.contains("warning: only 10 of 21 training photos state their exposure in EXIF data"), "{said}");
    let results = |out: &str| [work.ply(out), work.bytes(&format!("{out}/appearance.json"))];
    assert!(results("few") == results("without"));
    add_settings(&work, &changed, |i| i >= 10);
    run(&work, "off_with", &off);
    assert!(work.ply("off") == work.ply("off_with"));
}

#[test]
fn damaged_exif_data_are_named_in_one_warning_and_ignored() {
    let (work, changed) = flickering_city();
    add_settings(&work, &changed, |i| i >= 5);
    for (name, _) in &changed[..5] {
        add_exif(&work.path("scene/images").join(name), b"II*\0\xff\xff\xff\x7f");
    }
    let said = work.train("scene --out out --steps 2 --device cpu --appearance full");
    assert_eq!(said.matches("warning: ").count(), 1, "{said}");
    assert!(said.contains(&format!("damaged EXIF data are ignored: {} (", changed[0].0)), "{said}");
    assert!(said.contains(&format!("{}, {}, and 2 more", changed[1].0, changed[2].0)), "{said}");
    assert_eq!(from_exif(&work, "out"), 16);
}

/// A name on each line, for --views-file.
fn list(work: &Workdir, photos: impl Iterator<Item = usize>) {
    let names = work.photos();
    let line = |photo: usize| format!("{}\n", names[photo].file_name().unwrap().to_str().unwrap());
    work.write("views.txt", photos.map(line).collect::<String>());
}

/// Exposure and sightings of each photo, by name.
fn sightings(work: &Workdir, out: &str) -> BTreeMap<String, (f64, u64)> {
    let file = work.json(&format!("{out}/appearance.json"));
    let of = |image: &serde_json::Value| (image["exposure"].as_f64().unwrap(), image["sightings"].as_u64().unwrap());
    let images = file["images"].as_array().unwrap().iter();
    images.map(|image| (image["name"].as_str().unwrap().to_string(), of(image))).collect()
}

/// With one photo less and another one more, and with one more alone: the values of all others stay theirs, wherever they stand in the list.
#[test]
fn what_is_known_of_photos_follows_them_when_the_list_changes() {
    let (work, _) = flickering_city();
    list(&work, 0..20);
    run(
        &work,
        "out",
        "--steps 60 --appearance full --refine-poses --robust-pixels --robust-views --views-file views.txt --keep-checkpoint",
    );
    let (before, poses) = (sightings(&work, "out"), work.json("out/poses.json"));
    let turns = |poses: &serde_json::Value| -> BTreeMap<String, f64> {
        let images = poses["images"].as_array().unwrap().iter();
        images.map(|i| (i["name"].as_str().unwrap().to_string(), i["turn_degrees"].as_f64().unwrap())).collect()
    };
    let turns_before = turns(&poses);
    for (photos, steps) in [([1..1, 2..22], 61), ([1..2, 2..23], 62)] {
        list(&work, std::iter::once(0).chain(photos.into_iter().flatten()));
        work.train(&format!("--resume out --accept-changes --steps {steps} --quiet"));
        let after = sightings(&work, "out");
        let mut compared = 0;
        for (name, (exposure, seen)) in after {
            let Some(&(was, seen_before)) = before.get(&name) else {
                assert!(seen <= 2, "{name} is new, and was seen {seen} times");
                continue;
            };
            // A photo that has left the list begins anew when it returns. The steps since have moved one or two of the others a little.
            if seen >= seen_before {
                // The mean of all photos, which has changed with them, is not in it. Neighbours differ by .6 and more.
                assert!((exposure - was).abs() < 0.2, "{name}: {exposure} after {was}");
                let turn = turns(&work.json("out/poses.json"))[&name];
                assert!(
                    (turn - turns_before[&name]).abs() < 0.05,
                    "{name}: turned by {turn} after {}",
                    turns_before[&name]
                );
                compared += 1;
            }
        }
        assert!(compared >= 15, "{compared} photos kept their values");
    }
    // What was chosen stays chosen, and what is off by now leaves no file.
    work.train("--resume out --accept-changes --steps 63 --quiet --appearance auto --refine-poses off");
    assert!(work.text("out/config.toml").contains("appearance = \"full\""));
    assert!(!work.exists("out/poses.json") && work.exists("out/appearance.json"));
}

/// More steps of a run whose checkpoint is gone start from the exposures that it found.
#[test]
fn more_steps_keep_exposures() {
    let (work, _) = flickering_city();
    run(&work, "out", "--steps 60 --appearance exposure");
    let before = sightings(&work, "out");
    let said = work.train("--resume out --steps 62 --device cpu");
    assert!(said.contains("lost: Adam's moments;"), "{said}");
    for (name, (exposure, seen)) in sightings(&work, "out") {
        assert!(
            seen >= before[&name].1 && (exposure - before[&name].0).abs() < 0.2,
            "{name}: {exposure}, {:?}",
            before[&name]
        );
    }
    assert!(!work.text("out/config.toml").contains("appearance.json"));
}
