//! The content of a `reconstruction.json`, value by value: cameras, shots and points of each reconstruction.
//!
//! Not here: what the numbers mean ([`super`]).
//!
//! Invariants: 1. for any content the result is a value or an error with line and column; 2. memory holds names, poses and
//! points, not the observations, meshes and metadata around them: at most some 16 times the size of the file.

use crate::base::error::{InputError, InputResult};
use crate::dataset::gathered::MAX_COORDINATE;
use crate::dataset::loose_json::{LooseJson, Number};
use crate::dataset::model::PointCloud;
use serde::Deserialize;
use serde::de::{Deserializer, Error, IgnoredAny, MapAccess, Visitor};
use std::collections::BTreeMap;
use std::fmt::Formatter;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Largest file read, bytes: a survey of 20,000 photos has 2 GB.
const MAX_BYTES: u64 = 4 << 30;

/// A camera; a number that is not in the file is 0.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub(super) struct LensCamera {
    /// The name of the lens model; empty stands for `perspective`.
    pub projection_type: String,
    pub width: f64,
    pub height: f64,
    pub focal: f64,
    pub focal_x: f64,
    pub focal_y: f64,
    pub c_x: f64,
    pub c_y: f64,
    pub k1: f64,
    pub k2: f64,
    pub k3: f64,
    pub k4: f64,
    pub k5: f64,
    pub k6: f64,
    pub p1: f64,
    pub p2: f64,
    pub s0: f64,
    pub s1: f64,
    pub s2: f64,
    pub s3: f64,
}

/// A photo with its pose.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct PosedShot {
    /// Axis times angle in radians, world to camera.
    pub rotation: [Number; 3],
    /// World to camera.
    pub translation: [Number; 3],
    pub camera: String,
}

/// Photos whose poses are in one frame.
#[derive(Debug, Default, Deserialize)]
pub(super) struct Reconstruction {
    #[serde(deserialize_with = "cameras")]
    pub cameras: BTreeMap<String, LensCamera>,
    #[serde(deserialize_with = "shots")]
    pub shots: Vec<(String, PosedShot)>,
    #[serde(default, deserialize_with = "points")]
    pub points: Points,
}

/// Points, without those that are not finite or too far away for a coordinate.
#[derive(Debug, Default)]
pub(super) struct Points {
    pub cloud: PointCloud,
    pub dropped: usize,
}

/// Reads all reconstructions of a file.
pub(super) fn load(path: &Path) -> InputResult<Vec<Reconstruction>> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
    let length = file.metadata().map_err(|e| InputError::io(path, "reading", &e))?.len();
    if length > MAX_BYTES {
        let problem = format!("the file is larger than {} GiB", MAX_BYTES >> 30);
        return Err(InputError::new(path, problem, "export a COLMAP model, or split the project"));
    }
    serde_json::from_reader(BufReader::with_capacity(1 << 18, LooseJson::new(file))).map_err(|e| {
        if let Some(kind) = e.io_error_kind() {
            return InputError::io(path, "reading", &kind.into());
        }
        let remedy =
            "it must be a reconstruction.json of OpenSfM or OpenDroneMap: correct this place, or copy the file again";
        InputError::new(path, format!("cannot be read: {e}"), remedy).at(format!(
            "line {} column {}",
            e.line(),
            e.column()
        ))
    })
}

/// Passes the entries of an object to `take`, by name.
struct NamedEntries<V, F: FnMut(String, V)> {
    what: &'static str,
    take: F,
    values: std::marker::PhantomData<V>,
}

impl<'de, V: Deserialize<'de>, F: FnMut(String, V)> Visitor<'de> for NamedEntries<V, F> {
    type Value = ();
    fn expecting(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        write!(f, "an object of {}s", self.what)
    }
    fn visit_map<A: MapAccess<'de>>(mut self, mut of: A) -> Result<(), A::Error> {
        while let Some(name) = of.next_key::<String>()? {
            // The text of the error ends with line and column, which serde_json takes over.
            let value = of.next_value().map_err(|e| A::Error::custom(format!("{} {name:?}: {e}", self.what)))?;
            (self.take)(name, value);
        }
        Ok(())
    }
}

fn cameras<'de, D: Deserializer<'de>>(source: D) -> Result<BTreeMap<String, LensCamera>, D::Error> {
    let mut cameras = BTreeMap::new();
    let take = |name, camera| _ = cameras.insert(name, camera);
    source.deserialize_map(NamedEntries { what: "camera", take, values: std::marker::PhantomData })?;
    Ok(cameras)
}

fn shots<'de, D: Deserializer<'de>>(source: D) -> Result<Vec<(String, PosedShot)>, D::Error> {
    let mut shots = Vec::new();
    let take = |name, shot| shots.push((name, shot));
    source.deserialize_map(NamedEntries { what: "shot", take, values: std::marker::PhantomData })?;
    Ok(shots)
}

fn points<'de, D: Deserializer<'de>>(source: D) -> Result<Points, D::Error> {
    #[derive(Deserialize)]
    struct PointEntry {
        coordinates: [Number; 3],
        color: Option<[Number; 3]>,
        #[serde(rename = "observations")]
        _observations: Option<IgnoredAny>,
    }
    let mut points = Points::default();
    let take = |_, point: PointEntry| {
        let position = point.coordinates.map(|x| x.0);
        if !position.iter().all(|x| x.abs() <= MAX_COORDINATE) {
            points.dropped += 1;
            return;
        }
        points.cloud.positions.push(position);
        // Without a colour: grey.
        points.cloud.colors.push(point.color.map_or([128; 3], |color| color.map(|c| c.0.round() as u8)));
    };
    source.deserialize_map(NamedEntries { what: "point", take, values: std::marker::PhantomData })?;
    Ok(points)
}
