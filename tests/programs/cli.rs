//! Command lines and scenes that are wrong or unusual, through the real binaries. A bad scene ends with a message that
//! names the file, the place and the remedy, with a non-zero exit code, and without an output folder.

use crate::support::scenes::{TextModel, city, eval, stderr, summary, text, train};
use gsscale::config::choice::choices;
use gsscale::config::file::KEYS;
use gsscale::config::key::Shown;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A small city as a text model in a fresh folder.
fn small() -> (TempDir, PathBuf, TextModel) {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 400);
    let model = TextModel::of(&scene);
    model.write(&scene);
    (folder, scene, model)
}

/// Asserts that the run trains to the end; returns stderr.
fn trains(folder: &TempDir, scene: &Path, more: &[&str]) -> String {
    let out = folder.path().join("out");
    let mut args = vec![text(scene), "--out", text(&out), "--steps", "12", "--quiet", "--overwrite"];
    args.extend(more);
    let output = train(&args);
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    let loss_line = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    assert!(loss_line.contains("\"loss\":"), "{loss_line}");
    assert!(out.join("point_cloud.ply").is_file());
    assert!(summary(&out)["test"]["psnr"].as_f64().unwrap().is_finite());
    said
}

/// Asserts a refusal: exit code 1, all `words` in the message, a remedy, and no files left behind.
fn refuses(folder: &TempDir, scene: &Path, more: &[&str], words: &[&str]) {
    let out = folder.path().join("refused");
    let mut args = vec![text(scene), "--out", text(&out), "--steps", "12"];
    args.extend(more);
    let output = train(&args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for word in words {
        assert!(said.contains(word), "'{word}' is not in: {said}");
    }
    assert!(said.contains("remedy"), "{said}");
    assert!(!said.contains("panicked"), "{said}");
    assert!(!out.exists(), "something was left behind: {said}");
}

// Must train.

#[test]
fn one_point_trains() {
    let (folder, scene, mut model) = small();
    model.points.truncate(1);
    model.colors.truncate(1);
    model.write(&scene);
    trains(&folder, &scene, &[]);
}

#[test]
fn all_points_equal_train() {
    let (folder, scene, mut model) = small();
    let first = model.points[0];
    model.points.fill(first);
    model.write(&scene);
    trains(&folder, &scene, &[]);
}

#[test]
fn points_very_far_away_are_dropped_and_counted() {
    let (folder, scene, mut model) = small();
    for i in 0..3 {
        model.points[i * 7] = [1e12, -1e12, 1e12];
    }
    model.write(&scene);
    let said = trains(&folder, &scene, &[]);
    assert!(said.contains("3 points"), "{said}");
}

#[test]
fn a_camera_inside_a_gaussian_trains() {
    let (folder, scene, mut model) = small();
    // Few points spread widely around a camera make first Gaussians that contain it.
    let v = &model.views[3];
    let q = glam::DQuat::from_xyzw(v.qvec[1], v.qvec[2], v.qvec[3], v.qvec[0]);
    let centre = -(q.inverse() * glam::DVec3::from_array(v.tvec));
    model.points.truncate(4);
    model.colors.truncate(4);
    model.points[0] = (centre + glam::DVec3::new(0.01, 0.0, 0.01)).to_array();
    model.write(&scene);
    trains(&folder, &scene, &["--init-scale", "3"]);
}

#[test]
fn a_view_that_sees_nothing_trains() {
    let (folder, scene, mut model) = small();
    // Rotated by half a turn about its own y axis, the camera looks away from the city.
    let q = model.views[5].qvec;
    let turned = glam::DQuat::from_rotation_y(std::f64::consts::PI) * glam::DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    model.views[5].qvec = [turned.w, turned.x, turned.y, turned.z];
    let t = model.views[5].tvec;
    model.views[5].tvec = [-t[0], t[1], -t[2]];
    model.write(&scene);
    trains(&folder, &scene, &[]);
}

// Must warn and continue.

#[test]
fn extra_images_are_a_warning() {
    let (folder, scene, model) = small();
    let photo = scene.join("images").join(&model.views[0].name);
    std::fs::copy(photo, scene.join("images/zz_extra.jpg")).unwrap();
    let said = trains(&folder, &scene, &[]);
    assert!(said.contains("zz_extra.jpg"), "{said}");
}

#[test]
fn a_pose_that_is_not_a_number_leaves_its_view_out_by_name() {
    let (folder, scene, mut model) = small();
    model.views[4].tvec[1] = f64::NAN;
    model.write(&scene);
    let said = trains(&folder, &scene, &[]);
    assert!(said.contains(&model.views[4].name), "{said}");
}

// Must fail, with the file, the place and the remedy.

#[test]
fn missing_images_are_listed_and_may_be_allowed() {
    let (folder, scene, model) = small();
    for i in [2, 6] {
        std::fs::remove_file(scene.join("images").join(&model.views[i].name)).unwrap();
    }
    refuses(&folder, &scene, &[], &[&model.views[2].name, &model.views[6].name, "--allow-missing"]);
    trains(&folder, &scene, &["--allow-missing"]);
}

#[test]
fn an_image_that_cannot_belong_to_its_camera_is_refused() {
    let (folder, scene, model) = small();
    let path = scene.join("images").join(&model.views[1].name);
    image::RgbImage::new(50, 64).save(&path).unwrap();
    refuses(&folder, &scene, &[], &[&model.views[1].name, "50 x 64", "96 x 64"]);
}

#[test]
fn broken_photos_are_refused_at_load() {
    let (folder, scene, model) = small();
    let path = scene.join("images").join(&model.views[1].name);
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, b"").unwrap();
    refuses(&folder, &scene, &[], &[&model.views[1].name, "empty"]);
    for keep in [20, whole.len() / 2, whole.len() - 2] {
        std::fs::write(&path, &whole[..keep]).unwrap();
        refuses(&folder, &scene, &[], &[&model.views[1].name]);
    }
}

