//! Errors of page reads and writes, with place and remedy.
//!
//! Invariant: an error about stored bytes names the segment file, the offset, the page and its generation.

use crate::base::error::{REMEDY_TOO_MANY_FILES, is_out_of_space, is_too_many_files};
use crate::base::ids::PageId;
use crate::page::engine::page_engine::Place;
use crate::page::engine::segment_files::segment_file_name;
use crate::page::format::slot_header::LABEL_BYTES_MAX;
use std::io;

/// The slot of a version, for messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotName {
    pub page: PageId,
    pub place: Place,
    /// First generation that may name the version.
    pub generation: u64,
}

impl std::fmt::Display for SlotName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let SlotName { page, place, generation } = self;
        let file = segment_file_name(place.segment);
        write!(f, "page {page} of generation {generation} ({file}, offset {})", place.offset)
    }
}

/// What helps when the drive refuses a read, or a write.
const REMEDY_READ: &str = "check the drive and cable; roll back to an earlier checkpoint";
const REMEDY_WRITE: &str = "check the drive; committed generations are intact";
/// What helps when there is no space.
pub(in crate::page) const REMEDY_SPACE: &str =
    "free space on the drive of the pages: of the spill directory, or of the output folder of a run in memory";

/// Why a page could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// Reading failed twice.
    #[error("{0} cannot be read: {1}\n  remedy: {remedy}", remedy = remedy_of(.1, REMEDY_READ))]
    Read(SlotName, #[source] io::Error),
    /// The bytes read differ from those written, in two attempts.
    #[error("{0} is damaged: {1}\n  remedy: check the drive; roll back to an earlier checkpoint")]
    Damaged(SlotName, String),
    /// Writing failed. The store accepts no more writes.
    #[error("{0} cannot be written: {1}\n  remedy: {remedy}", remedy = remedy_of(.1, REMEDY_WRITE))]
    Write(SlotName, #[source] io::Error),
    /// No space for the bytes. Nothing is lost, and the write may be repeated.
    #[error("there is no space to write {0}: {1}\n  remedy: {REMEDY_SPACE}")]
    NoSpace(SlotName, #[source] io::Error),
    /// No space for another segment, or it cannot be created. Nothing is lost, and the attempt may be repeated.
    #[error("{} ({bytes} bytes) cannot be created: {source}\n  remedy: {}", segment_file_name(*.segment), grow_remedy(.source))]
    Grow { segment: u32, bytes: u64, source: io::Error },
    /// The drive failed to make writes durable. The store accepts no more writes.
    #[error("the drive could not make writes durable: {0}\n  remedy: {REMEDY_WRITE}")]
    Sync(#[source] io::Error),
    /// A write or sync failed earlier, so the store accepts no writes.
    #[error("writing stopped after a drive error ({0})\n  remedy: check the drive, then start again")]
    Poisoned(String),
    /// The payload or its label is too long.
    #[error(
        "page {page} has {payload_bytes} bytes (limit {capacity_bytes}) and a label of {label_bytes} (limit \
         {LABEL_BYTES_MAX})\n  remedy: report this as a bug"
    )]
    TooLong {
        page: PageId,
        payload_bytes: usize,
        /// Most bytes of a payload.
        capacity_bytes: usize,
        label_bytes: usize,
    },
}

impl PageError {
    /// Whether the error is only a lack of space: a later attempt may succeed.
    pub fn is_out_of_space(&self) -> bool {
        match self {
            PageError::NoSpace(..) => true,
            PageError::Grow { source, .. } => is_out_of_space(source.kind()),
            _ => false,
        }
    }
}

/// The remedy for a failed transfer, unless only too many files are open.
fn remedy_of(source: &io::Error, otherwise: &'static str) -> &'static str {
    if is_too_many_files(source) { REMEDY_TOO_MANY_FILES } else { otherwise }
}

/// The remedy when a segment cannot be created.
fn grow_remedy(source: &io::Error) -> &'static str {
    match source.kind() {
        _ if is_too_many_files(source) => REMEDY_TOO_MANY_FILES,
        _ if is_out_of_space(source.kind()) => REMEDY_SPACE,
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            "make the spill directory writable, or name another one"
        }
        io::ErrorKind::AlreadyExists => "remove the file from the spill directory if it does not belong to this run",
        _ => "check the drive and the spill directory; committed generations are intact",
    }
}
