//! What pages in slots promise: exact bytes back, every damage named, no lost buffer, whatever fails.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use gsscale::base::ids::PageId;
use gsscale::base::rng::mix64;
use gsscale::page::buffer::PageBuffer;
use gsscale::page::codec::Codec;
use gsscale::page::format::{HEADER_BYTES, SlotRef};
use gsscale::page::memory_store::MemoryStore;
use gsscale::page::paged_store::{PageDone, PageMoved, PagedStore, PagedStoreConfig};
use gsscale::page::slots::SlotLayout;

const CAPACITY: usize = 20_000;
const CODECS: [Codec; 2] = [Codec::Raw, Codec::Zstd { level: 1 }];

fn config(codec: Codec) -> PagedStoreConfig {
    PagedStoreConfig { store: 0xabc, layout: SlotLayout::new(CAPACITY, 4), codec, generation: 1, serial: 0 }
}

/// A payload that compresses for even pages and does not for odd ones.
fn payload(page: u64, version: u64, bytes: usize) -> Vec<u8> {
    let noise = |i: usize| mix64((page << 40) ^ (version << 20) ^ i as u64) as u8;
    (0..bytes).map(|i| if page % 2 == 0 && i % 4 > 0 { (page + version) as u8 } else { noise(i) }).collect()
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

fn write(store: &mut PagedStore, page: u64, payload: &[u8]) -> SlotRef {
    let buffer = filled(store, payload);
    store.write(page, PageId::initial(page as u32), b"label", payload.len(), buffer).expect("accepted");
    let done = one(store);
    assert_eq!(done.token, page);
    assert!(done.buffer.as_slice()[HEADER_BYTES..].starts_with(payload), "the payload changed while it was written");
    match done.result {
        Ok(PageMoved::Written(slot)) => slot,
        other => panic!("{other:?}"),
    }
}

fn read(store: &mut PagedStore, page: u64, slot: &SlotRef) -> PageDone {
    let mut buffer = store.new_buffer();
    buffer.as_mut_slice().fill(0x11);
    store.read(page, PageId::initial(page as u32), slot, buffer);
    one(store)
}

fn assert_reads(store: &mut PagedStore, page: u64, slot: &SlotRef, payload: &[u8]) {
    let done = read(store, page, slot);
    assert_eq!(done.result.expect("read"), PageMoved::Read { payload_bytes: payload.len() });
    assert!(done.buffer.as_slice()[HEADER_BYTES..].starts_with(payload));
}

#[test]
fn pages_come_back_to_the_bit() {
    for codec in CODECS {
        let mut store = PagedStore::new(Box::new(MemoryStore::new()), config(codec));
        let mut kept = Vec::new();
        for page in 0..10 {
            let payload = payload(page, 0, [0, 1, 4095, 4096, 4097, 12_345, CAPACITY][page as usize % 7]);
            kept.push((write(&mut store, page, &payload), payload));
        }
        for (page, (slot, payload)) in kept.iter().enumerate() {
            assert_reads(&mut store, page as u64, slot, payload);
        }
        let traffic = store.traffic();
        let stored: usize = kept.iter().map(|(slot, _)| slot.transfer_bytes()).sum();
        assert_eq!(
            (traffic.bytes_written, traffic.bytes_read, traffic.reads_repeated),
            (stored as u64, stored as u64, 0)
        );
    }
}
