//! Input files that decompress to more than the memory budget: a run stays within `--host-mem` or refuses the file by
//! name.

use crate::support::scenes::{TextModel, stderr, text};
use crate::support::workdir::{TRAIN, Workdir, says};
use flate2::write::ZlibEncoder;
use flate2::{Compression, Crc};
use image::{DynamicImage, ImageFormat};
use std::io::{Cursor, Read, Write};
use std::process::{Output, Stdio};

const BUDGET: u64 = 200 << 20;
/// Decompressed size of the bombs: three times the budget.
const HELD: usize = 600 << 20;

/// Runs the trainer; returns its output and its peak memory, bytes.
fn measured(work: &Workdir, flags: &str) -> (Output, u64) {
    let mut command = work.command(TRAIN, &format!("{flags} --device cpu --quiet"));
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let status = format!("/proc/{}/status", child.id());
    let mut peak = 0;
    let ended = loop {
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.trim().trim_end_matches("kB").trim().parse::<u64>().ok());
        peak = peak.max(kib.unwrap_or(0) << 10);
        if let Some(ended) = child.try_wait().unwrap() {
            break ended;
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    };
    let mut said = Vec::new();
    child.stderr.take().unwrap().read_to_end(&mut said).unwrap();
    assert!(peak > 0, "the peak of the process could not be read");
    (Output { status: ended, stdout: Vec::new(), stderr: said }, peak)
}

fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut crc = Crc::new();
    crc.update(kind);
    crc.update(data);
    [&(data.len() as u32).to_be_bytes()[..], kind, data, &crc.sum().to_be_bytes()].concat()
}

fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// A PNG with chunks between its header and its pixels.
fn png_with(picture: &DynamicImage, chunks: &[u8]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).unwrap();
    let bytes = bytes.into_inner();
    // Signature and IHDR are 33 bytes.
    [&bytes[..33], chunks, &bytes[33..]].concat()
}

fn profile_bomb() -> Vec<u8> {
    chunk(b"iCCP", &[b"all zeros\0\0", &deflated(&vec![0; HELD])[..]].concat())
}

/// Chunks that cameras and programs write beside pixels: a colour profile that is not all zeros, texts of all kinds,
/// EXIF.
fn ordinary_chunks() -> Vec<u8> {
    let profile: Vec<u8> = (0..560_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let text = "exposure 1/250 f/8 ".repeat(2000);
    [
        chunk(b"iCCP", &[b"Display\0\0", &deflated(&profile)[..]].concat()),
        chunk(b"gAMA", &45_455u32.to_be_bytes()),
        chunk(b"tEXt", b"Software\0a camera"),
        chunk(b"zTXt", &[b"Comment\0\0", &deflated(text.as_bytes())[..]].concat()),
        chunk(b"iTXt", &[b"XML:com.adobe.xmp\0\x01\0\0\0", &deflated(text.as_bytes())[..]].concat()),
        chunk(b"eXIf", &[b"MM\0\x2a\0\0\0\x08", &[0u8; 4000][..]].concat()),
    ]
    .concat()
}

/// Rewrites all photos as PNGs of the same pixels with these chunks; readers detect the format by the bytes, not by the
/// name.
fn make_png(work: &Workdir, chunks: &[u8]) {
    for path in work.photos() {
        let picture = image::load_from_memory(&std::fs::read(&path).unwrap()).unwrap();
        std::fs::write(&path, png_with(&picture, chunks)).unwrap();
    }
}

/// A short run within the budget; returns its Gaussians.
fn trained(work: &Workdir) -> Vec<u8> {
    let flags = "scene --out out --overwrite --steps 8 --threads 2 --host-mem 200MiB";
    let (output, peak) = measured(work, flags);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(peak <= BUDGET, "{} MiB were taken", peak >> 20);
    work.ply("out")
}

#[test]
fn photos_with_profiles_and_texts_train_as_without_them_and_within_the_budget() {
    let work = Workdir::city(5, 64, 48, 500);
    make_png(&work, &[]);
    let plain = trained(&work);
    make_png(&work, &ordinary_chunks());
    assert!(trained(&work) == plain, "texts and profiles changed the result");
    make_png(&work, &profile_bomb());
    assert!(trained(&work) == plain, "the pixels are the same, the result is not");
}

#[test]
fn masks_with_huge_profiles_stay_within_the_budget() {
    let work = Workdir::city(4, 64, 48, 500);
    std::fs::create_dir(work.path("scene/masks")).unwrap();
    let mask = image::GrayImage::from_fn(64, 48, |x, _| image::Luma([if x < 40 { 255 } else { 0 }]));
    let write = |chunks: &[u8]| {
        for photo in work.photos() {
            let name = format!("scene/masks/{}.png", photo.file_name().unwrap().to_string_lossy());
            work.write(&name, png_with(&mask.clone().into(), chunks));
        }
    };
    write(&[]);
    let plain = trained(&work);
    write(&profile_bomb());
    assert!(trained(&work) == plain);
}

/// transforms.json without the image size: the size is read from the photos.
#[test]
fn reading_the_size_of_a_photo_inflates_nothing() {
    let work = Workdir::city(4, 64, 48, 500);
    make_png(&work, &profile_bomb());
    TextModel::of(&work.scene()).write_transforms(&work.scene());
    work.remove("scene/sparse");
    let mut json = work.json("scene/transforms.json");
    json.as_object_mut().unwrap().retain(|key, _| key != "w" && key != "h");
    work.write("scene/transforms.json", json.to_string());
    let (output, peak) = measured(&work, "scene --dry-run --host-mem 200MiB");
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(peak <= BUDGET, "{} MiB were taken", peak >> 20);
}

/// A baseline JPEG of this size with one scan for each component, almost without data.
fn jpeg_in_scans(width: u16, height: u16) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let picture = image::RgbImage::from_pixel(16, 16, image::Rgb([90, 120, 40]));
    picture.write_to(&mut bytes, ImageFormat::Jpeg).unwrap();
    let bytes = bytes.into_inner();
    let at = |marker: [u8; 2]| bytes.windows(2).position(|w| w == marker).unwrap();
    let (frame, scan) = (at([0xff, 0xc0]), at([0xff, 0xda]));
    let mut header = bytes[..scan].to_vec();
    header[frame + 5..frame + 9].copy_from_slice(&[height.to_be_bytes(), width.to_be_bytes()].concat());
    let first = bytes[scan + 5];
    [&header[..], &[0xff, 0xda, 0, 8, 1, first, 0, 0, 63, 0], &[0; 4000], &[0xff, 0xd9]].concat()
}

