//! Command lines and scenes that are wrong or unusual, through the real binaries. A bad scene ends with a message that
//! names the file, the place and the remedy, with a non-zero exit code, and without an output folder.

use crate::support::scenes::{TextModel, stderr, stdout};
use crate::support::workdir::{BENCH, EVAL, TRAIN, VIEW, Workdir, says};
use gsscale::config::file::{KEYS, Shown};
use gsscale::config::habits::ADVICE;
use gsscale::config::values::choices;
use std::path::Path;
use std::process::{Command, Output};

/// Asserts that the run trains to the end; returns stderr.
fn trains(work: &Workdir, more: &str) -> String {
    let said = work.train(&format!("scene --out out --steps 12 --quiet --overwrite {more}"));
    assert!(work.metrics("out")[0]["loss"].is_number() && work.exists("out/point_cloud.ply"));
    assert!(work.psnr("out").is_finite());
    said
}

/// Asserts a refusal with all `words`, a remedy, and no files left behind.
fn refuses(work: &Workdir, more: &str, words: &[&str]) {
    work.refuses(&format!("scene --out refused --steps 12 {more}"), words);
    assert!(!work.exists("refused"), "{more}: something was left behind");
}

/// Each trains, and says some words.
#[test]
fn unusual_scenes_train() {
    let (work, whole) = Workdir::small_model();
    type Change = fn(&mut TextModel);
    let name = |i: usize| whole.views[i].name.clone();
    let cases: [(&str, Change, &str, String); 5] = [
        ("one point", |model| keep_points(model, 1), "", String::new()),
        ("all points equal", |model| model.points = vec![model.points[0]; model.points.len()], "", String::new()),
        (
            // Few points spread widely around a camera make first Gaussians that contain it.
            "a camera inside a Gaussian",
            |model| {
                let view = &model.views[3];
                let centre = -(view.rotation().inverse() * glam::DVec3::from_array(view.tvec));
                keep_points(model, 4);
                model.points[0] = (centre + glam::DVec3::new(0.01, 0.0, 0.01)).to_array();
            },
            "--init-scale 3",
            String::new(),
        ),
        (
            // Rotated by half a turn about its own y axis, the camera looks away from the city.
            "a view that sees nothing",
            |model| {
                let (view, turn) = (&mut model.views[5], glam::DQuat::from_rotation_y(std::f64::consts::PI));
                view.set_rotation(turn * view.rotation());
                view.tvec = (turn * glam::DVec3::from_array(view.tvec)).to_array();
            },
            "",
            String::new(),
        ),
        ("a pose that is not a number", |model| model.views[4].tvec[1] = f64::NAN, "", name(4)),
    ];
    for (what, change, flags, word) in cases {
        let mut model = whole.clone();
        change(&mut model);
        model.write(&work.scene());
        let said = trains(&work, flags);
        assert!(said.contains(&word), "{what}: {said}");
    }
}

fn keep_points(model: &mut TextModel, count: usize) {
    model.points.truncate(count);
    model.colors.truncate(count);
}

/// Models with impossible content are refused, by the file and the place.
#[test]
fn models_that_cannot_be_are_refused() {
    let (work, whole) = Workdir::small_model();
    let mut model = whole.clone();
    keep_points(&mut model, 0);
    model.write(&work.scene());
    refuses(&work, "--init-points 0", &["no points"]);
    trains(&work, "--init-points 500");
    whole.write(&work.scene());
    work.write("start.ply", "not a ply at all");
    refuses(&work, "--init-ply start.ply", &["start.ply"]);
    work.refuses("scene --out scene --overwrite --steps 2", &["is the scene itself", "--out"]);
    work.refuses("scne --out elsewhere", &["scne", "there is no such scene"]);
}

