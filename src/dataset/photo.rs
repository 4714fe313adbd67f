//! Converts a photo file to a training target: decodes, undistorts, downscales, applies the mask.
//!
//! Every picture becomes 8-bit RGB: 16-bit samples are rounded, gray is repeated, CMYK is converted. Transparent pixels
//! ([`Alpha`]) are left out as a mask leaves pixels out, or show a background colour. EXIF orientation is ignored: COLMAP
//! poses refer to the stored pixels.
//!
//! Invariants: 1. a target depends on its [`PhotoSource`] and the files alone; 2. [`decode`] never uses more memory than
//! [`PhotoSource::decode_bytes`], whatever the files contain besides pixels; 3. distorted photos are undistorted at full size, row
//! by row into the area average: the full-size result never exists in memory; 4. a target pixel is kept if at least half of its
//! area is inside the photo, at least half of it is kept by the mask, and it is at least half opaque.

use super::masks::MaskSource;
use super::model::Intrinsics;
use super::photo_header::{PhotoFormat, PhotoHeader};
use super::resize::{AreaResizer, Size, resize_area};
use super::undistort::Undistorter;
use crate::base::error::{InputError, InputResult};
use crate::base::png_pixels::{PNG_BUFFERS, PixelChunks};
use crate::scene::image::Target;
use image::codecs::{jpeg::JpegDecoder, png::PngDecoder};
use image::{DynamicImage, ImageDecoder, ImageError, Limits};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// What becomes of transparent pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Alpha {
    /// A pixel counts if it is at least half opaque, with the colour of its opaque part.
    Mask,
    /// Every pixel counts; transparent ones show this colour.
    Over([u8; 3]),
}

/// Everything needed to decode a view's target; the files were checked at load.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotoSource {
    pub image_path: PathBuf,
    /// Its header, as read at load.
    pub header: PhotoHeader,
    /// Intrinsics at the photo's true size, with the lens to undo.
    pub intrinsics: Intrinsics,
    pub target: Size,
    pub mask: Option<MaskSource>,
    pub alpha: Alpha,
}

impl PhotoSource {
    /// Most bytes of the decoded target (a mask may turn out to be unnecessary).
    pub fn target_bytes(&self) -> u64 {
        self.target_pixels() * if self.may_have_mask() { 4 } else { 3 }
    }

    /// Peak memory of [`decode`], bytes: the larger of the photo's and the mask's, plus the target. Buffers of a few
    /// rows are not counted.
    pub fn decode_bytes(&self) -> u64 {
        let photo = self.header.decode_bytes + self.target_bytes();
        // Validity of undistorted pixels; a photo with alpha has four bytes a pixel until its mask is taken from them.
        let undone = if self.may_have_mask() { self.target_pixels() } else { 0 };
        let mask = self.mask.as_ref().map_or(0, |m| m.header.gray_bytes() + self.target_pixels());
        photo.max(mask + self.target_bytes()) + undone
    }

    fn may_have_mask(&self) -> bool {
        self.mask.is_some() || self.intrinsics.lens.distorts() || self.is_masked_by_alpha()
    }

    pub fn is_masked_by_alpha(&self) -> bool {
        self.header.has_alpha && self.alpha == Alpha::Mask
    }

    fn target_pixels(&self) -> u64 {
        u64::from(self.target.0) * u64::from(self.target.1)
    }
}

/// Intrinsics of the same photo at another size: each axis is scaled by its own ratio. The lens is unchanged because it
/// acts on directions.
pub fn intrinsics_at(intrinsics: &Intrinsics, size: Size) -> Intrinsics {
    let sx = f64::from(size.0) / f64::from(intrinsics.width);
    let sy = f64::from(size.1) / f64::from(intrinsics.height);
    Intrinsics {
        width: size.0,
        height: size.1,
        fx: intrinsics.fx * sx,
        fy: intrinsics.fy * sy,
        cx: intrinsics.cx * sx,
        cy: intrinsics.cy * sy,
        lens: intrinsics.lens,
    }
}

