//! Pages in slots: exact bytes come back, every damage is found and named, no buffer is lost, and no slot of a kept
//! generation is overwritten, whatever fails.

use crate::support::faulty_engine::{Fault, Faults, FaultyEngine, Operation};
use gsscale::base::ids::PageId;
use gsscale::base::rng::mix64;
use gsscale::page::engine::buffer::PageBuffer;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::page_engine::{Completion, PageEngine, Place, Transfer};
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::{HEADER_BYTES, LABEL_BYTES_MAX, SlotHeader, SlotRef, StoredAs};
use gsscale::page::versions::page_error::PageError;
use gsscale::page::versions::paged_store::{PageDone, PageMoved, PagedStore, PagedStoreConfig};
use gsscale::page::versions::slots::{SlotLayout, SlotState};
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex};

const STORE: u128 = 0xabc;
const CAPACITY: usize = 20_000;
const CODECS: [Codec; 2] = [Codec::Raw, Codec::Zstd { level: 1 }];

/// An engine in memory that the test can change from outside and open a second time.
#[derive(Clone, Default)]
struct Shared(Arc<Mutex<MemoryEngine>>);

impl PageEngine for Shared {
    fn name(&self) -> &'static str {
        "memory"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        self.0.lock().unwrap().create_segment(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        self.0.lock().unwrap().submit(transfer);
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        self.0.lock().unwrap().complete(wait, done);
    }

    fn in_flight(&self) -> usize {
        self.0.lock().unwrap().in_flight()
    }

    fn sync(&mut self) -> io::Result<()> {
        self.0.lock().unwrap().sync()
    }
}

impl Shared {
    fn at(&self, place: Place, change: impl FnOnce(&mut [u8])) {
        change(&mut self.0.lock().unwrap().segment_mut(place.segment).unwrap()[place.offset as usize..]);
    }
}

fn config(codec: Codec) -> PagedStoreConfig {
    PagedStoreConfig { store: STORE, layout: SlotLayout::new(CAPACITY, 4), codec, generation: 1, serial: 0 }
}

fn faulty(codec: Codec) -> (PagedStore, Faults, Shared) {
    let (shared, faults) = (Shared::default(), Faults::new());
    let engine = FaultyEngine::new(Box::new(shared.clone()), faults.clone());
    (PagedStore::new(Box::new(engine), config(codec)), faults, shared)
}

/// A payload that compresses for even pages and does not compress for odd pages.
fn payload(page: u64, version: u64, bytes: usize) -> Vec<u8> {
    let noise = |i: usize| mix64((page << 40) ^ (version << 20) ^ i as u64) as u8;
    (0..bytes).map(|i| if page.is_multiple_of(2) && i % 4 > 0 { (page + version) as u8 } else { noise(i) }).collect()
}

fn id(page: u64) -> PageId {
    PageId::initial(page as u32)
}

fn filled(store: &PagedStore, payload: &[u8]) -> PageBuffer {
    let mut buffer = store.new_buffer();
    buffer.as_mut_slice().fill(0xee);
    buffer.as_mut_slice()[HEADER_BYTES..][..payload.len()].copy_from_slice(payload);
    buffer
}

fn one(store: &mut PagedStore) -> PageDone {
    let mut done = Vec::new();
    store.complete(true, &mut done);
    assert_eq!((done.len(), store.in_flight()), (1, 0));
    done.remove(0)
}

fn try_write(store: &mut PagedStore, page: u64, payload: &[u8]) -> Result<SlotRef, PageError> {
    let buffer = filled(store, payload);
    let length = buffer.len();
    let (buffer, result) = match store.write(page, id(page), b"label", payload.len(), buffer) {
        Ok(()) => {
            let done = one(store);
            assert_eq!((done.token, done.page), (page, id(page)));
            (done.buffer, done.result)
        }
        Err((error, buffer)) => (buffer, Err(error)),
    };
    assert_eq!(buffer.len(), length);
    assert!(buffer.as_slice()[HEADER_BYTES..].starts_with(payload), "the payload changed while it was written");
    result.map(|moved| match moved {
        PageMoved::Written(slot) => slot,
        PageMoved::Read { .. } => panic!("a write ended as a read"),
    })
}