#[test]
fn truncated_models_are_refused() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 400);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = scene.join("sparse/0").join(name);
        let whole = std::fs::read(&path).unwrap();
        for keep in [0, 5, whole.len() / 2, whole.len() - 1] {
            std::fs::write(&path, &whole[..keep]).unwrap();
            refuses(&folder, &scene, &[], &[name]);
        }
        std::fs::write(&path, &whole).unwrap();
    }
}

#[test]
fn counts_larger_than_the_file_are_refused() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 400);
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = scene.join("sparse/0").join(name);
        let whole = std::fs::read(&path).unwrap();
        for count in [1u64 << 60, u64::MAX, 1_000_000] {
            let mut hostile = whole.clone();
            hostile[..8].copy_from_slice(&count.to_le_bytes());
            std::fs::write(&path, &hostile).unwrap();
            refuses(&folder, &scene, &[], &[name]);
        }
        std::fs::write(&path, &whole).unwrap();
    }
}

#[test]
fn too_many_points_that_are_not_numbers_are_refused() {
    let (folder, scene, mut model) = small();
    model.points[0] = [f64::NAN, 0.0, 0.0];
    model.write(&scene);
    let said = trains(&folder, &scene, &[]);
    assert!(said.contains("not finite") || said.contains("non-finite"), "{said}");
    for p in model.points.iter_mut().take(20) {
        *p = [0.0, f64::INFINITY, 0.0];
    }
    model.write(&scene);
    refuses(&folder, &scene, &[], &["points3D.txt"]);
}

#[test]
fn names_that_leave_the_folder_are_refused() {
    for name in ["../secret.jpg", "/etc/hostname", "a/../../b.jpg"] {
        let (folder, scene, mut model) = small();
        model.views[0].name = name.into();
        model.write(&scene);
        refuses(&folder, &scene, &[], &["images.txt", name]);
    }
}

#[test]
fn unsupported_camera_models_are_refused_by_name() {
    let (folder, scene, model) = small();
    let [w, h] = model.size;
    std::fs::write(scene.join("sparse/0/cameras.txt"), format!("1 FOV {w} {h} 80 80 48 32 0.9\n")).unwrap();
    refuses(&folder, &scene, &[], &["FOV", "cameras.txt"]);
}

#[test]
fn no_points_and_no_way_to_make_any_is_refused() {
    let (folder, scene, mut model) = small();
    model.points.clear();
    model.colors.clear();
    model.write(&scene);
    refuses(&folder, &scene, &["--init-points", "0"], &["no points"]);
    trains(&folder, &scene, &["--init-points", "500"]);
}

#[test]
fn hostile_ply_files_are_refused() {
    let (folder, scene, _) = small();
    let ply = folder.path().join("start.ply");
    let header = |count: &str| {
        format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
             property float x\nproperty float y\nproperty float z\nend_header\n"
        )
    };
    for (count, bytes) in [("1152921504606846976", 24), ("3", 24), ("-1", 24), ("0", 0)] {
        let mut file = header(count).into_bytes();
        file.extend(vec![0u8; bytes]);
        std::fs::write(&ply, file).unwrap();
        refuses(&folder, &scene, &["--init-ply", text(&ply)], &["start.ply"]);
    }
    std::fs::write(&ply, b"not a ply at all").unwrap();
    refuses(&folder, &scene, &["--init-ply", text(&ply)], &["start.ply"]);
}