#[test]
fn missing_and_broken_photos_are_refused() {
    let (work, model) = Workdir::small_model();
    let (name, photo) = (model.views[1].name.as_str(), work.path("scene/images").join(&model.views[1].name));
    let whole = std::fs::read(&photo).unwrap();
    std::fs::write(&photo, &whole[..whole.len() / 2]).unwrap();
    refuses(&work, "", &[name]);
    std::fs::write(&photo, &whole).unwrap();
    for i in [2, 6] {
        std::fs::remove_file(work.path("scene/images").join(&model.views[i].name)).unwrap();
    }
    refuses(&work, "", &[&model.views[2].name, &model.views[6].name, "--allow-missing"]);
    trains(&work, "--allow-missing");
}

/// The text files of a run and of a city could not name such a folder. macOS makes none.
#[cfg(target_os = "linux")]
#[test]
fn folders_whose_names_are_not_utf8_are_refused_at_once() {
    use crate::support::workdir::CKPT;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    let work = Workdir::city(3, 32, 24, 100);
    let (odd, cells) = (OsStr::from_bytes(b"odd\xff"), env!("CARGO_BIN_EXE_gsscale-cells"));
    let inside = work.path("").join(odd);
    std::fs::create_dir(&inside).unwrap();
    let before = work.files("");
    for (program, flags) in [
        (TRAIN, "ODD --out out"),
        (TRAIN, "scene --out ODD"),
        (TRAIN, "scene --out out --spill-dir ODD"),
        (TRAIN, "--resume ODD"),
        (EVAL, "ODD"),
        (VIEW, "ODD"),
        (CKPT, "inspect ODD"),
        (cells, "prior scene --out ODD"),
        (cells, "run city --cell 0 --spill-dir ODD"),
    ] {
        let words =
            |name: &'static OsStr| flags.split(' ').map(move |word| if word == "ODD" { name } else { word.as_ref() });
        for (folder, name) in [(&work.path(""), odd), (&inside, "plain".as_ref())] {
            let output = Command::new(program).current_dir(folder).args(words(name)).output().unwrap();
            let said = stderr(&output);
            assert_eq!(output.status.code(), Some(2), "{flags}: {said}");
            says(&said, &["odd\u{fffd}", "is not UTF-8", "remedy: rename"]);
        }
    }
    assert!(work.files("") == before && std::fs::read_dir(&inside).unwrap().next().is_none());
    assert!(Command::new(TRAIN).current_dir(&inside).arg("--help").output().unwrap().status.success());
}

#[test]
fn output_folders_that_have_a_run_are_refused() {
    let (work, _) = Workdir::small_model();
    trains(&work, "--save-every 5");
    // No remedy proposes to lose a result.
    let said = work.refuses("scene --out out --steps 12", &["another --out", "--steps N"]);
    assert!(!said.contains("overwrite"), "{said}");
    // Overwriting removes what an earlier run saved, and nothing else.
    let saved = |name: &str| work.exists(&format!("out/{name}"));
    assert!(saved("point_cloud_000005.ply") && saved("point_cloud_000010.ply"));
    work.write("out/point_cloud_mine.ply", "kept");
    trains(&work, "");
    assert!(!saved("point_cloud_000005.ply") && !saved("point_cloud_000010.ply"));
    assert!(saved("point_cloud_mine.ply") && saved("point_cloud.ply"));
}

#[test]
fn flags_and_keys_are_read_in_any_order_and_unknown_ones_refused() {
    let (work, _) = Workdir::small_model();
    let output = work.output(TRAIN, "scene --out x --stepz 3");
    assert!(output.status.code() == Some(2) && stderr(&output).contains("--stepz"), "{}", stderr(&output));
    work.write("bad.toml", "steps = 5\nstepz = 3\n");
    refuses(&work, "--config bad.toml", &["bad.toml", "stepz"]);
    // Switches may stand before the scene.
    work.train("--allow-missing scene --masks=false --out switches --steps 3 -q");
    // A switch takes its value with or without `=`.
    work.train("scene --masks false --robust-views on --sweep-points off --out spaced --steps 3 -q");
    let config = work.text("spaced/config.toml");
    for line in ["masks = false", "robust-views = \"on\"", "sweep-points = \"off\""] {
        assert!(config.contains(line), "{line} is not in {config}");
    }
    let config = work.text("switches/config.toml");
    assert!(config.contains("allow-missing = true") && config.contains("masks = false"), "{config}");
    // A hidden key works as a flag and in a file.
    work.write("hidden.toml", "page-rows = 64\n");
    trains(&work, "--config hidden.toml --evict lru");
    let config = work.text("out/config.toml");
    assert!(config.contains("page-rows = 64\n") && config.contains("evict = \"lru\"\n"), "{config}");
}