fn write(store: &mut PagedStore, page: u64, payload: &[u8]) -> SlotRef {
    try_write(store, page, payload).expect("written")
}

fn try_read(store: &mut PagedStore, page: u64, slot: &SlotRef) -> Result<Vec<u8>, PageError> {
    let mut buffer = store.new_buffer();
    buffer.as_mut_slice().fill(0x11);
    let length = buffer.len();
    store.read(page, id(page), slot, buffer);
    let done = one(store);
    assert_eq!((done.token, done.page, done.buffer.len()), (page, id(page), length));
    done.result.map(|moved| match moved {
        PageMoved::Read { payload_bytes } => done.buffer.as_slice()[HEADER_BYTES..][..payload_bytes].to_vec(),
        PageMoved::Written(_) => panic!("a read ended as a write"),
    })
}

fn read(store: &mut PagedStore, page: u64, slot: &SlotRef) -> Vec<u8> {
    try_read(store, page, slot).expect("read")
}

fn assert_damaged(store: &mut PagedStore, page: u64, slot: &SlotRef, why: &str) {
    let error = try_read(store, page, slot).expect_err("returned as good");
    assert!(matches!(error, PageError::Damaged { .. }), "{error}");
    let place = format!(
        "page {page} of generation {} (seg-{:08}.dat, offset {})",
        slot.generation, slot.place.segment, slot.place.offset
    );
    assert!(error.to_string().contains(&place) && error.to_string().contains(why), "{error}");
}

#[test]
fn pages_round_trip_bit_for_bit() {
    for codec in CODECS {
        let mut store = PagedStore::new(Box::new(MemoryEngine::new()), config(codec));
        let mut kept = Vec::new();
        for page in 0..14 {
            let payload = payload(page, 0, [0, 1, 4095, 4096, 4097, 12_345, CAPACITY][page as usize % 7]);
            kept.push((write(&mut store, page, &payload), payload));
        }
        for (page, (slot, payload)) in kept.iter().enumerate() {
            assert!(read(&mut store, page as u64, slot) == *payload);
        }
        let traffic = store.traffic();
        let stored: u64 = kept.iter().map(|(slot, _)| slot.transfer_bytes() as u64).sum();
        assert_eq!((traffic.bytes_written, traffic.bytes_read, traffic.reads_repeated), (stored, stored, 0));
        let encoded = kept.iter().filter(|(slot, _)| slot.codec == StoredAs::ShuffledZstd).count();
        assert_eq!(encoded, if codec == Codec::Raw { 0 } else { 5 }, "even pages are, but not those of 0 and 1 byte");
        assert_eq!(store.staging_bytes() == 0, codec == Codec::Raw);
    }
}

/// A header holds everything needed to rebuild the index.
#[test]
fn slots_describe_themselves() {
    let (mut store, _, shared) = faulty(Codec::Raw);
    let first = write(&mut store, 3, &payload(3, 0, 5000));
    let label = vec![9; LABEL_BYTES_MAX];
    let buffer = filled(&store, &payload(3, 1, 100));
    store.write(0, id(3), &label, 100, buffer).unwrap();
    let PageMoved::Written(second) = one(&mut store).result.unwrap() else { panic!("not written") };
    let header = |slot: &SlotRef| {
        let mut bytes = [0; HEADER_BYTES];
        shared.at(slot.place, |slot| bytes.copy_from_slice(&slot[..HEADER_BYTES]));
        SlotHeader::decode(&bytes).unwrap()
    };
    assert_eq!((header(&first).store, header(&first).page, header(&first).slot), (STORE, id(3), first));
    assert_eq!((header(&second).label, header(&second).slot), (label, second));
    assert!(header(&first).serial < header(&second).serial, "which is the later version?");
}

