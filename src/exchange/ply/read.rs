//! Reads a PLY file into Gaussians or coloured points.
//!
//! Not here: the grammar of the header (`header`), splitting bytes or lines into rows (`rows`).
//!
//! Invariants: 1. a count is checked against the bytes left before anything is allocated for it; 2. no input makes this
//! panic; 3. rows with a non-finite value (infinite opacities apart) are dropped and counted, and more than 1 % of them
//! is an error; 4. a
//! successful result has at least one row.

use super::PlyContent;
use super::header::{Element, Header, PropertyKind, Scalar, parse_header, shorten};
use super::rows::{Body, read_rows};
use crate::base::error::{InputError, InputResult};
use crate::base::math::exp32;
use crate::exchange::foreign::foreign;
use crate::exchange::frames::unit_quat;
use crate::exchange::meta::{ExportFrame, ROUNDING_LEAST, SceneMeta};
use crate::exchange::transform::meta_beside;
use crate::scene::columns::{Column, Columns, sh_n_width};
use crate::scene::rotation::Rotation;
use std::collections::TryReserveError;
use std::fs::File;
use std::io::{BufRead, BufReader, Seek, SeekFrom};
use std::path::Path;

/// Reads `path`. See [`parse_ply`].
pub fn read_ply(path: &Path) -> InputResult<PlyContent> {
    let (reader, total_bytes) = open(path)?;
    let mut content = parse_ply(reader, total_bytes, path)?;
    if let PlyContent::Gaussians { meta, .. } = &mut content {
        read_transform_beside(path, meta)?;
    }
    Ok(content)
}

/// Takes frame and axes of Gaussians that do not state them from the transform file beside `path`, if there is one.
fn read_transform_beside(path: &Path, meta: &mut SceneMeta) -> InputResult<()> {
    if meta.is_stated {
        return Ok(());
    }
    if let Some(beside) = meta_beside(path)? {
        let SceneMeta { antialiased, dropped, opacities_clamped, moved, .. } = *meta;
        *meta = SceneMeta { antialiased, dropped, opacities_clamped, moved, ..beside };
    }
    Ok(())
}

/// Whether `path` holds Gaussians; otherwise it holds points.
/// Errors: the file cannot be opened, or its header cannot be read.
pub fn holds_gaussians(path: &Path) -> InputResult<bool> {
    let header = parse_header(&mut open(path)?.0, path)?;
    Ok(vertex_of(&header, path)?.1.find("f_dc_0").is_some())
}

/// Number of Gaussians or points that the header of `path` states.
/// Errors: the file cannot be opened, or its header cannot be read.
pub fn stated_rows(path: &Path) -> InputResult<u64> {
    let header = parse_header(&mut open(path)?.0, path)?;
    Ok(vertex_of(&header, path)?.1.count)
}

/// Streams the coloured points of `path` to `take` in file order, without storing them; returns the number dropped
/// because they are not finite. Gaussians count as points of the default colour.
/// Errors: as [`parse_ply`], and those of `take`.
pub fn stream_points(path: &Path, take: &mut dyn FnMut([f64; 3], [u8; 3]) -> InputResult<()>) -> InputResult<u64> {
    let (mut reader, total_bytes) = open(path)?;
    let header = parse_header(&mut reader, path)?;
    stream_body(reader, &header, (total_bytes, path), take)
}

fn open(path: &Path) -> InputResult<(BufReader<File>, u64)> {
    // Checked before opening: opening a pipe would block until somebody writes to it.
    let about = std::fs::metadata(path).map_err(|e| InputError::io(path, "opening", &e))?;
    if !about.is_file() {
        return Err(InputError::new(path, "this is not a regular file", "give a PLY file"));
    }
    if let Some(error) = foreign(path) {
        return Err(error);
    }
    let file = File::open(path).map_err(|e| InputError::io(path, "opening", &e))?;
    let bytes = file.metadata().map_err(|e| InputError::io(path, "reading the length", &e))?.len();
    Ok((BufReader::with_capacity(1 << 20, file), bytes))
}

