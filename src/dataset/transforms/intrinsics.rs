//! Intrinsics of a frame: its own keys, or else those of the top level.
//!
//! Focal lengths come from `fl_x, fl_y` or `camera_angle_x, camera_angle_y` (f = side / 2 / tan(angle / 2)); one axis
//! alone serves both. The principal point is the centre of the image unless `cx, cy` say otherwise.

use super::json::{FIX_KEY, JsonNode};
use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::checked_intrinsics;
use crate::dataset::model::{Intrinsics, Lens};

const UNDISTORT: &str = "undistort the photos first, or export a PINHOLE, OPENCV or OPENCV_FISHEYE camera";

#[derive(Clone, Copy)]
pub(super) struct Levels<'a> {
    pub frame: JsonNode<'a>,
    pub top: JsonNode<'a>,
}

impl<'a> Levels<'a> {
    fn number(&self, key: &str) -> InputResult<Option<f64>> {
        match self.frame.number(key)? {
            Some(x) => Ok(Some(x)),
            None => self.top.number(key),
        }
    }

    fn error(&self, key: &str, problem: impl Into<String>, remedy: &str) -> InputError {
        let node = if self.frame.get(key).is_some() { self.frame } else { self.top };
        node.error(key, problem, remedy)
    }

    /// The stated size in pixels, if any.
    pub fn size(&self) -> InputResult<Option<(u64, u64)>> {
        let side = |key: &str| -> InputResult<Option<u64>> {
            match self.number(key)? {
                None => Ok(None),
                // Some writers store whole numbers as floats.
                Some(x) if x.fract() == 0.0 && (1.0..1e9).contains(&x) => Ok(Some(x as u64)),
                Some(x) => Err(self.error(key, format!("{x} is not a number of pixels"), FIX_KEY)),
            }
        };
        Ok(side("w")?.zip(side("h")?))
    }

    /// Whether a focal length or the principal point is in pixels.
    pub fn has_pixels(&self) -> bool {
        let keys = ["fl_x", "fl_y", "cx", "cy"];
        keys.iter().any(|key| self.frame.get(key).is_some() || self.top.get(key).is_some())
    }

    fn focal_at(&self, node: &JsonNode<'_>, focal: &str, angle: &str, side: u64) -> InputResult<Option<f64>> {
        if let Some(f) = node.number(focal)? {
            return Ok(Some(f));
        }
        match node.number(angle)? {
            None => Ok(None),
            Some(a) if a > 0.0 && a < std::f64::consts::PI => Ok(Some(0.5 * side as f64 / libm::tan(0.5 * a))),
            Some(a) => Err(node.error(angle, format!("a field of view of {a} radians"), FIX_KEY)),
        }
    }

    /// Both focal lengths; if the frame has any such key, the top level's are ignored.
    fn focal(&self, (width, height): (u64, u64)) -> InputResult<[f64; 2]> {
        for node in [self.frame, self.top] {
            let x = self.focal_at(&node, "fl_x", "camera_angle_x", width)?;
            let y = self.focal_at(&node, "fl_y", "camera_angle_y", height)?;
            if let Some(one) = x.or(y) {
                return Ok([x.unwrap_or(one), y.unwrap_or(one)]);
            }
        }
        Err(self.frame.error(
            "fl_x",
            "no focal length: neither fl_x nor camera_angle_x, here or at the top level",
            "add fl_x or camera_angle_x",
        ))
    }

    /// Lens from `camera_model` and `k1..k6, p1, p2`. Without a model, or with a pinhole one, non-zero coefficients
    /// count as OPENCV's, as in nerfstudio.
    fn lens(&self) -> InputResult<Lens> {
        let mut k = [0.0; 6];
        for (i, value) in k.iter_mut().enumerate() {
            *value = self.number(&format!("k{}", i + 1))?.unwrap_or(0.0);
        }
        let p = [self.number("p1")?.unwrap_or(0.0), self.number("p2")?.unwrap_or(0.0)];
        let stated = match self.frame.text("camera_model")? {
            Some(m) => Some(m),
            None => self.top.text("camera_model")?,
        };
        let is_fisheye = [self.frame, self.top].iter().find_map(|n| n.get("is_fisheye")?.as_bool()).unwrap_or(false);
        let model = stated.unwrap_or(if is_fisheye { "OPENCV_FISHEYE" } else { "OPENCV" }).to_ascii_uppercase();
        match model.as_str() {
            "SIMPLE_PINHOLE" | "PINHOLE" | "PERSPECTIVE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV" => {
                match [4, 5, 6].into_iter().find(|&i| k[i - 1] != 0.0) {
                    // Some programs use it for r^8, others for a denominator.
                    Some(i) => Err(self.error(
                        &format!("k{i}"),
                        format!("k{i} = {} is not defined for camera model {model}", k[i - 1]),
                        "state FULL_OPENCV if k4 to k6 are its denominator; otherwise undistort the photos first",
                    )),
                    None => Ok(Lens::Radial([k[0], k[1], p[0], p[1], k[2], 0.0, 0.0, 0.0])),
                }
            }
            "FULL_OPENCV" => Ok(Lens::Radial([k[0], k[1], p[0], p[1], k[2], k[3], k[4], k[5]])),
            "OPENCV_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => {
                if p != [0.0; 2] || k[4] != 0.0 || k[5] != 0.0 {
                    let problem = format!("camera model {model} has no p1, p2, k5 or k6");
                    return Err(self.error("p1", problem, UNDISTORT));
                }
                Ok(Lens::Fisheye([k[0], k[1], k[2], k[3]]))
            }
            _ => Err(self.error("camera_model", format!("camera model {model:?} is not supported"), UNDISTORT)),
        }
    }

    pub fn intrinsics(&self, size: (u64, u64)) -> InputResult<Intrinsics> {
        let focal = self.focal(size)?;
        let centre =
            [self.number("cx")?.unwrap_or(0.5 * size.0 as f64), self.number("cy")?.unwrap_or(0.5 * size.1 as f64)];
        let lens = self.lens()?;
        checked_intrinsics(size, focal, centre, lens).map_err(|problem| {
            let is_bad = |centre| checked_intrinsics(size, focal, centre, Lens::Pinhole).is_err();
            let key = match () {
                () if is_bad([0.0; 2]) => "fl_x",
                () if is_bad([centre[0], 0.0]) => "cx",
                () if is_bad(centre) => "cy",
                () => "k1",
            };
            self.error(key, format!("the camera has {problem}"), FIX_KEY)
        })
    }
}