/// Decodes a view's target.
/// Errors: the photo or its mask cannot be read or decoded, or changed its size since load.
pub fn decode(source: &PhotoSource) -> InputResult<Target> {
    let (rgb, mut mask) = match read_colors(&source.image_path, &source.header, source.alpha)? {
        DecodedColors::Rgb(rgb) => at_target_size::<3>(rgb, source),
        DecodedColors::RgbOverBlack(rgba) => {
            let (rgba, valid) = at_target_size::<4>(rgba, source);
            let pixels = rgba.as_chunks::<4>().0;
            // Colours of the opaque parts of pixels over black, and which pixels are at least half opaque.
            let mut rgb = Vec::with_capacity(3 * pixels.len());
            for &[r, g, b, a] in pixels {
                let (half, a) = (u32::from(a) / 2, u32::from(a.max(1)));
                rgb.extend([r, g, b].map(|c| ((255 * u32::from(c) + half) / a).min(255) as u8));
            }
            let mut opaque = thresholded(pixels.iter().map(|pixel| pixel[3]).collect());
            if let Some(valid) = valid {
                opaque.iter_mut().zip(valid).for_each(|(k, v)| *k &= v);
            }
            (rgb, Some(opaque))
        }
    };
    if let Some(mask_source) = &source.mask {
        let mut kept = decode_mask(mask_source, &source.intrinsics, source.target)?;
        if let Some(valid) = &mask {
            kept.iter_mut().zip(valid).for_each(|(k, v)| *k &= v);
        }
        mask = Some(kept);
    }
    let mask = mask.filter(|m| m.contains(&0));
    Ok(Target { mask, ..Target::new(source.target.into(), rgb) })
}

/// The photo at target size; for one that is undistorted, also the pixels of which at least half are inside the photo.
fn at_target_size<const C: usize>(photo: Vec<u8>, source: &PhotoSource) -> (Vec<u8>, Option<Vec<u8>>) {
    let full = (source.header.width, source.header.height);
    if !source.intrinsics.lens.distorts() {
        return (if full == source.target { photo } else { resize_area(&photo, C, full, source.target) }, None);
    }
    let mut shares = AreaResizer::new(1, full, source.target, 1);
    let colors = undistort::<C>(&photo, source.intrinsics, source.target, |valid| shares.push_row(valid));
    (colors, Some(thresholded(shares.finish())))
}

/// The undistorted picture at target size. `take` receives the validity of each row at full size, 255 or 0 per pixel.
fn undistort<const C: usize>(picture: &[u8], k: Intrinsics, target: Size, mut take: impl FnMut(&[u8])) -> Vec<u8> {
    let undistorter = Undistorter::new(k);
    let mut resizer = AreaResizer::new(C, (k.width, k.height), target, 256);
    let (mut row, mut valid) = (vec![0u16; C * k.width as usize], vec![0u8; k.width as usize]);
    for y in 0..k.height {
        undistorter.sample_row::<C>(picture, y, &mut row, &mut valid);
        resizer.push_row(&row);
        take(&valid);
    }
    resizer.finish()
}

/// Decodes a mask for a photo with these full-size intrinsics: one byte per target pixel, 255 = keep, 0 = exclude.
fn decode_mask(mask: &MaskSource, intrinsics: &Intrinsics, target: Size) -> InputResult<Vec<u8>> {
    let (mut keep, _) = read_luma(&mask.path, &mask.header)?;
    for value in &mut keep {
        let white = *value >= 128;
        *value = if white != mask.invert { 255 } else { 0 };
    }
    let size = (mask.header.width, mask.header.height);
    let share = match intrinsics.lens.distorts() {
        false => resize_area(&keep, 1, size, target),
        true => undistort::<1>(&keep, intrinsics_at(intrinsics, size), target, |_| {}),
    };
    Ok(thresholded(share))
}

/// Converts coverage of 0 to 255 to 0 or 255; half or more is kept.
fn thresholded(mut share: Vec<u8>) -> Vec<u8> {
    share.iter_mut().for_each(|value| *value = if *value >= 128 { 255 } else { 0 });
    share
}

/// An 8-bit picture, interleaved.
enum DecodedColors {
    Rgb(Vec<u8>),
    /// Colours over black, and alpha.
    RgbOverBlack(Vec<u8>),
}

