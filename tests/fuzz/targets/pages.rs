//! Slots: headers, references, labels, payloads in all codecs, and a slot through the store.

use super::{split_mode, with_mode};
use crate::Target;
use gsscale::base::ids::PageId;
use gsscale::page::engine::buffer::PageBuffer;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::page_engine::{Direction, PageEngine, Place, Transfer};
use gsscale::page::format::codec::{Codec, decode, encode_as};
use gsscale::page::format::slot_header::{
    HEADER_BYTES, LABEL_BYTES_MAX, SlotHeader, SlotRef, StoredAs, checksum, transfer_bytes,
};
use gsscale::page::format::spill_format::{FORMAT_BYTES, SpillFormat};
use gsscale::page::versions::paged_store::{PageMoved, PagedStore, PagedStoreConfig};
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::stored::{label, meta_from_label};
use gsscale::scene::page_layout::PageLayout;
use gsscale::scene::page_meta::{PageBounds, PageMeta};

const STORE: u128 = 0x5eed;
const CHECKSUM_BYTES: usize = 16;

fn page() -> PageId {
    PageId::initial(5)
}

fn slot(codec: StoredAs, stored: usize, payload: usize) -> SlotRef {
    SlotRef {
        place: Place { segment: 0, offset: 0 },
        stored_bytes: stored as u32,
        payload_bytes: payload as u32,
        generation: 3,
        checksum: 1 << 90,
        codec,
    }
}

fn header(slot: SlotRef) -> [u8; HEADER_BYTES] {
    let mut bytes = [0; HEADER_BYTES];
    SlotHeader { store: STORE, page: page(), serial: 9, slot, label: vec![7; 40] }.encode(&mut bytes);
    bytes
}

/// The input as an array, padded with zeros; with a valid checksum if `sealed`.
fn array<const N: usize>(input: &[u8], sealed: bool) -> [u8; N] {
    let mut bytes = [0; N];
    let len = input.len().min(N);
    bytes[..len].copy_from_slice(&input[..len]);
    if sealed {
        let (body, sum) = bytes.split_at_mut(N - CHECKSUM_BYTES);
        sum.copy_from_slice(&checksum(body).to_le_bytes());
    }
    bytes
}

pub const PAGE_ROWS: usize = 16;

const LAYOUT_OF_A_PAGE: PageLayout = PageLayout { rows: 12, sh_degree: 1 };

pub fn payload_bytes_of_a_page() -> usize {
    LAYOUT_OF_A_PAGE.bytes()
}

pub fn label_of_a_page() -> Vec<u8> {
    let bounds = PageBounds { lo: [1.0; 3], hi: [2.0; 3], sigma_max: 0.5 };
    let PageLayout { rows, sh_degree } = LAYOUT_OF_A_PAGE;
    label(&PageMeta { id: page(), rows: rows as u32, sh_degree, events_applied: 2, bounds }).to_vec()
}

pub fn slot_header() -> Target {
    let raw = slot(StoredAs::Raw, 700, 700);
    let layout = SlotLayout { slot_bytes: 8192, slots_per_segment: 4 };
    let format = SpillFormat { store: STORE, layout, compatible: 0 };
    let parts: [&[u8]; 4] = [&header(raw)[..200], &raw.to_bytes(), &label_of_a_page(), &format.to_bytes()];
    let seeds = (0..8).map(|mode| with_mode(mode, parts[usize::from(mode) / 2])).collect();
    Target { name: "slot_header", run: run_header, seeds, words: &[], cases: 60_000, memory: [16 << 10, 1] }
}

fn run_header(input: &[u8]) {
    let (mode, rest) = split_mode(input);
    let sealed = mode % 2 == 0;
    match mode / 2 % 4 {
        0 => {
            if let Ok(read) = SlotHeader::decode(&array(rest, sealed)) {
                assert!(read.label.len() <= LABEL_BYTES_MAX);
                let mut again = [0; HEADER_BYTES];
                read.encode(&mut again);
                assert_eq!(SlotHeader::decode(&again), Ok(read));
            }
        }
        1 => {
            let bytes: [u8; SlotRef::ENCODED_BYTES] = array(rest, false);
            if let Some(read) = SlotRef::from_bytes(&bytes) {
                assert_eq!(read.to_bytes(), bytes);
                assert!(read.transfer_bytes() >= HEADER_BYTES);
            }
        }
        2 => {
            if let Some(read) = meta_from_label(page(), rest) {
                assert_eq!(label(&read), rest);
                assert!(read.sh_degree <= 3);
            }
        }
        _ => {
            let bytes: [u8; FORMAT_BYTES] = array(rest, sealed);
            if let Ok(read) = SpillFormat::from_bytes(&bytes) {
                assert_eq!(SpillFormat::from_bytes(&read.to_bytes()), Ok(read));
                assert!(read.layout.is_possible());
            }
            assert!(rest.len() == FORMAT_BYTES || SpillFormat::from_bytes(rest).is_err());
        }
    }
}

