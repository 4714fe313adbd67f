//! Versions of pages on an engine: slots, headers, codec, checksums.
//!
//! To write, the layer above hands over a page's buffer (header room, then payload) and receives a [`SlotRef`] for its
//! index. To read, it hands over a [`SlotRef`] and receives the verified payload. Buffers are moved, and every one is
//! returned, also on failure.
//!
//! Invariants: 1. a read succeeds only if header and payload are exactly the version that the reference names (store,
//! page, generation, place, lengths, checksum); a mismatch is read once more and then reported; 2. a new version never
//! overwrites a slot that a durable or pinned generation names; 3. after a failed write or sync the store accepts no
//! more writes, except after a lack of space: then nothing was written, and space may be freed later; 4. every accepted
//! transfer ends in exactly one [`PageDone`]; 5. a retired slot keeps the whole range of generations that may name it.
//!
//! A cut ends a generation. Versions of the ended generation may still be written after the cut, by its number, beside
//! versions of the next one.

use crate::base::error::is_out_of_space;
use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use crate::page::format::codec::{self, Codec};
use crate::page::format::slot_header::{
    HEADER_BYTES, LABEL_BYTES_MAX, SlotHeader, SlotRef, StoredAs, checksum, transfer_bytes,
};
use crate::page::format::verify::verify;
use crate::page::mutants::{Mutant, active};
use crate::page::versions::page_error::{PageError, SlotName};
use crate::page::versions::slots::{SlotLayout, Slots};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::io;

/// Writes that are encoded and checksummed as one batch, so that all threads have work.
const WRITE_BATCH: usize = 16;

#[derive(Debug, Clone, Copy)]
pub struct PagedStoreConfig {
    /// Identity of the store, in every slot.
    pub store: u128,
    /// Sizes of slots and segments.
    pub layout: SlotLayout,
    /// Codec of new versions; versions in any codec can be read.
    pub codec: Codec,
    /// The generation being written: one more than the last committed one.
    pub generation: u64,
    /// Serial number of the next write; higher than that of any valid slot.
    pub serial: u64,
}

/// Pages in slots. Has one owner.
pub struct PagedStore {
    engine: Box<dyn PageEngine>,
    config: PagedStoreConfig,
    slots: Slots,
    pending: BTreeMap<u64, Pending>,
    next_transfer: u64,
    waiting: Vec<Waiting>,
    /// Finished transfers not collected yet.
    ended: Vec<PageDone>,
    /// Free staging buffers, of a slot's size.
    staging: Vec<PageBuffer>,
    /// Number of staging buffers in use.
    staged: usize,
    traffic: PageTraffic,
    poison: Option<String>,
}

impl PagedStore {
    pub fn new(engine: Box<dyn PageEngine>, config: PagedStoreConfig) -> PagedStore {
        PagedStore::with_slots(engine, config, Slots::new(config.layout))
    }

