//! What a run finds out about its photos before training, and what it switches on because of it, through the real program.

use crate::support::scenes::{TextModel, told};
use crate::support::workdir::{TRAIN, Workdir};
use gsscale::config::file::TrainConfig;
use gsscale::dataset::disturb::{Disturbance, plan, write_disturbed};
use gsscale::dataset::plane_sweep::sweep;
use gsscale::dataset::synthetic::{CityOptions, write_city};
use gsscale::train::start::first_scene::prepare;

const SEED: u64 = 3;

/// The flags that the dry run of a disturbed scene says it has switched on, all it says, and the photos that are wrong.
fn switched_on(
    work: &Workdir,
    name: &str,
    disturbance: &Disturbance,
    more: &str,
) -> (Vec<String>, String, Vec<String>) {
    let dataset = prepare(&work.scene(), &TrainConfig::default()).unwrap().dataset;
    let made = plan(&dataset, disturbance, SEED).unwrap();
    if !work.exists(name) {
        write_disturbed(&work.path(name), &dataset, disturbance, SEED).unwrap();
    }
    let flags = format!("{name} --dry-run --steps 300 --device cpu --test-after {} {more}", made.test_after);
    let said = told(&work.succeeds(TRAIN, &flags));
    let words: Vec<&str> = said.split_whitespace().collect();
    let flags = match words.windows(4).position(|four| four == ["so", "this", "run", "has"]) {
        Some(at) => {
            words[at + 4..].iter().take_while(|word| **word != "each").map(|word| word.trim_matches(';')).collect()
        }
        None => Vec::new(),
    };
    (flags.into_iter().map(str::to_string).collect(), said, made.wrong)
}

#[test]
fn each_fault_of_a_capture_switches_its_remedy_on_and_a_clean_one_none() {
    let work = Workdir::city(32, 160, 112, 3000);
    let swapped = Disturbance::Swapped { share: 0.2, are_removed: false };
    for (name, disturbance, want) in [
        ("clean", Disturbance::Nothing, &[][..]),
        ("exposure", Disturbance::Exposure { stops: 0.5 }, &["--appearance", "exposure"]),
        ("colors", Disturbance::WhiteBalance { stops: 0.3 }, &["--appearance", "full"]),
        ("swapped", swapped, &["--robust-views"]),
        ("poses", Disturbance::PoseNoise { share: 0.005 }, &["--refine-poses"]),
        ("jpeg", Disturbance::Jpeg { quality: 20 }, &[]),
        ("few", Disturbance::FewPhotos { one_in: 3 }, &[]),
        // Points that the photos agree on take their place, and say what the points of the scene cannot.
        ("random", Disturbance::RandomPoints, &[]),
    ] {
        let (flags, said, wrong) = switched_on(&work, name, &disturbance, "");
        assert_eq!(flags, want, "{name}: {said}");
        assert_eq!(said.contains("Gaussians begin at such points"), name == "random", "{said}");
        if name == "swapped" {
            assert!(said.contains(&format!("{} do not show what", wrong.len())), "{said}");
        }
    }
    // Without such points nothing is known of the photos.
    let (flags, said, _) = switched_on(&work, "random", &Disturbance::RandomPoints, "--sweep-points=off");
    assert_eq!(flags, ["--appearance", "if-needed"]);
    assert!(said.contains("have not the colours that"), "{said}");
    // A flag decides otherwise.
    let (flags, ..) = switched_on(&work, "swapped", &swapped, "--robust-views=off");
    assert!(flags.is_empty(), "{flags:?}");
    let (flags, ..) = switched_on(&work, "exposure", &Disturbance::Exposure { stops: 0.5 }, "--appearance full");
    assert!(flags.is_empty(), "{flags:?}");
}

