//! What comes back from reads and writes of pages.

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::SlotRef;
use crate::page::versions::page_error::PageError;

/// What a transfer did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PageMoved {
    /// The payload is in the buffer, behind its [`crate::page::format::slot_header::HEADER_BYTES`] of header room.
    Read {
        /// Its bytes.
        payload_bytes: usize,
    },
    /// The version is in this slot, durable after the next [`crate::page::versions::paged_store::PagedStore::sync`].
    Written(SlotRef),
}

/// The end of a read or write.
#[derive(Debug)]
pub struct PageDone {
    /// The caller's name for it.
    pub token: u64,
    /// The page.
    pub page: PageId,
    /// The caller's buffer. After a write it holds the payload as before; after a failed read, nothing of use.
    pub buffer: PageBuffer,
    /// How it went.
    pub result: Result<PageMoved, PageError>,
}

/// Bytes moved so far, headers and padding included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PageTraffic {
    /// Bytes read.
    pub bytes_read: u64,
    /// Bytes written.
    pub bytes_written: u64,
    /// Payload bytes of what was written.
    pub payload_bytes_written: u64,
    /// Reads that had to be repeated.
    pub reads_repeated: u64,
}
