//! The brightness of a photo, its camera and its place, from its EXIF data.
//!
//! Of two photos of one surface in the same light, the photo with the longer exposure time, the higher ISO or the wider
//! aperture is brighter. A brightness is in stops of light. Pixel values are stored with a gamma, so they differ by fewer stops
//! (`crate::photos::exposure::state` converts).
//!
//! Not here: where the data lie in a file ([`super::photo_header`]).
//!
//! Invariants: 1. no pixel is decoded, and at most [`MOST_BYTES`] are read; 2. a brightness is finite, a place is on the globe.

use super::photo_header::ExifPlace;
use exif::{Exif, In, Reader, Tag, Value};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// EXIF data of more bytes are not read. JPEG allows 64 KiB; in PNG, previews and notes of the camera can be longer.
pub const MOST_BYTES: u32 = 1 << 20;

/// A place on the globe, as GPS gives it (WGS 84).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpsPlace {
    /// Degrees, north positive.
    pub latitude: f64,
    /// Degrees, east positive.
    pub longitude: f64,
    /// Metres; `None` if the data lack it.
    pub altitude: Option<f64>,
}

/// log2 of exposure time (seconds) times ISO over the squared f-number, stops; `None` if the data lack one of the three.
/// Errors: the reason why the data cannot be read, for a message that names the file.
pub fn brightness(path: &Path, place: ExifPlace) -> Result<Option<f64>, String> {
    let (data, damage) = read(path, place)?;
    match (stops_of(&data), damage) {
        (None, Some(damage)) => Err(damage),
        (stops, _) => Ok(stops),
    }
}

/// The camera with its lens and zoom, as one text (empty if unknown), and where it was.
/// Errors: the reason why the data cannot be read, for a message that names the file.
pub fn camera_and_place(path: &Path, place: ExifPlace) -> Result<(String, Option<GpsPlace>), String> {
    let (data, _) = read(path, place)?;
    let text = |tag| data.get_field(tag, In::PRIMARY).map(|field| field.display_value().to_string());
    let parts = [Tag::Make, Tag::Model, Tag::BodySerialNumber, Tag::LensModel, Tag::FocalLength].map(text);
    Ok((parts.into_iter().flatten().collect::<Vec<_>>().join(" "), place_of(&data)))
}

/// The data, and the first damage in them: damage elsewhere than in what is asked for, for example in a preview, is no error.
fn read(path: &Path, place: ExifPlace) -> Result<(Exif, Option<String>), String> {
    if place.bytes > MOST_BYTES {
        return Err(format!("{} bytes, more than {MOST_BYTES}", place.bytes));
    }
    let mut bytes = vec![0; place.bytes as usize];
    let mut file = File::open(path).map_err(|e| e.to_string())?;
    let read = file.seek(SeekFrom::Start(place.at)).and_then(|_| file.read_exact(&mut bytes));
    read.map_err(|e| e.to_string())?;
    let mut damage = None;
    let read = Reader::new().continue_on_error(true).read_raw(bytes);
    let read = read.or_else(|e| e.distill_partial_result(|errors| damage = errors.first().map(ToString::to_string)));
    Ok((read.map_err(|e| e.to_string())?, damage))
}

/// `None` also for (0, 0), which cameras without a fix write.
fn place_of(data: &Exif) -> Option<GpsPlace> {
    let value = |tag| data.get_field(tag, In::PRIMARY).map(|field| &field.value);
    let ratios = |tag| match value(tag)? {
        Value::Rational(ratios) => Some(ratios.iter().map(exif::Rational::to_f64).collect::<Vec<_>>()),
        _ => None,
    };
    let letter = |tag| match value(tag)? {
        Value::Ascii(texts) => texts.first()?.first().map(u8::to_ascii_uppercase),
        _ => None,
    };
    let degrees = |tag, sign_tag, [positive, negative]: [u8; 2], most: f64| {
        let parts = ratios(tag)?;
        let sum = parts.iter().zip([1.0, 60.0, 3600.0]).map(|(part, by)| part / by).sum::<f64>();
        let sign = match letter(sign_tag)? {
            letter if letter == positive => 1.0,
            letter if letter == negative => -1.0,
            _ => return None,
        };
        (!parts.is_empty() && sum <= most).then_some(sign * sum)
    };
    let latitude = degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, *b"NS", 90.0)?;
    let longitude = degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, *b"EW", 180.0)?;
    let is_below = value(Tag::GPSAltitudeRef).and_then(|value| value.get_uint(0)) == Some(1);
    let altitude =
        ratios(Tag::GPSAltitude).and_then(|parts| parts.first().copied()).filter(|metres| metres.is_finite());
    let altitude = altitude.map(|metres| if is_below { -metres } else { metres });
    (latitude != 0.0 || longitude != 0.0).then_some(GpsPlace { latitude, longitude, altitude })
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