#[test]
fn unknown_words_are_refused_with_the_words_that_are_known() {
    let (work, _) = Workdir::small_model();
    let help = stdout(&work.output(TRAIN, "--help")).split_whitespace().collect::<Vec<_>>().join(" ");
    let mut enumerations = 0;
    for (key, words) in choices() {
        let (last, first) = words.split_last().unwrap();
        let sentence = format!("unknown --{key} 'memory': use {} or {last}", first.join(", "));
        let output = work.output(TRAIN, &format!("scene --out refused --{key}=memory"));
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.starts_with(&format!("error: {sentence}\n")), "{said}");
        assert!(!work.exists("refused"), "something was left behind: {said}");
        work.write("unknown.toml", format!("{key} = \"memory\"\n"));
        // Several keys share the switches' words, so that a message about a file shows its line.
        let sentence =
            if words == ["auto", "on", "off"] { sentence.replace(&format!("--{key}"), "word") } else { sentence };
        refuses(&work, "--config unknown.toml", &["unknown.toml", key, &sentence]);
        if KEYS.iter().any(|of| of.name() == key && of.shown == Shown::Nowhere) {
            continue;
        }
        let listed = format!("[possible values: {}]", words.join(", "));
        assert!(help.contains(&listed), "--help does not list the words of --{key}");
        enumerations += 1;
    }
    // Every enumeration of --help has its words from the list: nothing else is refused in another way.
    // --poses is a flag, and no key.
    let booleans =
        help.matches("[possible values: true, false]").count() + help.matches("[possible values: auto]").count();
    assert_eq!(help.matches("[possible values: ").count(), booleans + enumerations);
    let output = work.command(TRAIN, "scene --out refused").args(["--device", " "]).output().unwrap();
    assert!(stderr(&output).contains("unknown --device ' ': use auto, gpu, cpu"), "{}", stderr(&output));
}

/// config.toml keeps the user's words: `--resume` compares them.
#[test]
fn a_run_keeps_the_words_that_were_written() {
    let (work, _) = Workdir::small_model();
    let words = "view-order groups:2, ssim-padding same, optimizer sparse, moments bf16, strategy none, appearance exposure, \
        log tensorboard, ssim-variant reflect, color-correct quadratic, export sog, export-frame local, io pread, \
        spill-codec zstd:3, evict lru, transfers demand, simd baseline, device cpu";
    let words: Vec<&str> = words.split(", ").collect();
    work.train(&format!("scene --out words --steps 2 --{}", words.join(" --")));
    let config = work.text("words/config.toml");
    for pair in words {
        let line = pair.replace(' ', " = \"") + "\"";
        assert!(config.lines().any(|of| of == line), "{line}: {config}");
    }
}

#[test]
fn numbers_that_no_machine_can_hold_are_refused() {
    let (work, _) = Workdir::small_model();
    for [flag, value] in [
        ["--max-gaussians", "1000000000000"],
        ["--threads", "4000000000"],
        ["--init-points", "4000000000"],
        ["--adam-eps", "1e-40"],
        ["--adam-eps", "0"],
        ["--adam-eps", "9.9e-17"],
        ["--adam-eps", "1.5"],
        ["--adam-eps", "nan"],
        ["--test-after=-2", ""],
    ] {
        let named = flag.split('=').next().unwrap();
        refuses(&work, &format!("{flag} {value}"), &[named, "out of range"]);
    }
    work.write("pages.txt", "0\n");
    refuses(&work, "--pages-file pages.txt", &["--pages-file", "--init-ply names none"]);
    refuses(&work, "--out new --spill-dir new/pages", &["new does not exist (yet)"]);
    // A file and the command line behave alike; the message names the limit, and the limit itself is allowed.
    work.write("eps.toml", "adam-eps = 1e-30\n");
    refuses(&work, "--config eps.toml", &["--adam-eps", "1e-30", "f32 rounds to zero", "1e-16 to 1"]);
    trains(&work, "--adam-eps 1e-16");
    // 3 TB with the optimizer's state; the city has 400 points and never reaches this cap.
    let said = trains(&work, "--max-gaussians 4000000000");
    let knows_memory = cfg!(target_os = "linux");
    assert!(said.contains("--max-gaussians") || !knows_memory, "{said}");
}

