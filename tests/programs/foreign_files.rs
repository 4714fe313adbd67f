//! Files that other programs wrote or saved again, through the real binaries: Gaussians without the comments that say their frame,
//! config files in other encodings, and results where a scene is expected.

use crate::support::scenes::{TextModel, city, eval, psnr, stderr, summary, text, train};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::write_gaussians;
use gsscale::scene::columns::Columns;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

fn run(scene: &Path, out: &Path, more: &[&str]) -> String {
    let mut args = vec![text(scene), "--out", text(out), "--quiet", "--device", "cpu"];
    args.extend(more);
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
    stderr(&output)
}

fn refused(program: &str, args: &[&str], words: &[&str]) {
    let output = Command::new(program).args(args).output().unwrap();
    let said = stderr(&output);
    assert!(!output.status.success(), "{args:?}: {said}");
    words.iter().for_each(|word| assert!(said.contains(word), "'{word}' is not in: {said}"));
}

fn ckpt(args: &[&str]) -> (serde_json::Value, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt")).args(args).arg("--json").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    (serde_json::from_slice(&output.stdout).unwrap(), stderr(&output))
}

/// Saves a PLY as editors do, without its comments.
fn save_without_comments(from: &Path, to: &Path) {
    let bytes = std::fs::read(from).unwrap();
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap();
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let kept: String =
        header.lines().filter(|line| !line.starts_with("comment")).map(|line| format!("{line}\n")).collect();
    std::fs::write(to, [kept.as_bytes(), &bytes[end..]].concat()).unwrap();
}

/// PSNR of a file on the held-out photos, and what was said.
fn measured(file: &Path, scene: &Path) -> (f64, String) {
    let output = eval(&[text(file), text(scene), "--device", "cpu"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    (report["test"]["psnr"].as_f64().unwrap(), stderr(&output))
}

const NOT_FITTING: &str = "it does not fit the cameras";

/// A PLY that an editor saved has lost its frame: the transform file beside it has it, for evaluation, for a new run and for a
/// store. Without that file a warning says that Gaussians and cameras do not fit.
#[test]
fn a_saved_ply_is_read_in_the_frame_of_the_file_beside_it() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 24, 96, 64, 1500);
    let path = |name: &str| folder.path().join(name);
    // In local coordinates and upright, so that origin, scale and axes differ.
    let said = run(&scene, &path("run"), &["--steps", "40", "--export-frame", "local", "--export", "spz,sog"]);
    assert!(!said.contains(NOT_FITTING), "{said}");
    let ply = path("run/point_cloud.ply");
    let (want, said) = measured(&ply, &scene);
    assert!(!said.contains(NOT_FITTING) && !said.contains("transform"), "{said}");
    // Saved over the original, renamed beside the files of the run, and with the transform of a copy.
    std::fs::create_dir_all(path("copy")).unwrap();
    std::fs::copy(path("run/point_cloud.transform.json"), path("copy/any.transform.json")).unwrap();
    let saved = [path("run/cleaned.ply"), path("copy/any.ply"), path("copy/renamed.PLY"), ply.clone()];
    saved.iter().rev().skip(1).chain([&ply]).for_each(|to| save_without_comments(&ply, to));
    for file in &saved {
        let (got, said) = measured(file, &scene);
        assert!((got - want).abs() < 1e-3, "{}: {got} instead of {want}", file.display());
        assert!(said.contains("transform.json beside it") && !said.contains(NOT_FITTING), "{said}");
    }
    // A new run from it, in memory and in pages, and from a store of it.
    let one = ["--steps", "1", "--means-lr", "1e-9", "--init-ply"];
    let (_, said) = ckpt(&["import", text(&saved[0]), "--out", text(&path("store"))]);
    assert!(said.contains("transform.json beside it"), "{said}");
    let spill = path("spill");
    for (from, more) in [(&saved[0], &[][..]), (&saved[2], &["--spill-dir", text(&spill)]), (&path("store"), &[])] {
        let said = run(&scene, &path("again"), &[&one[..], &[text(from), "--overwrite"], more].concat());
        assert!(!said.contains(NOT_FITTING), "{said}");
        let got = psnr(&path("again"));
        assert!((got - want).abs() < 0.3, "{}: {got} instead of {want}", from.display());
    }
    // Nothing beside it.
    let bare = path("bare.ply");
    save_without_comments(&ply, &bare);
    let (got, said) = measured(&bare, &scene);
    assert!(got < want - 0.5 && said.contains(NOT_FITTING), "{got} of {want}: {said}");
    ckpt(&["import", text(&bare), "--out", text(&path("bare_store"))]);
    for from in [&bare, &path("bare_store")] {
        let said = run(&scene, &path("wrong"), &[&one[..], &[text(from), "--overwrite"]].concat());
        assert!(said.contains(NOT_FITTING), "{said}");
    }
    // A transform that is none is named.
    std::fs::write(path("bare.transform.json"), "{\"file_to_dataset\": [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]}")
        .unwrap();
    refused(
        env!("CARGO_BIN_EXE_gsscale-eval"),
        &[text(&bare), text(&scene)],
        &["bare.transform.json", "file_to_dataset", "remedy"],
    );
    // The list of exports wrote both, and the report says so.
    let summary = summary(&path("run"));
    assert_eq!(summary["export"]["file"], "point_cloud.spz");
    assert_eq!(summary["more_exports"][0]["file"], "point_cloud_sog/lod-meta.json");
    let report = std::fs::read_to_string(path("run/report.html")).unwrap();
    assert!(report.contains("point_cloud.spz: ") && report.contains("point_cloud_sog/lod-meta.json: "));
    assert!(path("run/point_cloud.spz").is_file() && path("run/point_cloud_sog/lod-meta.json").is_file());
    results_in_the_place_of_a_scene(&path("run"), &scene);
}

