//! Commits in a real folder: which pages come back, which generations stay, which stores are refused, and how redb
//! behaves.

use crate::support::guarded::{Change, Guarded, GuardedFolder};
use gsscale::base::ids::PageId;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::engine::segment_files::segment_file_name;
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::folder::spill_dir::SpillDir;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::{HEADER_BYTES, SlotRef};
use gsscale::page::map::commit::{
    CommitConfig, CommitError, Commits, Cut, MAP_NAME, PageChange, RESERVE_NAME, RESERVE_NEW_NAME, WITNESS_NAME,
};
use gsscale::page::map::entries::{MapBatch, MapError};
use gsscale::page::map::manifest::Manifest;
use gsscale::page::map::opening::Opened;
use gsscale::page::tool::reading::{Access, ReadError, StoreReader, WitnessRule, commit_config};
use gsscale::page::versions::page_error::PageError;
use gsscale::page::versions::paged_store::{PageDone, PageMoved, PagedStore};
use gsscale::page::versions::slots::SlotLayout;
use redb::backends::InMemoryBackend;
use redb::{Builder, ReadableDatabase, StorageBackend, TableDefinition};
use std::io::ErrorKind;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

const CONFIG: CommitConfig = CommitConfig { store: 77, cache_bytes: 1 << 20, reserve_bytes: 1 << 20 };
pub(super) const LAYOUT: SlotLayout = SlotLayout { slot_bytes: 8192, slots_per_segment: 4 };

fn create(folder: &Path) -> Result<Opened, CommitError> {
    Opened::create(Box::new(DriveFolder::new(folder)), CONFIG)
}

fn open(folder: &Path) -> Result<Opened, CommitError> {
    Opened::open(Box::new(DriveFolder::new(folder)), CONFIG)
}

pub(super) fn pages_of(opened: &Opened, folder: &Path) -> PagedStore {
    let engine = open_engine(IoEngine::Pread, folder, 2).unwrap().store;
    opened.paged_store(engine, LAYOUT, Codec::Raw).unwrap()
}

/// A spill directory with an empty store, as a run makes it.
fn create_spill(at: &Path) -> (SpillDir, CommitConfig, Commits, PagedStore) {
    let spill = SpillDir::create(at, LAYOUT, false).unwrap();
    let config = commit_config(spill.format().store);
    let opened = Opened::create(Box::new(DriveFolder::new(at)), config).unwrap();
    let store = pages_of(&opened, at);
    (spill, config, opened.commits, store)
}

pub(super) fn try_write(store: &mut PagedStore, page: u32, fill: u8) -> Result<SlotRef, PageError> {
    let mut buffer = store.new_buffer();
    buffer.as_mut_slice()[HEADER_BYTES..].fill(fill);
    store.write(1, PageId::initial(page), &[fill], 100, buffer).map_err(|(error, _)| error)?;
    let PageMoved::Written(slot) = next_done(store).result? else { panic!("not a write") };
    Ok(slot)
}

fn write(store: &mut PagedStore, page: u32, fill: u8) -> SlotRef {
    try_write(store, page, fill).unwrap()
}

fn next_done(store: &mut PagedStore) -> PageDone {
    let mut done = Vec::new();
    while done.is_empty() {
        store.complete(true, &mut done);
    }
    done.remove(0)
}

fn commit(commits: &mut Commits, store: &mut PagedStore, changed: &[(u32, Option<SlotRef>)], pin: Option<&str>) -> u64 {
    let changes: Vec<PageChange> = changed
        .iter()
        .map(|(page, slot)| PageChange { page: PageId::initial(*page), version: slot.map(|s| (s, vec![9])) })
        .collect();
    let run_state = store.generation().to_le_bytes();
    let cut = Cut { changes: &changes, run_state: &run_state, note: b"step", pin };
    commits.commit(store, &mut Vec::new(), &cut).unwrap()
}

pub(super) fn try_read(store: &mut PagedStore, page: u32, slot: &SlotRef) -> Result<u8, PageError> {
    let buffer = store.new_buffer();
    store.read(5, PageId::initial(page), slot, buffer);
    let end = next_done(store);
    end.result.map(|_| end.buffer.as_slice()[HEADER_BYTES])
}