/// Flips every bit of every version in a small store, one at a time, on the drive.
#[test]
fn every_flipped_bit_is_found_and_named() {
    for codec in CODECS {
        let (mut store, _, shared) = faulty(codec);
        for page in 0..2 {
            let payload = payload(page, 0, 3000);
            let slot = write(&mut store, page, &payload);
            for bit in 0..slot.transfer_bytes() * 8 {
                let flip = |slot: &mut [u8]| slot[bit / 8] ^= 1 << (bit % 8);
                shared.at(slot.place, flip);
                assert_damaged(&mut store, page, &slot, "remedy");
                shared.at(slot.place, flip);
            }
            // Bytes after the version do not belong to it.
            shared.at(slot.place, |there| there[slot.transfer_bytes()] ^= 1);
            assert!(read(&mut store, page, &slot) == payload);
        }
    }
}

#[test]
fn a_fault_that_a_second_read_mends_is_not_an_error() {
    let faults = [Fault::FlipBit(40_000), Fault::Error(io::ErrorKind::Other), Fault::Short, Fault::Torn, Fault::Lost];
    for (fault, codec) in faults.iter().flat_map(|fault| CODECS.map(|codec| (*fault, codec))) {
        let (mut store, faults, _) = faulty(codec);
        let slot = write(&mut store, 2, &payload(2, 0, 9000));
        // The store's staging buffers now hold another page, so that bytes which are not read cannot be right by
        // chance.
        write(&mut store, 4, &payload(4, 0, 9000));
        faults.add(Operation::Read, 0, false, fault);
        assert!(read(&mut store, 2, &slot) == payload(2, 0, 9000), "{fault:?}");
        assert_eq!(store.traffic().reads_repeated, 1);
        // Two failing reads are an error.
        write(&mut store, 4, &payload(4, 1, 9000));
        faults.add(Operation::Read, 2, true, fault);
        assert!(try_read(&mut store, 2, &slot).is_err(), "{fault:?}");
        assert!(store.poison().is_none(), "a bad read is no reason to stop writing");
    }
}

/// The error of a slot that holds something else gives the reason.
#[test]
fn misdirected_and_lost_transfers_are_found() {
    for codec in CODECS {
        let (mut store, faults, shared) = faulty(codec);
        let bytes = 9000;
        let [a, b] = [1, 2].map(|page| write(&mut store, page, &payload(page, 0, bytes)));
        faults.add(Operation::Read, 0, true, Fault::Misdirected(b.place));
        assert_damaged(&mut store, 1, &a, "it holds page 2 instead");
        faults.clear();
        // A write that went to the slot of another page: both pages are reported.
        faults.add(Operation::Write, 2, false, Fault::Misdirected(b.place));
        let c = write(&mut store, 4, &payload(4, 0, bytes));
        assert_damaged(&mut store, 4, &c, "there is no slot header here");
        assert_damaged(&mut store, 2, &b, "it holds page 4 instead");
        // Lost writes: over nothing, over an older version of the same page; and a torn write.
        store.free(&c);
        faults.add(Operation::Write, 3, true, Fault::Lost);
        let d = write(&mut store, 4, &payload(4, 1, bytes));
        assert_damaged(&mut store, 4, &d, "there is no slot header here");
        store.free(&a);
        let e = write(&mut store, 1, &payload(1, 1, bytes));
        assert_eq!(e.place, a.place);
        assert_damaged(&mut store, 1, &e, "another version of the page");
        faults.clear();
        faults.add(Operation::Write, 5, false, Fault::Torn);
        let f = write(&mut store, 1, &payload(1, 2, bytes));
        assert_damaged(&mut store, 1, &f, "");
        // A whole segment from another place or another store.
        let mut copy = vec![0; b.transfer_bytes()];
        let good = write(&mut store, 6, &payload(6, 0, bytes));
        shared.at(good.place, |slot| copy.copy_from_slice(&slot[..good.transfer_bytes()]));
        let moved = SlotRef { place: f.place, ..good };
        shared.at(f.place, |slot| slot[..copy.len()].copy_from_slice(&copy));
        assert_damaged(&mut store, 6, &moved, "its header names another place");
        let other = PagedStoreConfig { store: STORE + 1, ..config(codec) };
        let mut other = PagedStore::open(Box::new(shared), other, 2, [&good]).unwrap();
        assert_damaged(&mut other, 6, &good, "it belongs to another store");
    }
}

