//! Upright results, through the programs: a scene whose axes are arbitrary stands upright in its PLY, and everything that
//! reads the PLY knows.

use crate::support::scenes::{TextModel, city, eval, psnr, stderr, text, train};
use glam::{DQuat, DVec3};
use gsscale::config::file::TrainConfig;
use gsscale::config::values::Up;
use gsscale::exchange::frames::to_local;
use gsscale::exchange::meta::SceneMeta;
use gsscale::exchange::ply::{PlyContent, read_ply};
use gsscale::scene::columns::{Column, Columns};
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// A city in axes as structure from motion leaves them; its up was z.
fn tilted(folder: &Path) -> (PathBuf, DVec3) {
    let scene = city(folder, 24, 96, 64, 800);
    let mut model = TextModel::of(&scene);
    let turn = DQuat::from_axis_angle(DVec3::new(2.0, -1.0, 0.5).normalize(), 1.9);
    model.turn(turn);
    model.write(&scene);
    (scene, turn * DVec3::Z)
}

fn run(scene: &Path, out: &Path, more: &[&str]) {
    let mut args = vec![text(scene), "--out", text(out), "--steps", "60", "--quiet", "--device", "cpu"];
    args.extend(["--refine-start", "10", "--refine-every", "20"]);
    args.extend(more);
    let output = train(&args);
    assert!(output.status.success(), "{}", stderr(&output));
}

fn gaussians(ply: &Path) -> (Columns, SceneMeta) {
    let PlyContent::Gaussians { columns, meta } = read_ply(ply).unwrap() else { panic!("Gaussians") };
    (columns, meta)
}

fn ckpt(args: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_gsscale-ckpt")).args(args).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
}

/// Largest difference of two scenes' values, `column` by `column`.
fn largest_difference(a: &Columns, b: &Columns, column: Column) -> f32 {
    assert_eq!(a.rows(), b.rows());
    a.column(column).iter().zip(b.column(column)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_tilted_scene_stands_upright() {
    let folder = TempDir::new().unwrap();
    let (scene, up) = tilted(folder.path());
    let [auto, keep] = ["auto", "keep"].map(|name| folder.path().join(name));
    run(&scene, &auto, &[]);
    run(&scene, &keep, &["--up", "keep"]);

    let text_of = |name: &str| std::fs::read_to_string(auto.join(name)).unwrap();
    let transform: serde_json::Value = serde_json::from_str(&text_of("point_cloud.transform.json")).unwrap();
    let found: [f64; 3] = std::array::from_fn(|i| transform["up_in_dataset"][i].as_f64().unwrap());
    // The cameras are level; the ground of the city is flat, its houses make the points uneven.
    assert!(DVec3::from_array(found).dot(up) > 0.5f64.to_radians().cos(), "{found:?} {up}");
    let config = TrainConfig::read(&auto.join("config.toml")).unwrap();
    let Up::Along(kept) = config.up else { panic!("the config of a run names its up: {:?}", config.up) };
    // Through the rotation and back: roundings of a unit vector.
    assert!(kept.iter().zip(found).all(|(a, b)| (a - b).abs() < 1e-14), "{kept:?} {found:?}");

    let ((mut turned, of_turned), (mut kept, of_kept)) =
        (gaussians(&auto.join("point_cloud.ply")), gaussians(&keep.join("point_cloud.ply")));
    assert!(of_turned.upright.is_some() && of_kept.upright.is_none());
    assert!(largest_difference(&turned, &kept, Column::Means) > 0.5, "nothing was turned");
    let (origin, scale) = (of_kept.origin, of_kept.scale);
    to_local(&mut turned, &of_turned, origin, scale);
    to_local(&mut kept, &of_kept, origin, scale);
    for (column, slack) in [
        // Positions up to 200 units, rounded to f32 (7.6e-6 each) in three axes, divided by a scale above 1.
        (Column::Means, 4e-5),
        // Products of up to seven values below 2, rounded twice.
        (Column::Quats, 1e-6),
        (Column::ShN, 4e-6),
        (Column::Scales, 0.0),
        (Column::Opacities, 0.0),
        (Column::Sh0, 0.0),
    ] {
        let most = largest_difference(&turned, &kept, column);
        assert!(most <= slack, "{column:?}: {most}");
    }
    assert_eq!(psnr(&auto), psnr(&keep), "training is not turned");
    let report: serde_json::Value = serde_json::from_slice(&eval(&[text(&auto), text(&scene)]).stdout).unwrap();
    // As for a PLY that is not turned: rounding in dataset coordinates.
    assert!((report["test"]["psnr"].as_f64().unwrap() - psnr(&auto)).abs() < 2e-3, "{report}");
}

#[test]
fn pages_exports_and_imports_are_turned_alike() {
    let folder = TempDir::new().unwrap();
    let (scene, _) = tilted(folder.path());
    let path = |name: &str| folder.path().join(name);
    let ply = |out: &str| path(out).join("point_cloud.ply");
    let bytes = |file: &Path| std::fs::read(file).unwrap();
    run(&scene, &path("memory"), &["--page-rows", "64"]);
    let pages = path("pages");
    run(&scene, &path("drive"), &["--page-rows", "64", "--spill-dir", text(&pages), "--keep-checkpoint"]);
    assert!(bytes(&ply("memory")) == bytes(&ply("drive")), "streamed points have another up");

    let exported = path("exported.ply");
    ckpt(&["export", text(&path("drive")), "--out", text(&exported)]);
    assert!(bytes(&exported) == bytes(&ply("drive")), "an export is the trainer's file");
    let transform = |file: &Path| std::fs::read_to_string(file).unwrap();
    let [of_export, of_run] =
        [path("exported.transform.json"), path("drive/point_cloud.transform.json")].map(|f| transform(&f));
    assert_eq!(of_export.replace("exported.ply", "point_cloud.ply"), of_run);

    let (store, again) = (path("store"), path("again.ply"));
    ckpt(&["import", text(&exported), "--out", text(&store)]);
    ckpt(&["export", text(&store), "--out", text(&again)]);
    let ((first, of_first), (second, of_second)) = (gaussians(&exported), gaussians(&again));
    let [a, b] = [of_first, of_second].map(|meta| meta.upright.unwrap().quaternion());
    // The direction that is up passes through a rotation and back.
    assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-14), "{a:?} {b:?}");
    let sorted = |columns: &Columns| {
        let mut rows: Vec<[f32; 3]> = columns.means.as_chunks::<3>().0.to_vec();
        rows.sort_by(|a, b| {
            a.iter().zip(b).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
        });
        rows
    };
    for (a, b) in sorted(&first).into_iter().zip(sorted(&second)) {
        // Positions up to 200 units are rounded twice, in three axes.
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 6.0 * 7.7e-6), "{a:?} {b:?}");
    }
}

#[test]
fn up_can_be_named_and_is_refused_with_its_words() {
    let folder = TempDir::new().unwrap();
    let (scene, _) = tilted(folder.path());
    let out = folder.path().join("named");
    run(&scene, &out, &["--up", "-1,0,0"]);
    let (_, meta) = gaussians(&out.join("point_cloud.ply"));
    let turned = meta.upright.unwrap().apply([-1.0, 0.0, 0.0]);
    // Roundings of a unit vector.
    assert!(turned.iter().zip([0.0, -1.0, 0.0]).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-14), "{turned:?}");
    let refused = train(&[text(&scene), "--out", text(&folder.path().join("no")), "--up", "sideways"]);
    assert!(!refused.status.success() && stderr(&refused).contains("auto, keep or X,Y,Z"), "{}", stderr(&refused));
}
