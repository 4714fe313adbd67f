//! Damage to pages that were written correctly: flipped bits, misdirected writes, old copies. The store reports the
//! damage or is unaffected.

use super::disk::{Disk, Rng};
use super::life::{CONFIG, paged_store};
use super::oracle::Oracle;
use super::tamper;
use gsscale::page::map::commit::MAP_NAME;
use gsscale::page::map::opening::Opened;

/// Damages a copy of the disk and opens it. Returns whether the damage was noticed; an error is wrong data or a commit
/// lost without a word.
///
/// `past` is the disk at an earlier time.
pub fn spoil_and_open(disk: &Disk, past: &Disk, oracle: &Oracle, rng: &mut Rng) -> Result<bool, String> {
    let disk = disk.fork();
    disk.forget_faults();
    let names: Vec<String> = disk.names().into_iter().filter(|name| disk.file_len(name) > 0).collect();
    let Some(name) = names.get(rng.below(names.len() as u64) as usize) else { return Ok(false) };
    let what = match rng.below(6) {
        0 if name.starts_with("seg-") => astray(&disk, name, rng),
        3 if name.starts_with("seg-") && past.names().contains(name) => lost_write(&disk, past, name, rng),
        3 | 4 if name == MAP_NAME && past.names().contains(name) => {
            disk.replace(name, &past.contents(name));
            "an old copy of the map".to_string()
        }
        5 if name == MAP_NAME => tamper::with(&disk, name, rng),
        1 => flip_used(&disk, name, rng),
        2 if name == MAP_NAME => {
            // The first sector is written with every commit and selects the valid tree.
            let bit = rng.below(320 * 8);
            disk.flip(name, bit);
            format!("bit {bit} of {name} flipped")
        }
        _ => {
            let bit = rng.below(disk.file_len(name) * 8);
            disk.flip(name, bit);
            format!("bit {bit} of {name} flipped")
        }
    };
    open_spoilt(&disk, oracle).map_err(|error| format!("{what}: {error}"))
}

/// Flips a bit in a used part: most of a map's file is empty.
fn flip_used(disk: &Disk, name: &str, rng: &mut Rng) -> String {
    let bytes = disk.contents(name);
    let used: Vec<usize> = bytes.iter().enumerate().filter(|(_, b)| **b != 0).map(|(i, _)| i).collect();
    let byte = used.get(rng.below(used.len() as u64) as usize).copied().unwrap_or(0);
    let bit = byte as u64 * 8 + rng.below(8);
    disk.flip(name, bit);
    format!("used bit {bit} of {name} flipped")
}

/// Copies a slot's bytes to another slot.
fn astray(disk: &Disk, name: &str, rng: &mut Rng) -> String {
    let slots = disk.file_len(name) / 8192;
    let (from, to) = (rng.below(slots), rng.below(slots));
    disk.copy_within(name, from * 8192, to * 8192, 8192);
    format!("slot {from} of {name} written to {to}")
}

/// Puts an earlier version back into a slot: the drive has silently dropped a write.
fn lost_write(disk: &Disk, past: &Disk, name: &str, rng: &mut Rng) -> String {
    let (mut bytes, old) = (disk.contents(name), past.contents(name));
    let slot = rng.below(disk.file_len(name) / 8192) as usize * 8192;
    if let (Some(now), Some(old)) = (bytes.get_mut(slot..slot + 8192), old.get(slot..slot + 8192)) {
        now.copy_from_slice(old);
    }
    disk.replace(name, &bytes);
    format!("a write to slot {slot} of {name} was lost")
}

/// Opens a damaged disk: the result is an error that names the damage, or exactly the acknowledged state.
pub fn open_spoilt(disk: &Disk, oracle: &Oracle) -> Result<bool, String> {
    let before: Vec<(String, Vec<u8>)> = disk.names().into_iter().map(|n| (n.clone(), disk.contents(&n))).collect();
    match Opened::open(Box::new(disk.clone()), CONFIG) {
        Err(_) => {
            let changed = before.iter().find(|(name, bytes)| disk.contents(name) != *bytes);
            // Before a store is refused, only the witness may be updated.
            match changed.filter(|(name, _)| name != gsscale::page::map::commit::WITNESS_NAME) {
                Some((name, _)) => Err(format!("a refused store was changed: {name}")),
                None => Ok(true),
            }
        }
        Ok(opened) => {
            let mut oracle = oracle.clone();
            oracle.judge(&opened)?;
            let Ok(mut store) = paged_store(disk, &opened, 1) else { return Ok(true) };
            Ok(oracle.compare(&opened, &mut store)? > 0)
        }
    }
}
