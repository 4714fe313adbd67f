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
