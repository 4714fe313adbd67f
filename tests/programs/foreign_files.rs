//! Files that other programs wrote or saved again, through the real binaries: Gaussians without the comments that say their frame,
//! config files in other encodings, and results where a scene is expected.

use crate::support::scenes::TextModel;
use crate::support::workdir::{CKPT, EVAL, TRAIN, VIEW, Workdir, sorted_rows, split_ply};
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::write_gaussians;
use gsscale::scene::columns::Columns;
use serde_json::Value;

fn run(work: &Workdir, out: &str, more: &str) -> String {
    work.train(&format!("scene --out {out} --quiet --device cpu {more}"))
}

fn ckpt(work: &Workdir, flags: &str) -> (Value, String) {
    work.json_and_words(CKPT, &format!("{flags} --json"))
}

/// Saves a PLY as editors do, without its comments.
fn save_without_comments(work: &Workdir, from: &str, to: &str) {
    let bytes = work.bytes(from);
    let (header, rows) = split_ply(&bytes);
    let kept: String =
        header.lines().filter(|line| !line.starts_with("comment")).map(|line| format!("{line}\n")).collect();
    work.write(to, [kept.as_bytes(), rows].concat());
}

/// PSNR of a file on the held-out photos, and what was said.
fn measured(work: &Workdir, file: &str) -> (f64, String) {
    let (report, said) = work.json_and_words(EVAL, &format!("{file} scene --device cpu"));
    (report["test"]["psnr"].as_f64().unwrap(), said)
}

const NOT_FITTING: &str = "it does not fit the cameras";

/// A PLY that an editor saved has lost its frame: the transform file beside it has it, for evaluation, for a new run and for a
/// store. Without that file a warning says that Gaussians and cameras do not fit.
#[test]
fn a_saved_ply_is_read_in_the_frame_of_the_file_beside_it() {
    let work = Workdir::city(24, 96, 64, 1500);
    // In local coordinates and upright, so that origin, scale and axes differ.
    let said = run(&work, "run", "--steps 40 --export-frame local --export spz,sog");
    assert!(!said.contains(NOT_FITTING), "{said}");
    let ply = "run/point_cloud.ply";
    let (want, said) = measured(&work, ply);
    assert!(!said.contains(NOT_FITTING) && !said.contains("transform"), "{said}");
    // Renamed beside the files of the run, with the transform of a copy, and saved over the original.
    std::fs::create_dir_all(work.path("copy")).unwrap();
    work.write("copy/any.transform.json", work.bytes("run/point_cloud.transform.json"));
    for file in ["run/cleaned.ply", "copy/any.ply", "copy/renamed.PLY", ply] {
        save_without_comments(&work, ply, file);
        let (got, said) = measured(&work, file);
        assert!((got - want).abs() < 1e-3, "{file}: {got} instead of {want}");
        assert!(said.contains("transform.json beside it") && !said.contains(NOT_FITTING), "{said}");
    }
    // A new run from it, in memory and in pages, and from a store of it.
    let one = "--overwrite --steps 1 --means-lr 1e-9 --init-ply";
    let (_, said) = ckpt(&work, "import run/cleaned.ply --out store");
    assert!(said.contains("transform.json beside it"), "{said}");
    for from in ["run/cleaned.ply", "copy/renamed.PLY --spill-dir spill", "store"] {
        let said = run(&work, "again", &format!("{one} {from}"));
        assert!(!said.contains(NOT_FITTING), "{said}");
        let got = work.psnr("again");
        assert!((got - want).abs() < 0.3, "{from}: {got} instead of {want}");
    }
    // Nothing beside it.
    save_without_comments(&work, ply, "bare.ply");
    let (got, said) = measured(&work, "bare.ply");
    assert!(got < want - 0.5 && said.contains(NOT_FITTING), "{got} of {want}: {said}");
    ckpt(&work, "import bare.ply --out bare_store");
    for from in ["bare.ply", "bare_store"] {
        let said = run(&work, "wrong", &format!("{one} {from}"));
        assert!(said.contains(NOT_FITTING), "{said}");
    }
    // A transform that is none is named.
    work.write("bare.transform.json", "{\"file_to_dataset\": [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]}");
    work.refuses_with(EVAL, "bare.ply scene", &["bare.transform.json", "file_to_dataset", "remedy"]);
    // The list of exports wrote both, and the report says so.
    let (summary, report) = (work.summary("run"), work.text("run/report.html"));
    let files = [&summary["export"]["file"], &summary["more_exports"][0]["file"]];
    assert_eq!(files, ["point_cloud.spz", "point_cloud_sog/lod-meta.json"]);
    for file in files.map(|file| file.as_str().unwrap()) {
        assert!(report.contains(&format!("{file}: ")) && work.path("run").join(file).is_file(), "{file}");
    }
    // Results in the place of a scene.
    work.refuses_with(TRAIN, "run", &["output folder of a run", "--resume", "gsscale-eval"]);
    work.refuses_with(TRAIN, "run/point_cloud.ply", &["not a scene", "gsscale-eval", "--init-ply"]);
    work.refuses_with(TRAIN, "run/point_cloud_sog/lod-meta.json", &["not a scene", "gsscale-eval"]);
    for ending in ["splat", "ksplat", "spz", "sog", "SPLAT"] {
        let file = format!("run/x.{ending}");
        work.write(&file, [7; 64]);
        // The frame of an SPZ is upside down for other programs.
        let turned = if ending == "spz" { " -r 180,0,0 run/x.ply" } else { "x.ply" };
        let words = &["splat-transform", turned, "remedy"];
        work.refuses_with(EVAL, &format!("{file} scene"), words);
        work.refuses_with(TRAIN, &format!("scene --init-ply {file}"), words);
        work.refuses_with(CKPT, &format!("import {file} --out run/store"), words);
        work.refuses_with(TRAIN, &file, &["not a scene", "splat-transform"]);
    }
    // The original beside it is better.
    let beside = "give the PLY beside it: run/point_cloud.ply";
    work.refuses_with(EVAL, "run/point_cloud.spz scene", &[beside]);
    work.refuses_with(CKPT, "import run/point_cloud_sog/lod-meta.json --out run/store", &[beside, "--init-ply"]);
    let tree = "run/point_cloud_sog/lod-meta.json";
    work.refuses_with(TRAIN, "scene --init-ply run/point_cloud_sog", &[tree]);
    work.refuses_with(EVAL, "run/point_cloud_sog", &[tree]);
    let said = work.refuses_with(VIEW, "run/point_cloud_sog scene", &[tree]);
    assert!(!said.contains("live page"), "{said}");
    // The finest level of SOGs is a start like a PLY, and as good but for its rounding.
    run(&work, "from_sog", &format!("{one} run/point_cloud_sog/lod-meta.json"));
    assert!((work.psnr("from_sog") - want).abs() < 0.3, "{} instead of {want}", work.psnr("from_sog"));
}

