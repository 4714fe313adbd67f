//! Generates photos of a random city: for the demo, scaling runs and tests.
//!
//! [`write_city`] builds a world from a seed (`world`, `build`, `parts`, `texture`), plans a flight over it
//! (`flight`), casts rays (`trace`, `shade`, `photo`), samples points (`points`) and writes a COLMAP scene:
//! `images/view_0000.jpg ...` and `sparse/0/{cameras,images,points3D}.bin`.
//!
//! Invariants: 1. the same options give the same bytes for any number of threads and on every platform: all random draws
//! are keyed, all arithmetic is + - * / sqrt and `libm`; 2. `sparse/` appears last, complete, in one rename: the folder
//! of an interrupted run cannot be read as a scene; 3. photos and models are removed only beside the mark, which is written
//! before them where there were none, and only files with the names that are written here.

mod build;
mod flight;
mod parts;
mod photo;
mod points;
mod shade;
mod texture;
mod trace;
mod world;

use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole;
use crate::base::whole_folder::{check_ours, remove_ours};
use crate::dataset::colmap_write::{ColmapModel, ModelImage, make_folder, write_model};
use build::build_city;
use flight::CityFlight;
use glam::DVec3;
use image::{ExtendedColorType, codecs::jpeg::JpegEncoder};
use photo::ShotPhoto;
use shade::Scene;
use std::path::{Path, PathBuf};

const JPEG_QUALITY: u8 = 95;

/// File that shows that photos and model of a folder are generated: others may have the same names.
const MARK: &str = ".gsscale-city";

#[derive(Debug, Clone, PartialEq)]
pub struct CityOptions {
    /// Seed of the city, the flight, the points and the sensor noise.
    pub seed: u64,
    /// Photos of the flight; with the overview photos 1 to 100,000.
    pub views: u32,
    /// Photos from high above, after those of the flight. They see no points.
    pub overviews: u32,
    /// Share of the area of all copies of the city that each of them shows, .0001 to 1.
    pub overview_area: f64,
    /// Width of a photo, pixels, 16 to 16,384.
    pub width: u32,
    /// Height of a photo, pixels, 16 to 16,384.
    pub height: u32,
    /// Angle of the cameras of the flight to the vertical, degrees, 0 to 80; `None`: 40, or as much as keeps the horizon outside.
    pub tilt: Option<f64>,
    /// Number of points, up to 50 million.
    pub points: u32,
    /// Side of the city in blocks of 60 m, 1 to 150 (a block takes about 0.15 MB of memory); `None`: the largest city
    /// that the views cover at full overlap.
    pub blocks: Option<u32>,
    /// Standard deviation of the photos' brightness (0.03 is 3 %), 0 to 0.3.
    pub exposure: f64,
    /// Standard deviation of the sensor noise as a fraction of white, 0 to 0.3.
    pub noise: f64,
    /// Where surfaces meet, NxN rays are cast through a pixel; 1 to 8.
    pub supersample: u32,
    /// Copies of the city along x and y, 1 to 100 each, for any number of points in bounded memory. The photos are
    /// divided among the copies in turn; those of the flight do not show neighbouring copies.
    pub tiles: [u32; 2],
    /// Added to all coordinates, metres: (500000, 4600000, 0) makes them look like UTM.
    pub offset: [f64; 3],
    /// Replace the generated scene in the folder.
    pub overwrite: bool,
}

impl Default for CityOptions {
    fn default() -> Self {
        CityOptions {
            seed: 1,
            views: 60,
            overviews: 0,
            overview_area: 0.4,
            width: 480,
            height: 320,
            tilt: None,
            points: 20_000,
            blocks: None,
            exposure: 0.0,
            noise: 0.0,
            supersample: 3,
            tiles: [1, 1],
            offset: [0.0; 3],
            overwrite: false,
        }
    }
}