/// References that no store returned, as from a damaged index: an error, not a panic, and no byte beyond the slot is
/// read.
#[test]
fn hostile_references_end_in_an_error() {
    for codec in CODECS {
        let (mut store, _, _) = faulty(codec);
        let slot = write(&mut store, 2, &payload(2, 0, 9000));
        let place = |segment, offset| SlotRef { place: Place { segment, offset }, ..slot };
        let hostile = [
            SlotRef { stored_bytes: u32::MAX, ..slot },
            SlotRef { payload_bytes: u32::MAX, ..slot },
            SlotRef { stored_bytes: u32::MAX, payload_bytes: u32::MAX, codec: StoredAs::Raw, ..slot },
            SlotRef { stored_bytes: slot.stored_bytes - 1, ..slot },
            SlotRef { payload_bytes: 0, ..slot },
            SlotRef { generation: 7, ..slot },
            SlotRef { checksum: slot.checksum ^ 1, ..slot },
            SlotRef { codec: StoredAs::ShuffledZstd, payload_bytes: slot.payload_bytes + 1, ..slot },
            place(99, 0),
            place(0, u64::MAX - 4095),
            place(0, slot.place.offset + 4096),
        ];
        for wrong in hostile {
            assert!(try_read(&mut store, 2, &wrong).is_err(), "{wrong:?}");
        }
        store.read(0, id(2), &slot, PageBuffer::zeroed(4096));
        assert!(one(&mut store).result.is_err(), "a buffer that is too short");
        assert!(read(&mut store, 2, &slot) == payload(2, 0, 9000));
    }
}

#[test]
fn what_does_not_fit_is_refused_at_once() {
    let (mut store, _, _) = faulty(Codec::Raw);
    let room = store.capacity_bytes();
    assert!((CAPACITY..CAPACITY + 4096).contains(&room));
    let mut refuse = |label: &[u8], bytes: usize, buffer: PageBuffer| {
        let (error, _buffer) = store.write(0, id(0), label, bytes, buffer).unwrap_err();
        assert!(matches!(error, PageError::TooLong { .. }), "{error}");
    };
    refuse(b"", room + 1, PageBuffer::zeroed(room * 2));
    refuse(b"", 5000, PageBuffer::zeroed(HEADER_BYTES + 4096));
    refuse(b"", 0, PageBuffer::zeroed(0));
    refuse(&[0; LABEL_BYTES_MAX + 1], 1, PageBuffer::zeroed(room));
    assert_eq!((store.in_flight(), store.slots().total()), (0, 0), "a refusal takes no slot");
}

