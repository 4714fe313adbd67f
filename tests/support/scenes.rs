//! Small scenes for tests through the real binaries: a generated city, rewritten as a COLMAP text model that a test can
//! edit.

use glam::{DMat3, DQuat, DVec3};
use gsscale::dataset::read::{ReadOptions, read_scene};
use gsscale::dataset::synthetic::{CityOptions, write_city};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Output;

#[derive(Debug, Clone)]
pub struct TextView {
    /// Photo, relative to images/.
    pub name: String,
    /// w x y z, as written.
    pub qvec: [f64; 4],
    /// As written.
    pub tvec: [f64; 3],
}

impl TextView {
    pub fn rotation(&self) -> DQuat {
        let [w, x, y, z] = self.qvec;
        DQuat::from_xyzw(x, y, z, w).normalize()
    }

    pub fn set_rotation(&mut self, q: DQuat) {
        self.qvec = [q.w, q.x, q.y, q.z];
    }
}

/// A COLMAP text model with one PINHOLE camera.
#[derive(Debug, Clone)]
pub struct TextModel {
    pub size: [u32; 2],
    /// fx, fy, cx, cy.
    pub pinhole: [f64; 4],
    pub views: Vec<TextView>,
    pub points: Vec<[f64; 3]>,
    pub colors: Vec<[u8; 3]>,
}

/// A generated city of `views` photos of `width` x `height`.
pub fn city(folder: &Path, views: u32, width: u32, height: u32, points: u32) -> PathBuf {
    let scene = folder.join("scene");
    let options = CityOptions { seed: 5, views, width, height, points, ..CityOptions::default() };
    write_city(&scene, &options, &|_, _| {}).unwrap();
    scene
}

impl TextModel {
    pub fn of(scene: &Path) -> TextModel {
        let raw = read_scene(scene, &ReadOptions::default()).unwrap();
        let i = raw.views[0].intrinsics;
        let views = raw.views.iter().map(|v| {
            let q = DQuat::from_mat3(&v.pose.rotation);
            TextView { name: v.name.clone(), qvec: [q.w, q.x, q.y, q.z], tvec: v.pose.translation.to_array() }
        });
        TextModel {
            size: [i.width, i.height],
            pinhole: [i.fx, i.fy, i.cx, i.cy],
            views: views.collect(),
            points: raw.points.positions,
            colors: raw.points.colors,
        }
    }

    /// Replaces the scene's model.
    pub fn write(&self, scene: &Path) {
        let folder = scene.join("sparse/0");
        std::fs::remove_dir_all(scene.join("sparse")).ok();
        std::fs::create_dir_all(&folder).unwrap();
        let [w, h] = self.size;
        let [fx, fy, cx, cy] = self.pinhole;
        std::fs::write(folder.join("cameras.txt"), format!("1 PINHOLE {w} {h} {fx} {fy} {cx} {cy}\n")).unwrap();
        let mut images = String::new();
        for (i, v) in self.views.iter().enumerate() {
            let [qw, qx, qy, qz] = v.qvec;
            let [tx, ty, tz] = v.tvec;
            writeln!(images, "{} {qw} {qx} {qy} {qz} {tx} {ty} {tz} 1 {}\n", i + 1, v.name).unwrap();
        }
        std::fs::write(folder.join("images.txt"), images).unwrap();
        let mut points = String::new();
        for (i, (p, c)) in self.points.iter().zip(&self.colors).enumerate() {
            writeln!(points, "{} {} {} {} {} {} {} 0.5 1 0", i + 1, p[0], p[1], p[2], c[0], c[1], c[2]).unwrap();
        }
        std::fs::write(folder.join("points3D.txt"), points).unwrap();
    }

