//! Finds versions of pages by their slot headers, for a store whose map is lost.
//!
//! Invariants: 1. nothing is written; 2. memory is bounded by the headers found; 3. a result is only what a header
//! claims: [`super::slot_reader`] tells whether the payload is intact.

use crate::base::error::{InputError, InputResult};
use crate::page::engine::buffer::ALIGNMENT;
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::{open_for_reading, segment_file_name};
use crate::page::folder::protocol_files::DriveFile;
use crate::page::folder::spill_dir::segments_in;
use crate::page::format::slot_header::{HEADER_BYTES, HeaderError, SlotHeader};
use crate::page::versions::slots::SlotLayout;
use redb::StorageBackend;
use std::collections::BTreeMap;
use std::path::Path;

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
///
/// # Errors
/// The folder or a segment cannot be read.
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
