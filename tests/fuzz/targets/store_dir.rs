//! A whole spill directory, damaged as the input says. The open refuses the directory, or finds a committed state page
//! by page to the bit, or reports pages as damaged.

use crate::Target;
use crate::scene_folder::scratch;
use gsscale::base::ids::PageId;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::HEADER_BYTES;
use gsscale::page::map::commit::{CommitConfig, Cut, PageChange};
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::paged_store::{PageMoved, PagedStore};
use gsscale::page::versions::slots::SlotLayout;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

const LAYOUT: SlotLayout = SlotLayout { slot_bytes: 8192, slots_per_segment: 4 };
const PAGES: u32 = 5;
const ROUNDS: u64 = 4;
const PAYLOAD_BYTES: usize = 3000;

type Files = BTreeMap<String, Vec<u8>>;

/// The directory after its last commit, and after an earlier one.
struct Template {
    now: Files,
    past: Files,
}

fn payload(page: PageId, version: u64) -> Vec<u8> {
    (0..PAYLOAD_BYTES as u64)
        .map(|i| gsscale::base::rng::mix64(page.to_bits() ^ version << 20 ^ (i / 64)) as u8)
        .collect()
}

fn version_at(page: u32, generation: u64) -> u64 {
    // Round g writes the pages with even (page + g); round 1 writes all.
    (1..=generation).rev().find(|g| *g == 1 || (u64::from(page) + g).is_multiple_of(2)).unwrap_or(0)
}

fn config(spill: &SpillDir) -> CommitConfig {
    CommitConfig { store: spill.format().store, cache_bytes: 1 << 18, reserve_bytes: 0 }
}

fn paged(opened: &Opened, folder: &Path, layout: SlotLayout) -> Option<PagedStore> {
    let engine = open_engine(IoEngine::Pread, folder, 1).unwrap().store;
    opened.paged_store(engine, layout, Codec::Zstd { level: 1 }).ok()
}

fn contents(folder: &Path) -> Files {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap());
    entries.map(|e| (e.file_name().into_string().unwrap(), std::fs::read(e.path()).unwrap())).collect()
}

fn template() -> &'static Template {
    static TEMPLATE: OnceLock<Template> = OnceLock::new();
    TEMPLATE.get_or_init(|| {
        let parent = scratch();
        let folder = parent.path().join("store");
        let spill = SpillDir::create(&folder, LAYOUT, true).unwrap();
        let opened = Opened::create(Box::new(DriveFolder::new(&folder)), config(&spill)).unwrap();
        let mut store = paged(&opened, &folder, LAYOUT).unwrap();
        let mut commits = opened.commits;
        let mut slots = BTreeMap::new();
        let mut past = Files::new();
        for round in 1..=ROUNDS {
            let mut changes = Vec::new();
            for page in (0..PAGES).filter(|p| version_at(*p, round) == round) {
                let id = PageId::initial(page);
                let mut buffer = store.new_buffer();
                buffer.as_mut_slice()[HEADER_BYTES..][..PAYLOAD_BYTES].copy_from_slice(&payload(id, round));
                store.write(1, id, b"label", PAYLOAD_BYTES, buffer).map_err(|(e, _)| e).unwrap();
                let mut done = Vec::new();
                while done.is_empty() {
                    store.complete(true, &mut done);
                }
                let Ok(PageMoved::Written(slot)) = done.remove(0).result else { panic!("not written") };
                if let Some(before) = slots.insert(page, slot) {
                    store.free(&before);
                }
                changes.push(PageChange { page: id, version: Some((slot, b"label".to_vec())) });
            }
            let cut = Cut { changes: &changes, run_state: &round.to_le_bytes(), note: b"", pin: None };
            assert_eq!(commits.commit(&mut store, &mut Vec::new(), &cut).unwrap(), round);
            if round == ROUNDS - 1 {
                past = contents(&folder);
            }
        }
        drop((commits, store, spill));
        Template { now: contents(&folder), past }
    })
}

