//! Stores of every released format version, opened by the present program.
//!
//! A fixture is a zip file of the store's files, compressed as a whole, and a JSON file of its contents.
//! `GSSCALE_WRITE_FIXTURE=1` writes the fixture of the present version; fixtures of earlier versions are never
//! rewritten.

use super::bench::Bench;
use gsscale::page::format::slot_header::checksum;
use gsscale::page::tool::reading::{Access, StoreReader, WitnessRule};
use serde_json::Value;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// Versions with a fixture, oldest first.
const VERSIONS: &[u32] = &[1];

fn file(version: u32, ending: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("tests/fixtures/store_v{version}.{ending}"))
}

fn pack(folder: &Path) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    // The lock names its last holder and is not compared.
    paths.retain(|path| path.file_name().is_some_and(|name| name != "LOCK"));
    paths.sort();
    for path in paths {
        zip.start_file(path.file_name().unwrap().to_str().unwrap(), options).unwrap();
        zip.write_all(&std::fs::read(path).unwrap()).unwrap();
    }
    zstd::stream::encode_all(zip.finish().unwrap().into_inner().as_slice(), 19).unwrap()
}

fn unpack(bytes: &[u8], folder: &Path) {
    let bytes = zstd::stream::decode_all(bytes).unwrap();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).unwrap();
        let mut content = Vec::new();
        entry.read_to_end(&mut content).unwrap();
        let name = entry.name().unwrap().into_owned();
        std::fs::write(folder.join(name), content).unwrap();
    }
}

/// The contents of the store `dir`, independent of its place.
fn content_of(bench: &Bench, dir: &str) -> Value {
    let mut content = serde_json::Map::new();
    let mut put = |key: &str, value: Value| content.insert(key.to_string(), value);
    put("generations", bench.ckpt_json(&format!("ls {dir}"))["generations"].clone());
    let inspected = bench.ckpt_json(&format!("inspect {dir}"));
    for key in ["identity", "format_version", "slot_bytes", "pages_by_degree", "pages_behind", "state"] {
        put(key, inspected[key].clone());
    }
    // The codecs of the first version.
    put("pages_by_codec", inspected["pages_by_codec"].as_array().unwrap()[..3].into());
    let store = StoreReader::open(&bench.path(dir), Access::Pages, WitnessRule::Obeyed).unwrap();
    let mut reader = store.slot_reader();
    let mut bytes = Vec::new();
    for (page, slot, label) in store.live_versions().unwrap() {
        bytes.extend_from_slice(&page.to_bits().to_le_bytes());
        bytes.extend_from_slice(&label);
        bytes.extend_from_slice(reader.payload(page, &slot).unwrap());
    }
    put("pages_digest", format!("{:032x}", checksum(&bytes)).into());
    // The PLY comments name the version of the program.
    let ply = bench.export(dir, "");
    let rows = ply.windows(11).position(|w| w == b"end_header\n").unwrap();
    put("ply_digest", format!("{:032x}", checksum(&ply[rows..])).into());
    Value::Object(content)
}

fn write_present_version() {
    let bench = Bench::new();
    // Few small pages, with moments, statistics and pending events.
    bench.stopped("--page-rows 16 --sh-degree 1 --max-gaussians 220 --spill-codec zstd:19");
    let version = *VERSIONS.last().unwrap();
    let packed = pack(&bench.spill());
    assert!(packed.len() < 200 << 10, "{} bytes are too many for the repository", packed.len());
    std::fs::write(file(version, "zip.zst"), packed).unwrap();
    let text = serde_json::to_string_pretty(&content_of(&bench, "spill")).unwrap() + "\n";
    std::fs::write(file(version, "json"), text).unwrap();
}

#[test]
fn stores_of_every_version_open_and_hold_what_they_held() {
    if std::env::var_os("GSSCALE_WRITE_FIXTURE").is_some() {
        write_present_version();
    }
    assert_eq!(
        VERSIONS.last(),
        Some(&gsscale::page::format::slot_header::FORMAT_VERSION),
        "a new version needs a fixture"
    );
    for &version in VERSIONS {
        let bench = Bench::empty();
        std::fs::create_dir(bench.path("store")).unwrap();
        unpack(&std::fs::read(file(version, "zip.zst")).unwrap(), &bench.path("store"));
        assert!(bench.is_intact("store"));
        let want: Value = serde_json::from_slice(&std::fs::read(file(version, "json")).unwrap()).unwrap();
        assert_eq!(content_of(&bench, "store"), want, "version {version}");
    }
}