/// A file does not state how large its scene is: the size follows from its rows, so that few of them count as giants.
#[test]
fn giants_of_an_imported_file_are_those_of_its_rows() {
    let work = Workdir::new();
    let mut rows = Columns::zeros(500, 0);
    for row in 0..500 {
        let at = row as f32;
        rows.means[3 * row..3 * row + 3].copy_from_slice(&[7.0 * at % 1000.0, 37.0 * at % 900.0, at % 20.0]);
        rows.scales[3 * row..3 * row + 3].fill(if row % 100 == 0 { 900.0f32 } else { 2.0 }.ln());
        rows.quats[4 * row] = 1.0;
    }
    write_gaussians(&work.path("a.ply"), &rows, &SceneMeta::default()).unwrap();
    ckpt(&work, "import a.ply --out store");
    let (done, _) = ckpt(&work, "export store --out sog/lod-meta.json");
    assert_eq!((done["always_shown"].as_u64(), done["levels"][0].as_u64()), (Some(5), Some(495)), "{done}");
    // The values are those of the file.
    ckpt(&work, "export store --out b.ply");
    assert!(sorted_rows(&work.bytes("a.ply")) == sorted_rows(&work.bytes("b.ply")));
}

/// Editors of Windows save text with a byte order mark or as UTF-16.
#[test]
fn config_files_and_models_in_other_encodings_train() {
    let work = Workdir::city(12, 96, 64, 400);
    let mut model = TextModel::of(&work.scene());
    // The model has the name in Windows-1252, the drive in UTF-8.
    std::fs::rename(&work.photos()[0], work.path("scene/images/Gemäuer.jpg")).unwrap();
    model.views[0].name = "Gem@uer.jpg".to_string();
    model.write(&work.scene());
    let [images, cameras] = ["images", "cameras"].map(|name| format!("scene/sparse/0/{name}.txt"));
    let bytes = work.bytes(&images).into_iter().map(|byte| if byte == b'@' { 0xe4 } else { byte });
    work.write(&images, bytes.collect::<Vec<u8>>());
    let utf_16 =
        |text: &str| [&b"\xff\xfe"[..], &text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>()].concat();
    work.write(&cameras, utf_16(&work.text(&cameras)));
    let keys = "# Größe\nsteps = 3\nexport = [\"spz\", \"sog\"]\n";
    for bytes in [
        utf_16(keys),
        [b"\xef\xbb\xbf", keys.as_bytes()].concat(),
        keys.replace("öß", "@").replace('@', "o").into_bytes(),
    ] {
        work.write("run.toml", bytes);
        let said = run(&work, "out", "--config run.toml --overwrite");
        assert!(said.contains("1 name is not UTF-8") && said.contains("Gem\\xE4uer.jpg is Gemäuer.jpg"), "{said}");
        assert_eq!(work.count("out", "steps"), 3);
        assert!(work.exists("out/point_cloud.spz") && work.path("out/point_cloud_sog").is_dir());
    }
    work.write("run.toml", b"steps = 3\nimages = \"Geb\xe4ude\"\n");
    work.refuses_with(TRAIN, "scene --config run.toml", &["line 2", "Geb\\xE4ude", "UTF-8"]);
}