/// Replaces a photo by `bytes`: the run must refuse it by name, with the memory that it needs.
fn refused(bytes: &[u8], more: &str) {
    let work = Workdir::city(4, 64, 48, 500);
    let photo = &work.photos()[1];
    std::fs::write(photo, bytes).unwrap();
    let flags = "scene --out out --steps 8 --host-mem 200MiB --max-resolution 64";
    let (output, peak) = measured(&work, &format!("{flags} {more}"));
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}; the peak was {} MiB", peak >> 20);
    says(
        &said,
        &[
            text(photo.strip_prefix(work.path("")).unwrap()),
            "decoding it takes up to",
            "200 MiB",
            "remedy: raise --host-mem",
        ],
    );
    assert!(peak <= BUDGET, "{} MiB were taken before it was refused", peak >> 20);
}

#[test]
fn a_jpeg_whose_coefficients_are_kept_is_refused_before_they_are() {
    // 3 bytes of result and 6 of coefficients for each of 27 million pixels: the result alone would fit.
    refused(&jpeg_in_scans(6000, 4500), "");
}

#[test]
fn a_photo_that_fits_no_cache_counts_all_the_same() {
    // 80 million pixels of 3 bytes, in 240 KB.
    let picture = image::RgbImage::new(10_240, 7_680);
    refused(&png_with(&picture.into(), &[]), "--image-cache 1MiB");
}

/// Writes and reads a transforms.json; returns the peak memory as a multiple of the file size, and stderr.
fn read_json(text_of_file: &str) -> (f64, String) {
    let work = Workdir::new();
    work.write("transforms.json", text_of_file);
    let (output, peak) = measured(&work, ". --dry-run");
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    (peak as f64 / text_of_file.len() as f64, said)
}

/// Length of the files.
const JSON_BYTES: usize = 12 << 20;
/// The bound of `dataset::transforms`, plus the memory of the program without a scene, some 20 MiB.
const JSON_MULTIPLE: f64 = 16.0 + (20 << 20) as f64 / JSON_BYTES as f64;

#[test]
fn transforms_are_read_within_a_multiple_of_their_size() {
    let list = |item: &str| vec![item; JSON_BYTES / (item.len() + 1)].join(",");
    let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
    let frame = |name: &str| format!("{{\"file_path\":\"{name}\",\"transform_matrix\":{matrix}}}");
    let names = |item: fn(usize) -> String| (0..JSON_BYTES / 9).map(item).collect::<Vec<_>>().join(",");
    let frames =
        (0..JSON_BYTES / frame("000000").len()).map(|i| frame(&format!("{i:x}"))).collect::<Vec<_>>().join(",");
    let cases = [
        ("empty frames", format!("{{\"frames\":[{}]}}", list("{}")), "frames[0].file_path"),
        ("numbers for frames", format!("{{\"frames\":[{}]}}", list("0")), "not an object"),
        (
            "a long matrix",
            format!("{{\"frames\":[{{\"file_path\":\"a\",\"transform_matrix\":[{}]}}]}}", list("0")),
            "4 x 4",
        ),
        ("a key that nobody knows", format!("{{\"x\":[{}],\"frames\":[]}}", list("[]")), "no frames"),
        (
            "names",
            format!("{{\"train_filenames\":[{}],\"frames\":[{{}}]}}", names(|i| format!("\"{i:06x}\""))),
            "file_path",
        ),
        ("frames without photos", format!("{{\"w\":640,\"h\":480,\"fl_x\":500,\"frames\":[{frames}]}}"), "missing"),
        ("frames without photos or size", format!("{{\"fl_x\":500,\"frames\":[{frames}]}}"), "missing"),
    ];
    for (name, file, part) in cases {
        let (multiple, said) = read_json(&file);
        println!("{name}: {multiple:.1} times its size");
        assert!(said.contains(part), "{name}: {said}");
        assert!(multiple <= JSON_MULTIPLE, "{name}: {multiple:.1} times its size was taken");
    }
}
