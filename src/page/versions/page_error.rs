//! What can go wrong with a page, with the place and the remedy.
//!
//! Invariant: an error about stored bytes names the segment file, the offset, the page and its generation.

use crate::base::ids::PageId;
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::slot_header::LABEL_BYTES_MAX;
use std::io;

/// A version of a page in its slot, for messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotName {
    /// The page.
    pub page: PageId,
    /// Where its slot is.
    pub place: Place,
    /// First generation that the version can belong to.
    pub generation: u64,
}

impl std::fmt::Display for SlotName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let SlotName { page, place, generation } = self;
        let file = segment_file_name(place.segment);
        write!(f, "page {page} of generation {generation} ({file}, offset {})", place.offset)
    }
}

/// Why a page could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// The drive did not give the bytes, twice.
    #[error("{at} cannot be read: {source}\n  remedy: check the drive and its cable; go back to an earlier checkpoint")]
    Read {
        /// Which version.
        at: SlotName,
        /// What the system said.
        source: io::Error,
    },
    /// The bytes are not those that were written, twice.
    #[error("{at} is damaged: {what}\n  remedy: check the drive; go back to an earlier checkpoint")]
    Damaged {
        /// Which version.
        at: SlotName,
        /// What does not match.
        what: String,
    },
    /// The drive did not take the bytes. The store takes no more writes.
    #[error("{at} cannot be written: {source}\n  remedy: check the drive; what was committed is still there")]
    Write {
        /// Which version it was to be.
        at: SlotName,
        /// What the system said.
        source: io::Error,
    },
    /// There is no space for the bytes. Nothing is lost; it may be tried again.
    #[error("there is no space to write {at}: {source}\n  remedy: free space on the drive of the spill directory")]
    NoSpace {
        /// Which version it was to be.
        at: SlotName,
        /// What the system said.
        source: io::Error,
    },
    /// There is no space for another segment, or it cannot be made. Nothing is lost; it may be tried again.
    #[error("{} ({bytes} bytes) cannot be made: {source}\n  remedy: {}", segment_file_name(*.segment), grow_remedy(.source))]
    Grow {
        /// Number of the segment.
        segment: u32,
        /// Its length.
        bytes: u64,
        /// What the system said.
        source: io::Error,
    },
    /// The drive reported an error while it made writes durable. The store takes no more writes.
    #[error(
        "the drive did not keep what was written: {source}\n  remedy: check the drive; what was committed is still there"
    )]
    Sync {
        /// What the system said.
        source: io::Error,
    },
    /// A write or sync failed earlier, so nothing may be written on top.
    #[error(
        "nothing is written any more after an error of the drive ({cause})\n  remedy: check the drive, then start again"
    )]
    Poisoned {
        /// The first error.
        cause: String,
    },
    /// The payload or its label is longer than there is room for.
    #[error(
        "page {page} has {payload_bytes} bytes and a label of {label_bytes}; there is room for {capacity_bytes} and {LABEL_BYTES_MAX}\n  remedy: report this, it is a mistake of the program"
    )]
    TooLong {
        /// The page.
        page: PageId,
        /// Its bytes.
        payload_bytes: usize,
        /// Room for them.
        capacity_bytes: usize,
        /// Bytes of the label.
        label_bytes: usize,
    },
}

impl PageError {
    /// Whether it is only space that is missing: the same may work later.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            PageError::NoSpace { .. } => true,
            PageError::Grow { source, .. } => is_out_of_space(source),
            _ => false,
        }
    }
}

/// What helps where a segment cannot be made.
fn grow_remedy(source: &io::Error) -> &'static str {
    match source.kind() {
        // A limit on the length of files counts as a want of space, too; the message above says which it was.
        _ if is_out_of_space(source) => "free space on the drive of the spill directory",
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            "see to it that the spill directory can be written, or name another one"
        }
        io::ErrorKind::AlreadyExists => "take the file out of the spill directory if it is not of this run",
        _ => "check the drive and the spill directory; what was committed is still there",
    }
}

/// Whether the system refused bytes for want of space. Nothing was written then.
pub fn is_out_of_space(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge)
}
