//! Writes Gaussians to an SPZ file.
//!
//! An array holds one attribute of all Gaussians, and rows arrive one after another. Rows therefore go to a temporary file
//! beside the target first, [`pack`]ed but for their positions, whose number of fractional bits follows from the largest one. At
//! the end the temporary file is read once for each attribute.
//!
//! Invariants: 1. memory beyond the given rows is a few buffers of 1 MiB; 2. the temporary file is removed, also after
//! errors; 3. a row with a value that is not finite, or with a coordinate beyond 8 million, is left out and counted.

use super::pack::{self, POSITION_BYTES};
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::PartFile;
use crate::exchange::frames::ExportRows;
use crate::exchange::meta::SceneMeta;
use crate::exchange::sink::{GaussianSink, Written};
use crate::scene::columns::Columns;
use crate::scene::rotation::{Rotation, VIEWER_UP};
use flate2::Compression;
use flate2::write::GzEncoder;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, Write};
use std::path::{Path, PathBuf};

/// First bytes of a file, little endian: "NGSP".
const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// Bytes of a position in the temporary file: three f32.
const RAW_POSITION_BYTES: usize = 12;
const BUFFER_BYTES: usize = 1 << 20;
/// Half a turn about x: from the axes of a PLY to those of SPZ.
const HALF_TURN: Rotation = Rotation::HALF_TURN_ABOUT_X;
/// Up in an upright file.
pub const SPZ_UP: [f64; 3] = [0.0, -VIEWER_UP[1], 0.0];

/// Writes a file in parts.
pub struct SpzWriter {
    path: PathBuf,
    part: PartFile,
    out: File,
    rows_path: PathBuf,
    rows_part: PartFile,
    rows_file: BufWriter<File>,
    to_file: ExportRows,
    sh_degree: u8,
    given: u64,
    rows: u64,
    reach: f32,
    /// Rows left out because a coordinate is too large for the format.
    far: u64,
}

impl SpzWriter {
    /// Converts the metadata of a PLY to the axes of SPZ.
    pub fn spz_meta(meta: &SceneMeta) -> SceneMeta {
        let upright = meta.upright.map_or(HALF_TURN, |upright| HALF_TURN.after(&upright));
        SceneMeta { upright: Some(upright), ..meta.clone() }
    }

    /// Starts a file of rows with the bands of `sh_degree`, beside its target. `meta` is that of a PLY of the same rows.
    ///
    /// # Errors
    /// The disk fails, or `path` names no file.
    pub fn create(path: &Path, sh_degree: u8, meta: &SceneMeta) -> InputResult<SpzWriter> {
        let (part, out) = PartFile::create(path)?;
        let rows_path = path.with_extension("spz.rows");
        let (rows_part, rows_file) = PartFile::create(&rows_path)?;
        // Read again at the end.
        drop(rows_file);
        let rows_file = rows_part.reopen()?;
        Ok(SpzWriter {
            path: path.to_path_buf(),
            part,
            out,
            rows_path,
            rows_part,
            rows_file: BufWriter::with_capacity(BUFFER_BYTES, rows_file),
            to_file: ExportRows::new(&Self::spz_meta(meta)),
            sh_degree,
            given: 0,
            rows: 0,
            reach: 0.0,
            far: 0,
        })
    }

    /// Writes header and arrays as one gzip stream; returns its length.
    fn compress(&mut self) -> io::Result<u64> {
        self.rows_file.flush()?;
        let fraction_bits = pack::fraction_bits(self.reach);
        let mut gzip = GzEncoder::new(BufWriter::with_capacity(BUFFER_BYTES, &self.out), Compression::default());
        gzip.write_all(&header(self.rows as u32, self.sh_degree, fraction_bits))?;
        let attributes = pack::attribute_bytes(self.sh_degree);
        let row_bytes = RAW_POSITION_BYTES + attributes.iter().sum::<usize>();
        let rows = self.rows_file.get_mut();
        each_row(rows, (self.rows, row_bytes), |row| {
            let (numbers, _) = row[..RAW_POSITION_BYTES].as_chunks::<4>();
            let position = [0, 1, 2].map(|i| f32::from_le_bytes(numbers[i]));
            let packed: [u8; POSITION_BYTES] = pack::position(position, fraction_bits);
            gzip.write_all(&packed)
        })?;
        let mut start = RAW_POSITION_BYTES;
        for length in attributes {
            if length > 0 {
                each_row(rows, (self.rows, row_bytes), |row| gzip.write_all(&row[start..start + length]))?;
            }
            start += length;
        }
        gzip.finish()?.flush()?;
        Ok(self.out.metadata()?.len())
    }
}