/// Reads a PLY of `total_bytes` bytes: Gaussians if its vertices have `f_dc_0`, else coloured points.
///
/// Accepts ascii and both binary formats, with properties in any order; other properties and elements, including lists,
/// are skipped. Colours are `red green blue`, integers of 0 to 255 (16 bits: to 65,535), or floating-point numbers in one of these
/// ranges or from 0 to 1, whichever the largest of them says. `path` only names the file in errors.
/// Errors: the file is cut short, states more rows than it holds, lacks a property, has a number of `f_rest` properties other
/// than 0, 9, 24 or 45, has no vertices, or more than 1 % of its rows have non-finite values.
pub fn parse_ply<R: BufRead + Seek>(mut reader: R, total_bytes: u64, path: &Path) -> InputResult<PlyContent> {
    let header = parse_header(&mut reader, path)?;
    let (mut body, vertex) = body_at_vertices(&mut reader, &header, total_bytes, path)?;
    let rows = vertex.count as usize;
    let no_memory = |_: TryReserveError| {
        let problem = format!("no memory for {rows} rows");
        InputError::new(path, problem, "thin the file out or use a larger machine")
    };
    if vertex.find("f_dc_0").is_some() {
        let sh_degree = sh_degree_of(path, vertex)?;
        let mut columns = Columns { sh_degree, ..Columns::default() };
        for column in Column::ALL {
            let floats = rows.saturating_mul(column.width(sh_degree));
            columns.column_mut(column).try_reserve_exact(floats).map_err(no_memory)?;
        }
        let mut take = |row: &[f32]| {
            push_row(&mut columns, row);
            Ok(())
        };
        let meta = stream_gaussian_rows(&mut body, &header, vertex, &mut take)?;
        return Ok(PlyContent::Gaussians { columns, meta });
    }
    drop(body);
    let (mut positions, mut colors) = (Vec::new(), Vec::new());
    positions.try_reserve_exact(rows).map_err(no_memory)?;
    colors.try_reserve_exact(rows).map_err(no_memory)?;
    reader.seek(SeekFrom::Start(header.bytes)).map_err(|e| InputError::io(path, "reading", &e))?;
    let dropped = stream_body(reader, &header, (total_bytes, path), &mut |position, color| {
        positions.push(position);
        colors.push(color);
        Ok(())
    })?;
    Ok(PlyContent::Points { positions, colors, dropped })
}

/// The body of a file, positioned at its vertices, whose presence is checked.
fn body_at_vertices<'p, 'h, R: BufRead>(
    reader: R,
    header: &'h Header,
    total_bytes: u64,
    path: &'p Path,
) -> InputResult<(Body<'p, R>, &'h Element)> {
    let (vertex_at, vertex) = vertex_of(header, path)?;
    let mut body = Body::new(reader, path, header, total_bytes);
    for element in &header.elements[..vertex_at] {
        body.skip(element)?;
    }
    body.check_room(vertex)?;
    Ok((body, vertex))
}

/// The vertex element and its index; it has at least one row.
fn vertex_of<'h>(header: &'h Header, path: &Path) -> InputResult<(usize, &'h Element)> {
    let vertex_at = header.elements.iter().position(|e| e.name == "vertex").ok_or_else(|| {
        InputError::new(path, "the file has no element 'vertex'", "give a PLY of points or Gaussians").at("header")
    })?;
    let vertex = &header.elements[vertex_at];
    if vertex.count == 0 {
        return Err(
            InputError::new(path, "the file has no vertices", "give a PLY with at least one point").at("header")
        );
    }
    if vertex.find("x").is_none() && vertex.find("packed_position").is_some() {
        let remedy = "convert it to an ordinary PLY first, for example with splat-transform";
        return Err(InputError::new(path, "this is a compressed PLY (packed_position)", remedy).at("header"));
    }
    Ok((vertex_at, vertex))
}