/// Views 0 and 8 of 12 are held out. One that is masked as a whole counts for nothing; if both are, that is said before the first step.
#[test]
fn held_out_photos_that_are_masked_count_for_nothing() {
    let (work, model) = Workdir::small_model();
    std::fs::create_dir(work.path("scene/masks")).unwrap();
    let mask = |i: usize| {
        let name = format!("{}.png", model.views[i].name);
        image::GrayImage::new(96, 64).save(work.path("scene/masks").join(name)).unwrap();
    };
    mask(0);
    trains(&work, "");
    let test = work.summary("out")["test"].clone();
    assert_eq!(test["views"], 1);
    assert!(test["psnr"].as_f64().unwrap() < 50.0 && test["ssim"].as_f64().is_some(), "{test}");
    mask(8);
    let said = work.train("scene --out none --steps 12");
    let warned = said.find("none of the 2 held-out photos can be compared").expect(&said);
    assert!(
        warned < said.find("done:").expect(&said) && said.contains("there is no held-out photo that counts"),
        "{said}"
    );
    assert!(work.summary("none")["test"].is_null(), "{said}");
}

/// Damages the pixels of a photo of 96x64 whose header and end stay intact, so that it passes at load.
fn damage_pixels(path: &Path) {
    image::RgbImage::new(96, 64).save_with_format(path, image::ImageFormat::Png).unwrap();
    let mut bytes = std::fs::read(path).unwrap();
    bytes[45] ^= 0xff;
    std::fs::write(path, bytes).unwrap();
}

/// All at once, and before the run has a folder.
#[test]
fn photos_that_cannot_be_decoded_are_named_before_training() {
    let (work, model) = Workdir::small_model();
    let names = [1, 3, 10].map(|i| model.views[i].name.as_str());
    let photos = names.map(|name| work.path("scene/images").join(name));
    let refused = |flags: &str| work.refuses(flags, &[&names[..], &["2 other photos", "--allow-missing"]].concat());
    photos.iter().for_each(|photo| damage_pixels(photo));
    refused("scene --out out --steps 20 --device cpu");
    refused("scene --dry-run --device cpu");
    assert!(!work.exists("out"));
    photos.iter().for_each(|photo| std::fs::remove_file(photo).unwrap());
    trains(&work, "--allow-missing");
}

#[test]
fn a_held_out_photo_that_cannot_be_decoded_loses_no_run() {
    let (work, model) = Workdir::small_model();
    damage_pixels(&work.path("scene/images").join(&model.views[0].name));
    let said = trains(&work, "--eval-every 6");
    let named = format!("the held-out photo '{}' cannot be read and is not compared", model.views[0].name);
    assert_eq!(said.matches(&named).count(), 2, "{said}");
    let done = work.summary("out");
    assert!(done["test"]["views"] == 1 && done["finished"] == true, "{done}");
    let output = work.output(EVAL, "out/point_cloud.ply");
    assert!(output.status.success() && stderr(&output).contains(&named), "{}", stderr(&output));
    assert!(stdout(&output).contains("\"views\": 1"));
}

