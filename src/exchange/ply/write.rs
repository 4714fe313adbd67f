//! Writes Gaussians to a PLY file.
//!
//! Not here: when and where to write. The parent module documents the file's layout.
//!
//! Invariants: 1. memory beyond the given rows is a buffer of 1 MiB; 2. the bytes depend on the
//! arguments alone; 3. the target is replaced as a whole, after the new bytes have reached the disk, or not at all; 4.
//! a row with a non-finite value, before or after the change of frame, is left out and counted.
//!
//! The comments precede the `element` line, because readers assign a later comment to the element, not to the file. The
//! viewer of the 3DGS code takes the third word of the third line for the number of rows, so that line is a comment
//! `vertices N`.

use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::PartFile;
use crate::exchange::frames::{ExportRow, ExportRows};
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::sink::{Format, FormatSink, GaussianSink, LevelCounts, Written};
use crate::scene::columns::{Columns, sh_n_width};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Writes rows of the local frame to `path`, in the frame that `meta` requests if f32 can hold it. For rows that are
/// not all in memory use [`PlyWriter`].
/// Errors: the disk fails, `path` names no file, or no row is finite. The target then stays unchanged.
pub fn write_gaussians(path: &Path, columns: &Columns, meta: &SceneMeta) -> InputResult<Written> {
    let mut writer = PlyWriter::create(path, columns.sh_degree, columns.rows() as u64, meta)?;
    writer.write(columns)?;
    Box::new(writer).finish()
}

/// Writes a file in parts.
///
/// Bands above those of the rows are zeros.
///
/// The header contains the number of rows, which is known only at the end: the header is then rewritten at the same
/// length. If the number has fewer digits than reserved, a comment is padded with spaces.
pub struct PlyWriter {
    path: PathBuf,
    part: PartFile,
    out: BufWriter<File>,
    sh_degree: u8,
    meta: SceneMeta,
    frame: ExportFrame,
    rows_at_most: u64,
    rows: u64,
    bytes: u64,
    row: Vec<u8>,
}

impl PlyWriter {
    /// Starts a file of at most `rows_at_most` rows with the bands of `sh_degree`, beside its target.
    /// Errors: the disk fails, or `path` names no file.
    pub fn create(
        path: &Path,
        sh_degree: u8,
        rows_at_most: u64,
        meta: &SceneMeta,
    ) -> InputResult<FormatSink<PlyWriter>> {
        let to_file = ExportRows::new(meta);
        let frame = to_file.frame();
        let (part, file) = PartFile::create(path)?;
        let mut out = BufWriter::with_capacity(1 << 20, file);
        let header = header_text(sh_degree, rows_at_most, rows_at_most, meta, frame);
        out.write_all(header.as_bytes()).map_err(|e| InputError::io(path, "writing", &e))?;
        let (path, meta, bytes) = (path.to_path_buf(), meta.clone(), header.len() as u64);
        let (rows, row) = (0, Vec::new());
        let writer = PlyWriter { path, part, out, sh_degree, meta, frame, rows_at_most, rows, bytes, row };
        Ok(FormatSink::new(&writer.path.clone(), sh_degree, to_file, writer))
    }
}

impl Format for PlyWriter {
    fn put(&mut self, row: &ExportRow) -> InputResult<bool> {
        if self.rows == self.rows_at_most {
            let problem = format!("more rows were given than the {} that were announced", self.rows_at_most);
            return Err(InputError::new(&self.path, problem, "report this as a bug"));
        }
        // Channel by channel.
        let coefficients = sh_n_width(self.sh_degree) / 3;
        let rest = (0..3).flat_map(|channel| row.sh_n.iter().skip(channel).step_by(3).take(coefficients));
        let head = row.position.iter().chain(&[0.0; 3]).chain(&row.sh0);
        let values = head.chain(rest).chain([&row.opacity]).chain(&row.log_scales).chain(&row.quat);
        self.row.clear();
        self.row.extend(values.flat_map(|v| v.to_le_bytes()));
        self.out.write_all(&self.row).map_err(|e| InputError::io(&self.path, "writing", &e))?;
        self.bytes += self.row.len() as u64;
        self.rows += 1;
        Ok(true)
    }

    fn complete(self) -> InputResult<(u64, Option<LevelCounts>)> {
        let failed = |doing: &str, e: &std::io::Error| InputError::io(&self.path, doing, e);
        let mut file = self.out.into_inner().map_err(|e| failed("writing", e.error()))?;
        if self.rows < self.rows_at_most {
            let header = header_text(self.sh_degree, self.rows, self.rows_at_most, &self.meta, self.frame);
            let written = file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(header.as_bytes()));
            written.map_err(|e| failed("writing", &e))?;
        }
        self.part.finish(file)?;
        Ok((self.bytes, None))
    }
}

/// The header for `rows` rows, padded to the length of the header for `rows_at_most`.
fn header_text(sh_degree: u8, rows: u64, rows_at_most: u64, meta: &SceneMeta, frame: ExportFrame) -> String {
    let digits = |n: u64| n.checked_ilog10().unwrap_or(0) as usize;
    // The number of rows stands in two lines.
    let padding = 2 * (digits(rows_at_most) - digits(rows));
    let mut text = format!("ply\nformat binary_little_endian 1.0\ncomment vertices {rows}\n");
    let mut line = |args: std::fmt::Arguments| {
        // Writing to a String cannot fail.
        let _ = text.write_fmt(args);
        text.push('\n');
    };
    line(format_args!("comment Generated by gsscale {}{:padding$}", env!("CARGO_PKG_VERSION"), ""));
    if let Some(step) = meta.step {
        line(format_args!("comment step {step}"));
    }
    line(format_args!("comment SH degree: {sh_degree}"));
    // `{}` prints the shortest decimal that reads back as the same f64.
    let [x, y, z] = meta.origin;
    line(format_args!("comment origin {x} {y} {z}"));
    line(format_args!("comment scale {}", meta.scale));
    line(format_args!("comment frame {}", frame.name()));
    if let Some(upright) = meta.upright {
        let [w, x, y, z] = upright.quaternion();
        line(format_args!("comment rotation {w} {x} {y} {z}"));
        // Brush's words for: y points down.
        line(format_args!("comment Vertical axis: y"));
    }
    line(format_args!("comment SplatRenderMode: default"));
    line(format_args!("element vertex {rows}"));
    for name in property_names(sh_degree) {
        line(format_args!("property float {name}"));
    }
    text.push_str("end_header\n");
    text
}

/// Names of a row's values in file order.
fn property_names(sh_degree: u8) -> Vec<String> {
    let numbered = |stem: &str, n: usize| (0..n).map(|i| format!("{stem}_{i}")).collect::<Vec<_>>();
    let place = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).to_vec();
    let (colours, opacity) = (numbered("f_rest", sh_n_width(sh_degree)), vec!["opacity".to_string()]);
    [place, numbered("f_dc", 3), colours, opacity, numbered("scale", 3), numbered("rot", 4)].concat()
}
