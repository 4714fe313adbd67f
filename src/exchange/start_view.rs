//! Where viewers look first: a settings file beside the exported Gaussians, in the form of SuperSplat's viewer (npm
//! `@playcanvas/supersplat-viewer`, version 2 of its settings). Without one it starts at a place of its own, often amid the scene.
//!
//! The camera is that of a training photo, where a scene looks best: of the one that sees most of it. The target, about which the
//! viewer orbits, lies on its axis, as far as the middle of what it sees. The viewer finds near and far plane itself, and keeps up up.
//!
//! Invariant: the text is a function of the cameras, the sample and the frame of the file.

use super::clean::{first_depth, in_picture};
use super::frames::ExportRows;
use crate::scene::camera::Camera;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Points beyond this multiple of the depth at which a photo's scene begins are probably hidden.
const DEPTHS_SEEN: f64 = 3.0;
/// Fields of view that the viewer takes, degrees.
const FIELD: [f64; 2] = [10.0, 120.0];

/// The camera with which a viewer starts, local frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartView {
    /// Which of the cameras it is.
    pub camera: usize,
    position: [f64; 3],
    target: [f64; 3],
    /// Field of view along the longer side of the picture, degrees.
    field: f64,
}

impl StartView {
    /// The one of `cameras` that sees most of `sample`, means of the scene; the first of equals. `None` if none sees any.
    pub fn choose(cameras: &[Camera], sample: &[[f64; 3]]) -> Option<StartView> {
        let mut best: Option<(usize, StartView)> = None;
        for (number, camera) in cameras.iter().enumerate() {
            let mut depths: Vec<f64> = in_picture(camera, sample).map(|(_, depth)| depth).collect();
            let farthest = DEPTHS_SEEN * first_depth(&mut depths);
            let seen = depths.partition_point(|&depth| depth <= farthest);
            if seen > best.map_or(0, |(most, _)| most) {
                best = Some((seen, StartView::of(number, camera, depths[seen / 2])));
            }
        }
        best.map(|(_, view)| view)
    }

    fn of(number: usize, camera: &Camera, depth: f64) -> StartView {
        let [position, target] =
            [0.0, depth].map(|z| camera.unproject([camera.cx, camera.cy].map(f64::from), z).map(f64::from));
        let half = |size: u32, f: f32| f64::from(size) / (2.0 * f64::from(f));
        let widest = half(camera.width, camera.fx).max(half(camera.height, camera.fy));
        let field = (2.0 * libm::atan(widest)).to_degrees().clamp(FIELD[0], FIELD[1]);
        StartView { camera: number, position, target, field }
    }

    /// The settings for the PLY and the SOG that `to_file` makes, on a background of this colour.
    pub fn settings(&self, to_file: &ExportRows, background: [f32; 3]) -> Value {
        // The viewer turns the files by half a turn about z, so that -y is up.
        let placed = |local: [f64; 3]| {
            let [x, y, z] = to_file.position(local);
            [-x, -y, z]
        };
        json!({
            "version": 2,
            "tonemapping": "linear",
            "highPrecisionRendering": false,
            "background": { "color": background },
            "postEffectSettings": {
                "sharpness": { "enabled": false, "amount": 0 },
                "bloom": { "enabled": false, "intensity": 0.1, "blurLevel": 2 },
                "grading": { "enabled": false, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1] },
                "vignette": { "enabled": false, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1 },
                "fringing": { "enabled": false, "intensity": 0.5 },
            },
            "animTracks": [],
            "cameras": [{ "initial": {
                "position": placed(self.position), "target": placed(self.target), "fov": self.field,
            } }],
            "annotations": [],
            "startMode": "default",
        })
    }
}

/// The settings file beside a PLY.
pub fn settings_path(ply: &Path) -> PathBuf {
    ply.with_extension("settings.json")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exchange::meta::{ExportFrame, SceneMeta};
    use crate::scene::rotation::{Rotation, VIEWER_UP};

    #[test]
    fn the_photo_that_sees_most_before_its_walls_starts() {
        // Looking along z from x, with a field of view of 90 degrees across and less along.
        let camera = |x: f32| Camera::along_z(x, [100.0, 100.0, 100.0, 20.0], [200, 60]);
        let row =
            |from: i32, step: f64, depth: f64, to: i32| (from..to).map(move |x| [step * f64::from(x), 0.0, depth]);
        // Before the first camera a wall of 10 points hides 18 behind it; the second sees 10, and one far ahead; the third, none.
        let scene = row(-5, 0.1, 1.0, 5).chain(row(-9, 1.0, 10.0, 9)).chain(row(13, 1.0, 5.0, 23));
        let scene: Vec<[f64; 3]> = scene.collect();
        let cameras = [camera(0.0), camera(18.0), camera(900.0)];
        let view = StartView::choose(&cameras, &scene).unwrap();
        assert_eq!((view.camera, view.position, view.target), (1, [18.0, 0.0, 0.0], [18.0, 0.0, 5.0]));
        assert!((view.field - 90.0).abs() < 1e-5, "{view:?}");
        assert_eq!(StartView::choose(&cameras[2..], &scene), None);

        // In the viewer, half a turn about z from the file: up is y in an upright file.
        let meta = SceneMeta {
            origin: [5.0, 6.0, 7.0],
            scale: 2.0,
            frame: ExportFrame::Dataset,
            upright: Rotation::upright([0.0, 0.0, 1.0]),
            ..SceneMeta::default()
        };
        let settings = view.settings(&ExportRows::new(&meta), [0.0; 3]);
        let of = |name: &str| [0, 1, 2].map(|i| settings["cameras"][0]["initial"][name][i].as_f64().unwrap());
        let shift = [0, 1, 2].map(|i| of("target")[i] - of("position")[i]);
        // The camera looks up in the dataset, five local units of two each.
        let want = VIEWER_UP.map(|x| -10.0 * x);
        assert!(shift.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-5), "{shift:?}");
        assert!((of("position")[1] - 7.0).abs() < 1e-5, "its height is z of the dataset: {:?}", of("position"));
    }
}
