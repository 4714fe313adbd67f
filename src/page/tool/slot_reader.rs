//! Reads single slots for tools that inspect a store, and finds versions of pages by their slot headers for a store whose map is
//! lost: no engine, no threads, no writes.
//!
//! Invariants: 1. bytes are returned only if [`crate::page::format::verify`] found them to be the requested version; 2.
//! memory is bounded by the actual size of a slot and its file, not by the largest size that the layout could state; 3. what a
//! scan finds is only what headers claim: [`SlotReader`] tells whether a payload is intact.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageId;
use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::{open_for_reading, segment_file_name};
use crate::page::folder::protocol_files::DriveFile;
use crate::page::folder::spill_dir::segments_in;
use crate::page::format::slot_header::{HEADER_BYTES, HeaderError, SlotHeader, SlotRef, StoredAs, transfer_bytes};
use crate::page::format::verify::{verify, verify_identity};
use crate::page::versions::slots::SlotLayout;
use redb::StorageBackend;
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

/// Reads the slots of one store.
#[derive(Debug)]
pub struct SlotReader {
    folder: PathBuf,
    store: u128,
    slot_bytes: u64,
    /// The segment read last, and its length.
    file: Option<(u32, DriveFile, u64)>,
    stored: PageBuffer,
    decoded: PageBuffer,
}

impl SlotReader {
    pub fn new(folder: &Path, store: u128, slot_bytes: u64) -> SlotReader {
        let buffer = || PageBuffer::zeroed(HEADER_BYTES);
        SlotReader { folder: folder.to_path_buf(), store, slot_bytes, file: None, stored: buffer(), decoded: buffer() }
    }

    /// Checks by the header alone that version `slot` of `page` is in its place, and returns the header.
    /// Errors: the problem, as text for users.
    pub fn check_header(&mut self, page: PageId, slot: &SlotRef) -> Result<SlotHeader, String> {
        let header = self.header_at(slot.place)?;
        verify_identity(self.store, page, slot, &header)?;
        let end = slot.place.offset.saturating_add(slot.transfer_bytes() as u64);
        match &self.file {
            Some((_, _, bytes)) if end > *bytes => Err("the segment ends inside the slot".to_string()),
            _ => Ok(header),
        }
    }

    /// The header at `place`, of whatever page.
    /// Errors: the problem, as text for users.
    pub fn header_at(&mut self, place: Place) -> Result<SlotHeader, String> {
        let bytes = self.read(place, HEADER_BYTES)?.first_chunk().ok_or("the slot is shorter than its header")?;
        SlotHeader::decode(bytes).map_err(|e| e.to_string())
    }

    /// The payload of version `slot` of `page`, verified and decoded; aligned for its tables.
    /// Errors: the problem, as text for users.
    pub fn payload(&mut self, page: PageId, slot: &SlotRef) -> Result<&[u8], String> {
        let bytes = slot.transfer_bytes();
        let needed = bytes.max(transfer_bytes(slot.payload_bytes as usize));
        if needed as u64 > self.slot_bytes {
            return Err(format!("the map states {bytes} bytes, more than a slot holds"));
        }
        self.read(slot.place, bytes)?;
        if slot.codec != StoredAs::Raw {
            ensure_len(&mut self.decoded, needed);
        }
        let decoded = self.decoded.as_mut_slice();
        verify(self.store, page, slot, &self.stored.as_slice()[..bytes], Some(decoded))?;
        let whole = if slot.codec == StoredAs::Raw { &self.stored } else { &self.decoded };
        Ok(&whole.as_slice()[HEADER_BYTES..][..slot.payload_bytes as usize])
    }

    /// Reads bytes into the buffer.
    fn read(&mut self, place: Place, bytes: usize) -> Result<&[u8], String> {
        let failed = |e: io::Error| match e.kind() {
            io::ErrorKind::NotFound => format!("{} is missing", segment_file_name(place.segment)),
            io::ErrorKind::UnexpectedEof => "the segment ends inside the slot".to_string(),
            _ => format!("it cannot be read: {e}"),
        };
        if self.file.as_ref().is_none_or(|(segment, ..)| *segment != place.segment) {
            let name = segment_file_name(place.segment);
            let file = open_for_reading(&self.folder.join(&name)).map_err(failed)?;
            let metadata = file.metadata().map_err(failed)?;
            if !metadata.is_file() {
                return Err(format!("{name} is not a file"));
            }
            self.file = Some((place.segment, DriveFile::new(file), metadata.len()));
        }
        let Some((_, file, length)) = &self.file else { return Ok(&[]) };
        if place.offset.saturating_add(bytes as u64) > *length {
            return Err(failed(io::ErrorKind::UnexpectedEof.into()));
        }
        ensure_len(&mut self.stored, bytes);
        let buffer = &mut self.stored.as_mut_slice()[..bytes];
        file.read(place.offset, buffer).map_err(failed)?;
        Ok(buffer)
    }
}

/// Replaces the buffer with a longer one if it is too short; its content is then lost.
fn ensure_len(buffer: &mut PageBuffer, bytes: usize) {
    if buffer.len() < bytes {
        *buffer = PageBuffer::zeroed(bytes);
    }
}

/// Result of a scan of all segments.
#[derive(Debug, Default)]
pub struct Scan {
    /// Headers that are at the place they name, by store.
    pub found: BTreeMap<u128, Vec<SlotHeader>>,
    /// Places whose header has a broken checksum or names another place, with the problem.
    pub broken: Vec<(Place, String)>,
    /// Segments that end before their last slot, with their lengths.
    pub short: Vec<(u32, u64)>,
    /// Number of segment files read.
    pub segments: u64,
}

/// Reads the header of every slot. Without the store's layout, tries every multiple of [`ALIGNMENT`].
/// Errors: the folder or a segment cannot be read.
pub fn scan_slots(folder: &Path, layout: Option<SlotLayout>) -> InputResult<Scan> {
    let mut scan = Scan::default();
    for (segment, bytes) in segments_in(folder)? {
        let path = folder.join(segment_file_name(segment));
        let file = open_for_reading(&path).map_err(|e| InputError::io(&path, "opening the segment", &e))?;
        let file = DriveFile::new(file);
        scan.segments += 1;
        if layout.is_some_and(|l| bytes < l.segment_bytes()) {
            scan.short.push((segment, bytes));
        }
        let step = layout.map_or(ALIGNMENT as u64, |l| l.slot_bytes);
        for offset in (0..bytes.saturating_sub(HEADER_BYTES as u64 - 1)).step_by(step as usize) {
            let mut header = [0; HEADER_BYTES];
            file.read(offset, &mut header)
                .map_err(|e| InputError::io(&path, "reading the segment", &e).at(format!("byte {offset}")))?;
            scan.take(Place { segment, offset }, &header);
        }
    }
    Ok(scan)
}

impl Scan {
    fn take(&mut self, place: Place, header: &[u8; HEADER_BYTES]) {
        match SlotHeader::decode(header) {
            Ok(header) if header.slot.place == place => self.found.entry(header.store).or_default().push(header),
            Ok(header) => {
                let meant = header.slot.place;
                let what = format!(
                    "the header of page {} names another place: segment {} offset {}",
                    header.page, meant.segment, meant.offset
                );
                self.broken.push((place, what));
            }
            // Never written, or the middle of a payload.
            Err(HeaderError::NoHeader) => {}
            Err(error) => self.broken.push((place, error.to_string())),
        }
    }
}
