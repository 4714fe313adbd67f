//! Writes a COLMAP model again in another frame and with the true names of the photos; what it does not change is copied.
//!
//! Format: as in `dataset/colmap_write.rs`. Files of rigs and frames are not copied: the images file holds every pose.
//!
//! Invariants: 1. counts in the files are only trusted as far as bytes follow; 2. the model's folder appears when all its files
//! are on disk.

use super::geo::Similarity;
use crate::base::error::{InputError, InputResult};
use crate::base::whole_file::write_whole_with;
use glam::{DMat3, DQuat, DVec3};
use std::fs::File;
use std::io::{BufRead, BufReader, Error, ErrorKind, Read, Result, Write};
use std::path::Path;

/// Bytes of a sighting in the images file, and of one in the points file.
const SIGHTING: u64 = 24;
const TRACK_ENTRY: u64 = 8;
/// Colour and error behind the position of a point.
const COLOUR_AND_ERROR: u64 = 3 + 8;

/// Writes the model of `from` to `to`, which must exist, moved by `moved`. `name_of` gives the true name of a photo.
/// Errors: files that are not as COLMAP writes them, an unknown photo, or the disk fails.
pub fn write_moved(
    from: &Path,
    to: &Path,
    moved: &Similarity,
    name_of: &dyn Fn(&str) -> Option<String>,
) -> InputResult<()> {
    let copy = |name: &str, fill: &dyn Fn(&mut dyn BufRead, &mut dyn Write) -> Result<()>| {
        let source = from.join(name);
        let file = File::open(&source).map_err(|e| InputError::io(&source, "opening the model", &e))?;
        write_whole_with(&to.join(name), |out| fill(&mut BufReader::new(file), out))
    };
    copy("cameras.bin", &|from, out| std::io::copy(from, out).map(|_| ()))?;
    copy("images.bin", &|from, out| images(from, out, moved, name_of))?;
    copy("points3D.bin", &|from, out| points(from, out, moved))
}

fn images(
    from: &mut dyn BufRead,
    out: &mut dyn Write,
    moved: &Similarity,
    name_of: &dyn Fn(&str) -> Option<String>,
) -> Result<()> {
    let count = integer(from)?;
    out.write_all(&count.to_le_bytes())?;
    for _ in 0..count {
        pass::<4>(from, out)?;
        let [w, x, y, z] = floats::<4>(from)?;
        let translation = DVec3::from_array(floats::<3>(from)?);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()) * moved.rotation.transpose();
        let translation = moved.scale * translation - rotation * moved.translation;
        let q = DQuat::from_mat3(&rotation).normalize();
        write_floats(out, &[q.w, q.x, q.y, q.z])?;
        write_floats(out, &translation.to_array())?;
        pass::<4>(from, out)?;
        let mut name = Vec::new();
        from.take(4096).read_until(0, &mut name)?;
        let name = name.strip_suffix(&[0]).and_then(|name| std::str::from_utf8(name).ok());
        let name =
            name.and_then(name_of).ok_or_else(|| Error::new(ErrorKind::InvalidData, "a photo of an unknown name"))?;
        out.write_all(name.as_bytes())?;
        out.write_all(&[0])?;
        pass_list(from, out, SIGHTING)?;
    }
    Ok(())
}

fn points(from: &mut dyn BufRead, out: &mut dyn Write, moved: &Similarity) -> Result<()> {
    let count = integer(from)?;
    out.write_all(&count.to_le_bytes())?;
    for _ in 0..count {
        pass::<8>(from, out)?;
        write_floats(out, &moved.apply(DVec3::from_array(floats::<3>(from)?)).to_array())?;
        pass::<{ COLOUR_AND_ERROR as usize }>(from, out)?;
        pass_list(from, out, TRACK_ENTRY)?;
    }
    Ok(())
}

/// Copies a count and that many entries.
fn pass_list(from: &mut dyn BufRead, out: &mut dyn Write, entry: u64) -> Result<()> {
    let count = integer(from)?;
    out.write_all(&count.to_le_bytes())?;
    let bytes = count.checked_mul(entry).ok_or(ErrorKind::InvalidData)?;
    if std::io::copy(&mut from.take(bytes), out)? < bytes {
        return Err(ErrorKind::UnexpectedEof.into());
    }
    Ok(())
}

fn pass<const N: usize>(from: &mut dyn BufRead, out: &mut dyn Write) -> Result<()> {
    let mut bytes = [0; N];
    from.read_exact(&mut bytes)?;
    out.write_all(&bytes)
}

fn integer(from: &mut dyn BufRead) -> Result<u64> {
    let mut bytes = [0; 8];
    from.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

fn floats<const N: usize>(from: &mut dyn BufRead) -> Result<[f64; N]> {
    let mut values = [0.0; N];
    for value in &mut values {
        *value = f64::from_bits(integer(from)?);
    }
    Ok(values)
}

fn write_floats(out: &mut dyn Write, values: &[f64]) -> Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}