impl CityOptions {
    pub fn photos(&self) -> u32 {
        self.views.saturating_add(self.overviews)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct CitySummary {
    pub folder: PathBuf,
    pub views: u32,
    pub points: u64,
    /// Total length of all tracks.
    pub observations: u64,
    pub blocks: u32,
    /// Side of the city, metres.
    pub side: f64,
    pub solids: u32,
    /// Number of rays cast through pixels, without shadow rays.
    pub rays: u64,
}

/// Refuses options out of range; the error names the flag of `gsscale-synth`.
fn check(options: &CityOptions) -> InputResult<()> {
    let in_range = |flag: &str, value: f64, low: f64, high: f64| {
        if value >= low && value <= high {
            return Ok(());
        }
        Err(InputError::new(flag, format!("{value} is out of range"), format!("choose {low} to {high}")))
    };
    in_range("--views", f64::from(options.views), 1.0, 100_000.0)?;
    in_range("--overviews", f64::from(options.overviews), 0.0, 100_000.0 - f64::from(options.views))?;
    in_range("--overview-area", options.overview_area, 1e-4, 1.0)?;
    in_range("--tilt", options.tilt.unwrap_or(0.0), 0.0, 80.0)?;
    in_range("--resolution", f64::from(options.width), 16.0, 16_384.0)?;
    in_range("--resolution", f64::from(options.height), 16.0, 16_384.0)?;
    in_range("--points", f64::from(options.points), 0.0, 50e6)?;
    in_range("--blocks", f64::from(options.blocks.unwrap_or(1)), 1.0, 150.0)?;
    in_range("--exposure", options.exposure, 0.0, 0.3)?;
    in_range("--noise", options.noise, 0.0, 0.3)?;
    in_range("--supersample", f64::from(options.supersample), 1.0, 8.0)?;
    options.tiles.iter().try_for_each(|&n| in_range("--tile", f64::from(n), 1.0, 100.0))?;
    options.offset.iter().try_for_each(|&v| in_range("--offset", v, -1e9, 1e9))
}

/// Generates a city and writes it to `folder` as a COLMAP scene. `progress(done, views)` is called after each photo.
/// Errors: an option is out of range, the folder is not empty and `overwrite` is off, it holds photos or a model of others, or a file
/// cannot be written.
pub fn write_city(
    folder: &Path,
    options: &CityOptions,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> InputResult<CitySummary> {
    check(options)?;
    prepare(folder, options.overwrite)?;
    let flight = flight::plan(options);
    let scene = Scene::new(build_city(options.seed, flight.blocks));
    let rays = write_photos(folder, options, &flight, &scene, progress)?;
    let points = points::sample(&scene, &flight, options);
    let offset = DVec3::from(options.offset);
    // Offsets of the copies of the city.
    let ([across, along], side) = (options.tiles, 2.0 * scene.world.half());
    let copy = |k: u32| [f64::from(k % across) * side, f64::from(k / across) * side, 0.0];
    let tiles: Vec<[f64; 3]> = (0..across * along).map(copy).collect();
    // Overview photos have their place among all copies.
    let tile = |k: usize| if k < options.views as usize { tiles[k % tiles.len()] } else { [0.0; 3] };
    let pose = |k: usize| flight.shots[k].pose(offset + DVec3::from(tile(k)));
    let name = |k: usize| photo_name(k, options.photos());
    let images = (0..flight.shots.len()).map(|k| ModelImage { name: name(k), pose: pose(k), camera: 0 });
    let model = ColmapModel { cameras: vec![flight.intrinsics], images: images.collect(), points, tiles };
    write_model(&folder.join("sparse"), &model)?;
    Ok(CitySummary {
        folder: folder.to_path_buf(),
        views: options.photos(),
        points: (model.points.len() * model.tiles.len()) as u64,
        observations: model.points.iter().map(|p| p.observations.len() as u64).sum(),
        blocks: flight.blocks,
        side,
        solids: scene.world.solids.len() as u32,
        rays,
    })
}

/// Name of photo `k`; names sort in the order of the flight.
fn photo_name(k: usize, views: u32) -> String {
    let digits = views.saturating_sub(1).to_string().len().max(4);
    format!("view_{k:0digits$}.jpg")
}

/// Whether the folder holds a generated scene, perhaps an unfinished one.
pub fn is_generated(folder: &Path) -> bool {
    folder.join(MARK).is_file()
}

/// Creates the folders, and marks them. With `overwrite`, removes the generated scene in them, but never other photos or models.
fn prepare(folder: &Path, overwrite: bool) -> InputResult<()> {
    make_folder(folder)?;
    let listed = std::fs::read_dir(folder).map_err(|e| InputError::io(folder, "listing the folder", &e))?;
    if !overwrite && listed.count() > 0 {
        return Err(InputError::new(
            folder,
            "the folder is not empty",
            "choose another folder, or --overwrite to replace the generated scene in it",
        ));
    }
    // The model is removed first: without it the folder cannot be read as a scene.
    let parts = ["sparse", "sparse.partial", "images"].map(|name| folder.join(name));
    if is_generated(folder) {
        parts.iter().try_for_each(|part| check_ours(part, is_generated_file))?;
        parts.iter().try_for_each(|part| remove_ours(part, is_generated_file))?;
    } else if let Some(other) = parts.iter().find(|part| part.symlink_metadata().is_ok()) {
        let problem = format!("no {MARK} beside it says that it is generated; nothing was overwritten");
        return Err(InputError::new(other, problem, "choose another folder, or move it away"));
    } else {
        write_whole(
            &folder.join(MARK),
            b"gsscale made the photos and the model in this folder, and may replace them.\n",
        )?;
    }
    make_folder(&folder.join("images"))
}

/// Whether [`write_city`] makes a file of this path inside of one of its folders, or an interrupted run left it.
fn is_generated_file(inside: &Path) -> bool {
    let name = inside.file_name().unwrap_or_default().to_string_lossy();
    let name = name.strip_prefix('.').and_then(|name| name.strip_suffix(".part")).unwrap_or(&name);
    let number = name.strip_prefix("view_").and_then(|n| n.strip_suffix(".jpg"));
    let is_photo = number.is_some_and(|n| n.len() >= 4 && n.bytes().all(|b| b.is_ascii_digit()));
    let is_of_model = ["cameras.bin", "images.bin", "points3D.bin"].contains(&name);
    is_photo && inside.components().count() == 1 || is_of_model && inside.parent() == Some(Path::new("0"))
}

/// Takes and writes all photos; returns the number of rays.
fn write_photos(
    folder: &Path,
    options: &CityOptions,
    flight: &CityFlight,
    scene: &Scene,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> InputResult<u64> {
    let mut rays = 0;
    let mut waiting: Option<(usize, ShotPhoto)> = None;
    // A photo is compressed and written while the next one is taken.
    for k in 0..=flight.shots.len() {
        let done = waiting.take();
        let (taken, written) = rayon::join(
            || {
                let shot = flight.shots.get(k)?;
                Some((k, photo::take(scene, &flight.intrinsics, shot, k as u32, options)))
            },
            || match &done {
                Some((j, photo)) => write_photo(folder, options, *j, photo),
                None => Ok(()),
            },
        );
        written?;
        if let Some((j, photo)) = done {
            rays += photo.rays;
            progress(j as u32 + 1, options.photos());
        }
        waiting = taken;
    }
    Ok(rays)
}

fn write_photo(folder: &Path, options: &CityOptions, k: usize, photo: &ShotPhoto) -> InputResult<()> {
    let path = folder.join("images").join(photo_name(k, options.photos()));
    let mut bytes = Vec::with_capacity(photo.rgb.len() / 4);
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
        .encode(&photo.rgb, options.width, options.height, ExtendedColorType::Rgb8)
        .map_err(|e| InputError::new(&path, format!("compressing failed: {e}"), "choose another --resolution"))?;
    write_whole(&path, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_refused_by_flag() {
        let cases: [(CityOptions, &str); 8] = [
            (CityOptions { tilt: Some(81.0), ..Default::default() }, "--tilt"),
            (CityOptions { overview_area: 0.0, ..Default::default() }, "--overview-area"),
            (CityOptions { overviews: 99_950, ..Default::default() }, "--overviews"),
            (CityOptions { views: 0, ..Default::default() }, "--views"),
            (CityOptions { width: 8, ..Default::default() }, "--resolution"),
            (CityOptions { noise: f64::NAN, ..Default::default() }, "--noise"),
            (CityOptions { supersample: 0, ..Default::default() }, "--supersample"),
            (CityOptions { offset: [0.0, f64::INFINITY, 0.0], ..Default::default() }, "--offset"),
        ];
        for (options, flag) in cases {
            let error = check(&options).err().map(|e| e.to_string()).unwrap_or_default();
            assert!(error.starts_with(flag), "{error}");
        }
        assert!(check(&CityOptions::default()).is_ok());
    }
}
