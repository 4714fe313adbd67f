//! Camera settings from the EXIF data of JPEG and PNG photos, and what damaged data give.

use crate::support::exif::{Settings, tiff_of_place, with_exif};
use gsscale::dataset::exif::{MOST_BYTES, brightness, camera_and_place};
use gsscale::dataset::photo_header::{ExifPlace, read_header};
use image::{ImageFormat, RgbImage};
use std::io::Cursor;
use tempfile::TempDir;

const SETTINGS: Settings = Settings { seconds: 0.004, aperture: 2.8, iso: 640 };

/// The photo of these bytes: where its EXIF data lie, and what they say.
fn read(photo: &[u8]) -> (Option<ExifPlace>, Result<Option<f64>, String>) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("photo");
    std::fs::write(&path, photo).unwrap();
    let place = read_header(&path).unwrap().exif;
    (place, place.map_or(Ok(None), |place| brightness(&path, place)))
}

fn photos() -> [Vec<u8>; 2] {
    [ImageFormat::Jpeg, ImageFormat::Png].map(|format| {
        let mut bytes = Cursor::new(Vec::new());
        RgbImage::from_pixel(16, 12, image::Rgb([90, 120, 30])).write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    })
}

#[test]
fn brightness_is_in_stops_of_light() {
    for photo in photos() {
        assert_eq!(read(&photo), (None, Ok(None)));
        let got = read(&with_exif(&photo, &SETTINGS.tiff())).1.unwrap().unwrap();
        let want = (0.004f64 * 640.0 / (2.8 * 2.8)).log2();
        assert!((got - want).abs() < 1e-6, "{got}, not {want}");
        // Twice the light by each of the three is one stop more.
        for double in [
            Settings { seconds: 0.008, ..SETTINGS },
            Settings { aperture: 2.8 / 2f64.sqrt(), ..SETTINGS },
            Settings { iso: 1280, ..SETTINGS },
        ] {
            let brighter = read(&with_exif(&photo, &double.tiff())).1.unwrap().unwrap();
            assert!((brighter - got - 1.0).abs() < 1e-4, "{double:?}: {brighter}");
        }
        // The pixels are those of the photo without.
        let [with, without] =
            [&with_exif(&photo, &SETTINGS.tiff()), &photo].map(|bytes| image::load_from_memory(bytes).unwrap());
        assert!(with == without);
    }
}

#[test]
fn settings_that_mean_nothing_are_unknown() {
    for photo in photos() {
        for nothing in [
            Settings { seconds: 0.0, ..SETTINGS },
            Settings { aperture: 0.0, ..SETTINGS },
            Settings { iso: 0, ..SETTINGS },
            Settings { iso: u16::MAX, ..SETTINGS },
        ] {
            assert_eq!(read(&with_exif(&photo, &nothing.tiff())).1, Ok(None), "{nothing:?}");
        }
        // A directory without the settings.
        assert_eq!(read(&with_exif(&photo, b"II*\0\x08\0\0\0\0\0\0\0\0\0")).1, Ok(None));
    }
}

#[test]
fn the_camera_and_the_place_are_read() {
    let read = |photo: &[u8], tiff: &[u8]| {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("photo");
        std::fs::write(&path, with_exif(photo, tiff)).unwrap();
        camera_and_place(&path, read_header(&path).unwrap().exif.unwrap())
    };
    for photo in photos() {
        for want in [[43.123_456, -87.98, 210.5], [-33.87, 151.2, -4.0], [0.5, 0.0, 0.0]] {
            let (camera, place) = read(&photo, &tiff_of_place("FC6310 (a long name)", want)).unwrap();
            let place = place.unwrap();
            let got = [place.latitude, place.longitude, place.altitude.unwrap()];
            assert!(got.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-8), "{got:?}");
            assert!(camera.contains("FC6310 (a long name)"), "{camera}");
        }
        // A camera without a fix; a latitude beyond the pole; no place at all.
        assert_eq!(read(&photo, &tiff_of_place("A", [0.0; 3])).unwrap().1, None);
        assert_eq!(read(&photo, &tiff_of_place("A", [91.0, 0.0, 0.0])).unwrap().1, None);
        assert_eq!(read(&photo, &SETTINGS.tiff()), Ok((String::new(), None)));
        let tiff = tiff_of_place("A", [43.0, -87.0, 210.0]);
        for length in 0..tiff.len() {
            // What is cut off is unknown or an error, never a wrong number.
            let place = read(&photo, &tiff[..length]).ok().and_then(|(_, place)| place);
            assert!(place.is_none_or(|p| (p.latitude, p.longitude) == (43.0, -87.0)), "{length}: {place:?}");
        }
    }
}

#[test]
fn damaged_data_give_a_reason_and_neither_a_panic_nor_a_wrong_length() {
    let tiff = SETTINGS.tiff();
    let [jpeg, png] = photos();
    for photo in [&jpeg, &png] {
        for length in 0..tiff.len() {
            let said = read(&with_exif(photo, &tiff[..length])).1;
            assert!(!matches!(said, Ok(Some(_))), "{length} of {} bytes: {said:?}", tiff.len());
        }
        assert!(read(&with_exif(photo, b"no TIFF structure")).1.is_err());
    }
    // A segment of another kind under the same marker is no EXIF data.
    let other = [&jpeg[..2], &[0xff, 0xe1, 0, 10], b"http://x", &jpeg[2..]].concat();
    assert_eq!(read(&other), (None, Ok(None)));
    let long = vec![0; MOST_BYTES as usize + 1];
    assert!(read(&with_exif(&png, &long)).1.unwrap_err().contains("more than"));
    // The file was cut after its header was read.
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("photo");
    std::fs::write(&path, &jpeg).unwrap();
    assert!(brightness(&path, ExifPlace { at: jpeg.len() as u64 - 4, bytes: 100 }).is_err());
    assert!(brightness(&folder.path().join("gone"), ExifPlace { at: 0, bytes: 8 }).is_err());
}
