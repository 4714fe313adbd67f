//! Published runs: config files against the papers' tables, and the way from a dataset folder to a table beside the
//! paper's, as configs/README.md describes it. On look-alike datasets through the real binaries.

use crate::support::lookalike::write_lookalike;
use crate::support::lpips::lpips_weights;
use crate::support::scenes::{stderr, told};
use crate::support::workdir::{BENCH, EVAL, Running, Workdir, says};
use gsscale::config::file::TrainConfig;
use gsscale::config::published::{BUILT_IN, PublishedRun};
use gsscale::config::values::Chosen;
use gsscale::dataset::layout::Layout;
use gsscale::dataset::synthetic::CityOptions;
use gsscale::densify::strategy::StrategyName;
use gsscale::photos::exposure::AppearanceMode;
use gsscale::render::metrics::SsimVariant;
use serde_json::Value;
use std::fs;
use std::path::Path;

/// GS-Scale's per-scene dictionary, typed from the paper's table rather than from the config files: name, data_factor,
/// test_every, test_after, position_lr, scaling_lr, smallest tier's refine_stop_iter, training size.
#[rustfmt::skip]
type SceneRow = (&'static str, f64, u32, i64, f64, f64, u32, Option<[u32; 2]>);
#[rustfmt::skip]
const SCENES: [SceneRow; 8] = [
    ("rubble",    4.0,    83, -1,   0.000016, 0.005,  5000, Some([1152, 864])),
    ("building",  4.0,    97, -1,   0.000008, 0.0025, 5000, Some([1152, 864])),
    ("lfls",      3.4175, 10, -1,   0.000016, 0.005,  4000, Some([1600, 1064])),
    ("sziit",     3.4175, 10, -1,   0.000016, 0.005,  5000, Some([1600, 1064])),
    ("sztu",      3.4175, 10, -1,   0.000016, 0.005,  4000, Some([1600, 1064])),
    ("aerial",    1.2,    0,  5620, 0.000008, 0.0025, 5000, Some([1600, 900])),
    ("residence", 4.0,    0,  2561, 0.000016, 0.005,  5000, None),
    ("sciart",    4.0,    0,  2998, 0.000016, 0.005,  5000, None),
];

/// GS-Scale's quality table: PSNR, SSIM, LPIPS of the unchanged trainer, then its own.
#[rustfmt::skip]
const QUALITY: [(&str, [f64; 6]); 6] = [
    ("rubble",   [26.63, 0.808, 0.194, 26.62, 0.808, 0.194]),
    ("building", [22.74, 0.777, 0.211, 22.78, 0.777, 0.211]),
    ("lfls",     [24.04, 0.752, 0.234, 24.08, 0.752, 0.233]),
    ("sziit",    [26.28, 0.797, 0.213, 26.29, 0.797, 0.213]),
    ("sztu",     [24.90, 0.835, 0.155, 24.95, 0.836, 0.155]),
    ("aerial",   [27.69, 0.873, 0.127, 27.66, 0.873, 0.128]),
];

/// The tiers above the smallest: grow_grad2d, grow_scale3d, refine_stop_iter.
const TIERS: [(&str, f64, f64, u32); 5] = [
    ("S1", 0.0002, 0.01, 15_000),
    ("S2", 0.00015, 0.005, 15_000),
    ("S3", 0.00013, 0.003, 15_000),
    ("S4", 0.0001, 0.002, 15_000),
    ("S5", 0.00008, 0.0016, 15_000),
];

fn find(name: &str) -> PublishedRun {
    PublishedRun::find(Path::new(name)).unwrap_or_else(|e| panic!("{e}"))
}

const SHARED: &str = r#"steps = 200000, seed = 42, sh-degree = 3, sh-start = 0, sh-every = 1000, init-opacity = 0.1, init-scale = 1.0,
    ssim-lambda = 0.2, ssim-padding = "valid", near-plane = 0.01, max-alpha = 0.999, background = [0.0; 0.0; 0.0], means-lr-final = 0.01,
    quats-lr = 0.001, opacities-lr = 0.05, sh0-lr = 0.0025, shn-lr = 0.000125, adam-eps = 1e-15, strategy = "default", max-gaussians = 0,
    refine-start = 500, refine-every = 100, reset-every = 3000, prune-opa = 0.005, prune-scale3d = 0.1, ssim-variant = "reflect",
    view-order = "shuffle""#;

#[test]
fn the_files_hold_the_tables() {
    assert_eq!(BUILT_IN.len(), SCENES.len());
    for (name, data_factor, test_every, test_after, means_lr, scales_lr, smallest, size) in SCENES {
        let mut run = find(name);
        let expected = TrainConfig {
            data_factor,
            test_every,
            test_after,
            means_lr,
            scales_lr,
            grow_grad2d: 0.0002,
            grow_scale3d: 0.01,
            refine_stop: 15_000,
            ..TrainConfig::parse(&SHARED.replace(',', "\n").replace(';', ",")).unwrap()
        };
        // And no remedy.
        let off = Chosen(Some(false));
        let (poor_points, sweep_points, robust_views, robust_pixels, refine_poses) = (off, off, off, off, off);
        let appearance = Chosen(Some(AppearanceMode::Off));
        let expected = TrainConfig {
            appearance,
            poor_points,
            sweep_points,
            robust_views,
            robust_pixels,
            refine_poses,
            ..expected
        };
        assert_eq!(run.config, expected, "{name}");
        assert_eq!((run.facts.size, run.tier_of(&run.config)), (size, Some("S1")), "{name}");
        assert_eq!(run.tiers.len(), 6);
        for (tier, grow_grad2d, grow_scale3d, refine_stop) in TIERS.into_iter().chain([("S0", 0.0002, 0.01, smallest)])
        {
            run.use_tier(tier).unwrap();
            assert_eq!(run.config, TrainConfig { grow_grad2d, grow_scale3d, refine_stop, ..expected.clone() });
        }
        let said = run.use_tier("S6").unwrap_err().to_string();
        assert!(said.contains("S0, S1, S2, S3, S4, S5"), "{said}");
        for layout in &run.facts.layouts {
            layout.parse::<Layout>().unwrap();
        }
        assert!(run.facts.fetch.iter().all(|f| f.starts_with("https://")) && !run.facts.fetch.is_empty());
    }
    assert_eq!((find("rubble").facts.views, find("rubble").facts.held_out), (Some(1657 + 21), Some(21)));
}

#[test]
fn the_files_hold_the_published_figures() {
    for (name, _) in BUILT_IN {
        let facts = find(name).facts;
        let Some((_, figures)) = QUALITY.iter().find(|(scene, _)| *scene == name) else {
            assert!(facts.expected.is_none() && facts.memory.is_none(), "{name} is not in the paper's tables");
            continue;
        };
        let e = facts.expected.unwrap();
        assert_eq!([e.original_psnr, e.original_ssim, e.original_lpips, e.psnr, e.ssim, e.lpips], *figures, "{name}");
        assert_eq!((e.ssim_variant, e.lpips_variant.as_str()), (SsimVariant::Reflect, "alex, signed"));
        let memory = facts.memory.unwrap();
        assert_eq!((memory.saving_range, memory.saving_mean), ([3.3, 5.6], 3.98));
        assert_eq!(memory.saving, (name == "aerial").then_some(5.5));
    }
}

#[test]
fn a_file_of_ones_own_is_read_as_strictly() {
    let work = Workdir::new();
    let path = work.path("mine.toml");
    let with = |from: &str, to: &str| {
        fs::write(&path, BUILT_IN[0].1.replacen(from, to, 1)).unwrap();
        PublishedRun::find(&path).map_err(|e| e.to_string())
    };
    let mine = with("steps = 200000", "steps = 7").unwrap();
    assert_eq!((mine.name.as_str(), mine.config.steps), ("mine", 7));
    assert!(with("original-psnr", "orginal-psnr").unwrap_err().contains("orginal-psnr"));
    assert!(with("[tier.S0]\ngrow-grad2d", "[tier.S0]\ngrow-grad").unwrap_err().contains("grow-grad"));
    assert!(with("[published]", "[publishd]").unwrap_err().contains("publishd"));
    fs::write(&path, "steps = 7\n").unwrap();
    assert!(PublishedRun::find(&path).unwrap_err().to_string().contains("no table [published]"));
    let said = PublishedRun::find(Path::new("rubbel")).unwrap_err().to_string();
    assert!(said.contains("rubble, building"), "{said}");
}

/// Writes a look-alike to the folder of its layout's name, which it returns.
fn lookalike(work: &Workdir, layout: Layout) -> &'static str {
    let options = CityOptions { seed: 5, views: 24, width: 96, height: 64, points: 1500, ..CityOptions::default() };
    write_lookalike(&work.path(layout.name()), &options, layout, 6);
    layout.name()
}