/// The photos have other exposures, of which a correlation sees nothing.
#[test]
fn points_that_photos_agree_on_are_on_surfaces_and_are_worth_decibels() {
    let work = Workdir::new();
    let size = CityOptions { seed: 5, views: 24, width: 160, height: 112, points: 20_000, ..CityOptions::default() };
    write_city(&work.scene(), &CityOptions { exposure: 0.3, ..size }, &|_, _| {}).unwrap();
    let dataset = prepare(&work.scene(), &TrainConfig::default()).unwrap().dataset;
    let (points, colors) = sweep(&dataset, SEED);
    assert!(points.len() > 2000 && points.len() == colors.len(), "{}", points.len());
    let to_surface = |point: &[f32; 3]| {
        let distance2 = |own: &[f32; 3]| own.iter().zip(point).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
        dataset.points.iter().map(distance2).fold(f32::INFINITY, f32::min).sqrt()
    };
    let mut distances: Vec<f32> = points.iter().step_by(20).map(to_surface).collect();
    distances.sort_by(f32::total_cmp);
    // The next of 20,000 points of the city is some .01 scales away; the depths that are tried first are .04 of themselves apart.
    let [median, most] =
        [2, 10].map(|part| distances[distances.len() - 1 - distances.len() / part] / dataset.scene_scale);
    println!("{} points, {median:.4} scales from a point of the city (median), {most:.4} (nine tenths)", points.len());
    assert!(median < 0.02 && most < 0.06, "{median} {most}");
    // The same for any number of threads.
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(alone.install(|| sweep(&dataset, SEED)) == (points, colors));

    let mut model = TextModel::of(&work.scene());
    (model.points, model.colors) = (Vec::new(), Vec::new());
    model.write(&work.scene());
    let flags = "--steps 200 --max-gaussians 6000 --seed 1 --appearance off";
    work.run("swept", flags);
    work.run("random", &format!("{flags} --sweep-points=off"));
    let [swept, random] = ["swept", "random"].map(|out| work.psnr(out));
    println!("{swept:.2} dB from such points, {random:.2} from random ones");
    // Well below what was seen.
    assert!(swept > random + 1.0, "{swept} {random}");
}

/// A photo of a large city shows a small part of its points.
#[test]
fn photos_of_a_large_city_are_examined_too() {
    let work = Workdir::new();
    let size = CityOptions { views: 40, width: 96, height: 64, points: 1000, ..CityOptions::default() };
    let options = CityOptions { tiles: [30, 30], exposure: 0.3, ..size };
    write_city(&work.path("city"), &options, &|_, _| {}).unwrap();
    let said = told(&work.output(TRAIN, "city --dry-run --steps 300 --device cpu --spill-dir spill"));
    assert!(said.contains("35 examined") && said.contains("--appearance exposure"), "{said}");
}

#[test]
fn exposures_are_known_before_training_and_the_run_keeps_what_it_switched_on() {
    let work = Workdir::city(24, 160, 112, 3000);
    let (_, _, _) = switched_on(&work, "clean", &Disturbance::Nothing, "");
    let (flags, ..) = switched_on(&work, "bright", &Disturbance::Exposure { stops: 1.0 }, "");
    assert_eq!(flags, ["--appearance", "exposure"]);
    let photos = |scene: &str| -> Vec<(String, f64)> {
        work.train(&format!("{scene} --out {scene}-out --steps 2 --quiet --device cpu --test-after 20"));
        let file = work.json(&format!("{scene}-out/diagnosis.json"));
        let photos = file["photos"].as_array().unwrap();
        photos.iter().map(|p| (p["name"].as_str().unwrap().into(), p["gain"][1].as_f64().unwrap())).collect()
    };
    let [clean, bright] = ["clean", "bright"].map(photos);
    assert!(clean.len() >= 20 && clean.len() == bright.len());
    // By how many stops a photo is brighter than its clean twin, from its own pixels: the truth.
    let truth = |name: &str| {
        let [clean, bright] = ["clean", "bright"]
            .map(|scene| image::open(work.path(scene).join("images").join(name)).unwrap().into_rgb8());
        let is_clear = |(a, b): &(u8, u8)| (20..235).contains(a) && (20..235).contains(b);
        let greens = clean.pixels().zip(bright.pixels()).map(|(a, b)| (a[1], b[1])).filter(is_clear);
        let mut stops: Vec<f64> = greens.map(|(a, b)| (f64::from(b) / f64::from(a)).log2()).collect();
        stops.sort_by(f64::total_cmp);
        stops[stops.len() / 2]
    };
    for ((name, before), (same, after)) in clean.iter().zip(&bright) {
        assert_eq!(name, same);
        let (found, truth) = (after - before, truth(name));
        assert!((found - truth).abs() < 0.1, "{name}: {found:.3} stops found, {truth:.3} true");
    }
    let config = work.text("bright-out/config.toml");
    assert!(config.contains("appearance = \"exposure\"") && config.contains("robust-views = \"off\""), "{config}");
    assert!(work.text("bright-out/report.html").contains("Photos before training"));
}
