//! Results of page reads and writes.

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::SlotRef;
use crate::page::versions::page_error::PageError;

/// What a successful transfer did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PageMoved {
    /// The payload is in the buffer, behind its [`crate::page::format::slot_header::HEADER_BYTES`] of header room.
    Read {
        /// Bytes of the payload.
        payload_bytes: usize,
    },
    /// The version is in this slot; durable after the next [`crate::page::versions::paged_store::PagedStore::sync`].
    Written(SlotRef),
}

/// A finished read or write.
#[derive(Debug)]
pub struct PageDone {
    /// An identifier chosen by the caller.
    pub token: u64,
    /// The page.
    pub page: PageId,
    /// The caller's buffer. After a write it holds the payload unchanged; after a failed read, garbage.
    pub buffer: PageBuffer,
    /// The outcome.
    pub result: Result<PageMoved, PageError>,
}

/// Bytes moved, headers and padding included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PageTraffic {
    /// Bytes read.
    pub bytes_read: u64,
    /// Bytes written.
    pub bytes_written: u64,
    /// Payload bytes of the pages written.
    pub payload_bytes_written: u64,
    /// Reads that were repeated.
    pub reads_repeated: u64,
}
