//! Reads the CSV that RealityCapture and RealityScan export as "Internal/External camera parameters":
//! `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`, a line for each photo. The photos lie in `images/`
//! beside the CSV or in its folder. It holds no points: `points.ply` beside it, in the same coordinates, is read where it
//! exists; otherwise give points with `--init-ply`, or some are found by a sweep.
//!
//! Conventions: `x, y, alt` is the place of the camera, in axes east-north-up. With all angles 0 it looks down, north on
//! top. Roll turns about its y axis first, pitch about x then, heading clockwise about the vertical last; degrees. `f` is
//! the focal length for a picture of 36 mm, `px, py` the principal point from the centre in units of the longer side.
//! `k1..k3` and `t1, t2` are OpenCV's k1..k3 and p1, p2; `k4`, of the eighth power, has no counterpart and is refused.
//!
//! Cells are separated by commas, semicolons or tabs, as the header says, and may be quoted. Numbers may have a decimal comma where
//! commas do not separate. `z` stands for `alt`. A name may be a path on the computer of the export: its longest end that is a
//! photo here counts.
//!
//! Invariant: for any content of the file the result is a scene or an [`InputError`] that names file and line.

use super::gathered::{Gathered, PUT_THEM_THERE, RefusalWords, checked_intrinsics};
use super::model::{Lens, RawScene, ReadOptions};
use super::photo_files::PhotoFiles;
use super::photo_header::read_size;
use super::transforms::pose::make_pose;
use crate::base::error::{InputError, InputResult};
use crate::base::text::{head_of, read_text};
use glam::{DMat3, DVec3};
use std::path::{Path, PathBuf};

/// Largest file read, bytes; a photo takes about 300.
const MAX_BYTES: u64 = 128 << 20;
/// Bytes in which the header must begin, to be looked for in the CSV files of a folder.
const HEAD_BYTES: u64 = 4096;
/// Columns that a line must have; the others are 0 where they are missing.
const REQUIRED: [&str; 8] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f"];
const SEPARATORS: [char; 3] = [',', ';', '\t'];
/// The film to which `f` refers, millimetres.
const FILM: f64 = 36.0;
const EXPORT: &str = "export it again: Registration, 'Internal/External camera parameters'";

/// Whether [`read_reality_capture`] would find something in this folder.
pub fn looks_like_reality_capture(folder: &Path) -> bool {
    !files_in(folder).is_empty()
}

/// Reads a folder with such a CSV, or the CSV.
/// Errors: no such file or several, columns that are missing or not numbers, impossible cameras, a lens with `k4`, a photo that is
/// missing (unless allowed), no view left.
pub fn read_reality_capture(path: &Path, options: &ReadOptions) -> InputResult<RawScene> {
    let found = if path.is_file() { vec![path.to_path_buf()] } else { files_in(path) };
    let file = match &found[..] {
        [file] => file.clone(),
        [] => return Err(InputError::new(path, "no CSV of RealityCapture here", EXPORT)),
        [.., other, file] => {
            let problem = format!("two CSV files with camera poses: {} and {}", other.display(), file.display());
            return Err(InputError::new(path, problem, "name the CSV itself instead of its folder"));
        }
    };
    let folder = file.parent().unwrap_or(Path::new(""));
    let text = read_text(&file, MAX_BYTES, EXPORT)?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let header = lines.find_map(|(_, line)| CsvHeader::of(line));
    let header = header.ok_or_else(|| InputError::new(&file, "no line of column names '#name,x,y,alt,...'", EXPORT))?;
    if let Some(missing) = REQUIRED.iter().find(|name| header.place(name).is_none()) {
        return Err(InputError::new(&file, format!("there is no column '{missing}'"), EXPORT));
    }
    let photos = PhotoFiles::with_folders(folder, options.images.as_deref().or(Some("images")), options);
    let mut gathered = Gathered::new(photos, options);
    for (number, line) in lines.filter(|(_, line)| !line.starts_with('#')) {
        let line = Line { file: &file, number: number + 1, header: &header, cells: cells_of(line, header.separator) };
        line.add_view(&mut gathered)?;
    }
    let mut scene = RawScene::default();
    let words = RefusalWords { photos: "", views: "", photo_is_missing: PUT_THEM_THERE, no_view: EXPORT };
    scene.views = gathered.finish(&file, &words, &mut scene.warnings)?;
    scene.points_path = Some(folder.join("points.ply")).filter(|path| path.is_file());
    Ok(scene)
}