fn read(store: &mut PagedStore, page: u32, slot: &SlotRef) -> u8 {
    try_read(store, page, slot).unwrap()
}

#[test]
fn generations_reopen_and_a_rollback_restores_an_older_one() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    assert!(matches!(open(at), Err(CommitError::NoStore)));
    let opened = create(at).unwrap();
    assert!(matches!(create(at), Err(CommitError::File { .. })), "a store is never overwritten");
    let mut store = pages_of(&opened, at);
    let mut commits = opened.commits;
    let first = [write(&mut store, 0, 10), write(&mut store, 1, 11)];
    assert_eq!(commit(&mut commits, &mut store, &[(0, Some(first[0])), (1, Some(first[1]))], Some("start")), 1);
    let mut before = first[0];
    for round in 0..4 {
        let slot = write(&mut store, 0, 20 + round);
        store.free(&before);
        before = slot;
        commit(&mut commits, &mut store, &[(0, Some(slot))], None);
    }
    drop((commits, store));
    let opened = open(at).unwrap();
    assert_eq!(opened.commits.generations().kept().collect::<Vec<_>>(), [1, 4, 5]);
    assert_eq!(opened.run_state, 5u64.to_le_bytes());
    assert_eq!(opened.commits.run_state(1).unwrap(), 1u64.to_le_bytes());
    let mut store = pages_of(&opened, at);
    assert_eq!(read(&mut store, 0, &opened.pages[0].slot), 23);
    assert_eq!(read(&mut store, 0, &opened.pages_at(4).unwrap()[0].slot), 22);
    assert_eq!(read(&mut store, 0, &opened.pages_at(1).unwrap()[0].slot), 10);
    assert!(matches!(opened.pages_at(3), Err(CommitError::NotKept(3))));
    // Generations 1, 4 and 5 name four slots; the slots of the rounds between them are free again.
    assert_eq!(store.slots().total() - store.slots().free(), 4);
    opened.commits.rollback(1).unwrap();
    let opened = open(at).unwrap();
    assert_eq!((opened.commits.generations().latest(), opened.commits.generations().next()), (1, 6));
    let mut store = pages_of(&opened, at);
    assert_eq!(read(&mut store, 0, &opened.pages[0].slot), 10);
    let mut commits = opened.commits;
    let slot = write(&mut store, 0, 99);
    assert_eq!(commit(&mut commits, &mut store, &[(0, Some(slot)), (1, None)], None), 6);
    drop((commits, store));
    let opened = open(at).unwrap();
    assert_eq!(opened.pages.iter().map(|p| p.page).collect::<Vec<_>>(), [PageId::initial(0)]);
}

/// Two pages in two segments, committed. The segment files have the length they were created with.
fn two_segments(at: &Path) {
    let opened = create(at).unwrap();
    let mut store = pages_of(&opened, at);
    let mut commits = opened.commits;
    let slots: Vec<SlotRef> = (0..5).map(|page| write(&mut store, page, 7)).collect();
    let changed: Vec<(u32, Option<SlotRef>)> = (0..5).map(|page| (page, Some(slots[page as usize]))).collect();
    commit(&mut commits, &mut store, &changed, None);
}

