//! The training of a run whose scene is cut into cells: the programs of a user, one after the other on this machine.
//!
//! Not here: when a run is trained, its folder and its log ([`super::runs`]).

use super::programs::problem;
use gsscale::base::error::InputResult;
use gsscale::cells::City;
use gsscale::cells::plan::CityPlan;
use serde::Deserialize;
use serde_json::Value;
use std::ffi::OsString;
use std::path::Path;
use std::process::Output;

/// How a scene is cut into cells. `None` stands for the default of `gsscale-cells cut`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct CityCut {
    cells: usize,
    /// Width of the margin, as a share of a cell's.
    margin: Option<f64>,
    /// The share of a photo's blending weight for which a cell takes the photo.
    view_share: Option<f64>,
}

/// The folders of a city and of its scenes.
pub struct CityPlace<'a> {
    pub scene: &'a Path,
    pub config: &'a Path,
    pub city: &'a Path,
    pub merged: &'a Path,
}

/// How well a scene is drawn beside the borders of cells.
#[derive(Debug, Clone, Copy)]
pub struct Borders {
    /// PSNR of the held-out views that show a border, and of the bands along borders, dB.
    pub crossing_psnr: Option<f64>,
    pub band_psnr: Option<f64>,
}

/// What starts `gsscale-cells` with such arguments.
pub type StartCells<'a> = dyn Fn(&[OsString]) -> InputResult<Output> + 'a;

impl CityCut {
    /// Trains the city and merges it; `machine` are flags for the cells. Returns the message of a step that failed.
    /// Errors: a program cannot be started, or was interrupted.
    pub fn train(&self, place: &CityPlace, machine: &[String], cells: &StartCells) -> InputResult<Option<String>> {
        let path = |path: &Path| path.as_os_str().to_os_string();
        let (city, scene) = (path(place.city), path(place.scene));
        let words = |words: &[&str]| words.iter().map(OsString::from).collect::<Vec<_>>();
        let mut cut = words(&["cut", "--quiet", "--cells", &self.cells.to_string()]);
        for (flag, value) in [("--margin", self.margin), ("--view-share", self.view_share)] {
            cut.extend(value.iter().flat_map(|value| words(&[flag, &value.to_string()])));
        }
        let machine = machine.iter().map(OsString::from);
        cut.extend([scene.clone(), "--out".into(), city.clone()].into_iter().chain(machine.clone()));
        let prior = ["prior".into(), "--quiet".into(), scene, "--out".into(), city.clone()];
        let prior = [&prior[..], &["--config".into(), path(place.config)]].concat();
        let run = |cell: usize| {
            let words = words(&["run", "--quiet", "--cell", &cell.to_string()]);
            words.into_iter().chain([city.clone()]).chain(machine.clone()).collect()
        };
        let merge = vec!["merge".into(), city.clone(), "--out".into(), path(place.merged)];
        let first_failure = |steps: Vec<Vec<OsString>>| -> InputResult<Option<String>> {
            for arguments in steps {
                let output = cells(&arguments)?;
                if !output.status.success() {
                    return problem(&output).map(Some);
                }
            }
            Ok(None)
        };
        if let Some(problem) = first_failure(vec![prior, cut])? {
            return Ok(Some(problem));
        }
        // Cells of few photos were joined to others.
        let count = CityPlan::read(&City(place.city.to_path_buf()))?.cells.len();
        first_failure((0..count).map(run).chain([merge]).collect())
    }
}

/// Measures the scene in the folder `model` beside the borders of a city. Returns the message of a measurement that failed.
/// Errors: the program cannot be started, or was interrupted.
pub fn borders(city: &Path, model: &Path, cells: &StartCells) -> InputResult<Result<Borders, String>> {
    let output = cells(&["seam".into(), city.into(), model.into()])?;
    if !output.status.success() {
        return Ok(Err(problem(&output)?));
    }
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let number = |name: &str| report[name].as_f64();
    Ok(Ok(Borders { crossing_psnr: number("crossing_psnr"), band_psnr: number("band_psnr") }))
}