    /// A store whose `segments` segments exist and hold the versions that an index names.
    /// Errors: the index names a slot twice, or one that does not exist.
    pub fn open<'a>(
        engine: Box<dyn PageEngine>,
        config: PagedStoreConfig,
        segments: u32,
        used: impl IntoIterator<Item = &'a SlotRef>,
    ) -> Result<PagedStore, String> {
        let slots = Slots::with_used(config.layout, segments, used.into_iter().map(|slot| slot.place))?;
        Ok(PagedStore::with_slots(engine, config, slots))
    }

    fn with_slots(engine: Box<dyn PageEngine>, config: PagedStoreConfig, slots: Slots) -> PagedStore {
        PagedStore {
            engine,
            config,
            slots,
            pending: BTreeMap::new(),
            next_transfer: 0,
            waiting: Vec::new(),
            ended: Vec::new(),
            staging: Vec::new(),
            staged: 0,
            traffic: PageTraffic::default(),
            poison: None,
        }
    }

    /// Longest payload, bytes.
    pub fn capacity_bytes(&self) -> usize {
        self.config.layout.slot_bytes as usize - HEADER_BYTES
    }

    /// A zeroed buffer for one page of this store: header room and the longest payload.
    pub fn new_buffer(&self) -> PageBuffer {
        PageBuffer::mapped(self.config.layout.slot_bytes as usize)
    }

    /// Bytes moved so far.
    pub fn traffic(&self) -> PageTraffic {
        self.traffic
    }

    pub fn slots(&self) -> &Slots {
        &self.slots
    }

    /// Accepted reads and writes whose result has not been collected.
    pub fn in_flight(&self) -> usize {
        self.pending.len() + self.waiting.len() + self.ended.len()
    }

    /// Memory of the staging buffers, bytes: none while pages are stored raw, else the most that was ever in flight.
    pub fn staging_bytes(&self) -> u64 {
        (self.staging.len() + self.staged) as u64 * self.config.layout.slot_bytes
    }

    /// Staging buffers in use: one per encoded page that is in flight or waiting.
    pub fn staged(&self) -> usize {
        self.staged
    }

    /// The generation being written.
    pub fn generation(&self) -> u64 {
        self.config.generation
    }

    /// Raises the number of the generation being written to `generation`, if that is higher: for copies that keep
    /// numbers.
    pub fn skip_to(&mut self, generation: u64) {
        self.config.generation = self.config.generation.max(generation);
    }

    /// The error after which the store accepts no writes, if any.
    pub fn poison(&self) -> Option<&str> {
        self.poison.as_deref()
    }

    /// Starts reading version `slot` of `page` into `buffer`, which is at least as long as a slot.
    pub fn read(&mut self, token: u64, page: PageId, slot: &SlotRef, buffer: PageBuffer) {
        let pending =
            Pending { token, page, slot: *slot, direction: Direction::Read, is_repeated: false, payload: None };
        self.submit_read(pending, buffer);
    }

    /// Accepts a new version of `page`; [`PagedStore::begin_writes`] starts the write. The payload is the first
    /// `payload_bytes` bytes after the header room of `buffer`. `label` is what the layer above needs to rebuild its
    /// index entry, at most [`LABEL_BYTES_MAX`] bytes. Header room and padding are overwritten; the payload is returned
    /// unchanged with the result.
    /// Errors: no space, the store is poisoned, or payload or label are too long; the buffer is returned at once.
    /// Nothing is then in flight, and no slot was taken.
    pub fn write(
        &mut self,
        token: u64,
        page: PageId,
        label: &[u8],
        payload_bytes: usize,
        buffer: PageBuffer,
    ) -> Result<(), (PageError, PageBuffer)> {
        self.write_for(self.config.generation, token, page, label, payload_bytes, buffer)
    }

    /// As [`PagedStore::write`], for a given generation: the current one, or the last one [cut](PagedStore::cut) if it
    /// is not committed yet.
    /// Errors: as [`PagedStore::write`].
    pub fn write_for(
        &mut self,
        generation: u64,
        token: u64,
        page: PageId,
        label: &[u8],
        payload_bytes: usize,
        buffer: PageBuffer,
    ) -> Result<(), (PageError, PageBuffer)> {
        let generation = if active(Mutant::CutForgotten) { self.config.generation } else { generation };
        let slot = match self.take_slot(page, label, payload_bytes, &buffer) {
            Ok(slot) => SlotRef { generation, ..slot },
            Err(error) => return Err((error, buffer)),
        };
        let is_staged = self.config.codec != Codec::Raw;
        let (payload, buffer) = if is_staged { (Some(buffer), self.take_staging()) } else { (None, buffer) };
        let pending = Pending { token, page, slot, direction: Direction::Write, is_repeated: false, payload };
        self.waiting.push(Waiting { pending, label: label.to_vec(), buffer });
        if self.waiting.len() >= WRITE_BATCH {
            self.begin_writes();
        }
        Ok(())
    }

    /// Moves finished reads and writes to `done`. With `wait`, blocks until at least one has finished, if any is in
    /// flight.
    pub fn complete(&mut self, wait: bool, done: &mut Vec<PageDone>) {
        self.begin_writes();
        loop {
            let wait = wait && self.ended.is_empty() && !self.pending.is_empty();
            let mut completions = Vec::new();
            self.engine.complete(wait, &mut completions);
            self.finish_all(completions);
            // A read that is being repeated has not finished.
            if !wait || !self.ended.is_empty() {
                return done.append(&mut self.ended);
            }
        }
    }

    /// Waits for all reads and writes, then makes the writes durable.
    /// Errors: the drive reported an error, now or earlier: the store is poisoned. Failed writes are in `done` as well.
    pub fn sync(&mut self, done: &mut Vec<PageDone>) -> Result<(), PageError> {
        while self.in_flight() > 0 {
            self.complete(true, done);
        }
        self.refuse_if_poisoned()?;
        let mut synced = self.engine.sync();
        if synced.is_err() && active(Mutant::SyncRetried) {
            synced = self.engine.sync();
        }
        synced.map_err(|source| {
            self.poison = Some(format!("making pages durable failed: {source}"));
            PageError::Sync(source)
        })
    }

    /// Version `slot` is superseded. If no committed generation can name it, its slot is free at once, otherwise after
    /// [`PagedStore::commit_done`]. A run without commits thus frees every slot at once.
    pub fn free(&mut self, slot: &SlotRef) {
        self.free_from(slot, self.config.generation);
    }

    /// As [`PagedStore::free`], but superseded from generation `from` on: one that is cut and not committed yet, or, at
    /// opening, one of the past.
    pub fn free_from(&mut self, slot: &SlotRef, from: u64) {
        let was_in_use = self.slots.retire(slot.place, slot.generation, from);
        debug_assert!(was_in_use, "a slot was freed twice: {slot:?}");
    }

    /// Ends generation [`PagedStore::generation`], which is about to be committed from the present index: later writes
    /// belong to the next generation, unless [`PagedStore::write_for`] names the ended one. [`PagedStore::sync`] must
    /// follow the last write of the generation and precede the commit.
    pub fn cut(&mut self) -> u64 {
        self.config.generation += 1;
        self.config.generation - 1
    }

    /// Acknowledges the commit of generation `durable`; of the earlier ones `pinned` are kept. Frees the slots that
    /// none of these names; returns how many.
    pub fn commit_done(&mut self, durable: u64, pinned: &[u64]) -> usize {
        self.slots.release_retired(durable, pinned)
    }

    /// Poisons the store, because another part of it failed: no more writes are accepted.
    pub fn poison_with(&mut self, cause: String) {
        self.poison.get_or_insert(cause);
    }

    fn refuse_if_poisoned(&self) -> Result<(), PageError> {
        match &self.poison {
            Some(cause) if !active(Mutant::PoisonIgnored) => Err(PageError::Poisoned(cause.clone())),
            _ => Ok(()),
        }
    }

    fn take_slot(
        &mut self,
        page: PageId,
        label: &[u8],
        payload_bytes: usize,
        buffer: &PageBuffer,
    ) -> Result<SlotRef, PageError> {
        self.refuse_if_poisoned()?;
        let room = self.capacity_bytes().min(buffer.len().saturating_sub(HEADER_BYTES));
        let has_header_room = buffer.len() >= HEADER_BYTES;
        if !has_header_room
            || payload_bytes > room
            || label.len() > LABEL_BYTES_MAX
            || u32::try_from(payload_bytes).is_err()
        {
            let label_bytes = label.len();
            return Err(PageError::TooLong { page, payload_bytes, capacity_bytes: room, label_bytes });
        }
        let place = match self.slots.allocate() {
            Some(place) => place,
            None => {
                self.add_segment()?;
                // A new segment has at least one slot.
                self.slots.allocate().ok_or(PageError::Poisoned("a segment without slots".to_string()))?
            }
        };
        Ok(SlotRef {
            place,
            stored_bytes: payload_bytes as u32,
            payload_bytes: payload_bytes as u32,
            generation: self.config.generation,
            checksum: 0,
            codec: StoredAs::Raw,
        })
    }

    fn add_segment(&mut self) -> Result<(), PageError> {
        let (segment, bytes) = (self.slots.segments(), self.config.layout.segment_bytes());
        self.engine.create_segment(segment, bytes).map_err(|source| PageError::Grow { segment, bytes, source })?;
        self.slots.add_segment();
        Ok(())
    }

    /// Makes sure that `slots` slots are free, in new segments if need be: as many writes will find space on the drive.
    /// Errors: the drive has no space for another segment.
    pub fn reserve(&mut self, slots: u64) -> Result<(), PageError> {
        while self.slots.free() < slots {
            self.add_segment()?;
        }
        Ok(())
    }

    fn take_staging(&mut self) -> PageBuffer {
        self.staged += 1;
        self.staging.pop().unwrap_or_else(|| self.new_buffer())
    }

    /// The caller's buffer of a transfer that `buffer` carried; a staging buffer becomes free.
    fn callers(&mut self, pending: &mut Pending, buffer: PageBuffer) -> PageBuffer {
        let Some(payload) = pending.payload.take() else { return buffer };
        self.staged -= 1;
        self.staging.push(buffer);
        payload
    }

    /// Submits the accepted writes to the engine. This happens by itself when a batch is full and in
    /// [`PagedStore::complete`].
    pub fn begin_writes(&mut self) {
        let (mut batch, codec) = (std::mem::take(&mut self.waiting), self.config.codec);
        match batch.as_mut_slice() {
            // For one page another thread costs more than it saves.
            [one] => one.seal(codec),
            many => many.par_iter_mut().for_each(|write| write.seal(codec)),
        }
        for Waiting { mut pending, label, mut buffer } in batch {
            if pending.slot.codec == StoredAs::Raw
                && let Some(staging) = pending.payload.take()
            {
                // Sealing has put the caller's buffer first.
                self.staged -= 1;
                self.staging.push(staging);
            }
            if let Err(error) = self.refuse_if_poisoned() {
                self.slots.release(pending.slot.place);
                buffer = self.callers(&mut pending, buffer);
                self.ended.push(pending.end(buffer, Err(error)));
            } else {
                self.submit_write(pending, label, buffer);
            }
        }
    }

    /// Writes the header before the payload and submits.
    fn submit_write(&mut self, pending: Pending, label: Vec<u8>, mut buffer: PageBuffer) {
        let (slot, bytes) = (pending.slot, pending.slot.transfer_bytes());
        let (store, serial) = (self.config.store, self.config.serial);
        self.config.serial += 1;
        if let Some(header) = buffer.as_mut_slice().first_chunk_mut() {
            SlotHeader { store, page: pending.page, serial, slot, label }.encode(header);
        }
        self.traffic.bytes_written += bytes as u64;
        self.submit(pending, buffer, bytes);
    }

    /// Submits the read of `pending`; an encoded version goes to a staging buffer.
    fn submit_read(&mut self, mut pending: Pending, buffer: PageBuffer) {
        let bytes = pending.slot.transfer_bytes();
        let needed = bytes.max(transfer_bytes(pending.slot.payload_bytes as usize));
        // A reference from a damaged index may ask for more than a slot holds.
        if needed > buffer.len().min(self.config.layout.slot_bytes as usize) {
            let what = format!("the map states {needed} bytes, more than a slot holds");
            let error = PageError::Damaged(pending.name(), what);
            return self.ended.push(pending.end(buffer, Err(error)));
        }
        self.traffic.bytes_read += bytes as u64;
        let buffer = match pending.slot.codec {
            StoredAs::Raw => buffer,
            _ => {
                pending.payload = Some(buffer);
                self.take_staging()
            }
        };
        self.submit(pending, buffer, bytes);
    }

    fn submit(&mut self, pending: Pending, buffer: PageBuffer, bytes: usize) {
        let token = self.next_transfer;
        self.next_transfer += 1;
        let (direction, place) = (pending.direction, pending.slot.place);
        self.pending.insert(token, pending);
        self.engine.submit(Transfer { token, direction, place, bytes, buffer });
    }

    /// Verifies finished reads on all threads, then completes or repeats each transfer.
    fn finish_all(&mut self, completions: Vec<Completion>) {
        let mut checked: Vec<(Pending, Completion, Result<(), String>)> = completions
            .into_iter()
            .filter_map(|c| Some((self.pending.remove(&c.transfer.token)?, c, Ok(()))))
            .collect();
        let store = self.config.store;
        let check = |(pending, completion, verdict): &mut (Pending, Completion, Result<(), String>)| {
            if pending.direction == Direction::Read && completion.result.is_ok() {
                let bytes = &completion.transfer.buffer.as_slice()[..completion.transfer.bytes];
                let payload = pending.payload.as_mut().map(PageBuffer::as_mut_slice);
                *verdict = verify(store, pending.page, &pending.slot, bytes, payload);
            }
        };
        match checked.as_mut_slice() {
            // For one page another thread costs more than it saves.
            [one] => check(one),
            many => many.par_iter_mut().for_each(check),
        }
        for (mut pending, Completion { transfer, result }, verdict) in checked {
            let buffer = self.callers(&mut pending, transfer.buffer);
            match pending.direction {
                Direction::Read => self.finish_read(pending, buffer, result, verdict),
                Direction::Write => self.finish_write(pending, buffer, result),
            }
        }
    }

    fn finish_read(
        &mut self,
        mut pending: Pending,
        buffer: PageBuffer,
        result: io::Result<()>,
        verdict: Result<(), String>,
    ) {
        let at = pending.name();
        let error = match (result, verdict) {
            (Ok(()), Ok(())) => {
                let payload_bytes = pending.slot.payload_bytes as usize;
                return self.ended.push(pending.end(buffer, Ok(PageMoved::Read { payload_bytes })));
            }
            (Err(source), _) => PageError::Read(at, source),
            (Ok(()), Err(what)) => PageError::Damaged(at, what),
        };
        if pending.is_repeated {
            self.ended.push(pending.end(buffer, Err(error)));
        } else {
            pending.is_repeated = true;
            self.traffic.reads_repeated += 1;
            self.submit_read(pending, buffer);
        }
    }

    fn finish_write(&mut self, pending: Pending, buffer: PageBuffer, result: io::Result<()>) {
        let at = pending.name();
        let result = if active(Mutant::WriteErrorIgnored) { Ok(()) } else { result };
        let end = result.map(|()| PageMoved::Written(pending.slot)).map_err(|source| {
            self.slots.release(pending.slot.place);
            if is_out_of_space(source.kind()) {
                return PageError::NoSpace(at, source);
            }
            self.poison.get_or_insert_with(|| format!("writing {at} failed: {source}"));
            PageError::Write(at, source)
        });
        self.ended.push(pending.end(buffer, end));
    }
}