/// The CSV files of a folder that have the header of this format.
fn files_in(folder: &Path) -> Vec<PathBuf> {
    let has_header = |path: &PathBuf| head_of(path, HEAD_BYTES).lines().any(|line| CsvHeader::of(line).is_some());
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let is_csv = |path: &PathBuf| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv")) && path.is_file();
    let mut files: Vec<PathBuf> = entries.filter(is_csv).filter(has_header).collect();
    files.sort();
    files
}

/// The cells of a line, without the quotes around them.
fn cells_of(line: &str, separator: char) -> Vec<String> {
    let (mut cells, mut cell, mut is_quoted) = (Vec::new(), String::new(), false);
    let mut chars = line.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '"' if is_quoted && chars.next_if_eq(&'"').is_some() => cell.push('"'),
            '"' if is_quoted || cell.trim().is_empty() => is_quoted = !is_quoted,
            c if c == separator && !is_quoted => cells.push(std::mem::take(&mut cell)),
            c => cell.push(c),
        }
    }
    cells.push(cell);
    cells.iter().map(|cell| cell.trim().to_string()).collect()
}

struct CsvHeader {
    names: Vec<String>,
    separator: char,
}

impl CsvHeader {
    /// The header in this line, if it is one: it begins with the name and has the place. With `z` instead of `alt` it must have
    /// an angle too, since lists of ground control points begin in the same way.
    fn of(line: &str) -> Option<CsvHeader> {
        SEPARATORS.into_iter().find_map(|separator| {
            let names = cells_of(line, separator);
            let names = names.iter().map(|name| name.trim_matches(['#', ' ']).to_ascii_lowercase());
            let mut header = CsvHeader { names: names.collect(), separator };
            if let (Some(z), None, Some(_)) = (header.place("z"), header.place("alt"), header.place("heading")) {
                header.names[z] = "alt".to_string();
            }
            let [name, x, alt] = ["name", "x", "alt"].map(|name| header.place(name));
            (name == Some(0) && x.is_some() && alt.is_some()).then_some(header)
        })
    }

    fn place(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|other| other == name)
    }
}

struct Line<'a> {
    file: &'a Path,
    number: usize,
    header: &'a CsvHeader,
    cells: Vec<String>,
}

