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
use crate::exchange::sink::{GaussianSink, Written, no_finite_row};
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
/// [`ExportRows`] says how values change on the way. Bands above those of the rows are zeros.
///
/// The header contains the number of rows, which is known only at the end: the header is then rewritten at the same
/// length. If the number has fewer digits than reserved, a comment is padded with spaces.
pub struct PlyWriter {
    path: PathBuf,
    part: PartFile,
    out: BufWriter<File>,
    sh_degree: u8,
    meta: SceneMeta,
    to_file: ExportRows,
    rows_at_most: u64,
    given: u64,
    rows: u64,
    bytes: u64,
}

impl PlyWriter {
    /// Starts a file of at most `rows_at_most` rows with the bands of `sh_degree`, beside its target.
    /// Errors: the disk fails, or `path` names no file.
    pub fn create(path: &Path, sh_degree: u8, rows_at_most: u64, meta: &SceneMeta) -> InputResult<PlyWriter> {
        let to_file = ExportRows::new(meta);
        let (part, file) = PartFile::create(path)?;
        let mut out = BufWriter::with_capacity(1 << 20, file);
        let header = header_text(sh_degree, rows_at_most, rows_at_most, meta, to_file.frame());
        out.write_all(header.as_bytes()).map_err(|e| InputError::io(path, "writing", &e))?;
        Ok(PlyWriter {
            path: path.to_path_buf(),
            part,
            out,
            sh_degree,
            meta: meta.clone(),
            to_file,
            rows_at_most,
            given: 0,
            rows: 0,
            bytes: header.len() as u64,
        })
    }

    /// The values of a row in file order.
    fn fill(row: &ExportRow, out: &mut [f32]) {
        let (geometry, rest) = out.split_at_mut(9);
        let (f_rest, tail) = rest.split_at_mut(rest.len() - 8);
        let coefficients = f_rest.len() / 3;
        geometry[..3].copy_from_slice(&row.position);
        geometry[3..6].fill(0.0);
        geometry[6..].copy_from_slice(&row.sh0);
        for (k, coefficient) in row.sh_n.chunks_exact(3).take(coefficients).enumerate() {
            for channel in 0..3 {
                f_rest[channel * coefficients + k] = coefficient[channel];
            }
        }
        tail[0] = row.opacity;
        tail[1..4].copy_from_slice(&row.log_scales);
        tail[4..].copy_from_slice(&row.quat);
    }
}

impl GaussianSink for PlyWriter {
    fn write(&mut self, columns: &Columns) -> InputResult<()> {
        let rows = columns.rows();
        self.given += rows as u64;
        if self.given > self.rows_at_most || columns.sh_degree > self.sh_degree {
            let problem = format!("{} rows were given, but at most {} were announced", self.given, self.rows_at_most);
            return Err(InputError::new(&self.path, problem, "report this as a bug"));
        }
        let (mut values, mut bytes) = (vec![0.0; 17 + sh_n_width(self.sh_degree)], Vec::new());
        for row in 0..rows {
            if let Some(row) = self.to_file.row(columns, row) {
                Self::fill(&row, &mut values);
                bytes.clear();
                bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
                self.out.write_all(&bytes).map_err(|e| InputError::io(&self.path, "writing", &e))?;
                self.bytes += bytes.len() as u64;
                self.rows += 1;
            }
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> InputResult<Written> {
        let PlyWriter { path, part, out, meta, rows_at_most, given, rows, bytes, .. } = *self;
        let frame = self.to_file.frame();
        if rows == 0 {
            return Err(no_finite_row(&path, given));
        }
        let failed = |doing: &str, e: &std::io::Error| InputError::io(&path, doing, e);
        let mut file = out.into_inner().map_err(|e| failed("writing", e.error()))?;
        if rows < rows_at_most {
            let header = header_text(self.sh_degree, rows, rows_at_most, &meta, frame);
            let written = file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(header.as_bytes()));
            written.map_err(|e| failed("writing", &e))?;
        }
        part.finish(file)?;
        Ok(Written { frame, rows, skipped: given - rows, bytes, levels: None })
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