/// Readers and writers need the segments of kept pages; another one may be gone, and a writer makes it again.
#[test]
fn a_segment_without_kept_pages_may_be_gone() {
    let parent = tempfile::tempdir().unwrap();
    let at = parent.path().join("store");
    let (spill, config, mut commits, mut store) = create_spill(&at);
    let mut slots: Vec<SlotRef> = (0..5).map(|page| write(&mut store, page, 7)).collect();
    let changed = |pages: Range<u32>, slots: &[SlotRef]| -> Vec<(u32, Option<SlotRef>)> {
        pages.map(|page| (page, Some(slots[page as usize]))).collect()
    };
    commit(&mut commits, &mut store, &changed(0..5, &slots), None);
    // The pages leave the first segment, whose slots are free once the first generation is gone.
    for pages in [0..4, 4..5] {
        for page in pages.clone() {
            let slot = write(&mut store, page, 8);
            store.free(&std::mem::replace(&mut slots[page as usize], slot));
        }
        commit(&mut commits, &mut store, &changed(pages, &slots), None);
    }
    drop((commits, store, spill));
    let first = at.join(segment_file_name(0));
    std::fs::remove_file(&first).unwrap();
    let reader = StoreReader::open(&at, Access::Pages, WitnessRule::Obeyed).unwrap();
    let pages = reader.pages_at(reader.find(None).unwrap()).unwrap();
    assert!(pages.iter().all(|page| page.slot.place.segment > 0), "{pages:?}");
    assert!(reader.paged_store(&pages, 1).is_ok() && !first.exists(), "a reader writes nothing");
    drop(reader);
    let opened = Opened::open(Box::new(DriveFolder::new(&at)), config).unwrap();
    let engine = open_engine(IoEngine::Pread, &at, 2).unwrap().store;
    opened.check_segments(&*engine, LAYOUT).unwrap();
    assert!(!first.exists(), "a check writes nothing");
    let mut store = pages_of(&opened, &at);
    assert_eq!(std::fs::metadata(&first).unwrap().len(), LAYOUT.segment_bytes());
    assert!(opened.pages.iter().zip(0..).all(|(page, number)| read(&mut store, number, &page.slot) == 8));
}

/// With any engine: a segment that is missing, truncated at any block, too long, or not a file is reported by name, and
/// nothing changes.
#[test]
fn missing_cut_and_longer_segments_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    two_segments(at);
    let paths = [0, 1].map(|segment| at.join(segment_file_name(segment)));
    let bytes = paths.each_ref().map(|path| std::fs::read(path).unwrap());
    assert!(bytes.iter().all(|b| b.len() as u64 == LAYOUT.segment_bytes()));
    let refused = |names: &[&str]| {
        for engine in [IoEngine::Auto, IoEngine::Pread, IoEngine::Mmap] {
            let engine = open_engine(engine, at, 2).unwrap().store;
            let error = open(at).unwrap().paged_store(engine, LAYOUT, Codec::Raw).unwrap_err().to_string();
            assert!(names.iter().all(|name| error.contains(name)) && error.contains("remedy"), "{error}");
        }
    };
    for (path, bytes) in paths.iter().zip(&bytes) {
        let name = path.file_name().unwrap().to_str().unwrap();
        for cut in (0..bytes.len()).step_by(4096) {
            std::fs::write(path, &bytes[..cut]).unwrap();
            refused(&[name, &format!("{cut} bytes")]);
        }
        std::fs::write(path, [bytes.as_slice(), &[0]].concat()).unwrap();
        refused(&[name]);
        std::fs::remove_file(path).unwrap();
        refused(&[name]);
        std::fs::create_dir(path).unwrap();
        refused(&[name, "not a file"]);
        std::fs::remove_dir(path).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    paths.iter().for_each(|path| std::fs::remove_file(path).unwrap());
    refused(&["seg-00000000.dat", "seg-00000001.dat"]);
    for (path, bytes) in paths.iter().zip(&bytes) {
        std::fs::write(path, bytes).unwrap();
    }
    // A file outside the store stays untouched.
    std::fs::write(at.join(segment_file_name(7)), b"mine").unwrap();
    let opened = open(at).unwrap();
    let mut store = pages_of(&opened, at);
    assert!(opened.pages.iter().zip(0..).all(|(page, number)| read(&mut store, number, &page.slot) == 7));
    assert_eq!(std::fs::read(at.join(segment_file_name(7))).unwrap(), b"mine");
}

/// A map made by an attacker: valid seals, and numbers that would exhaust memory or overflow.
#[test]
fn hostile_maps_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    two_segments(at);
    let opened = open(at).unwrap();
    let mut store = pages_of(&opened, at);
    let mut commits = opened.commits;
    for segment in [u32::MAX, u32::MAX - 1, 1 << 20] {
        let mut slot = opened.pages[0].slot;
        slot.place.segment = segment;
        commit(&mut commits, &mut store, &[(0, Some(slot))], None);
        // The map is in memory twice only while it is read.
        let engine = open_engine(IoEngine::Pread, at, 2).unwrap().store;
        let error = open(at).unwrap().paged_store(engine, LAYOUT, Codec::Raw).unwrap_err();
        assert!(matches!(&error, CommitError::Segments(what) if what.contains("seg-")), "{error}");
    }
    for (latest, next) in [(1, u64::MAX), (1, 1 << 32), (u64::MAX - 1, u64::MAX)] {
        let file: Arc<dyn StorageBackend> = Arc::new(InMemoryBackend::new());
        let mut map = Manifest::create(Arc::clone(&file), 5, 1 << 18).unwrap();
        let put_generation = Some((latest, Vec::new(), Vec::new()));
        map.apply(&MapBatch { latest, next, put_generation, ..MapBatch::default() }).unwrap();
        drop(map);
        let error = Manifest::open(file, 5, 0, 1 << 18).err().unwrap();
        assert!(matches!(&error, MapError::Damaged(what) if what.contains("is impossible")), "{error}");
    }
}

