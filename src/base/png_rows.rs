//! Writes a PNG row by row, so that a picture of any size takes the memory of some rows.
//!
//! Not here: reading a PNG ([`super::png_pixels`]).

use png::{BitDepth, ColorType, Compression, Encoder, EncodingError};
use std::io::{Error, Result, Write};

/// Writes an RGB picture of 8 bits a channel. `fill` is called for each row from the top with its number and its
/// `3 * width` bytes. Errors: `to` cannot be written, or a side is 0.
pub fn write_rgb_rows(to: impl Write, [width, height]: [u32; 2], mut fill: impl FnMut(usize, &mut [u8])) -> Result<()> {
    let other = |error: EncodingError| match error {
        EncodingError::IoError(error) => error,
        error => Error::other(error),
    };
    let mut encoder = Encoder::new(to, width, height);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Balanced);
    let mut writer = encoder.write_header().map_err(other)?;
    let mut rows = writer.stream_writer().map_err(other)?;
    let mut row = vec![0; 3 * width as usize];
    for y in 0..height as usize {
        fill(y, &mut row);
        rows.write_all(&row)?;
    }
    rows.finish().map_err(other)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn another_reader_finds_the_rows() {
        let mut bytes = Vec::new();
        write_rgb_rows(&mut bytes, [70, 31], |y, row| row.iter_mut().enumerate().for_each(|(x, b)| *b = (x * y) as u8))
            .unwrap();
        let read = image::load_from_memory(&bytes).unwrap().into_rgb8();
        assert_eq!(read.dimensions(), (70, 31));
        assert!(read.as_raw().chunks(210).enumerate().all(|(y, row)| (0..210).all(|x| row[x] == (x * y) as u8)));
        assert!(write_rgb_rows(Vec::new(), [0, 3], |_, _| {}).is_err());
    }
}
