//! Files of PyTorch in Mega-NeRF's layout, and the pickles inside them under valid checksums.

use super::{split_mode, with_mode};
use crate::Target;
use crate::scene_folder::{read_and_check, scratch};
use std::io::{Cursor, Read, Write};
use std::path::Path;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/mega_nerf").join(name)).unwrap()
}

fn pickle_of(file: &[u8]) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(file)).unwrap();
    let name = archive.file_names().flatten().find(|n| n.ends_with("data.pkl")).unwrap().to_string();
    let mut bytes = Vec::new();
    archive.by_name(&name).unwrap().read_to_end(&mut bytes).unwrap();
    bytes
}

fn with_pickle(file: &[u8], pickle: &[u8]) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(file)).unwrap();
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for i in 0..archive.len() {
        let mut entry = archive.by_index(i).unwrap();
        let name = entry.name().unwrap().to_string();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        writer.start_file(name.as_str(), options).unwrap();
        writer.write_all(if name.ends_with("data.pkl") { pickle } else { &bytes }).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

/// Mode 0 and 1: metadata of a view; 2 and 3: coordinates. Odd modes: the pickle alone.
pub fn torch() -> Target {
    let mut seeds = Vec::new();
    for (mode, name) in [(0, "000000.pt"), (2, "coordinates.pt")] {
        let file = fixture(name);
        seeds.push(with_mode(mode, &file));
        seeds.push(with_mode(mode + 1, &pickle_of(&file)));
    }
    // Memoising a list repeatedly while it grows would keep every version of it: 200 MB from 9 KB.
    let grown = [b"\x80\x02]".as_slice(), &b"Na\x94".repeat(3000), b"."].concat();
    // Numbers ahead of the values: each would grow the table by as many entries as there are values.
    let ahead: Vec<u8> = (1..100u32).flat_map(|i| [&b"r"[..], &(i * 1000).to_le_bytes()].concat()).collect();
    let ahead = [b"N".repeat(1000), ahead].concat();
    let nested = [b"]".repeat(200), b"a".repeat(199), b".".to_vec()].concat();
    seeds.extend([grown, ahead, nested, b"(".repeat(20_000), b"N".repeat(20_000)].map(|text| with_mode(1, &text)));
    for text in [
        &b"cos\nsystem\n."[..],
        b"cbuiltins\neval\n(X\x01\x00\x00\x001tR.",
        b"X\xff\xff\xff\xffabc.",
        b"r\xff\xff\xff\xff.",
        b"Nr\xff\xff\xff\x7f.",
        b"h\x05.",
        b"]q\x00h\x00.",
        b"t.",
        b"(.",
        b"I1\n.",
    ] {
        seeds.push(with_mode(1, text));
    }
    let words = &["ctorch\nFloatStorage\n", "]", "(", "}", "\u{94}", "q", "h", "a", "u", "t", "R", "Q", "N", "."];
    Target { name: "torch", run, seeds, words, cases: 1_500, memory: [3 << 20, 64] }
}

fn run(input: &[u8]) {
    let (mode, rest) = split_mode(input);
    let folder = scratch();
    let (mut metadata, mut coordinates) = (fixture("000000.pt"), fixture("coordinates.pt"));
    let file = if mode % 4 < 2 { &mut metadata } else { &mut coordinates };
    *file = if mode % 2 == 0 { rest.to_vec() } else { with_pickle(file, rest) };
    for sub in ["metadata", "rgbs"] {
        std::fs::create_dir_all(folder.path().join("train").join(sub)).unwrap();
    }
    std::fs::write(folder.path().join("coordinates.pt"), coordinates).unwrap();
    std::fs::write(folder.path().join("train/metadata/000000.pt"), metadata).unwrap();
    std::fs::write(folder.path().join("train/rgbs/000000.JPG"), b"").unwrap();
    read_and_check(folder.path());
}