/// The same for read-only access.
#[test]
fn hostile_maps_cost_readers_nothing() {
    let parent = tempfile::tempdir().unwrap();
    let at = parent.path().join("store");
    let (spill, _, mut commits, mut store) = create_spill(&at);
    let good = write(&mut store, 0, 7);
    for segment in [u32::MAX, u32::MAX - 1, 1 << 20] {
        let mut slot = good;
        slot.place.segment = segment;
        commit(&mut commits, &mut store, &[(0, Some(slot))], None);
    }
    commit(&mut commits, &mut store, &[(0, Some(good))], Some("good"));
    drop((commits, store, spill));
    let reader = StoreReader::open(&at, Access::Pages, WitnessRule::Obeyed).unwrap();
    let mut pages = reader.pages_at(reader.find(None).unwrap()).unwrap();
    assert!(reader.paged_store(&pages, 1).is_ok());
    let slot = pages[0].slot;
    let mut reading = reader.slot_reader();
    assert_eq!(reading.payload(PageId::initial(0), &slot).unwrap(), [7; 100]);
    // Longer than the file, and longer than a slot.
    let longer = |payload_bytes| SlotRef { stored_bytes: payload_bytes, payload_bytes, ..slot };
    let error = reading.payload(PageId::initial(0), &longer(4000)).unwrap_err();
    assert!(error.contains("another version"), "{error}");
    let error = reading.payload(PageId::initial(0), &longer(5000)).unwrap_err();
    assert!(error.contains("more than a slot holds"), "{error}");
    for segment in [u32::MAX, u32::MAX - 1, 1 << 20] {
        pages[0].slot.place.segment = segment;
        let error = reader.paged_store(&pages, 1).unwrap_err();
        assert!(matches!(&error, ReadError::Commit(CommitError::Segments(_))), "{error}");
    }
}

/// A partly filled reserve is not taken for a reserve: the file gets its name only after every byte was written.
#[test]
fn the_reserve_is_filled_whole_and_exists_until_it_is_given_up() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    drop(create(at).unwrap());
    let config = CommitConfig { reserve_bytes: 3 << 20, ..CONFIG };
    // As if the process were killed after the first piece.
    let stops = |change| if matches!(change, Change::WriteAt(1..)) { Err(ErrorKind::Other.into()) } else { Ok(()) };
    let killed = GuardedFolder::new(at, &[RESERVE_NEW_NAME], Arc::new(stops));
    let mut killed = Opened::open(Box::new(killed), config).unwrap().commits;
    assert!(killed.fill_reserve().is_err());
    drop(killed);
    let mut commits = Opened::open(Box::new(DriveFolder::new(at)), config).unwrap().commits;
    assert!(commits.fill_reserve().unwrap() && commits.fill_reserve().unwrap());
    let bytes = std::fs::read(at.join(RESERVE_NAME)).unwrap();
    assert!(bytes.len() == 3 << 20 && bytes.iter().all(|&byte| byte == 0x5a), "it is hollow");
    assert!(!at.join(RESERVE_NEW_NAME).exists());
    std::fs::write(at.join(RESERVE_NEW_NAME), b"left by a process that was killed").unwrap();
    assert!(commits.give_up_reserve().unwrap() && !commits.give_up_reserve().unwrap());
    assert!(!at.join(RESERVE_NAME).exists() && !at.join(RESERVE_NEW_NAME).exists());
}

