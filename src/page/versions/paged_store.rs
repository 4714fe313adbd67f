//! Versions of pages over an engine: slots, headers, codec, checksums.
//!
//! The layer above hands over a page's buffer (header room first, then the payload) and gets a [`SlotRef`] to keep in
//! its index, or hands over a [`SlotRef`] and gets the payload back, verified. Buffers are moved, and every one comes
//! back, also when something fails.
//!
//! Invariants: 1. bytes are given out as good only if header and payload are exactly the version that the reference
//! names (store, page, generation, place, lengths, checksum); what fails that is read once more and then named;
//! 2. a new version never overwrites a slot that a durable or pinned generation names; 3. after a failed write or
//! sync no write is taken any more; running out of space is not that: nothing was written, and there may be space
//! later; 4. every accepted transfer ends in exactly one [`PageDone`].

use crate::base::ids::PageId;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Place, Transfer};
use crate::page::format::codec::Codec;
use crate::page::format::slot_header::{HEADER_BYTES, LABEL_BYTES_MAX, SlotHeader, SlotRef, StoredAs, transfer_bytes};
use crate::page::format::verify::verify;
use crate::page::map::mutants::{Mutant, active};
pub use crate::page::versions::page_done::{PageDone, PageMoved, PageTraffic};
use crate::page::versions::page_error::{PageError, SlotName, is_out_of_space};
use crate::page::versions::slots::{SlotError, SlotLayout, Slots};
use crate::page::versions::waiting::Waiting;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::io;

/// Writes that wait to be encoded and checksummed together, so that all threads have work.
const WRITE_BATCH: usize = 16;

/// What a store is told at its making.
#[derive(Debug, Clone, Copy)]
pub struct PagedStoreConfig {
    /// Identity of the store, in every slot.
    pub store: u128,
    /// Sizes of slots and segments.
    pub layout: SlotLayout,
    /// How new versions are stored; versions stored otherwise are read all the same.
    pub codec: Codec,
    /// Generation that is being written: one more than the last committed one.
    pub generation: u64,
    /// Number of the next write; larger than that of any slot that counts.
    pub serial: u64,
}

/// A transfer between acceptance and end.
#[derive(Debug)]
struct Pending {
    token: u64,
    page: PageId,
    slot: SlotRef,
    direction: Direction,
    /// Set for the second and last attempt of a read.
    is_repeated: bool,
    /// The caller's buffer while the encoded form travels in one of the store's own.
    payload: Option<PageBuffer>,
}

/// Pages in slots. One owner.
pub struct PagedStore {
    engine: Box<dyn PageEngine>,
    pub(in crate::page) config: PagedStoreConfig,
    pub(in crate::page) slots: Slots,
    pending: BTreeMap<u64, Pending>,
    next_transfer: u64,
    waiting: Vec<Waiting>,
    /// Ends that were not taken yet.
    ended: Vec<PageDone>,
    /// Buffers of a slot's size that are not in use.
    staging: Vec<PageBuffer>,
    /// Buffers of that kind that are in use.
    staged: usize,
    traffic: PageTraffic,
    poison: Option<String>,
}

impl PagedStore {
    /// A store without pages.
    pub fn new(engine: Box<dyn PageEngine>, config: PagedStoreConfig) -> PagedStore {
        PagedStore::with_slots(engine, config, Slots::new(config.layout))
    }

