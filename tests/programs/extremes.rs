//! Inputs that other trainers turn into infinities, silence or misleading words: extreme numbers, runs in which nothing
//! counts, resets just before the end, budgets and limits that are too small. Through the real binaries.

use crate::support::scenes::{TextModel, TextView, stderr};
use crate::support::workdir::{CKPT, Workdir, says};
use gsscale::config::file::TrainConfig;
use gsscale::scene::columns::Columns;
use gsscale::train::start::first_scene::prepare;
use std::fmt::Write as _;
use std::path::Path;

/// Two threads, on the CPU: the words and results are those of any machine.
const PLAIN: &str = "--device cpu --threads 2 --quiet";

fn small_city() -> Workdir {
    Workdir::city(12, 96, 64, 400)
}

fn done(work: &Workdir, out: &str, more: &str) -> String {
    work.train(&format!("scene --out {out} {PLAIN} {more}"))
}

/// The words of a run that stops with an error.
fn stopped(work: &Workdir, out: &str, more: &str, words: &[&str]) -> String {
    work.refuses(&format!("scene --out {out} {PLAIN} {more}"), words)
}

/// The first Gaussians of a scene as a PLY, changed by `change`, which receives them in dataset coordinates.
fn gaussians(work: &Workdir, file: &str, change: impl Fn(&mut Columns)) {
    let prepared = prepare(&work.scene(), &TrainConfig::default()).unwrap();
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
    work.write(file, ply);
}

/// Every page of every generation is intact and finite.
fn assert_intact(work: &Workdir, store: &str) {
    work.succeeds(CKPT, &format!("verify {store} --deep"));
}

#[test]
fn rates_beyond_reason_reach_no_page_with_infinities() {
    let work = Workdir::city(24, 160, 112, 1500);
    // Log-scales drift by hundreds, so the children of a split would lie at infinity.
    let rates = "--scales-lr 20 --refine-start 20 --refine-every 10 --steps 60 --keep-checkpoint --commit-every 0.01";
    let said = done(&work, "out", &format!("{rates} --spill-dir pages"));
    assert!(said.contains("Gaussians keep their values because"), "skipped rows are warned of: {said}");
    assert!(!said.contains("are not finite and are not in"), "every Gaussian is in the PLY: {said}");
    assert!(work.count("out", "rows_skipped_non_finite") > 0);
    assert_intact(&work, "pages");
}

#[test]
fn a_ply_with_absurd_colours_is_named_as_the_cause() {
    let work = small_city();
    // f32 still holds 1e20, its square not; at 1e30 gradients are not finite either.
    for brightness in [1e20f32, 1e30] {
        gaussians(&work, "bright.ply", |columns| columns.sh0[..30].fill(brightness));
        let words = ["is skipped: ", "the run diverged", "check bright.ply"];
        let said = stopped(&work, "out", "--steps 60 --init-ply bright.ply --overwrite", &words);
        assert!(!said.contains("report this as a bug"), "{said}");
        let summary = work.summary("out");
        assert_eq!((&summary["finished"], &summary["steps"]), (&false.into(), &2.into()), "the third step stops it");
    }
    // A run that fails twice names the first cause: a folder stands where the transform of the last rows is to be written.
    work.remove("out");
    std::fs::create_dir_all(work.path("out/point_cloud.transform.json")).unwrap();
    let words = ["error: the run diverged", "warning: ", "cannot be written"];
    stopped(&work, "out", "--steps 60 --init-ply bright.ply --overwrite", &words);
}

#[test]
fn log_scales_and_opacities_of_a_ply_are_brought_into_range_and_said() {
    let work = small_city();
    gaussians(&work, "odd.ply", |columns| {
        // A giant, another one, and a row that is only too small.
        (columns.scales[1], columns.scales[3], columns.scales[6]) = (20.0, 1e38, -200.0);
        columns.opacities[5] = f32::INFINITY;
        columns.opacities[6] = f32::NEG_INFINITY;
    });
    for (out, more) in [("memory", ""), ("streamed", "--keep-checkpoint --spill-dir pages")] {
        let said = done(&work, out, &format!("--steps 20 --init-ply odd.ply {more}"));
        says(
            &said,
            &["2 opacities are exactly 0 or 1", "odd.ply: 2 Gaussians are larger than", "1 log-scales of the first"],
        );
    }
    assert!(work.ply("memory") == work.ply("streamed"));
    assert_intact(&work, "pages");
    assert_eq!(work.count("memory", "gaussians"), 398, "giants are dropped");
}

