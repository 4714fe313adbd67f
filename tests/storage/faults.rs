//! The fault matrix of the store: what may go wrong, what happens then, and which test shows it. Tests that have no better
//! place are here; the first one sees to it that every test that is named exists.
//!
//! | fault | what happens | tests |
//! | --- | --- | --- |
//! | process killed anywhere | opens at the last acknowledged commit, or the one under way | crash: no_acknowledged_commit_is_lost_and_no_wrong_byte_returned; resume: a_run_that_is_killed_at_any_time_ends_with_the_same_bytes |
//! | power loss: writes lost, torn, reordered | the same | crash: every_crash_point_of_a_small_run_opens_at_an_acknowledged_state |
//! | folder entry lost | nothing durable names a file whose entry is not | crash: every_mutant_is_noticed |
//! | short, interrupted, EAGAIN | resumed a bounded number of times, then an error | src/page/engine/short_transfers: what_cannot_go_on_is_an_error_at_once_or_after_some_tries; src/page/engine/short_transfers: a_transfer_in_interrupted_parts_arrives_whole; engines: a_short_answer_of_the_ring_is_resumed; crash: every_call_of_a_small_run_may_fail |
//! | EIO on read | read once more; then named with page, generation and place; an earlier generation can be gone back to | store: a_fault_that_a_second_read_mends_is_not_an_error; commits: generations_reopen_and_a_rollback_restores_an_older_one |
//! | EIO on write, any error of a sync | nothing is written any more; the last acknowledged commit stands | store: a_failed_write_or_sync_ends_all_writing; paging: a_sync_without_space_ends_all_commits; crash: every_call_of_a_small_run_may_fail; paging: a_drive_that_fails_for_ever_loses_nothing_that_is_in_memory |
//! | ENOSPC, not of a sync | no poison: the same call works when there is space; the reserve is used | paging: pages_of_a_commit_that_was_durable_after_all_go_with_the_next_one; store: a_full_drive_is_survived; paging: a_full_drive_can_be_waited_for; commits: the_reserve_is_filled_whole_and_exists_until_it_is_given_up |
//! | limit on the length of files | as ENOSPC, for segments and the map | faults: a_limit_on_the_length_of_files_is_a_full_drive |
//! | flipped bit in a page or its header | found and named, never returned as good | store: every_flipped_bit_is_found_and_named |
//! | flipped bit in map, witness or FORMAT | refused, or nothing is different | faults: a_flipped_bit_anywhere_in_the_map_is_noticed_or_harmless; spill_dir: left_over_directories_are_refused_with_the_remedy; src/page/format/spill_format: every_flipped_bit_and_every_cut_is_found |
//! | misdirected read or write, lost write | named as damage, at both places | store: misdirected_and_lost_transfers_are_found |
//! | old map put back | refused | commits: the_witness_detects_a_stale_map_that_redb_accepts |
//! | old map and old witness put back | that older generation, whole; pages that were overwritten since are named | faults: an_older_map_with_its_witness_is_that_generation_or_names_pages |
//! | segment missing, cut, longer, or one more | refused with a list; one more stays untouched | commits: missing_cut_and_longer_segments_are_refused_by_name |
//! | anything in the folder damaged | one of the above | fuzz: store_dir; fuzz: map_values |
//! | map of another store, links in place of files | refused | commits: another_stores_map_and_a_missing_witness_are_refused; commits: links_in_place_of_the_map_are_refused_and_files_are_private |
//! | folder read-only from the start | refused | spill_dir: read_only_folders_are_refused |
//! | drive read-only or rights lost later | as EIO | store: any_operation_may_fail_in_any_way |
//! | folder moved away in use | what was acknowledged is where the folder is; growing is an error | faults: a_folder_that_is_moved_away_keeps_its_commits |
//! | few file handles | files are closed and opened again | engines: more_segments_than_open_files |
//! | two processes | exactly one has the folder | spill_dir: of_many_racing_processes_one_wins; spill_dir: two_processes_never_share_a_directory |
//! | clock jumps, sleep | no decision reads the wall clock | faults: no_decision_reads_the_wall_clock |
//! | slow drive | transfers in flight are bounded in bytes; others may end in any order and time | paging: what_moves_ahead_at_a_slow_drive_is_bounded_in_bytes; store: transfers_may_end_in_any_order |
//! | device lost | named, last good step written | gpu_train: a_device_that_fails_in_mid_run_leaves_the_last_good_step |
//! | newer format | refused with both versions | fuzz: slot_header |
//!
//! No tests of their own: no memory and a panic in a worker end the process, which is a kill, and nothing is committed
//! meanwhile; other endianness does not compile.