/// Index of a number property.
fn scalar_at(path: &Path, vertex: &Element, name: &str) -> InputResult<(usize, Scalar)> {
    let index = vertex.find(name);
    match index.map(|i| (i, vertex.properties[i].kind)) {
        Some((i, PropertyKind::Scalar(s))) => Ok((i, s)),
        Some((_, PropertyKind::List { .. })) => Err((format!("property '{name}' is a list"), "write it as a number")),
        None if name == "scale_2" => {
            Err(("these are 2D Gaussians (no scale_2)".to_string(), "give a PLY of 3D Gaussians"))
        }
        None => Err((format!("the vertices have no property '{name}'"), "export the file again with all properties")),
    }
    .map_err(|(problem, remedy)| InputError::new(path, problem, remedy).at("header"))
}

/// Number of dropped rows, and the first one.
#[derive(Default)]
struct Dropped {
    count: u64,
    first: u64,
}

impl Dropped {
    fn add(&mut self, row: u64) {
        if self.count == 0 {
            self.first = row;
        }
        self.count += 1;
    }

    fn check(&self, path: &Path, rows: u64) -> InputResult<()> {
        if u128::from(self.count) * 100 <= u128::from(rows) {
            return Ok(());
        }
        let problem = format!("{} of {rows} vertices have values that are not finite numbers", self.count);
        let remedy = "more than 1 % means that the file is broken: repair or export it again";
        Err(InputError::new(path, problem, remedy).at(format!("vertex {}", self.first)))
    }
}

/// Logit of an opacity of 1 - 1e-6, in place of infinity: some programs store an opacity of exactly 0 or 1.
const OPACITY_MOST: f32 = 13.815_51;

/// Floats of a Gaussian before its higher bands: means, sh0, opacity, scales, quaternion.
pub const ROW_HEAD: usize = 14;

/// Streams the Gaussians of `path` to `take` one by one in file order, without storing them: means (3), sh0 (3),
/// opacity, scales (3), quaternion (4), then the higher bands, coefficient by coefficient. Returns the metadata from
/// the comments.
/// Errors: as [`parse_ply`], and those of `take`; also if the file holds points.
pub fn stream_gaussians(path: &Path, take: &mut dyn FnMut(&[f32]) -> InputResult<()>) -> InputResult<SceneMeta> {
    let (mut reader, total_bytes) = open(path)?;
    let header = parse_header(&mut reader, path)?;
    let (mut body, vertex) = body_at_vertices(reader, &header, total_bytes, path)?;
    let mut meta = stream_gaussian_rows(&mut body, &header, vertex, take)?;
    read_transform_beside(path, &mut meta)?;
    Ok(meta)
}

/// Metadata in the header of a file of Gaussians, and its SH degree. `dropped` is still 0.
/// Errors: as [`parse_ply`], for the header.
pub fn gaussians_header(path: &Path) -> InputResult<(SceneMeta, u8)> {
    let header = parse_header(&mut open(path)?.0, path)?;
    let (_, vertex) = vertex_of(&header, path)?;
    let mut meta = meta_from_comments(path, &header.comments)?;
    read_transform_beside(path, &mut meta)?;
    Ok((meta, sh_degree_of(path, vertex)?))
}

/// Appends a row in the layout of [`stream_gaussians`].
pub fn push_row(columns: &mut Columns, row: &[f32]) {
    columns.means.extend_from_slice(&row[0..3]);
    columns.sh0.extend_from_slice(&row[3..6]);
    columns.opacities.push(row[6]);
    columns.scales.extend_from_slice(&row[7..10]);
    columns.quats.extend_from_slice(&row[10..ROW_HEAD]);
    columns.sh_n.extend_from_slice(&row[ROW_HEAD..]);
}

/// Reads row `row` in the layout of [`push_row`].
pub fn take_row(columns: &Columns, row: usize, values: &mut Vec<f32>) {
    values.clear();
    for column in [Column::Means, Column::Sh0, Column::Opacities, Column::Scales, Column::Quats, Column::ShN] {
        values.extend_from_slice(columns.row(column, row));
    }
}

