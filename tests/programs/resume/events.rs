//! TensorBoard event files of a run, parsed the way TensorBoard parses them.

use std::path::{Path, PathBuf};

/// Valid steps of all files in order of their names: the start of a session voids earlier records of its first step and
/// later ones.
pub fn steps(folder: &Path) -> Vec<u64> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let mut steps = Vec::new();
    for file in files {
        let data = std::fs::read(file).unwrap();
        let mut rest = data.as_slice();
        // A record is length, checksum, message, checksum; a record cut short by a kill does not count.
        while rest.len() >= 16 {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            if rest.len() < length + 16 {
                break;
            }
            let message = &rest[12..12 + length];
            rest = &rest[length + 16..];
            // Wall time (9 bytes), then step = 2 as a varint, if there is one; the first record has none.
            if message.get(9) != Some(&0x10) {
                continue;
            }
            let (step, bytes) = varint(&message[10..]);
            match message[10 + bytes] {
                0x3a => steps.retain(|&s| s < step),
                0x2a => steps.push(step),
                other => panic!("a field that is not written: {other:#x}"),
            }
        }
    }
    steps
}

fn varint(bytes: &[u8]) -> (u64, usize) {
    let length = bytes.iter().position(|b| b & 0x80 == 0).unwrap() + 1;
    (bytes[..length].iter().rev().fold(0, |value, b| value << 7 | u64::from(b & 0x7f)), length)
}
