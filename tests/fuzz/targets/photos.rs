//! JPEG and PNG: headers, EXIF data, and decoding within the announced size.

use crate::Target;
use crate::allocation::peak_of;
use crate::exif::{Settings, with_exif};
use crate::scene_folder::scratch;
use gsscale::dataset::exif::brightness;
use gsscale::dataset::masks::MaskSource;
use gsscale::dataset::model::{Intrinsics, Lens};
use gsscale::dataset::photo::{Alpha, PhotoSource, decode};
use gsscale::dataset::photo_header::{PhotoHeader, read_header};
use image::{ExtendedColorType, ImageEncoder, ImageFormat};
use std::io::Cursor;

/// Larger photos are not decoded here.
const DECODE_BYTES_MAX: u64 = 4 << 20;

fn encoded(picture: &image::DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

pub fn photo() -> Target {
    let rgb = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([x as u8 * 6, y as u8 * 8, (x * y) as u8]));
    let rgb = image::DynamicImage::from(rgb);
    let mut tiny = Vec::new();
    image::codecs::png::PngEncoder::new(&mut tiny).write_image(&[9; 8], 2, 2, ExtendedColorType::La8).unwrap();
    let settings = Settings { seconds: 0.004, aperture: 2.8, iso: 640 }.tiff();
    let seeds = vec![
        encoded(&rgb, ImageFormat::Jpeg),
        encoded(&rgb.to_luma8().into(), ImageFormat::Jpeg),
        encoded(&rgb, ImageFormat::Png),
        encoded(&rgb.to_rgba8().into(), ImageFormat::Png),
        encoded(&rgb.to_rgb16().into(), ImageFormat::Png),
        with_exif(&encoded(&rgb, ImageFormat::Jpeg), &settings),
        with_exif(&tiny, &settings),
        tiny,
    ];
    let words = &["IEND", "IDAT", "IHDR", "tRNS", "PLTE", "acTL", "iCCP", "eXIf", "Exif\0\0", "II*\0", "MM\0*"];
    Target { name: "photo", run, seeds, words, cases: 4_000, memory: [16 << 20, 64] }
}

fn run(input: &[u8]) {
    let folder = scratch();
    let path = folder.path().join("a.jpg");
    std::fs::write(&path, input).unwrap();
    let header = match read_header(&path) {
        Ok(header) => header,
        Err(e) => return assert!(!e.remedy.is_empty() && !e.problem.is_empty(), "{e}"),
    };
    let (width, height) = (header.width, header.height);
    assert!(width > 0 && height > 0);
    if let Some(place) = header.exif {
        let is_sound = |stops: Option<f64>| stops.is_none_or(f64::is_finite);
        assert!(brightness(&path, place).map_or_else(|why| !why.is_empty(), is_sound));
    }
    if header.decode_bytes > DECODE_BYTES_MAX {
        return;
    }
    let intrinsics = Intrinsics { width, height, fx: 50.0, fy: 50.0, cx: 1.0, cy: 1.0, lens: Lens::Pinhole };
    let target = (width.div_ceil(2), height.div_ceil(2));
    let source = PhotoSource { image_path: path, header, intrinsics, target, mask: None, alpha: Alpha::Mask };
    if let Ok(target) = decode(&source) {
        assert_eq!(target.rgb.len(), 3 * target.width as usize * target.height as usize);
    }
}

/// A file of every pixel format that decoders return, 2000 x 1500.
pub fn pictures() -> Vec<(String, Vec<u8>)> {
    let rgb = image::RgbImage::from_fn(2000, 1500, |x, y| image::Rgb([x as u8, y as u8, (x / 100 * y) as u8]));
    let rgb = image::DynamicImage::from(rgb);
    let mut files = vec![
        ("a gray JPEG".to_string(), encoded(&rgb.to_luma8().into(), ImageFormat::Jpeg)),
        ("a colour JPEG".to_string(), encoded(&rgb, ImageFormat::Jpeg)),
    ];
    let pngs: [(&str, image::DynamicImage, &[u8]); 8] = [
        ("gray", rgb.to_luma8().into(), &[0; 2]),
        ("gray with alpha", rgb.to_luma_alpha8().into(), &[]),
        ("colour", rgb.to_rgb8().into(), &[0; 6]),
        ("colour with alpha", rgb.to_rgba8().into(), &[]),
        ("16-bit gray", rgb.to_luma16().into(), &[0; 2]),
        ("16-bit gray with alpha", rgb.to_luma_alpha16().into(), &[]),
        ("16-bit colour", rgb.to_rgb16().into(), &[0; 6]),
        ("16-bit colour with alpha", rgb.to_rgba16().into(), &[]),
    ];
    for (name, picture, transparent) in pngs {
        let bytes = encoded(&picture, ImageFormat::Png);
        if !transparent.is_empty() {
            files.push((format!("a {name} PNG with a transparent colour"), with_transparency(&bytes, transparent)));
        }
        files.push((format!("a {name} PNG"), bytes));
    }
    files
}

/// A PNG with a tRNS chunk before its pixels.
fn with_transparency(png: &[u8], colour: &[u8]) -> Vec<u8> {
    let mut crc = flate2::Crc::new();
    crc.update(b"tRNS");
    crc.update(colour);
    let length = (colour.len() as u32).to_be_bytes();
    [&png[..33], &length, b"tRNS", colour, &crc.sum().to_be_bytes(), &png[33..]].concat()
}

/// Decodes a file as a photo and as the mask of a small photo: peak bytes, and announced bytes.
pub fn decoded(bytes: &[u8]) -> [(&'static str, u64, u64); 2] {
    let folder = scratch();
    let (path, small) = (folder.path().join("a"), folder.path().join("b"));
    std::fs::write(&path, bytes).unwrap();
    std::fs::write(&small, encoded(&image::DynamicImage::new_rgb8(16, 12), ImageFormat::Png)).unwrap();
    let (header, of_small) = (read_header(&path).unwrap(), read_header(&small).unwrap());
    let source = |image_path, header: PhotoHeader, mask| {
        let (width, height) = (header.width, header.height);
        let intrinsics = Intrinsics { width, height, fx: 50.0, fy: 50.0, cx: 1.0, cy: 1.0, lens: Lens::Pinhole };
        PhotoSource { image_path, header, intrinsics, target: (16, 12), mask, alpha: Alpha::Mask }
    };
    let mask = Some(MaskSource { path: path.clone(), header, invert: false });
    [("a photo", source(path.clone(), header, None)), ("a mask", source(small, of_small, mask))].map(
        |(what, source)| {
            let peak = peak_of(|| assert!(decode(&source).is_ok()));
            (what, peak, source.decode_bytes())
        },
    )
}
