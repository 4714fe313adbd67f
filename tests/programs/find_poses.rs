//! `gsscale-poses` on photos of a flight without their model, through pycolmap and COLMAP where they are installed
//! (`GSSCALE_PYTHON`, `colmap` on the PATH), and what it refuses without any program.

use super::clients::python_with;
use crate::support::exif::{add_exif, tiff_of_place};
use crate::support::scenes::stderr;
use crate::support::shared::real_scene;
use crate::support::workdir::{POSES, TRAIN, Workdir, says, succeeded};
use glam::{DMat3, DVec3};
use gsscale::dataset::exif::GpsPlace;
use gsscale::dataset::model::RawScene;
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::poses::geo::metres_from;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

/// Less work than by default: photos are 1,200 pixels wide.
const QUICK: &str = "--max-resolution 600 --features 1500";
/// Metres of a unit of brighton's model.
const METRES: f64 = 8.26;

/// Whether COLMAP is installed; prints a skip otherwise.
fn has_colmap() -> bool {
    let said = Command::new("colmap").arg("help").env("QT_QPA_PLATFORM", "offscreen").output();
    let is_there = said.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains("COLMAP"));
    if !is_there {
        println!("SKIPPED: colmap is not installed");
    }
    is_there
}

/// Where the cameras of the model stand: metres east, north and up of their middle, if the flight looked straight down.
fn stand(scene: &RawScene) -> Vec<DVec3> {
    let backs: DVec3 = scene.views.iter().map(|view| -view.pose.rotation.row(2)).sum();
    let up = backs.normalize();
    let east = up.any_orthonormal_vector();
    let turn = DMat3::from_cols(east, up.cross(east), up).transpose();
    let centres = || scene.views.iter().map(|view| view.pose.centre());
    let middle = centres().sum::<DVec3>() / scene.views.len() as f64;
    centres().map(|at| METRES * (turn * (at - middle))).collect()
}

/// Copies the photos of brighton to `photos`, under names with spaces, with their places as GPS tags if `with_gps`.
fn flight(work: &Workdir, with_gps: bool) -> Option<Vec<GpsPlace>> {
    let brighton = read_scene(&real_scene("brighton")?, &ReadOptions::default()).unwrap();
    std::fs::create_dir(work.path("photos")).unwrap();
    let of_view = |(view, at): (&gsscale::dataset::model::RawView, DVec3)| {
        let copy = work.path("photos").join(view.name.replace("DJI_", "photo "));
        std::fs::copy(&view.image_path, &copy).unwrap();
        // At 43 degrees north a degree is 111.11 km along the meridian and 81.54 km along the parallel.
        let (latitude, longitude) = (43.0 + at.y / 111_113.0, -87.0 + at.x / 81_541.0);
        let altitude = 300.0 + at.z;
        if with_gps {
            add_exif(&copy, &tiff_of_place("FC300X", [latitude, longitude, altitude]));
        }
        GpsPlace { latitude, longitude, altitude: Some(altitude) }
    };
    Some(brighton.views.iter().zip(stand(&brighton)).map(of_view).collect())
}

fn poses(work: &Workdir, flags: &str, program: &[&str]) -> String {
    stderr(&succeeded(work.command(POSES, flags).args(program).output().unwrap()))
}

/// The scene, of which at least 16 of 18 photos must have poses.
fn found(scene: &Path) -> RawScene {
    let raw = read_scene(scene, &ReadOptions::default()).unwrap();
    assert!(raw.views.len() >= 16 && raw.points.positions.len() > 300, "{} photos", raw.views.len());
    assert!(raw.views.iter().all(|view| view.image_path.is_file()), "{:?}", raw.views);
    raw
}