/// Flags of runs on a look-alike.
const RUBBLE: &str = "run rubble --data colmap-merged --out out";
const SHORT: &str = "--steps 30 --data-factor 1 --device cpu";

#[test]
fn a_run_is_set_beside_the_published_one() {
    let work = Workdir::new();
    let data = lookalike(&work, Layout::ColmapMerged);
    let before = work.files(data);
    let (line, said) = work.json_and_words(BENCH, &format!("{RUBBLE} {SHORT} --tier S2 --color-correct affine"));
    assert_eq!(
        (&line["tier"], &line["layout"], &line["comparable"]),
        (&"S2".into(), &"colmap-merged".into(), &false.into())
    );
    assert_eq!(line["published"]["psnr"], 26.62);
    let ours = line["ours"]["test"]["psnr"].as_f64().unwrap();
    assert!((line["difference"]["psnr"].as_f64().unwrap() - (ours - 26.62)).abs() < 1e-9);
    assert!(line["difference"]["ssim"].is_number() && line["difference"]["lpips"].is_null(), "{line}");
    let corrected = line["ours"]["test"]["color_corrected"]["cc_psnr"].as_f64().unwrap();
    assert!(corrected.is_finite() && line["ours"]["test"]["color_corrected"]["method"] == "affine");
    let why = line["not_the_published_run"].to_string();
    says(&why, &["24 photos instead of 1678", "4 held-out photos instead of 21", "steps = 30 instead of 200000"]);
    says(
        &said,
        &[
            "Mill-19 Rubble, tier S2",
            "GS-Scale",
            "26.62",
            "colour-corrected PSNR (affine), dB",
            "not the published run: ",
            "SSIM (reflect)",
        ],
    );
    let page = work.text("out/published.html");
    assert!(page.contains("26.62") && page.contains("colour-corrected PSNR (affine)"));
    assert!(work.exists("out/report.html") && work.exists("out/published.json"));
    assert!(before == work.files(data), "nothing is written into the dataset");
    // The same figures again without training. Another SSIM or LPIPS gives no difference to the published one.
    lpips_weights(&work.path(""));
    let weights = format!("{RUBBLE} --no-train --lpips");
    work.refuses_with(
        BENCH,
        &format!("{weights} none.safetensors"),
        &["none.safetensors", "reading the LPIPS weights"],
    );
    let again = |more: &str| {
        work.json_and_words(BENCH, &format!("{RUBBLE} --no-train --quiet --lpips lpips_alex.safetensors {more}")).0
    };
    let signed = again("");
    assert_eq!(signed["ours"]["lpips_variant"], "alex, signed");
    let distance = signed["ours"]["test"]["lpips"].as_f64().unwrap();
    assert!((signed["difference"]["lpips"].as_f64().unwrap() - (distance - 0.194)).abs() < 1e-9);
    let again = again("--ssim-variant same --lpips-range unit");
    assert!(again["difference"]["lpips"].is_null() && again["ours"]["test"]["lpips"].is_number());
    // The PLY holds unit quaternions.
    assert!((again["ours"]["test"]["psnr"].as_f64().unwrap() - ours).abs() < 0.01);
    assert!(again["difference"]["ssim"].is_null() && again["tier"] == "S2");
    // Settings of the tier that the run had at training are no difference either.
    assert_eq!(signed["not_the_published_run"], line["not_the_published_run"]);
    assert!(!why.contains("grow-") && !why.contains("refine-stop"), "{why}");
    // gsscale-eval with colour correction, from the same PLY; the run's config asked for the affine fit.
    for (more, method) in [("", "affine"), ("--colour-correct quadratic", "quadratic")] {
        let report = work.json_of(EVAL, &format!("out {data} {more}"));
        let test = &report["test"];
        assert_eq!(test["color_corrected"]["method"], method);
        assert!(test["color_corrected"]["cc_psnr"].is_number() && test["psnr"] == again["ours"]["test"]["psnr"]);
    }
    // A run that was killed has no figures.
    fs::remove_file(work.path("out/summary.json")).unwrap();
    work.refuses_with(BENCH, &format!("{RUBBLE} --no-train"), &["has not ended", "gsscale-train --resume out"]);
    // Another run in the folder takes the table away.
    work.train(&format!("{data} --out out --overwrite --steps 2 --device cpu"));
    assert!(!work.exists("out/published.json") && !work.exists("out/published.html"));
}

