//! Writes small COLMAP models, binary and text, and checks the words of errors.

use gsscale::base::error::{InputError, InputResult};
use gsscale::dataset::model::RawScene;
use std::fs;
use std::path::{MAIN_SEPARATOR, Path, PathBuf};
use tempfile::TempDir;

/// The first line of a CSV of RealityCapture.
pub const HEADER: &str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2";

#[derive(Clone)]
pub struct Cam {
    pub id: u32,
    pub model: (i32, &'static str),
    pub size: (u64, u64),
    pub params: Vec<f64>,
}

#[derive(Clone)]
pub struct Img {
    pub quat: [f64; 4],
    pub translation: [f64; 3],
    pub camera: u32,
    pub name: Vec<u8>,
    pub observations: usize,
}

#[derive(Clone)]
pub struct Pt {
    pub position: [f64; 3],
    pub color: [u8; 3],
    pub track: usize,
}

#[derive(Clone)]
pub struct Model {
    pub cameras: Vec<Cam>,
    pub images: Vec<Img>,
    pub points: Vec<Pt>,
}

/// Two cameras, four images out of order, a cloud of `points` points.
pub fn model(points: usize) -> Model {
    let image = |i: usize, name: &str| Img {
        quat: [0.9, 0.1 * i as f64, -0.2, 0.3],
        translation: [i as f64, -0.5, 2.0],
        camera: if i == 2 { 7 } else { 1 },
        name: name.into(),
        observations: 3 * i,
    };
    Model {
        cameras: vec![
            Cam { id: 1, model: (1, "PINHOLE"), size: (640, 480), params: vec![500.0, 510.0, 320.0, 240.0] },
            Cam { id: 7, model: (3, "RADIAL"), size: (320, 200), params: vec![300.0, 160.0, 100.0, 0.1, -0.01] },
        ],
        images: vec![image(0, "d.jpg"), image(1, "a b.jpg"), image(2, "sub/c.png"), image(3, "b.jpg")],
        points: (0..points)
            .map(|i| Pt { position: [i as f64, 0.25, -1.5], color: [i as u8, 2, 3], track: i % 5 })
            .collect(),
    }
}

impl Model {
    pub fn cameras_bin(&self) -> Vec<u8> {
        let mut out = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for c in &self.cameras {
            out.extend(c.id.to_le_bytes());
            out.extend(c.model.0.to_le_bytes());
            out.extend(c.size.0.to_le_bytes());
            out.extend(c.size.1.to_le_bytes());
            out.extend(c.params.iter().flat_map(|p| p.to_le_bytes()));
        }
        out
    }

    pub fn images_bin(&self) -> Vec<u8> {
        let mut out = (self.images.len() as u64).to_le_bytes().to_vec();
        for (i, im) in self.images.iter().enumerate() {
            out.extend((i as u32 + 1).to_le_bytes());
            out.extend(im.quat.iter().chain(&im.translation).flat_map(|x| x.to_le_bytes()));
            out.extend(im.camera.to_le_bytes());
            out.extend(&im.name);
            out.push(0);
            out.extend((im.observations as u64).to_le_bytes());
            for o in 0..im.observations {
                out.extend((o as f64).to_le_bytes());
                out.extend(1.5f64.to_le_bytes());
                out.extend((-1i64).to_le_bytes());
            }
        }
        out
    }

    pub fn points_bin(&self) -> Vec<u8> {
        let mut out = (self.points.len() as u64).to_le_bytes().to_vec();
        for (i, p) in self.points.iter().enumerate() {
            out.extend((i as u64 + 10).to_le_bytes());
            out.extend(p.position.iter().flat_map(|x| x.to_le_bytes()));
            out.extend(p.color);
            out.extend(0.7f64.to_le_bytes());
            out.extend((p.track as u64).to_le_bytes());
            out.extend((0..2 * p.track).flat_map(|t| (t as u32).to_le_bytes()));
        }
        out
    }

    pub fn cameras_txt(&self) -> String {
        let mut out = format!("# Camera list\n#   CAMERA_ID, MODEL\n# Number of cameras: {}\n", self.cameras.len());
        for c in &self.cameras {
            let params = c.params.iter().map(|p| format!(" {p}")).collect::<String>();
            out += &format!("{} {} {} {}{params}\n", c.id, c.model.1, c.size.0, c.size.1);
        }
        out
    }

    pub fn images_txt(&self) -> String {
        let mut out = format!("# Number of images: {}, mean observations per image: 1\n", self.images.len());
        for (i, im) in self.images.iter().enumerate() {
            let ([w, x, y, z], [a, b, c]) = (im.quat, im.translation);
            let name = String::from_utf8_lossy(&im.name);
            out += &format!("{} {w} {x} {y} {z} {a} {b} {c} {} {name}\n", i + 1, im.camera);
            out += &((0..im.observations).map(|o| format!("{o}.5 1.5 -1")).collect::<Vec<_>>().join(" ") + "\n");
        }
        out
    }

    pub fn points_txt(&self) -> String {
        let mut out = format!("# Number of points: {}, mean track length: 2\n", self.points.len());
        for (i, p) in self.points.iter().enumerate() {
            let ([x, y, z], [r, g, b]) = (p.position, p.color);
            let track = (0..p.track).map(|t| format!(" {t} {t}")).collect::<String>();
            out += &format!("{} {x} {y} {z} {r} {g} {b} 0.7{track}\n", i + 10);
        }
        out
    }

    pub fn write_bin(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        fs::write(folder.join("cameras.bin"), self.cameras_bin()).unwrap();
        fs::write(folder.join("images.bin"), self.images_bin()).unwrap();
        fs::write(folder.join("points3D.bin"), self.points_bin()).unwrap();
    }

    pub fn write_txt(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        fs::write(folder.join("cameras.txt"), self.cameras_txt()).unwrap();
        fs::write(folder.join("images.txt"), self.images_txt()).unwrap();
        fs::write(folder.join("points3D.txt"), self.points_txt()).unwrap();
    }
}

/// An empty scene folder with `images/`.
pub fn scene_folder() -> TempDir {
    let scene = TempDir::new().unwrap();
    fs::create_dir(scene.path().join("images")).unwrap();
    scene
}

/// A scene with this model in `sparse/0`; the second value is that folder.
pub fn scene_with(model: &Model, is_binary: bool) -> (TempDir, PathBuf) {
    let scene = scene_folder();
    let folder = scene.path().join("sparse/0");
    if is_binary {
        model.write_bin(&folder)
    } else {
        model.write_txt(&folder)
    }
    (scene, folder)
}

/// The error of a reading that must fail: it names this file, says a place and a remedy, and its text holds `parts`.
#[track_caller]
pub fn refused(result: InputResult<RawScene>, file: &str, parts: &[&str]) -> InputError {
    let error = result.expect_err("the scene must be refused");
    assert!(error.file.ends_with(file), "{error} is not about {file}");
    assert!(!error.remedy.is_empty(), "{error} has no remedy");
    let text = error.to_string();
    for part in parts {
        assert!(text.contains(part), "{text:?} does not say {part:?}");
    }
    error
}

/// Whether some warning holds all of these.
#[track_caller]
pub fn warned(scene: &RawScene, parts: &[&str]) {
    let says = |warning: &str| parts.iter().all(|part| warning.contains(part));
    let found = scene.warnings.iter().any(|warning| says(&warning.replace(MAIN_SEPARATOR, "/")));
    assert!(found, "no warning says {parts:?}: {:?}", scene.warnings);
}