impl std::fmt::Debug for PagedStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PagedStore({}, {} slots, {} in flight)", self.engine.name(), self.slots.total(), self.in_flight())
    }
}

/// What a successful transfer did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PageMoved {
    /// The payload is in the buffer, behind its [`HEADER_BYTES`] of header room.
    Read { payload_bytes: usize },
    /// The version is in this slot; durable after the next [`PagedStore::sync`].
    Written(SlotRef),
}

/// A finished read or write.
#[derive(Debug)]
pub struct PageDone {
    /// An identifier chosen by the caller.
    pub token: u64,
    pub page: PageId,
    /// The caller's buffer. After a write it holds the payload unchanged; after a failed read, garbage.
    pub buffer: PageBuffer,
    pub result: Result<PageMoved, PageError>,
}

/// Bytes moved, headers and padding included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PageTraffic {
    pub bytes_read: u64,
    pub bytes_written: u64,
    pub reads_repeated: u64,
}

/// A transfer in flight.
#[derive(Debug)]
struct Pending {
    pub token: u64,
    pub page: PageId,
    pub slot: SlotRef,
    pub direction: Direction,
    /// Whether this is the second and last attempt of a read.
    pub is_repeated: bool,
    /// The caller's buffer, while a staging buffer carries the encoded form.
    pub payload: Option<PageBuffer>,
}

