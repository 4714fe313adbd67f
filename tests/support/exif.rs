//! EXIF data for photos of tests: camera settings in a TIFF structure, in a JPEG or a PNG.

use std::path::Path;

#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Exposure time, seconds.
    pub seconds: f64,
    pub aperture: f64,
    pub iso: u16,
}

impl Settings {
    /// Settings that make a photo brighter by `stops` of light than those of 0 stops do.
    pub fn brighter_by(stops: f64) -> Settings {
        Settings { seconds: 0.01 * stops.exp2(), aperture: 4.0, iso: 200 }
    }

    /// The TIFF structure: a directory that points to the directory of the camera, which has the three values.
    pub fn tiff(&self) -> Vec<u8> {
        let entry = |tag: u16, kind: u16, value: u32| -> Vec<u8> {
            [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &1u32.to_le_bytes(), &value.to_le_bytes()].concat()
        };
        let (short, long, rational) = (3, 4, 5);
        let ratio = |value: f64| [((value * 1e6).round() as u32).to_le_bytes(), 1_000_000u32.to_le_bytes()].concat();
        // Header 8, first directory 2 + 12 + 4, second directory 2 + 3 * 12 + 4, then two fractions.
        let (camera, fractions) = (26u32, 68u32);
        [
            b"II*\0".to_vec(),
            8u32.to_le_bytes().to_vec(),
            1u16.to_le_bytes().to_vec(),
            entry(0x8769, long, camera),
            vec![0; 4],
            3u16.to_le_bytes().to_vec(),
            entry(0x829a, rational, fractions),
            entry(0x829d, rational, fractions + 8),
            entry(0x8827, short, u32::from(self.iso)),
            vec![0; 4],
            ratio(self.seconds),
            ratio(self.aperture),
        ]
        .concat()
    }
}

/// A TIFF structure of a camera's name, and a directory of a place: degrees north and east (of any sign), metres above the sea.
pub fn tiff_of_place(camera: &str, [north, east, up]: [f64; 3]) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| -> Vec<u8> {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value].concat()
    };
    let letter = |letter: u8| [letter, 0, 0, 0];
    let ratio =
        |value: f64, by: u32| [((value * f64::from(by)).round() as u32).to_le_bytes(), by.to_le_bytes()].concat();
    let angle = |degrees: f64| {
        let (whole, minutes) = (degrees.abs().floor(), degrees.abs().fract() * 60.0);
        [ratio(whole, 1), ratio(minutes.floor(), 1), ratio(minutes.fract() * 60.0, 1_000_000)].concat()
    };
    let (ascii, long, rational) = (2, 4, 5);
    // Header 8, first directory 2 + 2 * 12 + 4, directory of the place 2 + 6 * 12 + 4, then what is longer than 4 bytes.
    let (gps, values) = (38u32, 116u32);
    let name = [camera.as_bytes(), &[0]].concat();
    [
        b"II*\0".to_vec(),
        8u32.to_le_bytes().to_vec(),
        2u16.to_le_bytes().to_vec(),
        entry(0x0110, ascii, name.len() as u32, (values + 56).to_le_bytes()),
        entry(0x8825, long, 1, gps.to_le_bytes()),
        vec![0; 4],
        6u16.to_le_bytes().to_vec(),
        entry(1, ascii, 2, letter(if north < 0.0 { b'S' } else { b'N' })),
        entry(2, rational, 3, values.to_le_bytes()),
        entry(3, ascii, 2, letter(if east < 0.0 { b'W' } else { b'E' })),
        entry(4, rational, 3, (values + 24).to_le_bytes()),
        entry(5, 1, 1, letter(u8::from(up < 0.0))),
        entry(6, rational, 1, (values + 48).to_le_bytes()),
        vec![0; 4],
        angle(north),
        angle(east),
        ratio(up.abs(), 1000),
        name,
    ]
    .concat()
}

/// A JPEG or PNG with these EXIF data before its other segments or chunks.
pub fn with_exif(photo: &[u8], tiff: &[u8]) -> Vec<u8> {
    if photo.starts_with(&[0xff, 0xd8]) {
        let length = (tiff.len() as u16 + 8).to_be_bytes();
        return [&photo[..2], &[0xff, 0xe1], &length, b"Exif\0\0", tiff, &photo[2..]].concat();
    }
    let mut crc = flate2::Crc::new();
    crc.update(b"eXIf");
    crc.update(tiff);
    [&photo[..33], &(tiff.len() as u32).to_be_bytes(), b"eXIf", tiff, &crc.sum().to_be_bytes(), &photo[33..]].concat()
}

/// Adds EXIF data to a photo file.
pub fn add_exif(path: &Path, tiff: &[u8]) {
    let photo = std::fs::read(path).unwrap();
    std::fs::write(path, with_exif(&photo, tiff)).unwrap();
}