use super::commits::{pages_of, try_read, try_write};
#[cfg(unix)]
use super::engines::limit_files;
#[cfg(unix)]
use crate::support::child::in_child;
use crate::support::hush::hush_library_panics;
use gsscale::base::ids::PageId;
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::format::slot_header::SlotRef;
use gsscale::page::map::commit::{CommitConfig, CommitError, Commits, Cut, MAP_NAME, PageChange, WITNESS_NAME};
use gsscale::page::map::manifest::Manifest;
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::page_error::PageError;
use gsscale::page::versions::paged_store::PagedStore;
use redb::StorageBackend;
use redb::backends::InMemoryBackend;
use std::path::{MAIN_SEPARATOR, Path, PathBuf};
use std::sync::Arc;

const CONFIG: CommitConfig = CommitConfig { store: 77, cache_bytes: 1 << 18, reserve_bytes: 0 };

/// An open store and the pages of its last commit.
struct Store {
    commits: Commits,
    pages: PagedStore,
    slots: Vec<Option<SlotRef>>,
}

impl Store {
    fn new(at: &Path, opened: Opened) -> Store {
        let pages = pages_of(&opened, at);
        let mut slots = vec![None; 64];
        for page in &opened.pages {
            slots[(page.page.to_bits() >> 32) as usize] = Some(page.slot);
        }
        Store { commits: opened.commits, pages, slots }
    }

    fn create(at: &Path) -> Store {
        Store::new(at, Opened::create(Box::new(DriveFolder::new(at)), CONFIG).unwrap())
    }

    fn open(at: &Path) -> Result<Store, CommitError> {
        Ok(Store::new(at, Opened::open(Box::new(DriveFolder::new(at)), CONFIG)?))
    }

    fn write(&mut self, page: u32, fill: u8) -> Result<(), PageError> {
        let slot = try_write(&mut self.pages, page, fill)?;
        if let Some(before) = self.slots[page as usize].replace(slot) {
            self.pages.free(&before);
        }
        Ok(())
    }

    fn commit(&mut self) -> Result<u64, CommitError> {
        let version = |slot: &Option<SlotRef>| slot.map(|slot| (slot, vec![9]));
        let pages = self.slots.iter().zip(0..).filter(|(slot, _)| slot.is_some());
        let changes: Vec<PageChange> =
            pages.map(|(slot, page)| PageChange { page: PageId::initial(page), version: version(slot) }).collect();
        let run_state = self.pages.generation().to_le_bytes();
        let cut = Cut { changes: &changes, run_state: &run_state, note: b"", pin: None };
        self.commits.commit(&mut self.pages, &mut Vec::new(), &cut)
    }

    fn read(&mut self, page: u32) -> Result<u8, PageError> {
        try_read(&mut self.pages, page, &self.slots[page as usize].unwrap())
    }
}

#[test]
fn every_test_of_the_matrix_exists() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let text = std::fs::read_to_string(root.join("tests/storage/faults.rs")).unwrap();
    let rows = text.lines().filter_map(|line| line.strip_prefix("//! | ")).skip(2);
    let mut named = 0;
    for row in rows {
        let tests = row.trim_end_matches(" |").rsplit(" | ").next().unwrap();
        for test in tests.split("; ") {
            let (file, name) = test.split_once(": ").unwrap_or_else(|| panic!("{row}"));
            // A source file, or a suite: a file or a folder of a test binary. A fuzz target is a function of its name.
            let mut files = Vec::new();
            for folder in ["", "tests", "tests/storage", "tests/programs"].map(|folder| root.join(folder).join(file)) {
                files.push(folder.with_extension("rs"));
                files.extend(std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()));
            }
            let is_code = |line: &str| !line.trim_start().starts_with("//") && line.contains(name);
            let holds_it = |file: &PathBuf| std::fs::read_to_string(file).is_ok_and(|text| text.lines().any(is_code));
            assert!(files.iter().any(holds_it), "{test} does not exist");
            named += 1;
        }
    }
    assert!(named > 30, "{named}");
}

/// Flips one bit of every used byte of a small map and its witness: of every seventh byte in a plain run, of all with
/// `GSSCALE_FLIPS`. A map that still opens equals the last one, entry for entry.
#[test]
fn a_flipped_bit_anywhere_in_the_map_is_noticed_or_harmless() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = Store::create(folder.path());
    for round in 1..4 {
        (0..3).for_each(|page| store.write(page, round).unwrap());
        store.commit().unwrap();
    }
    drop(store);
    let bytes = std::fs::read(folder.path().join(MAP_NAME)).unwrap();
    let sequence = Store::open(folder.path()).unwrap().commits.generations().latest() + 1;
    let open = |bytes: &[u8]| {
        let file: Arc<dyn StorageBackend> = Arc::new(InMemoryBackend::new());
        file.set_len(bytes.len() as u64).unwrap();
        file.write(0, bytes).unwrap();
        Manifest::open(file, CONFIG.store, sequence, CONFIG.cache_bytes).map(|(_, content)| content)
    };
    hush_library_panics();
    let good = open(&bytes).unwrap();
    let used: Vec<usize> = (0..bytes.len()).filter(|&at| bytes[at] != 0 || at < 512).collect();
    let stride = if std::env::var_os("GSSCALE_FLIPS").is_some() { 1 } else { 7 };
    let (mut noticed, mut tried) = (0, 0);
    for &at in used.iter().step_by(stride) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1 << (at % 8);
        tried += 1;
        match open(&damaged) {
            Err(_) => noticed += 1,
            Ok(content) => {
                assert_eq!(content.versions, good.versions, "byte {at}");
                assert_eq!((content.counters, &content.pins), (good.counters, &good.pins), "byte {at}");
                assert_eq!(content.generations, good.generations, "byte {at}");
            }
        }
    }
    println!("{tried} flips of {} used bytes, {noticed} noticed, the others in bytes that are not read", used.len());
    // Most used bytes belong to freed pages and to redb's bitmaps; everything that counts is compared above.
    assert!(noticed > 50, "{noticed} of {tried}");
}