#[test]
fn photos_with_gps_become_a_scene_in_metres_by_pycolmap() {
    let work = Workdir::new();
    let Some(python) = python_with("pycolmap") else { return };
    let Some(places) = flight(&work, true) else { return };
    let program = ["--python", python.as_str()];
    let told = poses(&work, &format!("photos --out scan {QUICK}"), &program);
    says(&told, &["18 photos of 1 camera(s), 18 with GPS", "about 153 pairs", "forecast:", "of 18 photos have poses"]);
    says(&told, &["in metres east, north and up of 4", "next: gsscale-train scan"]);
    let raw = found(&work.path("scan"));
    // The photos lie under their own names in the new scene, and nothing is left beside the old ones.
    assert!(work.exists("scan/images/photo 0018.JPG") && !work.exists("photos/sparse") && !work.exists("photos/poses"));
    let origin = work.json("scan/reference_lla.json");
    let number = |key: &str| origin[key].as_f64().unwrap();
    let altitude = Some(number("altitude"));
    let origin = GpsPlace { latitude: number("latitude"), longitude: number("longitude"), altitude };
    let names = work.files("photos").into_keys().map(|name| name.into_os_string().into_string().unwrap());
    let names: Vec<String> = names.collect();
    let mut errors: Vec<f64> = raw
        .views
        .iter()
        .map(|view| {
            let place = &places[names.iter().position(|name| *name == view.name).unwrap()];
            view.pose.centre().distance(metres_from(&origin, place))
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    // The flight is some 60 m above a flat park, so its own scale and height are known to a metre or two.
    assert!(errors[errors.len() / 2] < 1.0 && errors[errors.len() - 1] < 4.0, "{errors:?}");
    assert!(raw.views.iter().all(|view| -view.pose.rotation.row(2).z > 0.95), "cameras that looked down do not");
    work.refuses_with(
        POSES,
        "photos --out scan",
        &["a model is here already", "gsscale-train scan", "rename scan/sparse"],
    );
    // A photo that came later has no pose: whoever asks for poses is told.
    work.succeeds(TRAIN, "scan --out out --dry-run --poses auto");
    std::fs::copy(work.path("scan/images/photo 0018.JPG"), work.path("scan/images/later.jpg")).unwrap();
    work.refuses("scan --dry-run --poses auto", &["1 photo is new or changed since the search", "rename scan/sparse"]);
    std::fs::remove_file(work.path("scan/images/later.jpg")).unwrap();

    // Finished phases are not done again: without a model in the scene it is written again from what is there.
    let database = || std::fs::metadata(work.path("scan/poses/database.db")).unwrap().modified().unwrap();
    let (before, model) = (database(), work.files("scan/sparse"));
    work.remove("scan/sparse");
    poses(&work, &format!("photos --out scan {QUICK}"), &program);
    assert!(database() == before && work.files("scan/sparse") == model);
    // Other options begin again, and a search that was killed goes on as soon as its program has ended, which the system does on Linux.
    work.remove("scan/sparse");
    let again = || {
        let mut command = work.command(POSES, "photos --out scan --max-resolution 400 --features 500");
        command.args(program).stderr(Stdio::piped());
        command
    };
    let mut killed = again().spawn().unwrap();
    let log = work.path("scan/poses/log.txt");
    while !std::fs::read_to_string(&log).is_ok_and(|text| text.contains("Processed file [2/18]")) {
        assert!(killed.try_wait().unwrap().is_none(), "it ended before it was killed");
        std::thread::sleep(Duration::from_millis(20));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    assert!(!work.exists("scan/sparse"));
    let phases =
        || std::fs::read_to_string(&log).unwrap().lines().filter(|line| line.contains("Processed file [")).count();
    let begun = phases();
    let told = loop {
        let output = again().output().unwrap();
        let told = stderr(&output);
        if !told.contains("another search works in this folder") {
            assert!(output.status.success(), "{told}");
            break told;
        }
        assert!(!cfg!(target_os = "linux") || phases() <= begun + 4, "the program works on");
        std::thread::sleep(Duration::from_millis(100));
    };
    assert!(database() != before && told.contains("of 18 photos have poses"), "{told}");
}

#[test]
fn a_folder_of_photos_becomes_a_scene_by_colmap() {
    let work = Workdir::new();
    if !has_colmap() || flight(&work, false).is_none() {
        return;
    }
    // Debian's COLMAP compares in four times the time of newer ones.
    let told = poses(&work, "photos --max-resolution 500 --features 1000", &["--colmap", "colmap"]);
    says(&told, &["18 photos of 1 camera(s), 0 with GPS; COLMAP ", "next: gsscale-train photos"]);
    found(&work.path("photos"));
    work.succeeds(TRAIN, "photos --out out --dry-run --poses auto");
}

#[test]
fn what_cannot_work_is_refused_with_a_remedy() {
    let work = Workdir::city(3, 32, 24, 100);
    let refused = |flags: &str, words: &[&str]| work.refuses_with(POSES, flags, words);
    refused("scene", &["scene/sparse", "a model is here already", "--out"]);
    work.remove("scene/sparse");
    refused("scene --colmap nowhere/colmap", &["nowhere/colmap", "no such program", "leave --colmap out"]);
    let without = work.command(POSES, "scene").env("PATH", "").env_remove("GSSCALE_PYTHON").output().unwrap();
    let misnamed =
        work.command(POSES, "scene").env("PATH", "").env("GSSCALE_PYTHON", "nowhere/python").output().unwrap();
    says(&stderr(&misnamed), &["nowhere/python", "no such program", "leave GSSCALE_PYTHON out"]);
    says(&stderr(&without), &["neither COLMAP nor a Python with pycolmap", "pip install pycolmap", "--colmap PATH"]);
    // A pycolmap that is too old, and one that cannot be loaded, are named as what they are.
    #[cfg(unix)]
    for (prints, words) in [
        (
            "old pycolmap 3.11.1",
            ["old pycolmap 3.11.1 is there, and 3.13 or newer is needed", "-m pip install --upgrade pycolmap"],
        ),
        ("ImportError: libGL.so.1: no such file", ["no pycolmap that can be used: ImportError: libGL.so.1", "install"]),
    ] {
        let folder = work.path("bin");
        std::fs::create_dir_all(&folder).unwrap();
        work.write("bin/python3", format!("#!/bin/sh\necho '{prints}'\n"));
        let may_run = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(folder.join("python3"), may_run).unwrap();
        let said = work.command(POSES, "scene").env("PATH", &folder).env_remove("GSSCALE_PYTHON").output().unwrap();
        says(&stderr(&said), &words);
    }
    // A program that is no COLMAP, and a Python that is none.
    let echo = if cfg!(unix) { "/bin/echo" } else { "hostname" };
    refused(&format!("scene --colmap {echo}"), &["COLMAP 3.8 or newer is needed"]);
    refused(&format!("scene --python {echo}"), &["no pycolmap that can be used"]);
    refused("nowhere", &["nowhere", "listing the photos"]);
    std::fs::create_dir(work.path("empty")).unwrap();
    refused("empty", &["0 photos", "three photos"]);
    work.write("flight.mp4", "?");
    refused("flight.mp4", &["this is a file", "ffmpeg"]);
    std::fs::create_dir_all(work.path("card/DCIM")).unwrap();
    for photo in work.photos() {
        std::fs::copy(&photo, work.path("card/DCIM").join(photo.file_name().unwrap())).unwrap();
    }
    refused("card", &["sub-folders", "DCIM/", "--out"]);
    refused("card --out card/DCIM", &["DCIM", "3 photos would be left out"]);
    // Pictures of a telephone.
    std::fs::create_dir(work.path("heic")).unwrap();
    (0..4).for_each(|i| work.write(&format!("heic/IMG_{i}.HEIC"), "?"));
    refused("heic", &["neither JPEG nor PNG", "convert them"]);
    work.refuses("heic --poses auto", &["neither JPEG nor PNG", "convert them"]);
    work.refuses("heic", &["4 pictures are here neither JPEG nor PNG", "convert them"]);
    // A folder of the name of ours, and photos in the place of links.
    if let Some(python) = python_with("pycolmap") {
        let program = format!("--python {python}");
        std::fs::create_dir(work.path("scene/poses")).unwrap();
        work.write("scene/poses/notes.txt", "mine");
        refused(&format!("scene {program}"), &["scene/poses", "not a work folder of gsscale-poses"]);
        std::fs::create_dir_all(work.path("new/images")).unwrap();
        refused(&format!("scene --out new {program}"), &["new/images", "exists already"]);
        assert!(!work.exists("new/poses"));
        // Photos of a size that shows nothing: pycolmap finds no model.
        let told = refused(&format!("scene --out small {program}"), &["no poses were found", "remedy"]);
        // Training does not send the user back, and counts each photo once.
        let photos = format!("the {} photos show too little", work.photos().len());
        work.refuses_with(TRAIN, "small", &[&photos, "take more photos between the gaps", "gsscale-poses small again"]);
        assert!(!work.exists("small/sparse"), "{told}");
        let lock = std::fs::File::open(work.path("small/poses/lock")).unwrap();
        lock.try_lock().unwrap();
        refused(&format!("scene --out small {program}"), &["small/poses", "another search works in this folder"]);
    }
}