#[test]
fn the_defaults_of_gsscale_are_set_beside_both() {
    let work = Workdir::new();
    lookalike(&work, Layout::ColmapMerged);
    let (line, said) = work.json_and_words(BENCH, &format!("{RUBBLE} {SHORT} --with-defaults"));
    let psnr = |line: &Value, of: &str| line[of]["test"]["psnr"].as_f64().unwrap();
    assert!(psnr(&line, "with_defaults") != psnr(&line, "ours"), "two different rules");
    assert_eq!(line["with_defaults"]["ssim_variant"], "reflect");
    assert_eq!(line["difference"]["psnr"], psnr(&line, "ours") - 26.62);
    // The settings: those of the paper in one folder, the defaults in the other; the photos are the same.
    let [of_paper, of_defaults] =
        ["out", "out/defaults"].map(|out| TrainConfig::read(&work.path(out).join("config.toml")).unwrap());
    assert_eq!((of_paper.strategy, of_defaults.strategy), (StrategyName::Default, StrategyName::LongAxis));
    assert_eq!((of_paper.test_every, of_defaults.test_every), (83, 83));
    assert_eq!((of_paper.steps, of_defaults.steps), (30, 30));
    says(&said, &["ours, defaults", "with the defaults of gsscale: "]);
    assert!(work.text("out/published.html").contains("ours, defaults"));
    let (again, _) = work.json_and_words(BENCH, &format!("{RUBBLE} --with-defaults --no-train --quiet"));
    // The PLY holds unit quaternions.
    assert!((psnr(&again, "with_defaults") - psnr(&line, "with_defaults")).abs() < 0.01);
    // The command of a run that was stopped before it came to the defaults trains these.
    fs::remove_dir_all(work.path("out/defaults")).unwrap();
    let (again, said) = work.json_and_words(BENCH, &format!("{RUBBLE} {SHORT} --with-defaults --no-train"));
    assert!((psnr(&again, "with_defaults") - psnr(&line, "with_defaults")).abs() < 0.01);
    says(&said, &["into out/defaults, which holds no run yet"]);
    lpips_weights(&work.path(""));
    let stopped = "run rubble --data colmap-merged --out stopped --with-defaults --lpips lpips_alex.safetensors";
    let long = format!("{stopped} --steps 100000 --data-factor 1 --device cpu");
    let said = Running::spawn(&work, &mut work.command(BENCH, &long)).after_lines("stopped", 1).stop();
    says(&said, &[&format!("for the table: gsscale-bench {stopped}").replace(" --lpips lpips_alex.safetensors", "")]);
    says(
        &said,
        &[" --steps=100000", " --data-factor=1", " --lpips lpips_alex.safetensors --lpips-range signed --no-train"],
    );
}