fn results_in_the_place_of_a_scene(run: &Path, scene: &Path) {
    let (train, eval, ckpt) =
        (env!("CARGO_BIN_EXE_gsscale-train"), env!("CARGO_BIN_EXE_gsscale-eval"), env!("CARGO_BIN_EXE_gsscale-ckpt"));
    refused(train, &[text(run)], &["output folder of a run", "--resume", "gsscale-eval"]);
    refused(train, &[text(&run.join("point_cloud.ply"))], &["not a scene", "gsscale-eval", "--init-ply"]);
    refused(train, &[text(&run.join("point_cloud_sog/lod-meta.json"))], &["not a scene", "gsscale-eval"]);
    for ending in ["splat", "ksplat", "spz", "sog", "SPLAT"] {
        let file = run.join(format!("x.{ending}"));
        std::fs::write(&file, [7; 64]).unwrap();
        let words = &["splat-transform", "x.ply", "remedy"];
        refused(eval, &[text(&file), text(scene)], words);
        refused(train, &[text(scene), "--init-ply", text(&file)], words);
        refused(ckpt, &["import", text(&file), "--out", text(&run.join("store"))], words);
        refused(train, &[text(&file)], &["not a scene", "splat-transform"]);
    }
    refused(
        train,
        &[text(scene), "--init-ply", text(&run.join("point_cloud_sog/lod-meta.json"))],
        &["splat-transform"],
    );
}

/// A file does not state how large its scene is: the size follows from its rows, so that few of them count as giants.
#[test]
fn giants_of_an_imported_file_are_those_of_its_rows() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut rows = Columns::zeros(500, 0);
    for row in 0..500 {
        let at = row as f32;
        rows.means[3 * row..3 * row + 3].copy_from_slice(&[7.0 * at % 1000.0, 37.0 * at % 900.0, at % 20.0]);
        rows.scales[3 * row..3 * row + 3].fill(if row % 100 == 0 { 900.0f32 } else { 2.0 }.ln());
        rows.quats[4 * row] = 1.0;
    }
    write_gaussians(&path("a.ply"), &rows, &SceneMeta::default()).unwrap();
    ckpt(&["import", text(&path("a.ply")), "--out", text(&path("store"))]);
    let (done, _) = ckpt(&["export", text(&path("store")), "--out", text(&path("sog/lod-meta.json"))]);
    assert_eq!((done["always_shown"].as_u64(), done["levels"][0].as_u64()), (Some(5), Some(495)), "{done}");
    // The values are those of the file.
    ckpt(&["export", text(&path("store")), "--out", text(&path("b.ply"))]);
    let rows_of = |name: &str| {
        let bytes = std::fs::read(path(name)).unwrap();
        let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap();
        let mut rows: Vec<Vec<u8>> = bytes[end + 11..].chunks(17 * 4).map(<[u8]>::to_vec).collect();
        rows.sort();
        rows
    };
    assert!(rows_of("a.ply") == rows_of("b.ply"));
}

/// Editors of Windows save text with a byte order mark or as UTF-16.
#[test]
fn config_files_and_models_in_other_encodings_train() {
    let folder = TempDir::new().unwrap();
    let scene = city(folder.path(), 12, 96, 64, 400);
    let mut model = TextModel::of(&scene);
    // The model has the name in Windows-1252, the drive in UTF-8.
    let first = model.views[0].name.clone();
    std::fs::rename(scene.join("images").join(&first), scene.join("images/Gemäuer.jpg")).unwrap();
    model.views[0].name = "Gem@uer.jpg".to_string();
    model.write(&scene);
    let images = scene.join("sparse/0/images.txt");
    let bytes = std::fs::read(&images).unwrap().into_iter().map(|byte| if byte == b'@' { 0xe4 } else { byte });
    std::fs::write(&images, bytes.collect::<Vec<u8>>()).unwrap();
    let cameras = scene.join("sparse/0/cameras.txt");
    let utf_16 =
        |text: &str| [&b"\xff\xfe"[..], &text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>()].concat();
    std::fs::write(&cameras, utf_16(&std::fs::read_to_string(&cameras).unwrap())).unwrap();
    let config: PathBuf = folder.path().join("run.toml");
    let keys = "# Größe\nsteps = 3\nexport = [\"spz\", \"sog\"]\n";
    for bytes in [
        utf_16(keys),
        [b"\xef\xbb\xbf", keys.as_bytes()].concat(),
        keys.replace("öß", "@").replace('@', "o").into_bytes(),
    ] {
        std::fs::write(&config, bytes).unwrap();
        let out = folder.path().join("out");
        let said = run(&scene, &out, &["--config", text(&config), "--overwrite"]);
        assert!(said.contains("1 name(s) are not UTF-8") && said.contains("Gem\\xE4uer.jpg is Gemäuer.jpg"), "{said}");
        assert_eq!(summary(&out)["steps"].as_u64(), Some(3));
        assert!(out.join("point_cloud.spz").is_file() && out.join("point_cloud_sog").is_dir());
    }
    std::fs::write(&config, b"steps = 3\nimages = \"Geb\xe4ude\"\n").unwrap();
    let words = ["line 2", "Geb\\xE4ude", "UTF-8"];
    refused(env!("CARGO_BIN_EXE_gsscale-train"), &[text(&scene), "--config", text(&config)], &words);
    refused(env!("CARGO_BIN_EXE_gsscale-train"), &[text(&scene), "--export", "spz,splat"], &["ply, spz or sog"]);
}