/// Drive errors end all writing; earlier pages remain readable.
#[test]
fn a_failed_write_or_sync_ends_all_writing() {
    for (codec, on) in CODECS.iter().flat_map(|codec| [(codec, Operation::Write), (codec, Operation::Sync)]) {
        let (mut store, faults, _) = faulty(*codec);
        let slot = write(&mut store, 2, &payload(2, 0, 9000));
        faults.add(on, u64::from(on == Operation::Write), false, Fault::Error(io::ErrorKind::Other));
        let error = match on {
            Operation::Write => try_write(&mut store, 4, &payload(4, 0, 9000)).unwrap_err(),
            _ => store.sync(&mut Vec::new()).unwrap_err(),
        };
        let told = error.to_string();
        assert!(matches!(error, PageError::Write { .. } | PageError::Sync { .. }) && told.contains("remedy"), "{told}");
        // A second attempt would succeed, as on Linux; it must not be made.
        let [writes, syncs] = [Operation::Write, Operation::Sync].map(|on| faults.count(on));
        let again = try_write(&mut store, 4, &payload(4, 0, 9000)).unwrap_err();
        assert!(matches!(again, PageError::Poisoned { .. }), "{again}");
        assert!(matches!(store.sync(&mut Vec::new()), Err(PageError::Poisoned { .. })));
        assert_eq!([Operation::Write, Operation::Sync].map(|on| faults.count(on)), [writes, syncs]);
        assert!(read(&mut store, 2, &slot) == payload(2, 0, 9000));
    }
}

/// A full drive is not a drive error: nothing is lost, and writing works again once there is space.
#[test]
fn a_full_drive_is_survived() {
    for codec in CODECS {
        for on in [Operation::Write, Operation::Create] {
            let (mut store, faults, _) = faulty(codec);
            faults.add(on, 0, false, Fault::Error(io::ErrorKind::StorageFull));
            let error = try_write(&mut store, 2, &payload(2, 0, 9000)).unwrap_err();
            assert!(error.is_out_of_space() && error.to_string().contains("free space"), "{error}");
            let slot = write(&mut store, 2, &payload(2, 0, 9000));
            assert_eq!(slot.place, Place { segment: 0, offset: 0 }, "the slot of the failed write was lost");
            assert!(read(&mut store, 2, &slot) == payload(2, 0, 9000));
            store.sync(&mut Vec::new()).unwrap();
        }
    }
}

/// Many transfers in flight complete in any order: each comes back once, with its own buffer and page.
#[test]
fn transfers_may_end_in_any_order() {
    for codec in CODECS {
        let (mut store, faults, _) = faulty(codec);
        faults.reorder(5);
        let pages = 0..40_u64;
        for page in pages.clone() {
            let buffer = filled(&store, &payload(page, 0, 9000));
            store.write(page, id(page), b"", 9000, buffer).unwrap();
        }
        assert_eq!(store.in_flight(), 40);
        let mut done = Vec::new();
        store.sync(&mut done).unwrap();
        let tokens: Vec<u64> = done.iter().map(|d| d.token).collect();
        assert!(done.len() == 40 && !tokens.is_sorted());
        let slots: BTreeMap<u64, SlotRef> = done
            .iter()
            .map(|d| match d.result {
                Ok(PageMoved::Written(slot)) => (d.token, slot),
                _ => panic!("{:?}", d.result),
            })
            .collect();
        for page in pages {
            store.read(page, id(page), &slots[&page], store.new_buffer());
        }
        done.clear();
        while store.in_flight() > 0 {
            store.complete(true, &mut done);
        }
        for d in &done {
            assert!(d.result.is_ok() && d.buffer.as_slice()[HEADER_BYTES..].starts_with(&payload(d.token, 0, 9000)));
        }
        assert_eq!(done.len(), 40);
    }
}

/// The expected state of the store: the payload of every version that an index names.
#[derive(Default)]
struct Run {
    /// Page to version number, reference.
    present: BTreeMap<u64, (u64, SlotRef)>,
    /// Committed generations that are kept.
    kept: BTreeMap<u64, BTreeMap<u64, (u64, SlotRef)>>,
    pinned: Vec<u64>,
    errors: usize,
}

const RUN_PAGES: u64 = 5;
const RUN_BYTES: usize = 5000;