#[test]
fn an_output_folder_that_cannot_be_written_is_refused() {
    let (folder, scene, _) = small();
    let file = folder.path().join("a_file");
    std::fs::write(&file, b"x").unwrap();
    let out = file.join("out");
    let output = train(&[text(&scene), "--out", text(&out), "--steps", "12"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("a_file"), "{}", stderr(&output));
}

#[test]
fn an_existing_run_is_refused_unless_overwritten() {
    let (folder, scene, _) = small();
    trains(&folder, &scene, &[]);
    let out = folder.path().join("out");
    let output = train(&[text(&scene), "--out", text(&out), "--steps", "12"]);
    assert_eq!(output.status.code(), Some(1));
    // No remedy proposes to lose a result.
    let said = stderr(&output);
    assert!(said.contains("another --out") && said.contains("--steps N") && !said.contains("overwrite"), "{said}");
    trains(&folder, &scene, &[]);
}

#[test]
fn scenes_that_are_not_there_say_what_was_looked_for() {
    let folder = TempDir::new().unwrap();
    refuses(&folder, &folder.path().join("nowhere"), &[], &["nowhere"]);
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    refuses(&folder, &folder.path().join("empty"), &[], &["sparse", "transforms"]);
}

#[test]
fn unknown_flags_and_keys_are_refused() {
    let (folder, scene, _) = small();
    let output = train(&[text(&scene), "--out", "x", "--stepz", "3"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("--stepz"));
    let config = folder.path().join("bad.toml");
    std::fs::write(&config, "steps = 5\nstepz = 3\n").unwrap();
    refuses(&folder, &scene, &["--config", text(&config)], &["bad.toml", "stepz"]);
}

#[test]
fn a_dry_run_writes_nothing_and_tells_the_memory() {
    let (folder, scene, _) = small();
    let out = folder.path().join("dry");
    let output = train(&[text(&scene), "--out", text(&out), "--dry-run"]);
    assert!(output.status.success(), "{}", stderr(&output));
    // What was asked for is on standard output, so that it can be kept in a file.
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("memory") && said.contains("views to train on"), "{said}");
    assert!(!out.exists());
}

#[test]
fn switches_may_stand_before_the_scene() {
    let (folder, scene, _) = small();
    let out = folder.path().join("out");
    let output = train(&["--allow-missing", text(&scene), "--masks=false", "--out", text(&out), "--steps", "3", "-q"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    assert!(config.contains("allow-missing = true") && config.contains("masks = false"), "{config}");
}

#[test]
fn unknown_words_are_refused_with_the_words_that_are_known() {
    let (folder, scene, _) = small();
    let help = train(&["--help"]);
    let help = String::from_utf8_lossy(&help.stdout).split_whitespace().collect::<Vec<_>>().join(" ");
    let mut enumerations = 0;
    for (key, words) in choices() {
        let (last, first) = words.split_last().unwrap();
        let sentence = format!("unknown --{key} 'memory': use {} or {last}", first.join(", "));
        let out = folder.path().join("refused");
        let output = train(&[text(&scene), "--out", text(&out), &format!("--{key}"), "memory"]);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.starts_with(&format!("error: {sentence}\n")), "{said}");
        assert!(!out.exists(), "something was left behind: {said}");
        let file = folder.path().join("unknown.toml");
        std::fs::write(&file, format!("{key} = \"memory\"\n")).unwrap();
        refuses(&folder, &scene, &["--config", text(&file)], &["unknown.toml", &sentence]);
        if KEYS.iter().any(|of| of.name() == key && of.shown == Shown::Nowhere) {
            continue;
        }
        let listed = format!("[possible values: {}]", words.join(", "));
        assert!(help.contains(&listed), "--help does not list the words of --{key}");
        enumerations += 1;
    }
    // Every enumeration of --help has its words from the list: nothing else is refused in another way.
    let booleans = help.matches("[possible values: true, false]").count();
    assert_eq!(help.matches("[possible values: ").count(), booleans + enumerations);
    let output = train(&[text(&scene), "--out", text(&folder.path().join("refused")), "--device", " "]);
    assert!(stderr(&output).contains("unknown --device ' ': use auto, gpu, cpu"), "{}", stderr(&output));
}

/// config.toml keeps the user's words: `--resume` compares them.
#[test]
fn a_run_keeps_the_words_that_were_written() {
    let (folder, scene, _) = small();
    let out = folder.path().join("words");
    let words = [
        ("view-order", "groups:2"),
        ("ssim-padding", "same"),
        ("optimizer", "sparse"),
        ("moments", "bf16"),
        ("strategy", "none"),
        ("appearance", "exposure"),
        ("log", "tensorboard"),
        ("ssim-variant", "reflect"),
        ("color-correct", "quadratic"),
        ("export", "sog"),
        ("export-frame", "local"),
        ("io", "pread"),
        ("spill-codec", "zstd:3"),
        ("evict", "lru"),
        ("transfers", "demand"),
        ("simd", "baseline"),
        ("device", "cpu"),
    ];
    let flags: Vec<String> = words.iter().flat_map(|(key, word)| [format!("--{key}"), word.to_string()]).collect();
    let mut args = vec![text(&scene), "--out", text(&out), "--steps", "2"];
    args.extend(flags.iter().map(String::as_str));
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
    let config = std::fs::read_to_string(out.join("config.toml")).unwrap();
    for (key, word) in words {
        assert!(config.lines().any(|line| line == format!("{key} = \"{word}\"")), "{key}: {config}");
    }
}

#[test]
fn numbers_that_no_machine_can_hold_are_refused() {
    let (folder, scene, _) = small();
    for (flag, value) in [
        ("--max-gaussians", "1000000000000"),
        ("--threads", "4000000000"),
        ("--init-points", "4000000000"),
        ("--adam-eps", "1e-40"),
        ("--adam-eps", "0"),
        ("--adam-eps", "9.9e-17"),
        ("--adam-eps", "1.5"),
        ("--adam-eps", "nan"),
    ] {
        refuses(&folder, &scene, &[flag, value], &[flag, "out of range"]);
    }
    // A file and the command line behave alike; the message names the limit, and the limit itself is allowed.
    let file = folder.path().join("eps.toml");
    std::fs::write(&file, "adam-eps = 1e-30\n").unwrap();
    refuses(&folder, &scene, &["--config", text(&file)], &["--adam-eps", "1e-30", "f32 rounds to zero", "1e-16 to 1"]);
    trains(&folder, &scene, &["--adam-eps", "1e-16"]);
}

#[test]
fn a_cap_beyond_memory_is_a_warning() {
    let (folder, scene, _) = small();
    // 3 TB with the optimizer's state; the city has 400 points and never reaches this cap.
    let said = trains(&folder, &scene, &["--max-gaussians", "4000000000"]);
    let knows_memory = cfg!(target_os = "linux");
    assert!(said.contains("--max-gaussians") || !knows_memory, "{said}");
}

#[test]
fn a_view_masked_as_a_whole_counts_for_nothing() {
    let (folder, scene, model) = small();
    let masks = scene.join("masks");
    std::fs::create_dir(&masks).unwrap();
    // Views 0 and 8 of 12 are held out.
    let black = image::GrayImage::new(96, 64);
    black.save(masks.join(format!("{}.png", model.views[0].name))).unwrap();
    trains(&folder, &scene, &[]);
    let test = summary(&folder.path().join("out"))["test"].clone();
    assert_eq!(test["views"], 1);
    assert!(test["psnr"].as_f64().unwrap() < 50.0 && test["ssim"].as_f64().is_some(), "{test}");
}

#[test]
fn a_held_out_photo_that_cannot_be_decoded_loses_no_run() {
    let (folder, scene, model) = small();
    // Header and end are intact, so the photo passes at load; the pixels between are damaged.
    let path = scene.join("images").join(&model.views[0].name);
    image::RgbImage::new(96, 64).save_with_format(&path, image::ImageFormat::Png).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[45] ^= 0xff;
    std::fs::write(&path, bytes).unwrap();
    let out = folder.path().join("out");
    let said = trains(&folder, &scene, &["--eval-every", "6"]);
    let named = format!("the held-out photo '{}' cannot be read and is not compared", model.views[0].name);
    assert_eq!(said.matches(&named).count(), 2, "{said}");
    assert_eq!((summary(&out)["test"]["views"].clone(), summary(&out)["finished"].clone()), (1.into(), true.into()));
    let output = eval(&[text(&out.join("point_cloud.ply"))]);
    assert!(output.status.success() && stderr(&output).contains(&named), "{}", stderr(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("\"views\": 1"));
}

#[test]
fn held_out_photos_that_are_all_masked_are_said_before_the_first_step() {
    let (folder, scene, model) = small();
    let masks = scene.join("masks");
    std::fs::create_dir(&masks).unwrap();
    for i in [0, 8] {
        image::GrayImage::new(96, 64).save(masks.join(format!("{}.png", model.views[i].name))).unwrap();
    }
    let out = folder.path().join("out");
    let output = train(&[text(&scene), "--out", text(&out), "--steps", "12"]);
    let said = stderr(&output);
    let warned = said.find("none of the 2 held-out photos can be compared").expect(&said);
    assert!(
        warned < said.find("done:").expect(&said) && said.contains("there is no held-out photo that counts"),
        "{said}"
    );
    assert!(output.status.success() && summary(&out)["test"].is_null(), "{said}");
}

#[test]
fn overwriting_removes_what_an_earlier_run_saved() {
    let (folder, scene, _) = small();
    trains(&folder, &scene, &["--save-every", "5"]);
    let saved = |name: &str| folder.path().join("out").join(name).exists();
    assert!(saved("point_cloud_000005.ply") && saved("point_cloud_000010.ply"));
    std::fs::write(folder.path().join("out/point_cloud_mine.ply"), "kept").unwrap();
    trains(&folder, &scene, &[]);
    assert!(!saved("point_cloud_000005.ply") && !saved("point_cloud_000010.ply"));
    assert!(saved("point_cloud_mine.ply") && saved("point_cloud.ply"));
}

#[test]
fn points_of_a_ply_that_are_dropped_are_counted() {
    let (folder, scene, _) = small();
    let ply = folder.path().join("start.ply");
    let mut file = b"ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\nproperty float y\n\
        property float z\nend_header\n"
        .to_vec();
    for i in 0..200 {
        file.extend(if i == 7 { "nan 0 0\n".to_string() } else { format!("{i} {} 0\n", i % 9) }.bytes());
    }
    std::fs::write(&ply, file).unwrap();
    let said = trains(&folder, &scene, &["--init-ply", text(&ply)]);
    assert!(said.contains("start.ply") && said.contains("1 points"), "{said}");
}

#[test]
fn help_is_grouped_and_has_examples() {
    let output = train(&["--help"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    for word in ["Examples:", "Dataset:", "Training:", "Densification:", "--refine-start", "--demo"] {
        assert!(said.contains(word), "{word} is not in --help");
    }
    assert!(said.trim_end().lines().last().unwrap().contains("configs/README.md"), "{said}");
    let flags: Vec<&str> =
        said.lines().filter_map(|line| line.strip_prefix("      --")?.split([' ', '[']).next()).collect();
    let shown = KEYS.iter().filter(|key| flags.contains(&key.name().as_str())).count();
    assert!(shown <= 50 && shown == KEYS.iter().filter(|key| key.shown != Shown::Nowhere).count(), "{flags:?}");
}

#[test]
fn short_help_has_the_examples_first() {
    let output = train(&["-h"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.lines().count() <= 30, "{said}");
    let at = |word: &str| said.find(word).expect(&said);
    assert!(at("Examples:") < at("Usage:") && at("Usage:") < at("--steps") && !said.contains("--refine-start"));
}

#[test]
fn a_hidden_key_works_as_a_flag_and_in_a_file() {
    let (folder, scene, _) = small();
    let file = folder.path().join("hidden.toml");
    std::fs::write(&file, "page-rows = 64\n").unwrap();
    trains(&folder, &scene, &["--config", text(&file), "--evict", "lru"]);
    let config = std::fs::read_to_string(folder.path().join("out/config.toml")).unwrap();
    assert!(config.contains("page-rows = 64\n") && config.contains("evict = \"lru\"\n"), "{config}");
}

/// `gsscale-plan ... | head` exits with success, whatever remains unprinted.
#[test]
fn a_reader_that_has_gone_is_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let args: [(&str, &[&str]); 2] = [
        (env!("CARGO_BIN_EXE_gsscale-bench"), &["help"]),
        (env!("CARGO_BIN_EXE_gsscale-iotune"), &[".", "--file", "64MiB", "--seconds", "1", "--written", "16MiB"]),
    ];
    for (program, args) in args {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = std::process::Command::new(program)
            .args(args)
            .current_dir(folder.path())
            .stdout(writer)
            .stderr(std::process::Stdio::piped())
            .spawn()
            .and_then(std::process::Child::wait_with_output)
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !errors.contains("panicked"), "{program}: {errors}");
    }
}

/// Output that cannot be written is an error with a message.
#[cfg(target_os = "linux")]
#[test]
fn a_full_standard_output_is_an_error() {
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_gsscale-bench"));
    let output = program.arg("help").stdout(full).output().unwrap();
    let errors = stderr(&output);
    assert!(!output.status.success() && errors.contains("standard output") && errors.contains("remedy"), "{errors}");
    assert!(!errors.contains("panicked"), "{errors}");
}