fn stream_gaussian_rows<R: BufRead>(
    body: &mut Body<'_, R>,
    header: &Header,
    vertex: &Element,
    take: &mut dyn FnMut(&[f32]) -> InputResult<()>,
) -> InputResult<SceneMeta> {
    let path = body.path;
    let rest = sh_n_width(sh_degree_of(path, vertex)?);
    let mut names: Vec<String> = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"].map(String::from).into();
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    names.extend((0..rest).map(|i| format!("f_rest_{i}")));
    let slots = names.iter().map(|n| Ok(scalar_at(path, vertex, n)?.0)).collect::<InputResult<Vec<usize>>>()?;
    let is_double = scalar_at(path, vertex, "x")?.1.size() == size_of::<f64>();
    let mut meta = meta_from_comments(path, &header.comments)?;
    let (mut dropped, mut clamped, mut moved) = (Dropped::default(), 0, 0);
    let (mut values, mut out) = (vec![0.0f32; slots.len()], vec![0.0f32; slots.len()]);
    read_rows(body, vertex, &slots, |row, raw| {
        for (value, &r) in values.iter_mut().zip(raw) {
            *value = r as f32;
        }
        if values[6].is_infinite() {
            values[6] = OPACITY_MOST.copysign(values[6]);
            clamped += 1;
        }
        if !values.iter().all(|v| v.is_finite()) {
            dropped.add(row);
            return Ok(());
        }
        let rounding = raw[..3].iter().zip(&values).fold(0.0f64, |most, (&r, &v)| most.max((r - f64::from(v)).abs()));
        if is_double && rounding > 0.0 {
            let sigma = f64::from(exp32(values[7].max(values[8]).max(values[9])));
            moved += u64::from(rounding > ROUNDING_LEAST * sigma);
        }
        out[..10].copy_from_slice(&values[..10]);
        out[10..ROW_HEAD].copy_from_slice(&unit_quat([values[10], values[11], values[12], values[13]]));
        // Channel-major in the file.
        let f_rest = &values[ROW_HEAD..];
        for k in 0..rest / 3 {
            (0..3).for_each(|channel| out[ROW_HEAD + 3 * k + channel] = f_rest[channel * (rest / 3) + k]);
        }
        take(&out)
    })?;
    dropped.check(path, vertex.count)?;
    (meta.dropped, meta.opacities_clamped, meta.moved) = (dropped.count, clamped, moved);
    Ok(meta)
}

/// SH degree from the number of `f_rest` properties.
fn sh_degree_of(path: &Path, vertex: &Element) -> InputResult<u8> {
    let rest = vertex.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    (0..=3).find(|&degree| sh_n_width(degree) == rest).ok_or_else(|| {
        let problem = format!("{rest} f_rest properties match no SH degree from 0 to 3 (expected 0, 9, 24 or 45)");
        InputError::new(path, problem, "export the file with SH degree 3 or less").at("header")
    })
}

/// Metadata from the comments. The words `step`, `origin`, `scale`, `frame` and `rotation` count only in files written by
/// gsscale: in others they may mean anything.
fn meta_from_comments(path: &Path, comments: &[String]) -> InputResult<SceneMeta> {
    let mut meta = SceneMeta::default();
    let ours = comments.iter().any(|c| c.starts_with("Generated by gsscale"));
    meta.is_stated = ours;
    for comment in comments {
        let bad = || {
            let problem = format!("the comment '{}' cannot be understood", shorten(comment));
            InputError::new(path, problem, "export the file again, or remove all its gsscale comments").at("header")
        };
        let words: Vec<&str> = comment.split_whitespace().collect();
        match words[..] {
            // Brush's spelling, then Postshot's.
            ["SplatRenderMode:", mode] => meta.antialiased = mode == "mip",
            ["antialiased", flag] => meta.antialiased = flag == "1",
            _ if !ours => {}
            ["step", n] => meta.step = Some(n.parse().map_err(|_| bad())?),
            ["origin", x, y, z] => {
                for (value, text) in meta.origin.iter_mut().zip([x, y, z]) {
                    *value = text.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(bad)?;
                }
            }
            ["scale", s] => {
                meta.scale = s.parse().ok().filter(|v: &f64| v.is_normal() && *v > 0.0).ok_or_else(bad)?;
            }
            ["frame", name] => meta.frame = ExportFrame::from_name(name).ok_or_else(bad)?,
            ["rotation", w, x, y, z] => {
                let mut quaternion = [0.0; 4];
                for (value, text) in quaternion.iter_mut().zip([w, x, y, z]) {
                    *value = text.parse().map_err(|_| bad())?;
                }
                meta.upright = Some(Rotation::from_quaternion(quaternion).ok_or_else(bad)?);
            }
            ["step" | "origin" | "scale" | "frame" | "rotation", ..] => return Err(bad()),
            _ => {}
        }
    }
    meta.scene_radius = meta.scale;
    Ok(meta)
}