/// Values as in pages: smooth, interleaved with 16-bit words.
fn payload(len: usize) -> Vec<u8> {
    let word = |i: usize| if i % 64 < 32 { (i as u32 & 0xff) << 20 } else { (i as f32 * 0.37).sin().to_bits() };
    (0..len.div_ceil(4)).flat_map(|i| word(i).to_le_bytes()).take(len).collect()
}

/// Mode 0: a payload to encode. Mode 1: a reference, then a slot. The others: a stored form, two bytes of length, stored bytes.
pub fn page_payload() -> Target {
    let mut seeds = vec![with_mode(0, &payload(5000))];
    for len in [100, 3000] {
        for form in StoredAs::ALL {
            let mut stored = vec![0; len];
            let encoded = encode_as(form.into(), &payload(len), &mut stored).unwrap();
            let bytes = encoded.map_or(payload(len), |(bytes, _)| stored[..bytes].to_vec());
            seeds.push(with_mode(2 + form as u8, &[(len as u16).to_le_bytes().as_slice(), &bytes].concat()));
        }
        let raw = slot(StoredAs::Raw, len, len);
        seeds.push(with_mode(1, &[raw.to_bytes().as_slice(), &payload(len)].concat()));
    }
    let memory = [1 << 20, 4];
    Target { name: "page_payload", run: run_payload, seeds, words: &[], cases: 20_000, memory }
}

fn run_payload(input: &[u8]) {
    let (mode, rest) = split_mode(input);
    match usize::from(mode) % (2 + StoredAs::ALL.len()) {
        0 => {
            for form in StoredAs::ALL {
                let mut stored = vec![0; rest.len()];
                let Some((bytes, stored_as)) = encode_as(form.into(), rest, &mut stored).unwrap() else { continue };
                assert!(bytes < rest.len());
                let mut back = vec![1; rest.len()];
                decode(&stored[..bytes], stored_as, &mut back).unwrap();
                assert_eq!(back, rest);
            }
        }
        1 => run_slot(rest),
        mode => {
            let Some((len, stored)) = rest.split_first_chunk() else { return };
            let codec = StoredAs::ALL[mode - 2];
            let mut out = vec![0; usize::from(u16::from_le_bytes(*len))];
            let first = decode(stored, codec, &mut out).is_ok();
            let mut again = vec![1; out.len()];
            assert_eq!(decode(stored, codec, &mut again).is_ok(), first);
            assert!(!first || out == again, "decoding leaves bytes as they were");
        }
    }
}

/// Reads a slot that matches the reference through the store, with a valid or a wrong checksum.
fn run_slot(input: &[u8]) {
    let Some((reference, bytes)) = input.split_first_chunk() else { return };
    let Some(mut wanted) = SlotRef::from_bytes(reference) else { return };
    let layout = SlotLayout { slot_bytes: transfer_bytes(8192) as u64, slots_per_segment: 2 };
    let room = layout.slot_bytes as usize - HEADER_BYTES;
    let mut buffer = PageBuffer::zeroed(layout.slot_bytes as usize);
    let stored = bytes.len().min(room);
    buffer.as_mut_slice()[HEADER_BYTES..][..stored].copy_from_slice(&bytes[..stored]);
    let padded = (wanted.stored_bytes as usize).min(room).next_multiple_of(4096);
    if wanted.checksum & 1 == 0 {
        wanted.checksum = checksum(&buffer.as_slice()[HEADER_BYTES..][..padded]);
    }
    buffer.as_mut_slice()[..HEADER_BYTES].copy_from_slice(&header(wanted));
    let mut engine = MemoryEngine::new();
    engine.create_segment(0, layout.segment_bytes()).unwrap();
    let place = Place { segment: 0, offset: 0 };
    let len = buffer.len();
    engine.submit(Transfer { token: 0, direction: Direction::Write, place, bytes: len, buffer });
    engine.complete(true, &mut Vec::new());
    let config = PagedStoreConfig { store: STORE, layout, codec: Codec::Raw, generation: 4, serial: 99 };
    let Ok(mut store) = PagedStore::open(Box::new(engine), config, 1, [&wanted]) else { return };
    let buffer = store.new_buffer();
    store.read(1, page(), &wanted, buffer);
    let mut done = Vec::new();
    store.complete(true, &mut done);
    if let Ok(PageMoved::Read { payload_bytes }) = done.remove(0).result {
        assert!(payload_bytes == wanted.payload_bytes as usize && payload_bytes <= room);
    }
}