/// Input in pieces of eight bytes: operation, file, other file, four bytes of offset, value.
pub fn store_dir() -> Target {
    let op = |what: u8, file: u8, other: u8, at: u32, value: u8| {
        [&[what, file, other], at.to_le_bytes().as_slice(), &[value]].concat()
    };
    let files = template().now.len() as u8;
    let mut seeds = vec![Vec::new()];
    for file in 0..files {
        for what in 0..9 {
            seeds.push(op(what, file, (file + 1) % files, 4096 + 77 * u32::from(file), 8));
        }
    }
    seeds.push([op(8, 4, 0, 0, 0), op(8, 7, 0, 0, 0)].concat());
    Target { name: "store_dir", run, seeds, words: &[], cases: 600, memory: [96 << 20, 1000] }
}

fn damaged(input: &[u8]) -> Files {
    let Template { now, past } = template();
    let mut files = now.clone();
    for op in input.chunks_exact(8).take(6) {
        let names: Vec<String> = files.keys().cloned().collect();
        let Some(name) = names.get(usize::from(op[1]) % names.len().max(1)).cloned() else { break };
        let other = names[usize::from(op[2]) % names.len()].clone();
        let at = u32::from_le_bytes([op[3], op[4], op[5], op[6]]) as usize;
        let bytes = files.get_mut(&name).unwrap();
        let len = bytes.len().max(1);
        match op[0] % 9 {
            0 if !bytes.is_empty() => bytes[at % len] ^= 1 << (op[7] % 8),
            1 if !bytes.is_empty() => bytes[at % len] = op[7],
            2 => bytes.truncate(at % len),
            3 => bytes.extend(std::iter::repeat_n(op[7], at % 20_000)),
            4 => _ = files.remove(&name),
            5 => {
                let (a, b) = (files[&name].clone(), files[&other].clone());
                files.insert(name, b);
                files.insert(other, a);
            }
            6 => _ = files.insert(other, files[&name].clone()),
            7 => {
                let from = at % len / 4096 * 4096;
                let piece = bytes[from..(from + 4096).min(bytes.len())].to_vec();
                let to = usize::from(op[7]) * 4096 % len;
                let end = (to + piece.len()).min(bytes.len());
                bytes[to..end].copy_from_slice(&piece[..end - to]);
            }
            _ => {
                if let Some(old) = past.get(&name) {
                    files.insert(name, old.clone());
                }
            }
        }
    }
    files
}

fn run(input: &[u8]) {
    let files = damaged(input);
    let parent = scratch();
    let folder = parent.path();
    std::fs::remove_dir(folder).unwrap();
    std::fs::DirBuilder::new().create(folder).unwrap();
    for (name, bytes) in &files {
        std::fs::write(folder.join(name), bytes).unwrap();
    }
    make_private(folder);
    let Ok(spill) = SpillDir::open(folder, true) else { return };
    let Ok(opened) = Opened::open(Box::new(DriveFolder::new(folder)), config(&spill)) else {
        // A refused store is unchanged except for the lock and the witness.
        let after = contents(folder);
        for (name, bytes) in files.iter().filter(|(name, _)| !["LOCK", "witness"].contains(&name.as_str())) {
            assert_eq!(after.get(name), Some(bytes), "{name} was changed");
        }
        return;
    };
    let latest = opened.commits.generations().latest();
    assert!(latest == ROUNDS || latest == ROUNDS - 1, "opened at {latest}");
    assert_eq!(opened.run_state, latest.to_le_bytes());
    let pages: Vec<PageId> = opened.pages.iter().map(|p| p.page).collect();
    assert_eq!(pages, (0..PAGES).map(PageId::initial).collect::<Vec<_>>());
    let Some(mut store) = paged(&opened, folder, spill.format().layout) else { return };
    for (number, page) in (0..PAGES).zip(&opened.pages) {
        let buffer = store.new_buffer();
        store.read(1, page.page, &page.slot, buffer);
        let mut done = Vec::new();
        while done.is_empty() {
            store.complete(true, &mut done);
        }
        let end = done.remove(0);
        if let Ok(PageMoved::Read { payload_bytes }) = end.result {
            let expected = payload(page.page, version_at(number, latest));
            assert!(end.buffer.as_slice()[HEADER_BYTES..][..payload_bytes] == expected, "wrong bytes of page {number}");
        }
    }
}

fn make_private(_folder: &Path) {
    #[cfg(unix)]
    std::fs::set_permissions(_folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
}
