//! JPEG and PNG: what their headers say, and decoding within what was announced.

use crate::Target;
use crate::scene_folder::scratch;
use gsscale::dataset::model::{Intrinsics, Lens};
use gsscale::dataset::photo::{PhotoSource, decode};
use gsscale::dataset::photo_header::read_header;
use image::{ExtendedColorType, ImageEncoder, ImageFormat};
use std::io::Cursor;

/// Photos that would take more are not decoded here.
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
    let seeds = vec![
        encoded(&rgb, ImageFormat::Jpeg),
        encoded(&rgb.to_luma8().into(), ImageFormat::Jpeg),
        encoded(&rgb, ImageFormat::Png),
        encoded(&rgb.to_rgba8().into(), ImageFormat::Png),
        encoded(&rgb.to_rgb16().into(), ImageFormat::Png),
        tiny,
    ];
    let words = &["IEND", "IDAT", "IHDR", "tRNS", "PLTE", "acTL", "iCCP", "eXIf"];
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
    if header.decode_bytes > DECODE_BYTES_MAX {
        return;
    }
    let intrinsics = Intrinsics { width, height, fx: 50.0, fy: 50.0, cx: 1.0, cy: 1.0, lens: Lens::Pinhole };
    let target = (width.div_ceil(2), height.div_ceil(2));
    let source = PhotoSource { image_path: path, header, intrinsics, target, mask: None };
    if let Ok(target) = decode(&source) {
        assert_eq!(target.rgb.len(), 3 * target.width as usize * target.height as usize);
    }
}