#[test]
fn a_reset_just_before_the_end_is_left_out() {
    let work = small_city();
    let ply = |more: &str| {
        done(&work, "out", &format!("--overwrite --refine-start 50 --refine-every 50 {more}"));
        work.ply("out")
    };
    // Step 200 is the last but one of these, and a third of the interval is 66 steps.
    assert!(ply("--steps 201 --reset-every 200") == ply("--steps 201 --reset-every 0"));
    let [longer, without] = ["200", "0"].map(|every| ply(&format!("--steps 267 --reset-every {every}")));
    assert!(longer != without, "this reset has time to recover");
}

#[test]
fn saves_and_evaluations_show_the_scene_before_a_reset() {
    let work = small_city();
    let shown = |out: &str, every: u32| {
        let steps = format!("--steps 140 --save-every 60 --eval-every 60 --reset-every {every}");
        done(&work, out, &format!("--refine-start 50 --refine-every 50 {steps}"));
        let lines = work.metrics(out).into_iter().filter(|line| line["step"] == 60);
        let test: Vec<f64> = lines.map(|line| line["test"]["psnr"].as_f64().unwrap()).collect();
        (work.bytes(&format!("{out}/point_cloud_000060.ply")), test, work.psnr(out))
    };
    let (with, without) = (shown("with", 60), shown("without", 0));
    assert!(with.0 == without.0 && with.1 == without.1 && with.1.len() == 1, "{:?} {:?}", with.1, without.1);
    assert_ne!(with.2, without.2, "there was no reset, so the test shows nothing");
}

#[test]
fn a_run_whose_masks_are_all_black_stops() {
    let work = small_city();
    std::fs::create_dir(work.path("scene/masks")).unwrap();
    for view in TextModel::of(&work.scene()).views {
        let name = Path::new(&view.name).with_extension("png");
        image::GrayImage::new(96, 64).save(work.path("scene/masks").join(name)).unwrap();
    }
    // Before the first step, also of a run that is too short to find out by training.
    for steps in [1, 1000] {
        stopped(&work, "out", &format!("--steps {steps}"), &["exclude every pixel", "--invert-masks"]);
        assert!(!work.exists("out/config.toml"));
    }
    done(&work, "inverted", "--steps 60 --invert-masks");

    // Two photos of which nothing counts: they train nothing, and their steps have no PSNR.
    let views = TextModel::of(&work.scene()).views;
    for (i, view) in views.iter().enumerate() {
        let name = Path::new(&view.name).with_extension("png");
        let white = if [1, 2].contains(&i) { 0 } else { 255 };
        image::GrayImage::from_pixel(96, 64, image::Luma([white])).save(work.path("scene/masks").join(name)).unwrap();
    }
    let said = done(&work, "some", "--steps 60 --log-every 1");
    let [first, second] = [1, 2].map(|i| views[i].name.as_str());
    assert!(
        said.contains(&format!("photos exclude every pixel, so these photos train nothing: {first}, {second};")),
        "{said}"
    );
    let psnrs: Vec<Option<f64>> = work.metrics("some").iter().map(|line| line["psnr"].as_f64()).collect();
    assert!(psnrs.iter().flatten().all(|psnr| *psnr < 50.0) && psnrs.contains(&None), "{psnrs:?}");
}

