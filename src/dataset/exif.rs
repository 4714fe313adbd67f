//! The brightness of a photo, from the camera settings in its EXIF data.
//!
//! Of two photos of one surface in the same light, the photo with the longer exposure time, the higher ISO or the wider
//! aperture is brighter. A brightness is in stops of light. Pixel values are stored with a gamma, so they differ by fewer stops
//! (`crate::photos::exposure::state` converts).
//!
//! Not here: where the data lie in a file ([`super::photo_header`]).
//!
//! Invariants: 1. no pixel is decoded, and at most [`MOST_BYTES`] are read; 2. a brightness is finite.

use super::photo_header::ExifPlace;
use exif::{Exif, In, Reader, Tag, Value};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// EXIF data of more bytes are not read. JPEG allows 64 KiB; in PNG, previews and notes of the camera can be longer.
pub const MOST_BYTES: u32 = 1 << 20;

/// log2 of exposure time (seconds) times ISO over the squared f-number, stops; `None` if the data lack one of the three.
/// Errors: the reason why the data cannot be read, for a message that names the file.
pub fn brightness(path: &Path, place: ExifPlace) -> Result<Option<f64>, String> {
    if place.bytes > MOST_BYTES {
        return Err(format!("{} bytes, more than {MOST_BYTES}", place.bytes));
    }
    let mut bytes = vec![0; place.bytes as usize];
    let mut file = File::open(path).map_err(|e| e.to_string())?;
    let read = file.seek(SeekFrom::Start(place.at)).and_then(|_| file.read_exact(&mut bytes));
    read.map_err(|e| e.to_string())?;
    // Damage elsewhere in the data, for example in a preview, is no error.
    let mut damage = None;
    let read = Reader::new().continue_on_error(true).read_raw(bytes);
    let read = read.or_else(|e| e.distill_partial_result(|errors| damage = errors.first().map(ToString::to_string)));
    let stops = stops_of(&read.map_err(|e| e.to_string())?);
    match (stops, damage) {
        (None, Some(damage)) => Err(damage),
        (stops, _) => Ok(stops),
    }
}

fn stops_of(data: &Exif) -> Option<f64> {
    let value = |tag| data.get_field(tag, In::PRIMARY).map(|field| &field.value);
    let ratio = |tag| match value(tag)? {
        Value::Rational(ratios) => ratios.first().map(|ratio| ratio.to_f64()),
        _ => None,
    };
    let (seconds, aperture) = (ratio(Tag::ExposureTime)?, ratio(Tag::FNumber)?);
    // 65535 means that the true ISO does not fit this field.
    let iso = value(Tag::PhotographicSensitivity)?.get_uint(0).filter(|iso| *iso < u32::from(u16::MAX))?;
    let stops = libm::log2(seconds * f64::from(iso) / (aperture * aperture));
    stops.is_finite().then_some(stops)
}