#[test]
fn the_depth_cloud_is_found_and_its_absence_said() {
    let work = Workdir::new();
    let matrix_city = lookalike(&work, Layout::MatrixCity);
    let data = lookalike(&work, Layout::Colmap);
    let dry = |data: &str| {
        let output = work.output(BENCH, &format!("run aerial --data {data} --dry-run --device cpu"));
        // The plan is on standard output; no line of figures is.
        let has_figures = String::from_utf8_lossy(&output.stdout).contains('{');
        assert!(output.status.success() && !has_figures, "{}", told(&output));
        stderr(&output)
    };
    assert!(dry(matrix_city).contains("laid out as matrixcity"));
    // 24 views are fewer than 5,620: no view is held out by index.
    let said = dry(data);
    assert!(said.contains("the published point cloud is missing (sparse/0/points.ply)"), "{said}");
    assert!(said.contains("0 held-out photos instead of 741"), "{said}");
    fs::copy(work.path(matrix_city).join("points.ply"), work.path(data).join("sparse/0/points.ply")).unwrap();
    assert!(!dry(data).contains("the published point cloud is missing"));
}

#[test]
fn an_incomplete_folder_is_told_from_a_complete_one() {
    let work = Workdir::new();
    let data = work.path(lookalike(&work, Layout::ColmapMerged));
    let refuses = |words: &[&str]| {
        work.refuses_with(BENCH, &format!("{RUBBLE} --steps 2"), words);
        assert!(!work.exists("out"), "nothing is left behind");
    };
    work.refuses_with(BENCH, &format!("{RUBBLE} --no-train"), &["no run in this folder", "leave out --no-train"]);
    work.refuses_with(BENCH, &format!("{RUBBLE} --dry-run --lpips none.safetensors"), &["none.safetensors"]);
    // The size is that of the photos, and the counts are those of the used ones.
    work.write("views.txt", "000000.jpg\n000001.jpg\n");
    fs::write(work.path("mine.toml"), BUILT_IN[0].1.replacen("[1152, 864]", "[96, 64]", 1)).unwrap();
    let flags = "run mine.toml --data colmap-merged --dry-run --device cpu --views-file views.txt";
    says(
        &stderr(&work.succeeds(BENCH, flags)),
        &[
            "2 photos instead of 1678",
            "1 held-out photo instead of 21",
            "photos of 24x16 instead of 96x64: the photos are reduced already: use --data-factor 1",
        ],
    );
    fs::remove_file(data.join("val/rgbs/000006.jpg")).unwrap();
    refuses(&["1 of 24 photos is missing: 000006.jpg"]);
    fs::remove_dir_all(data.join("val/sparse")).unwrap();
    fs::remove_file(data.join("coordinates.pt")).unwrap();
    refuses(&[
        "as colmap-merged: a model (cameras and images) in val/sparse/0 missing",
        "as mega-nerf: coordinates.pt missing",
        "train/sparse/0/ ",
        "https://github.com/cmusatyalab/mega-nerf",
    ]);
    assert!(stderr(&work.output(BENCH, "run rubble")).contains("--data"));
}