/// Decodes a picture to 8 bits; where alpha is no mask, over its background.
fn read_colors(path: &Path, header: &PhotoHeader, alpha: Alpha) -> InputResult<DecodedColors> {
    let picture = read_picture(path, header)?;
    if !picture.color().has_alpha() {
        return Ok(DecodedColors::Rgb(picture.into_rgb8().into_raw()));
    }
    let mut rgba = picture.into_rgba8().into_raw();
    match alpha {
        Alpha::Mask => {
            for pixel in rgba.as_chunks_mut::<4>().0 {
                let [r, g, b, a] = *pixel;
                *pixel = [over_black(r, a), over_black(g, a), over_black(b, a), a];
            }
            Ok(DecodedColors::RgbOverBlack(rgba))
        }
        Alpha::Over(background) => {
            let mut rgb = Vec::with_capacity(rgba.len() / 4 * 3);
            for &[r, g, b, a] in rgba.as_chunks::<4>().0 {
                let under = background.map(|c| over_black(c, 255 - a));
                rgb.extend([over_black(r, a) + under[0], over_black(g, a) + under[1], over_black(b, a) + under[2]]);
            }
            Ok(DecodedColors::Rgb(rgb))
        }
    }
}

/// Decodes a mask to 8-bit gray over black. A PNG of 0 and 1 is read as one of 0 and 255, which any program writes that
/// saves labels; a JPEG has such values from black alone.
fn read_luma(path: &Path, header: &PhotoHeader) -> InputResult<(Vec<u8>, bool)> {
    let picture = read_picture(path, header)?;
    let is_png = header.format == PhotoFormat::Png;
    let mut gray = match &picture {
        DynamicImage::ImageLuma16(deep) if is_png && deep.iter().max() == Some(&1) => {
            deep.iter().map(|&value| value as u8).collect()
        }
        picture if picture.color().has_alpha() => {
            let gray = picture.to_luma_alpha8();
            gray.as_raw().as_chunks::<2>().0.iter().map(|&[l, a]| over_black(l, a)).collect()
        }
        _ => picture.into_luma8().into_raw(),
    };
    let is_0_and_1 = is_png && gray.iter().max() == Some(&1);
    if is_0_and_1 {
        gray.iter_mut().for_each(|value| *value *= 255);
    }
    Ok((gray, is_0_and_1))
}

/// Whether a mask holds 1 where others hold 255.
pub(super) fn holds_0_and_1(mask: &MaskSource) -> InputResult<bool> {
    Ok(read_luma(&mask.path, &mask.header)?.1)
}

fn over_black(value: u8, alpha: u8) -> u8 {
    ((u32::from(value) * u32::from(alpha) + 127) / 255) as u8
}

fn read_picture(path: &Path, header: &PhotoHeader) -> InputResult<DynamicImage> {
    let file = File::open(path).map_err(|e| InputError::io(path, "opening the photo", &e))?;
    let reader = BufReader::new(file);
    match header.format {
        PhotoFormat::Jpeg => decode_with(JpegDecoder::new(reader).map_err(|e| undecodable(path, &e))?, path, header),
        PhotoFormat::Png => {
            let pixels = PixelChunks::new(reader).map_err(|e| InputError::io(path, "reading the photo", &e))?;
            let mut limits = Limits::no_limits();
            limits.max_alloc = Some(PNG_BUFFERS);
            let decoder = PngDecoder::with_limits(pixels, limits).map_err(|e| undecodable(path, &e))?;
            decode_with(decoder, path, header)
        }
    }
}

fn decode_with(decoder: impl ImageDecoder, path: &Path, header: &PhotoHeader) -> InputResult<DynamicImage> {
    let (width, height) = decoder.dimensions();
    if (width, height) != (header.width, header.height) {
        let problem = format!("its size is {width} x {height} now, {} x {} at load", header.width, header.height);
        return Err(InputError::new(path, problem, "do not change photos during a run; start it again"));
    }
    DynamicImage::from_decoder(decoder).map_err(|e| undecodable(path, &e))
}

fn undecodable(path: &Path, e: &ImageError) -> InputError {
    match e {
        ImageError::IoError(e) => InputError::io(path, "decoding the photo", e),
        e => {
            let remedy = "copy it again from its source, or move it away and add --allow-missing";
            InputError::new(path, format!("the picture cannot be decoded: {e}"), remedy)
        }
    }
}