    /// A store whose `segments` segments exist and hold the versions of an index.
    ///
    /// # Errors
    /// The index names a slot twice, or one that does not exist.
    pub fn open<'a>(
        engine: Box<dyn PageEngine>,
        config: PagedStoreConfig,
        segments: u32,
        used: impl IntoIterator<Item = &'a SlotRef>,
    ) -> Result<PagedStore, SlotError> {
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

    /// A buffer for one page of this store: header room and the longest payload, zeroed.
    pub fn new_buffer(&self) -> PageBuffer {
        PageBuffer::mapped(self.config.layout.slot_bytes as usize)
    }

    /// The engine's name, for people.
    pub fn engine_name(&self) -> &'static str {
        self.engine.name()
    }

    /// Bytes moved so far.
    pub fn traffic(&self) -> PageTraffic {
        self.traffic
    }

    /// The slots, to look at.
    pub fn slots(&self) -> &Slots {
        &self.slots
    }

    /// Reads and writes that were accepted and whose end was not taken yet.
    pub fn in_flight(&self) -> usize {
        self.pending.len() + self.waiting.len() + self.ended.len()
    }

    /// Memory of the store's own buffers, bytes: none while pages are stored raw, otherwise as much as was ever in flight
    /// at once.
    pub fn staging_bytes(&self) -> u64 {
        (self.staging.len() + self.staged) as u64 * self.config.layout.slot_bytes
    }

    /// Buffers of the store's own that are in use: one for every page that is on its way encoded or waits to be.
    pub fn staged(&self) -> usize {
        self.staged
    }

    /// Generation that is being written.
    pub fn generation(&self) -> u64 {
        self.config.generation
    }

    /// Raises the number of the generation that is being written, if `generation` is higher: for copies that keep numbers.
    pub fn skip_to(&mut self, generation: u64) {
        self.config.generation = self.config.generation.max(generation);
    }

    /// Number of the next write.
    pub fn serial(&self) -> u64 {
        self.config.serial
    }

    /// Why the store takes no writes any more, if so.
    pub fn poison(&self) -> Option<&str> {
        self.poison.as_deref()
    }

    /// Starts to read the version `slot` of `page` into `buffer`, which is at least as long as a slot needs.
    pub fn read(&mut self, token: u64, page: PageId, slot: &SlotRef, buffer: PageBuffer) {
        let pending =
            Pending { token, page, slot: *slot, direction: Direction::Read, is_repeated: false, payload: None };
        self.submit_read(pending, buffer);
    }

    /// Accepts a new version of `page` for writing, which begins with [`PagedStore::begin_writes`]: the first
    /// `payload_bytes` bytes behind the header room of `buffer`. `label` is what the index needs to know of the page, at
    /// most [`LABEL_BYTES_MAX`] bytes. Header room and padding are overwritten; the payload stays as it is and comes back
    /// with the end.
    ///
    /// # Errors
    /// No space, the store is poisoned, or payload or label are too long; the buffer comes back at once. Nothing is in
    /// flight then and no slot was taken.
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

    /// As [`PagedStore::write`], for a generation: the present one, or the last that was [cut](PagedStore::cut) and is
    /// not committed yet.
    ///
    /// # Errors
    /// As [`PagedStore::write`].
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
        let staging = (self.config.codec != Codec::Raw).then(|| self.take_staging());
        self.waiting.push(Waiting { token, page, slot, label: label.to_vec(), payload: buffer, staging });
        if self.waiting.len() >= WRITE_BATCH {
            self.begin_writes();
        }
        Ok(())
    }

    /// Moves ended reads and writes to `done`. With `wait`, blocks until at least one is there, if any is in flight.
    pub fn complete(&mut self, wait: bool, done: &mut Vec<PageDone>) {
        self.begin_writes();
        loop {
            let wait = wait && self.ended.is_empty() && !self.pending.is_empty();
            let mut completions = Vec::new();
            self.engine.complete(wait, &mut completions);
            self.finish_all(completions);
            // A repeated read is no end yet.
            if !wait || !self.ended.is_empty() {
                return done.append(&mut self.ended);
            }
        }
    }

    /// Waits for all reads and writes, then makes what was written durable.
    ///
    /// # Errors
    /// The drive reported an error, now or earlier: the store is poisoned. Failed writes are in `done` as well.
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
            PageError::Sync { source }
        })
    }

    /// Takes no writes from now on: something else that belongs to the store failed.
    pub fn poison_with(&mut self, cause: String) {
        self.poison.get_or_insert(cause);
    }

    fn refuse_if_poisoned(&self) -> Result<(), PageError> {
        match &self.poison {
            Some(cause) if !active(Mutant::PoisonIgnored) => Err(PageError::Poisoned { cause: cause.clone() }),
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
            None => self.grow()?,
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

    fn grow(&mut self) -> Result<Place, PageError> {
        let (segment, bytes) = (self.slots.segments(), self.config.layout.segment_bytes());
        self.engine.create_segment(segment, bytes).map_err(|source| PageError::Grow { segment, bytes, source })?;
        self.slots.add_segment();
        // A fresh segment has at least one slot.
        self.slots.allocate().ok_or(PageError::Poisoned { cause: "a segment without slots".to_string() })
    }

    fn take_staging(&mut self) -> PageBuffer {
        self.staged += 1;
        self.staging.pop().unwrap_or_else(|| self.new_buffer())
    }

    fn give_staging(&mut self, buffer: PageBuffer) {
        self.staged -= 1;
        self.staging.push(buffer);
    }

    /// Hands the writes that were accepted to the engine. They begin by themselves when there are some more of them, or
    /// with [`PagedStore::complete`].
    pub fn begin_writes(&mut self) {
        let (mut batch, codec) = (std::mem::take(&mut self.waiting), self.config.codec);
        match batch.as_mut_slice() {
            // Handing one page to another thread costs more than it saves.
            [one] => one.seal(codec),
            many => many.par_iter_mut().for_each(|write| write.seal(codec)),
        }
        for Waiting { token, page, slot, label, payload, staging } in batch {
            let (buffer, payload) = match (slot.codec, staging) {
                (StoredAs::Raw, staging) => {
                    staging.into_iter().for_each(|staging| self.give_staging(staging));
                    (payload, None)
                }
                (_, Some(staging)) => (staging, Some(payload)),
                (_, None) => (payload, None),
            };
            let pending = Pending { token, page, slot, direction: Direction::Write, is_repeated: false, payload };
            self.submit_write(pending, &label, buffer);
        }
    }

    /// Puts the header in front and submits.
    fn submit_write(&mut self, mut pending: Pending, label: &[u8], mut buffer: PageBuffer) {
        if let Err(error) = self.refuse_if_poisoned() {
            self.slots.release(pending.slot.place);
            let payload = match pending.payload.take() {
                Some(payload) => {
                    self.give_staging(buffer);
                    payload
                }
                None => buffer,
            };
            return self.ended.push(pending.end(payload, Err(error)));
        }
        let slot = &pending.slot;
        let bytes = slot.transfer_bytes();
        let described = SlotHeader {
            store: self.config.store,
            page: pending.page,
            serial: self.config.serial,
            slot: *slot,
            label: label.to_vec(),
        };
        self.config.serial += 1;
        if let Some(header) = buffer.as_mut_slice().first_chunk_mut() {
            described.encode(header);
        }
        self.traffic.bytes_written += bytes as u64;
        self.traffic.payload_bytes_written += u64::from(slot.payload_bytes);
        self.submit(pending, buffer, bytes);
    }

    /// Reads the slot of `pending`; encoded versions into a buffer of the store.
    fn submit_read(&mut self, mut pending: Pending, buffer: PageBuffer) {
        let bytes = pending.slot.transfer_bytes();
        let needed = bytes.max(transfer_bytes(pending.slot.payload_bytes as usize));
        // A reference from a damaged index may ask for more than a slot holds.
        if needed > buffer.len().min(self.config.layout.slot_bytes as usize) {
            let what = format!("the index gives it {needed} bytes, more than a slot holds");
            let error = PageError::Damaged { at: pending.name(), what };
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

    /// Verifies what was read, all threads at once, and ends or repeats each transfer.
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
            // Handing one page to another thread costs more than it saves.
            [one] => check(one),
            many => many.par_iter_mut().for_each(check),
        }
        for (mut pending, Completion { transfer, result }, verdict) in checked {
            let buffer = match pending.payload.take() {
                Some(payload) => {
                    self.give_staging(transfer.buffer);
                    payload
                }
                None => transfer.buffer,
            };
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
            (Err(source), _) => PageError::Read { at, source },
            (Ok(()), Err(what)) => PageError::Damaged { at, what },
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
            if is_out_of_space(&source) {
                return PageError::NoSpace { at, source };
            }
            self.poison.get_or_insert_with(|| format!("writing {at} failed: {source}"));
            PageError::Write { at, source }
        });
        self.ended.push(pending.end(buffer, end));
    }
}

impl Pending {
    fn name(&self) -> SlotName {
        SlotName { page: self.page, place: self.slot.place, generation: self.slot.generation }
    }

    fn end(self, buffer: PageBuffer, result: Result<PageMoved, PageError>) -> PageDone {
        PageDone { token: self.token, page: self.page, buffer, result }
    }
}

impl std::fmt::Debug for PagedStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PagedStore({}, {} slots, {} in flight)", self.engine.name(), self.slots.total(), self.in_flight())
    }
}