impl Pending {
    pub fn name(&self) -> SlotName {
        SlotName { page: self.page, place: self.slot.place, generation: self.slot.generation }
    }

    pub fn end(self, buffer: PageBuffer, result: Result<PageMoved, PageError>) -> PageDone {
        PageDone { token: self.token, page: self.page, buffer, result }
    }
}

/// A write waiting to be encoded and checksummed.
#[derive(Debug)]
struct Waiting {
    pub pending: Pending,
    pub label: Vec<u8>,
    /// The caller's buffer, or the staging buffer that receives the encoded form.
    pub buffer: PageBuffer,
}

impl Waiting {
    /// Encodes, zero-pads and checksums the payload; sets codec, stored length and checksum in the slot reference.
    pub fn seal(&mut self, codec: Codec) {
        let Pending { slot, payload, .. } = &mut self.pending;
        if let Some(caller) = payload {
            let bytes = &caller.as_slice()[HEADER_BYTES..][..slot.payload_bytes as usize];
            match codec::encode_as(codec, bytes, &mut self.buffer.as_mut_slice()[HEADER_BYTES..]) {
                Ok(Some((stored_bytes, stored_as))) => {
                    (slot.stored_bytes, slot.codec) = (stored_bytes as u32, stored_as);
                }
                // A payload that fails to encode for any reason is stored raw, from the caller's buffer.
                _ => std::mem::swap(caller, &mut self.buffer),
            }
        }
        let stored = &mut self.buffer.as_mut_slice()[HEADER_BYTES..slot.transfer_bytes()];
        stored[slot.stored_bytes as usize..].fill(0);
        slot.checksum = checksum(stored);
    }
}