#[cfg(unix)]
#[test]
fn links_in_place_of_the_map_are_refused_and_files_are_private() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    drop(create(folder.path()).unwrap());
    for name in [MAP_NAME, WITNESS_NAME] {
        let path = folder.path().join(name);
        assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600);
        let elsewhere = folder.path().join("elsewhere");
        std::fs::rename(&path, &elsewhere).unwrap();
        std::os::unix::fs::symlink(&elsewhere, &path).unwrap();
        assert!(matches!(open(folder.path()), Err(CommitError::File { .. })));
        std::fs::remove_file(&path).unwrap();
        std::fs::rename(&elsewhere, &path).unwrap();
    }
    assert!(open(folder.path()).is_ok());
}

#[test]
fn another_stores_map_and_a_missing_witness_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    drop(create(folder.path()).unwrap());
    let other = CommitConfig { store: 78, ..CONFIG };
    assert!(Opened::open(Box::new(DriveFolder::new(folder.path())), other).is_err());
    std::fs::remove_file(folder.path().join(WITNESS_NAME)).unwrap();
    let error = open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("witness") && error.contains("remedy"), "{error}");
}

const TABLE: TableDefinition<'_, u32, u32> = TableDefinition::new("t");
/// Where redb keeps the bit that selects its valid root. No checksum covers this bit.
const PRIMARY_BYTE: u64 = 9;

fn flip_primary(file: &dyn StorageBackend) {
    let mut byte = [0];
    file.read(PRIMARY_BYTE, &mut byte).unwrap();
    file.write(PRIMARY_BYTE, &[byte[0] ^ 1]).unwrap();
}

fn memory() -> Guarded {
    Guarded(Arc::new(InMemoryBackend::new()), Arc::new(|_| Ok(())))
}

/// A counterexample inside redb, kept as a test: one flipped bit silently undoes the last two-phase commit, even with
/// the integrity check at opening.
#[test]
fn one_flipped_bit_makes_redb_forget_a_durable_commit() {
    let shared = memory();
    let builder = || {
        let mut builder = Builder::new();
        builder.set_check_integrity_on_open(true);
        builder
    };
    let database = builder().create_with_backend(shared.clone()).unwrap();
    for value in 1..=2 {
        let mut transaction = database.begin_write().unwrap();
        transaction.set_two_phase_commit(true);
        transaction.open_table(TABLE).unwrap().insert(0, value).unwrap();
        transaction.commit().unwrap();
    }
    // Like a crash: closing writes nothing.
    let crashed = memory();
    let mut bytes = vec![0; shared.len().unwrap() as usize];
    shared.read(0, &mut bytes).unwrap();
    crashed.set_len(bytes.len() as u64).unwrap();
    crashed.write(0, &bytes).unwrap();
    flip_primary(&crashed);
    let again = builder().create_with_backend(crashed).expect("the library notices by now: simplify the witness");
    let value = again.begin_read().unwrap().open_table(TABLE).unwrap().get(0).unwrap().unwrap().value();
    assert_eq!(value, 1, "the library returns the transaction before the last one");
}

#[test]
fn the_witness_detects_a_stale_map_that_redb_accepts() {
    let shared = memory();
    let mut map = Manifest::create(Arc::new(shared.clone()), 5, 1 << 20).unwrap();
    for generation in 1..=2 {
        let put_generation = Some((generation, vec![1], vec![2]));
        map.apply(&MapBatch { put_generation, latest: generation, next: generation + 1, ..MapBatch::default() })
            .unwrap();
    }
    let acknowledged = map.counters().sequence;
    drop(map);
    flip_primary(&shared);
    let mut before = vec![0; shared.len().unwrap() as usize];
    shared.read(0, &mut before).unwrap();
    match Manifest::open(Arc::new(shared.clone()), 5, acknowledged, 1 << 20) {
        Err(MapError::Stale { found, .. }) => assert_eq!(found, acknowledged - 1),
        other => panic!("{other:?}"),
    }
    let mut after = vec![0; before.len()];
    shared.read(0, &mut after).unwrap();
    assert!(before == after, "a refused map changed");
    flip_primary(&shared);
    let (map, content) = Manifest::open(Arc::new(shared), 5, acknowledged, 1 << 20).unwrap();
    assert_eq!((content.counters.latest, map.run_state(2).unwrap()), (2, vec![2]));
}