impl Line<'_> {
    fn error(&self, problem: impl Into<String>, remedy: &str) -> InputError {
        InputError::new(self.file, problem, remedy).at(format!("line {}", self.number))
    }

    /// The number in a column, 0 if the header has no such column.
    fn number(&self, name: &str) -> InputResult<f64> {
        let Some(place) = self.header.place(name) else { return Ok(0.0) };
        let cell = self.cells.get(place).map_or("", String::as_str);
        let number = if cell.contains('.') { cell.to_string() } else { cell.replacen(',', ".", 1) };
        number.parse().map_err(|_| self.error(format!("{cell:?} in column '{name}' is not a number"), EXPORT))
    }

    fn numbers<const N: usize>(&self, names: [&str; N]) -> InputResult<[f64; N]> {
        let mut numbers = [0.0; N];
        for (number, name) in numbers.iter_mut().zip(names) {
            *number = self.number(name)?;
        }
        Ok(numbers)
    }

    fn add_view(&self, gathered: &mut Gathered<'_>) -> InputResult<()> {
        // With other cells than those of the header, numbers would stand in wrong columns. An empty cell at the end is none.
        let count = |cells: &[String]| cells.len() - usize::from(cells.last().is_some_and(String::is_empty));
        let (cells, names) = (count(&self.cells), count(&self.header.names));
        if cells != names && self.cells.len() != self.header.names.len() {
            let problem = format!("the line has {cells} cells, the header names {names} columns");
            let comma = "if the numbers have a decimal comma, export them with a point, or with ';' between the cells";
            let is_comma = self.header.separator == ',' && cells > names;
            return Err(self.error(problem, if is_comma { comma } else { EXPORT }));
        }
        let stated = self.header.place("name").and_then(|place| self.cells.get(place)).map_or("", |name| name.trim());
        let stays = "names must stay in the folder of the photos: export with plain file names";
        let photo = gathered.photos.find(stated).map_err(|problem| self.error(problem, stays))?;
        let [k1, k2, k3, k4, t1, t2] = self.numbers(["k1", "k2", "k3", "k4", "t1", "t2"])?;
        if k4 != 0.0 {
            let remedy = "choose the distortion model Brown3 before the export, or export undistorted photos";
            return Err(self.error(format!("k4 = {k4} is a lens of the eighth power, which is not supported"), remedy));
        }
        let [f, px, py] = self.numbers(["f", "px", "py"])?;
        let angles = self.numbers(["heading", "pitch", "roll"])?;
        let centre = self.numbers(["x", "y", "alt"])?;
        if !photo.exists {
            gathered.missing.push(photo.name);
            return Ok(());
        }
        let size = read_size(&photo.path)?;
        let side = size.0.max(size.1) as f64;
        let principal = [size.0 as f64 / 2.0 + px * side, size.1 as f64 / 2.0 + py * side];
        let lens = Lens::Radial([k1, k2, t1, t2, k3, 0.0, 0.0, 0.0]);
        let intrinsics = checked_intrinsics(size, [f * side / FILM; 2], principal, lens)
            .map_err(|problem| self.error(problem, EXPORT))?;
        gathered.add(photo, intrinsics, make_pose(&camera_to_world(angles, centre)), None);
        Ok(())
    }
}

/// Camera to world with the camera's axes right-up-back, from heading, pitch and roll in degrees.
fn camera_to_world([heading, pitch, roll]: [f64; 3], centre: [f64; 3]) -> [[f64; 4]; 4] {
    let turn = |degrees: f64| {
        let angle = degrees.to_radians();
        (libm::sin(angle), libm::cos(angle))
    };
    let (s, c) = turn(-heading);
    let about_z = DMat3::from_cols(DVec3::new(c, s, 0.0), DVec3::new(-s, c, 0.0), DVec3::Z);
    let (s, c) = turn(pitch);
    let about_x = DMat3::from_cols(DVec3::X, DVec3::new(0.0, c, s), DVec3::new(0.0, -s, c));
    let (s, c) = turn(roll);
    let about_y = DMat3::from_cols(DVec3::new(c, 0.0, -s), DVec3::Y, DVec3::new(s, 0.0, c));
    let rotation = about_z * about_x * about_y;
    let row = |r: usize| [rotation.row(r).x, rotation.row(r).y, rotation.row(r).z, centre[r]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The directions of view and of the picture's top.
    fn seen(angles: [f64; 3]) -> [DVec3; 2] {
        let pose = make_pose(&camera_to_world(angles, [0.0; 3])).unwrap();
        let back = pose.rotation.transpose();
        [back * DVec3::Z, back * DVec3::NEG_Y]
    }

    #[test]
    fn cameras_look_where_the_angles_say() {
        let (east, north, up) = (DVec3::X, DVec3::Y, DVec3::Z);
        for (angles, view, top) in [
            ([0.0, 0.0, 0.0], -up, north),
            ([90.0, 0.0, 0.0], -up, east),
            ([0.0, 90.0, 0.0], north, up),
            ([90.0, 90.0, 0.0], east, up),
            ([180.0, 90.0, 0.0], -north, up),
            // A roll is about the axis that points north in a camera that looks down: the wings of an aircraft tilt.
            ([0.0, 0.0, 90.0], -east, north),
            ([0.0, 90.0, 90.0], -east, up),
        ] {
            let [v, t] = seen(angles);
            // A few roundings.
            assert!((v - view).length() < 1e-12 && (t - top).length() < 1e-12, "{angles:?}: {v} {t}");
        }
    }
}