impl GaussianSink for SpzWriter {
    fn write(&mut self, columns: &Columns) -> InputResult<()> {
        if columns.sh_degree > self.sh_degree {
            return Err(InputError::new(&self.path, "rows have more SH bands than announced", "report this as a bug"));
        }
        let mut bytes = Vec::new();
        for row in 0..columns.rows() {
            self.given += 1;
            let Some(mut row) = self.to_file.row(columns, row) else { continue };
            let reach = row.position.iter().fold(0.0f32, |most, x| most.max(x.abs()));
            if reach > pack::coordinate_max() {
                self.far += 1;
                continue;
            }
            row.quat = half_turn_of_own_axes(row.quat);
            self.reach = self.reach.max(reach);
            bytes.clear();
            bytes.extend(row.position.iter().flat_map(|x| x.to_le_bytes()));
            pack::attributes(&row, self.sh_degree, &mut bytes);
            self.rows_file.write_all(&bytes).map_err(|e| InputError::io(&self.rows_path, "writing", &e))?;
            self.rows += 1;
        }
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> InputResult<Written> {
        if self.rows == 0 {
            let given = self.given;
            let far = format!("all {given} Gaussians lie beyond the {} units of this format", pack::coordinate_max());
            let lost = format!("none of the {given} Gaussians is finite, so there is no row to write");
            let (problem, remedy) = match self.far == given {
                true => (far, "export in local coordinates (--export-frame local), or as a PLY"),
                false => (lost, "the training diverged or lost all Gaussians: lower the rates"),
            };
            return Err(InputError::new(&self.path, problem, remedy));
        }
        if u32::try_from(self.rows).is_err() {
            let problem = format!("an SPZ file holds at most {} Gaussians, and these are {}", u32::MAX, self.rows);
            return Err(InputError::new(&self.path, problem, "export a part of the scene"));
        }
        let bytes = self.compress().map_err(|e| InputError::io(&self.path, "writing", &e))?;
        let SpzWriter { part, out, rows_part, to_file, given, rows, .. } = *self;
        part.finish(out)?;
        drop(rows_part);
        Ok(Written { frame: to_file.frame(), rows, skipped: given - rows, bytes, levels: None })
    }
}

/// Rotates the Gaussian's own axes by 180 degrees about the first of them, which leaves the covariance unchanged. Readers
/// conjugate quaternions when they convert a file to the axes of a PLY; they then get the quaternion of the PLY.
fn half_turn_of_own_axes([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [x, -w, -z, y]
}

fn header(rows: u32, sh_degree: u8, fraction_bits: u8) -> [u8; 16] {
    let mut header = [0; 16];
    header[..4].copy_from_slice(&MAGIC.to_le_bytes());
    header[4..8].copy_from_slice(&VERSION.to_le_bytes());
    header[8..12].copy_from_slice(&rows.to_le_bytes());
    header[12] = sh_degree;
    header[13] = fraction_bits;
    header
}

/// Calls `take` with each of `rows` rows of a file of rows.
fn each_row(
    file: &mut File,
    (rows, row_bytes): (u64, usize),
    mut take: impl FnMut(&[u8]) -> io::Result<()>,
) -> io::Result<()> {
    file.rewind()?;
    let mut file = BufReader::with_capacity(BUFFER_BYTES, file);
    let mut row = vec![0; row_bytes];
    for _ in 0..rows {
        file.read_exact(&mut row)?;
        take(&row)?;
    }
    Ok(())
}