#[test]
fn an_older_map_with_its_witness_is_that_generation_or_names_pages() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mut store = Store::create(at);
    (0..3).for_each(|page| store.write(page, 1).unwrap());
    store.commit().unwrap();
    let old = [MAP_NAME, WITNESS_NAME].map(|name| (name, std::fs::read(at.join(name)).unwrap()));
    // Page 2 stays; the fourth round overwrites slots of page 0's first version.
    for round in 2..6 {
        store.write(0, round).unwrap();
        store.commit().unwrap();
    }
    drop(store);
    old.iter().for_each(|(name, bytes)| std::fs::write(at.join(name), bytes).unwrap());
    let mut store = Store::open(at).unwrap();
    assert_eq!(store.commits.generations().latest(), 1);
    assert_eq!([store.read(1).unwrap(), store.read(2).unwrap()], [1, 1]);
    let error = store.read(0).unwrap_err();
    assert!(
        matches!(error, PageError::Damaged { .. }) && error.to_string().contains("page 0 of generation 1"),
        "{error}"
    );
}

#[test]
fn a_folder_that_is_moved_away_keeps_its_commits() {
    let parent = tempfile::tempdir().unwrap();
    let (at, moved) = (parent.path().join("store"), parent.path().join("moved"));
    std::fs::create_dir(&at).unwrap();
    let mut store = Store::create(&at);
    (0..3).for_each(|page| store.write(page, 1).unwrap());
    let mut latest = store.commit().unwrap();
    std::fs::rename(&at, &moved).unwrap();
    // Open files keep working. A new segment cannot be created, and that loses nothing.
    store.write(3, 1).unwrap();
    let error = store.write(4, 1).unwrap_err();
    assert!(matches!(error, PageError::Grow { segment: 1, .. }) && error.to_string().contains("remedy"), "{error}");
    if let Ok(generation) = store.commit() {
        latest = generation;
    }
    drop(store);
    let mut store = Store::open(&moved).unwrap();
    assert_eq!(store.commits.generations().latest(), latest);
    assert!((0..3).all(|page| store.read(page).unwrap() == 1));
    assert!(!at.exists(), "nothing is made where the folder was");
}

#[test]
#[cfg(unix)]
fn a_limit_on_the_length_of_files_is_a_full_drive() {
    if !in_child(module_path!(), "a_limit_on_the_length_of_files_is_a_full_drive") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut store = Store::create(folder.path());
    (0..4).for_each(|page| store.write(page, 1).unwrap());
    store.commit().unwrap();
    // Neither a segment of 32 KiB nor the map may be written beyond the first 16 KiB.
    limit_files(Some(16 << 10));
    let error = store.write(4, 1).unwrap_err();
    assert!(error.is_out_of_space(), "{error}");
    let error = store.commit().unwrap_err();
    assert!(error.is_out_of_space(), "{error}");
    limit_files(None);
    store.write(4, 1).unwrap();
    let latest = store.commit().unwrap();
    drop(store);
    let mut store = Store::open(folder.path()).unwrap();
    assert_eq!(store.commits.generations().latest(), latest);
    assert!((0..5).all(|page| store.read(page).unwrap() == 1));
}

/// The wall clock may jump. Identities and the times in event files are read from it, and `gsscale-cells status` calls an owner lost by it.
#[test]
fn no_decision_reads_the_wall_clock() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let (mut folders, mut readers) = (vec![root.join("src"), root.join("tools")], Vec::new());
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()) {
            if path.is_dir() {
                folders.push(path);
            } else if std::fs::read_to_string(&path).is_ok_and(|text| text.contains("SystemTime")) {
                readers.push(path.strip_prefix(&root).unwrap().to_string_lossy().replace(MAIN_SEPARATOR, "/"));
            }
        }
    }
    readers.sort();
    assert_eq!(readers, ["src/base/identity.rs", "src/exchange/tensorboard.rs"]);
}