/// As [`stream_points`], for a file that `reader` has read up to the end of its header.
fn stream_body<R: BufRead + Seek>(
    mut reader: R,
    header: &Header,
    (total_bytes, path): (u64, &Path),
    take: &mut dyn FnMut([f64; 3], [u8; 3]) -> InputResult<()>,
) -> InputResult<u64> {
    let colors = ColorFields::of(path, vertex_of(header, path)?.1)?;
    let full = match colors.full {
        Some(full) => full,
        // A pass that only finds the range of floating-point colours. Fractions may exceed 1 a little; a file of bytes in which
        // none exceeds 2 would be black.
        None => {
            let mut most = 0.0;
            let (mut body, vertex) = body_at_vertices(&mut reader, header, total_bytes, path)?;
            stream_rows(&mut body, vertex, &colors, &mut |_, color| {
                most = color.into_iter().fold(most, f64::max);
                Ok(())
            })?;
            reader.seek(SeekFrom::Start(header.bytes)).map_err(|e| InputError::io(path, "reading", &e))?;
            match most {
                ..=2.0 => 1.0,
                ..=256.0 => 255.0,
                _ => 65_535.0,
            }
        }
    };
    let (mut body, vertex) = body_at_vertices(reader, header, total_bytes, path)?;
    stream_rows(&mut body, vertex, &colors, &mut |position, color| {
        take(position, color.map(|value| ((value / full).clamp(0.0, 1.0) * 255.0 + 0.5) as u8))
    })
}

struct ColorFields {
    slots: Vec<usize>,
    /// The value of full brightness; `None` for floating-point numbers, whose range is not stated.
    full: Option<f64>,
}

impl ColorFields {
    fn of(path: &Path, vertex: &Element) -> InputResult<ColorFields> {
        let known = [["red", "green", "blue"], ["diffuse_red", "diffuse_green", "diffuse_blue"], ["r", "g", "b"]];
        let Some(names) = known.into_iter().find(|n| n.iter().all(|name| vertex.find(name).is_some())) else {
            return Ok(ColorFields { slots: Vec::new(), full: Some(255.0) });
        };
        let found = names.iter().map(|name| scalar_at(path, vertex, name)).collect::<InputResult<Vec<_>>>()?;
        let full = match found[0].1 {
            kind if kind.is_float() => None,
            kind if kind.size() == 2 => Some(65_535.0),
            _ => Some(255.0),
        };
        Ok(ColorFields { slots: found.into_iter().map(|(slot, _)| slot).collect(), full })
    }
}

/// Streams the points of a body with their colours as the file has them, mid grey of 255 without; returns the number dropped.
fn stream_rows<R: BufRead>(
    body: &mut Body<'_, R>,
    vertex: &Element,
    colors: &ColorFields,
    take: &mut dyn FnMut([f64; 3], [f64; 3]) -> InputResult<()>,
) -> InputResult<u64> {
    let path = body.path;
    let place = ["x", "y", "z"].map(|name| scalar_at(path, vertex, name));
    let mut slots = place.into_iter().map(|found| Ok(found?.0)).collect::<InputResult<Vec<usize>>>()?;
    slots.extend(&colors.slots);
    let mut dropped = Dropped::default();
    read_rows(body, vertex, &slots, |row, raw| {
        if !raw.iter().all(|v| v.is_finite()) {
            dropped.add(row);
            return Ok(());
        }
        let color = |c: usize| raw.get(3 + c).map_or(128.0, |&v| f64::from(v as f32));
        take([raw[0], raw[1], raw[2]], [color(0), color(1), color(2)])
    })?;
    dropped.check(path, vertex.count)?;
    Ok(dropped.count)
}