#[test]
fn a_run_that_sees_loses_or_draws_no_gaussian_stops() {
    let work = small_city();
    // The cameras look down on the city.
    gaussians(&work, "above.ply", |columns| {
        columns.means.as_chunks_mut::<3>().0.iter_mut().for_each(|mean| mean[2] += 1e5)
    });
    stopped(&work, "out", "--steps 1000 --init-ply above.ply", &["training views sees any of the 400 Gaussians"]);
    assert!(!work.exists("out"), "refused before anything is written");
    let prunes = "--prune-opa 0.4 --refine-start 1 --refine-every 2 --steps 1000";
    // At once.
    stopped(&work, "pruned", prunes, &["no Gaussian is left", "--prune-opa", "images: step 3: "]);
    // Alpha below 1/255 is not drawn, so no gradient raises it.
    let faint = "--init-opacity 0.001 --strategy none --steps 1000";
    stopped(&work, "faint", faint, &["too transparent", "--init-opacity"]);
    gaussians(&work, "faint.ply", |columns| columns.opacities.fill(-100.0));
    let words = ["too transparent", "check opacities and scales in ", "faint.ply"];
    stopped(&work, "file", "--steps 1000 --init-ply faint.ply --strategy none", &words);
    // The rate throws all Gaussians out of the pictures.
    stopped(
        &work,
        "thrown",
        "--steps 1000 --means-lr 1e6 --strategy none",
        &["training has moved them out", "leave out flags of rates"],
    );
    // Positions of no scene are dropped, as points are.
    gaussians(&work, "absurd.ply", |columns| columns.means[..6].fill(1e30));
    let said = done(&work, "dropped", "--steps 4 --init-ply absurd.ply");
    assert!(said.contains("2 Gaussians are too far from this scene"), "{said}");
}

/// Each is legal where it is read.
#[test]
fn numbers_at_the_ends_of_their_types_mean_what_they_say() {
    let work = small_city();
    // The settings of a run are TOML, whose numbers have 63 bits.
    work.refuses("scene --out out --seed 9223372036854775808", &["--seed", "0 to 9,223,372,036,854,775,807"]);
    done(&work, "seed", "--steps 1 --seed 9223372036854775807 --save-every 1 --keep-checkpoint");
    work.train("--resume seed --steps 2 --quiet --device cpu");
    // Behind all photos.
    done(&work, "after", "--steps 1 --test-after 5000000000");
    assert!(work.summary("after")["test"].is_null());
    work.train("scene --out dry --dry-run --commit-every 1e-45 --spill-dir pages");
}

#[test]
fn remedies_name_what_helps() {
    let work = small_city();
    gaussians(&work, "first.ply", |_| {});
    for spill in ["", "--spill-dir pages"] {
        let said = stopped(&work, "capped", &format!("--init-ply first.ply --max-gaussians 399 {spill}"), &[]);
        assert!(said.starts_with("error: first.ply"), "the PLY is too large, not the scene: {said}");
    }
    let said = work.train("scene --out threads --device cpu --steps 2 --threads 1024");
    assert!(said.contains("--threads 1024: ") && said.contains("are started"), "{said}");
}

#[cfg(unix)]
#[test]
fn a_limit_on_open_files_is_told_from_a_broken_drive() {
    let work = small_city();
    let mut told = 0;
    for files in 5..14 {
        let flags = format!("scene --out out{files} --spill-dir pages{files} --steps 30 --commit-every 0.01 {PLAIN}");
        let said = stderr(&work.limited(&format!("-n {files}"), &flags).output().unwrap());
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
    let work = Workdir::new();
    std::fs::create_dir_all(work.path("scene/images")).unwrap();
    let side = 2048;
    let views = [("a.png", 0.0), ("b.png", 0.5)].map(|(name, x)| {
        let photo = image::GrayImage::from_pixel(side, side, image::Luma([128]));
        photo.save(work.path("scene/images").join(name)).unwrap();
        TextView { name: name.to_string(), qvec: [1.0, 0.0, 0.0, 0.0], tvec: [x, 0.0, 0.0] }
    });
    let model = TextModel {
        size: [side; 2],
        pinhole: [2000.0, 2000.0, 1024.0, 1024.0],
        views: views.to_vec(),
        points: (0..2000).map(|i| [0.0, 0.0, 4.0 + f64::from(i) * 1e-3]).collect(),
        colors: vec![[90, 100, 110]; 2000],
    };
    model.write(&work.scene());
    gaussians(&work, "giants.ply", |columns| {
        columns.scales.fill(3.0);
        // Nearly opaque, so that the pixels end after a few of them and the test is quick.
        columns.opacities.fill(4.0);
    });
    let flags = "--steps 1 --test-every 0 --strategy none --image-cache 16MiB --host-mem 512MiB --init-ply giants.ply";
    done(&work, "out", flags);
    let peak = work.count("out", "host_bytes_peak");
    assert!(peak > 0 && peak <= 512 << 20, "{peak} bytes");
}