impl Run {
    /// One write, with occasional reads, commits and pins; `step` decides them all.
    fn step(&mut self, store: &mut PagedStore, step: u64) {
        let page = mix64(step) % RUN_PAGES;
        if let Some((version, slot)) = self.present.get(&page).copied() {
            self.check(store, page, version, &slot);
        }
        match try_write(store, page, &payload(page, step, RUN_BYTES)) {
            Ok(slot) => {
                if let Some((_, old)) = self.present.insert(page, (step, slot)) {
                    store.free(&old);
                }
            }
            Err(_) => self.errors += 1,
        }
        if step % 4 == 3 {
            if store.sync(&mut Vec::new()).is_err() {
                self.errors += 1;
                return;
            }
            let generation = store.cut();
            let last = self.kept.last_key_value().map(|(generation, _)| *generation);
            if step % 8 == 7 {
                self.pinned.push(generation);
            }
            self.kept.insert(generation, self.present.clone());
            if let Some(last) = last.filter(|last| !self.pinned.contains(last)) {
                self.kept.remove(&last);
            }
            store.commit_done(generation, &self.pinned);
        }
    }

    /// Reads a version: the bytes as written, or an error, never other bytes.
    fn check(&mut self, store: &mut PagedStore, page: u64, version: u64, slot: &SlotRef) {
        match try_read(store, page, slot) {
            Ok(bytes) => assert!(bytes == payload(page, version, RUN_BYTES), "other bytes were returned as good"),
            Err(_) => self.errors += 1,
        }
    }

    /// Checks every version that an index names; returns how many could not be read.
    fn check_all(&mut self, store: &mut PagedStore) -> usize {
        let before = self.errors;
        for index in self.kept.clone().values().chain([&self.present.clone()]) {
            for (page, (version, slot)) in index {
                assert_ne!(store.slots().state(slot.place), Some(SlotState::Free));
                self.check(store, *page, *version, slot);
            }
        }
        self.errors - before
    }
}

/// Makes every operation of a run fail, once and permanently, in every way: no panic, no lost buffer, no wrong bytes.
/// Where the drive reports its results truthfully, every version reported as written is there.
#[test]
fn any_operation_may_fail_in_any_way() {
    use io::ErrorKind as K;
    const STEPS: u64 = 16;
    for codec in CODECS {
        let (mut store, faults, _) = faulty(codec);
        let mut run = Run::default();
        (0..STEPS).for_each(|step| run.step(&mut store, step));
        assert_eq!(run.errors, 0);
        let mut cases = 0;
        for on in [Operation::Read, Operation::Write, Operation::Sync, Operation::Create] {
            let operations = faults.count(on);
            assert!(operations > 0, "{on:?} never happens");
            let honest = [K::Other, K::StorageFull, K::TimedOut, K::ReadOnlyFilesystem, K::PermissionDenied]
                .map(Fault::Error)
                .into_iter()
                .chain([Fault::Short]);
            let elsewhere = Place { segment: 0, offset: 0 };
            let lies = [Fault::Torn, Fault::Lost, Fault::FlipBit(50_000), Fault::Misdirected(elsewhere)];
            let all = honest.map(|fault| (fault, true)).chain(lies.map(|fault| (fault, false)));
            for ((fault, is_honest), nth) in all.flat_map(|fault| (0..operations).map(move |nth| (fault, nth))) {
                for for_ever in [false, true] {
                    let (mut store, faults, _) = faulty(codec);
                    faults.add(on, nth, for_ever, fault);
                    let mut run = Run::default();
                    (0..STEPS).for_each(|step| run.step(&mut store, step));
                    faults.clear();
                    let unreadable = run.check_all(&mut store);
                    if is_honest || on != Operation::Write {
                        assert_eq!(unreadable, 0, "{codec} {on:?} {nth} {fault:?} for ever: {for_ever}");
                    }
                    let is_poisoned = store.poison().is_some();
                    let is_drive_error = is_honest && fault != Fault::Error(K::StorageFull);
                    if on == Operation::Write && is_honest {
                        assert_eq!(is_poisoned, is_drive_error, "{fault:?}");
                    }
                    cases += 1;
                }
            }
        }
        assert!(cases > 500, "{cases}");
    }
}