#[test]
fn points_of_a_ply_that_are_dropped_are_counted() {
    let (work, _) = Workdir::small_model();
    let mut ply = "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\nproperty float y\n\
        property float z\nend_header\n"
        .to_string();
    for i in 0..200 {
        ply += &if i == 7 { "nan 0 0\n".to_string() } else { format!("{i} {} 0\n", i % 9) };
    }
    work.write("start.ply", ply);
    let said = trains(&work, "--init-ply start.ply");
    assert!(said.contains("start.ply") && said.contains("1 points"), "{said}");
}

#[test]
fn help_is_grouped_and_has_examples() {
    let work = Workdir::new();
    let said = stdout(&work.output(TRAIN, "--help"));
    says(&said, &["Examples:", "Dataset:", "Training:", "Densification:", "--refine-start", "--demo"]);
    assert!(said.trim_end().lines().last().unwrap().contains("configs/README.md"), "{said}");
    let flags: Vec<&str> =
        said.lines().filter_map(|line| line.strip_prefix("      --")?.split([' ', '[']).next()).collect();
    let shown = KEYS.iter().filter(|key| flags.contains(&key.name().as_str())).count();
    assert!(shown <= 50 && shown == KEYS.iter().filter(|key| key.shown != Shown::Nowhere).count(), "{flags:?}");
    // Programs that only draw show no keys of training, and accept them.
    for program in [EVAL, VIEW] {
        let said = stdout(&work.output(program, "--help"));
        assert!(
            said.contains("--host-mem <") && said.contains("--test-every <") && !said.contains("--refine-every"),
            "{said}"
        );
    }
    let said = work.refuses_with(EVAL, "none.ply scene --refine-every 50", &["none.ply"]);
    assert!(!said.contains("--refine-every"), "{said}");
    // The short help has the examples first.
    let said = stdout(&work.output(TRAIN, "-h"));
    assert!(said.lines().count() <= 30, "{said}");
    let at = |word: &str| said.find(word).expect(&said);
    assert!(at("Examples:") < at("Usage:") && at("Usage:") < at("--steps") && !said.contains("--refine-start"));
}

#[test]
fn flags_of_other_trainers_work_or_are_answered() {
    let work = Workdir::city(3, 32, 24, 100);
    for flags in ["-s scene -m out", "--data scene --result-dir out", "--data-dir scene --model-path out"] {
        let said = stdout(&work.output(TRAIN, &format!("{flags} --iterations 7 --cap-max 50 --dry-run")));
        assert!(said.contains(" 7 steps on ") && said.contains(" 50 Gaussians,"), "{flags}: {said}");
    }
    // Through other keys: the table of advice is tested without a program.
    let (flags, advice) = ADVICE[0];
    let output = work.output(TRAIN, &format!("scene --out out {}", flags[0]));
    let told = stderr(&output);
    assert!(output.status.code() == Some(2) && told.contains(flags[0]) && told.contains(advice), "{told}");
    assert!(!work.exists("out"));
}

/// `gsscale-plan ... | head` exits with success, whatever remains unprinted.
#[test]
fn a_reader_that_has_gone_is_no_error() {
    let work = Workdir::new();
    let iotune = env!("CARGO_BIN_EXE_gsscale-iotune");
    for (program, flags) in [(BENCH, "help"), (iotune, ". --file 64MiB --seconds 1 --written 16MiB")] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = piped(work.command(program, flags).stdout(writer));
        assert!(output.status.success() && !stderr(&output).contains("panicked"), "{program}: {}", stderr(&output));
    }
}

/// Output that cannot be written is an error with a message.
#[cfg(target_os = "linux")]
#[test]
fn a_full_standard_output_is_an_error() {
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let output = piped(Workdir::new().command(BENCH, "help").stdout(full));
    let errors = stderr(&output);
    assert!(!output.status.success() && errors.contains("standard output") && errors.contains("remedy"), "{errors}");
    assert!(!errors.contains("panicked"), "{errors}");
}

/// Runs a command whose standard output is set.
fn piped(command: &mut Command) -> Output {
    command.stderr(std::process::Stdio::piped()).spawn().and_then(std::process::Child::wait_with_output).unwrap()
}
