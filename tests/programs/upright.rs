//! Upright results, through the programs: a scene whose axes are arbitrary stands upright in its PLY, and everything that
//! reads the PLY knows.

use crate::support::scenes::{TextModel, stderr};
use crate::support::workdir::{CKPT, TRAIN, Workdir};
use glam::{DQuat, DVec3};
use gsscale::config::file::TrainConfig;
use gsscale::config::values::Up;
use gsscale::exchange::frames::to_local;
use gsscale::scene::columns::{Column, Columns};

/// A city in axes as structure from motion leaves them; its up was z.
fn tilted() -> (Workdir, DVec3) {
    let work = Workdir::city(24, 96, 64, 800);
    let mut model = TextModel::of(&work.scene());
    let turn = DQuat::from_axis_angle(DVec3::new(2.0, -1.0, 0.5).normalize(), 1.9);
    model.turn(turn);
    model.write(&work.scene());
    (work, turn * DVec3::Z)
}

fn run(work: &Workdir, out: &str, more: &str) {
    work.run(out, &format!("--steps 60 --refine-start 10 --refine-every 20 {more}"));
}

fn largest_difference(a: &Columns, b: &Columns, column: Column) -> f32 {
    assert_eq!(a.rows(), b.rows());
    a.column(column).iter().zip(b.column(column)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_tilted_scene_stands_upright() {
    let (work, up) = tilted();
    run(&work, "auto", "");
    run(&work, "keep", "--up keep");

    let transform = work.json("auto/point_cloud.transform.json");
    let found: [f64; 3] = std::array::from_fn(|i| transform["up_in_dataset"][i].as_f64().unwrap());
    // The cameras are level; the ground of the city is flat, its houses make the points uneven.
    assert!(DVec3::from_array(found).dot(up) > 0.5f64.to_radians().cos(), "{found:?} {up}");
    let config = TrainConfig::read(&work.path("auto/config.toml")).unwrap();
    let Up::Along(kept) = config.up else { panic!("the config of a run names its up: {:?}", config.up) };
    // Through the rotation and back: roundings of a unit vector.
    assert!(kept.iter().zip(found).all(|(a, b)| (a - b).abs() < 1e-14), "{kept:?} {found:?}");

    let [(mut turned, of_turned), (mut kept, of_kept)] =
        ["auto", "keep"].map(|out| work.gaussians(&format!("{out}/point_cloud.ply")));
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
    assert_eq!(work.psnr("auto"), work.psnr("keep"), "training is not turned");
    // As for a PLY that is not turned: rounding in dataset coordinates.
    assert!((work.eval_psnr("auto scene") - work.psnr("auto")).abs() < 2e-3);
}

#[test]
fn pages_exports_and_imports_are_turned_alike() {
    let (work, _) = tilted();
    run(&work, "drive", "--page-rows 64 --spill-dir pages --keep-checkpoint");
    let ckpt = |flags: &str| assert!(work.output(CKPT, flags).status.success(), "{flags}");
    ckpt("export drive --out exported.ply");
    assert!(work.bytes("exported.ply") == work.ply("drive"), "an export is the trainer's file");
    let [of_export, of_run] =
        ["exported", "drive/point_cloud"].map(|name| work.text(&format!("{name}.transform.json")));
    assert_eq!(of_export.replace("exported.ply", "point_cloud.ply"), of_run);

    ckpt("import exported.ply --out store");
    ckpt("export store --out again.ply");
    let [(first, of_first), (second, of_second)] = ["exported.ply", "again.ply"].map(|file| work.gaussians(file));
    let [a, b] = [of_first, of_second].map(|meta| meta.upright.unwrap().quaternion());
    // The direction that is up passes through a rotation and back.
    assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-14), "{a:?} {b:?}");
    let sorted = |columns: &Columns| {
        let mut rows: Vec<[f32; 3]> = columns.means.as_chunks::<3>().0.to_vec();
        rows.sort_by(|a, b| a.partial_cmp(b).unwrap());
        rows
    };
    for (a, b) in sorted(&first).into_iter().zip(sorted(&second)) {
        // Positions up to 200 units are rounded twice, in three axes.
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 6.0 * 7.7e-6), "{a:?} {b:?}");
    }
}

#[test]
fn up_can_be_named_and_is_refused_with_its_words() {
    let (work, _) = tilted();
    run(&work, "named", "--up -1,0,0");
    let (_, meta) = work.gaussians("named/point_cloud.ply");
    let turned = meta.upright.unwrap().apply([-1.0, 0.0, 0.0]);
    // Roundings of a unit vector.
    assert!(turned.iter().zip([0.0, -1.0, 0.0]).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-14), "{turned:?}");
    let refused = work.output(TRAIN, "scene --out no --up sideways");
    let said = stderr(&refused);
    assert!(!refused.status.success() && said.contains("auto, keep or X,Y,Z"), "{said}");
}