    /// Writes the same scene as transforms.json beside its photos, with its points in points.ply.
    pub fn write_transforms(&self, scene: &Path) {
        let [w, h] = self.size;
        let [fx, fy, cx, cy] = self.pinhole;
        let frames = self.poses().map(|(v, rotation, translation)| {
            // Camera to world; y and z of the camera are reversed in OpenGL.
            let (x, y, z) = (rotation.row(0), -rotation.row(1), -rotation.row(2));
            let t = -(rotation.transpose() * translation);
            let row = |i: usize| [x[i], y[i], z[i], t[i]];
            serde_json::json!({
                "file_path": format!("images/{}", v.name),
                "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            })
        });
        let frames: Vec<serde_json::Value> = frames.collect();
        let top = serde_json::json!({
            "w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "ply_file_path": "points.ply", "frames": frames,
        });
        std::fs::write(scene.join("transforms.json"), top.to_string()).unwrap();
        std::fs::write(scene.join("points.ply"), self.points_ply()).unwrap();
    }

    /// Each view with its rotation and translation, world to camera.
    fn poses(&self) -> impl Iterator<Item = (&TextView, DMat3, DVec3)> {
        self.views.iter().map(|v| (v, DMat3::from_quat(v.rotation()), DVec3::from_array(v.tvec)))
    }

    /// Writes the same scene as OpenSfM does, to `file`, beside an older and smaller reconstruction.
    pub fn write_reconstruction(&self, file: &Path) {
        let [w, h] = self.size.map(f64::from);
        let [fx, fy, cx, cy] = self.pinhole;
        let side = w.max(h);
        let shots = self.poses().map(|(v, rotation, translation)| {
            // The axis is what the rotation leaves alone, the angle follows from its trace.
            let (axis, angle) = DQuat::from_mat3(&rotation).to_axis_angle();
            let shot = serde_json::json!({
                "rotation": (axis * angle).to_array(), "translation": translation.to_array(), "camera": "v2 drone",
                "orientation": 1, "capture_time": 1.5e9, "gps_position": [1.0, 2.0, 3.0], "vertices": [], "faces": [],
            });
            (v.name.clone(), shot)
        });
        let points = self.points.iter().zip(&self.colors).enumerate();
        let points = points.map(|(i, (at, color))| {
            (format!("{i:07}"), serde_json::json!({ "color": color.map(f64::from), "coordinates": at }))
        });
        let camera = serde_json::json!({
            "projection_type": "brown", "width": w as u32, "height": h as u32, "focal_x": fx / side, "focal_y": fy / side,
            "c_x": (cx - w / 2.0) / side, "c_y": (cy - h / 2.0) / side,
            "k1": 0.0, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0,
        });
        let whole = serde_json::json!({
            "cameras": { "v2 drone": camera }, "shots": shots.collect::<serde_json::Map<_, _>>(),
            "points": points.collect::<serde_json::Map<_, _>>(), "reference_lla": { "latitude": 1, "longitude": 2, "altitude": 0 },
        });
        let lost = serde_json::json!({ "cameras": {}, "shots": {}, "points": {} });
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, serde_json::json!([lost, whole]).to_string()).unwrap();
    }

    /// Writes the same scene as RealityCapture does, to `file`, and its points to points.ply beside it.
    pub fn write_reality_capture(&self, file: &Path) {
        let [w, h] = self.size.map(f64::from);
        let [fx, _, cx, cy] = self.pinhole;
        let side = w.max(h);
        let mut csv = String::from("#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\r\n");
        for (v, rotation, translation) in self.poses() {
            let [x, y, z] = (-(rotation.transpose() * translation)).to_array();
            // Camera to world with axes right-up-back is Rz(-heading) Rx(pitch) Ry(roll); its last row is
            // (-cos(pitch) sin(roll), sin(pitch), cos(pitch) cos(roll)), its second column
            // (sin(heading) cos(pitch), cos(heading) cos(pitch), sin(pitch)).
            let [right, up, back] = [rotation.row(0), -rotation.row(1), -rotation.row(2)];
            let angles = [up.x.atan2(up.y), up.z.asin(), (-right.z).atan2(back.z)].map(f64::to_degrees);
            let [heading, pitch, roll] = angles;
            let [f, px, py] = [fx / side * 36.0, (cx - w / 2.0) / side, (cy - h / 2.0) / side];
            write!(csv, "{},{x},{y},{z},{heading},{pitch},{roll},{f},{px},{py},0,0,0,0,0,0\r\n", v.name).unwrap();
        }
        std::fs::write(file, csv).unwrap();
        std::fs::write(file.with_file_name("points.ply"), self.points_ply()).unwrap();
    }

    fn points_ply(&self) -> String {
        let mut ply = format!("ply\nformat ascii 1.0\nelement vertex {}\n", self.points.len());
        for property in ["double x", "double y", "double z", "uchar red", "uchar green", "uchar blue"] {
            writeln!(ply, "property {property}").unwrap();
        }
        ply.push_str("end_header\n");
        for (p, c) in self.points.iter().zip(&self.colors) {
            writeln!(ply, "{} {} {} {} {} {}", p[0], p[1], p[2], c[0], c[1], c[2]).unwrap();
        }
        ply
    }

    /// Turns the whole scene about its origin.
    pub fn turn(&mut self, by: DQuat) {
        for p in &mut self.points {
            *p = (by * DVec3::from_array(*p)).to_array();
        }
        for v in &mut self.views {
            // World to camera of a turned world: first back, then as before. The translation stays.
            v.set_rotation(v.rotation() * by.inverse());
        }
    }
}

/// Keeps lengths, rates and densification as the flags of a test and gsplat's defaults say, whatever the number of steps.
const CLASSIC: [[&str; 2]; 2] = [["--schedule", "classic"], ["--strategy", "default"]];

/// The flags of [`CLASSIC`] that these arguments leave open. A run that is resumed keeps its own.
pub fn classic(args: &[&str]) -> Vec<&'static str> {
    let is_open = |flag: &&[&str; 2]| !args.contains(&flag[0]) && !args.contains(&"--resume");
    CLASSIC.iter().filter(is_open).flatten().copied().collect()
}

/// Standard output, then standard error.
pub fn told(output: &Output) -> String {
    stdout(output) + &stderr(output)
}

pub fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Paints a box onto each photo, an eighth of a photo of 64x48, and on each at another place: something that no other photo shows there.
pub fn add_boxes(photos: &[PathBuf]) {
    for (i, photo) in photos.iter().enumerate() {
        let mut picture = image::open(photo).unwrap().to_rgb8();
        let (width, height) = picture.dimensions();
        for (x, y) in (0..16).flat_map(|x| (0..24).map(move |y| (x + 7 * i as u32, y + 5 * i as u32))) {
            picture.put_pixel(x % width, y % height, image::Rgb([250, 40, 220]));
        }
        picture.save(photo).unwrap();
    }
}
