//! Slots of pages in device memory: slabs of at most one binding, each with slots of one size.
//!
//! Not here: which page lies in which slot.
//!
//! Invariant: a slab stays for as long as the pages of a run are held, so the place of a slot never changes.

use super::pages::{DeviceSlot, SlotPage};
use crate::gpu::{Buffer, BufferView, Gpu, GpuError, GpuResult, Readback};
use crate::scene::page_layout::PageLayout;
use std::collections::VecDeque;

/// Bytes that a slot is a multiple of: the largest alignment that a device may require of a binding.
const SLOT_STEP: u64 = 256;
/// Most bytes of slots that are read back at once.
const READ_BYTES: u64 = 8 << 20;
/// Most bytes of slots whose reads have begun and not ended.
const IN_FLIGHT_BYTES: u64 = 64 << 20;
/// Reads beside the work on a view take at most this part of the memory that the view leaves.
const READ_SHARE: u64 = 8;

/// A buffer of slots.
#[derive(Debug)]
struct Slab {
    buffer: Buffer,
    /// Number of its first slot.
    first: u32,
    slots: u32,
}

/// All slots of a device.
#[derive(Debug, Default)]
pub struct Slots {
    slot_bytes: u64,
    /// Whether moments have 16 bits, two to a word.
    is_packed: bool,
    slabs: Vec<Slab>,
    /// Reads that have begun and not ended, with the slots that they read, in the order of their beginning.
    in_flight: VecDeque<(SlotPage, Readback)>,
}

impl Slots {
    /// No slots yet, for payloads up to this layout, whose moments are packed if they have 16 bits.
    pub fn new(largest: PageLayout, is_packed: bool) -> Slots {
        let none = Slots { is_packed, ..Slots::default() };
        Slots { slot_bytes: none.bytes_of(largest).next_multiple_of(SLOT_STEP), ..none }
    }

    /// Bytes of a payload in a slot.
    fn bytes_of(&self, layout: PageLayout) -> u64 {
        layout.bytes_on_device(self.is_packed)
    }

    pub fn slot_bytes(&self) -> u64 {
        self.slot_bytes
    }

    pub fn is_empty(&self) -> bool {
        self.slabs.is_empty()
    }

    pub fn len(&self) -> u32 {
        self.slabs.last().map_or(0, |slab| slab.first + slab.slots)
    }

    /// Makes up to `wanted` slots in slabs as large as one binding allows; returns how many the device had memory for. Of a device that is
    /// filled to its end, because no limit was stated, about half is given back: views need it.
    pub fn add(&mut self, gpu: &Gpu, wanted: usize) -> GpuResult<usize> {
        let most = (gpu.max_binding_bytes() / self.slot_bytes).max(1) as usize;
        let (mut added, mut next) = (0, wanted.min(most));
        while added < wanted {
            next = next.min(wanted - added);
            match gpu.optional_buffer("pages", next as u64 * self.slot_bytes)? {
                Some(buffer) => {
                    self.slabs.push(Slab { buffer, first: self.len(), slots: next as u32 });
                    added += next;
                }
                None if next > 1 => next /= 2,
                None => break,
            }
        }
        if added < wanted && gpu.room() > u64::MAX / 2 {
            let least = (added / 2).max(1);
            let is_spare = |last: &mut Slab, added: usize| added.checked_sub(last.slots as usize) >= Some(least);
            while let Some(last) = self.slabs.pop_if(|last| is_spare(last, added)) {
                added -= last.slots as usize;
            }
        }
        Ok(added)
    }

    /// The slab of a slot, and the first byte of the slot in it.
    pub fn place(&self, slot: DeviceSlot) -> (u32, u64) {
        let slab = self.slabs.partition_point(|slab| slab.first <= slot.0).saturating_sub(1);
        let first = self.slabs.get(slab).map_or(0, |slab| slab.first);
        (slab as u32, u64::from(slot.0 - first) * self.slot_bytes)
    }

    /// All bytes of a slab.
    pub fn slab(&self, slab: u32) -> GpuResult<BufferView> {
        self.slabs.get(slab as usize).map(|slab| slab.buffer.view()).ok_or_else(no_such_slot)
    }

    fn view(&self, SlotPage { slot, layout }: SlotPage) -> GpuResult<BufferView> {
        let (slab, offset) = self.place(slot);
        let slab = self.slabs.get(slab as usize).filter(|slab| slot.0 < slab.first + slab.slots);
        let bytes = self.bytes_of(layout).min(self.slot_bytes);
        slab.map(|slab| slab.buffer.slice(offset, bytes)).ok_or_else(no_such_slot)
    }

    /// Copies payloads into slots. Does not wait.
    pub fn write(&self, gpu: &Gpu, payloads: &[(SlotPage, &[u8])]) -> GpuResult<()> {
        let mut recorder = gpu.begin("pages");
        let mut packed = Vec::new();
        for (page, payload) in payloads {
            let view = self.view(*page)?;
            match self.is_packed {
                true => {
                    page.layout.pack(payload, &mut packed);
                    recorder.upload(&view, &packed)?;
                }
                false => recorder.upload(&view, payload)?,
            }
        }
        gpu.submit(recorder).map(|_| ())
    }

    /// Copies slots into payloads, as many at once as staging should hold. Waits.
    pub fn read(&self, gpu: &Gpu, payloads: &mut [(SlotPage, &mut [u8])]) -> GpuResult<()> {
        let mut at_once = (READ_BYTES / self.slot_bytes).max(1) as usize;
        let mut rest = payloads;
        while !rest.is_empty() {
            let count = at_once.min(rest.len());
            match self.read_some(gpu, &mut rest[..count]) {
                Ok(()) => rest = &mut rest[count..],
                Err(error) if error.is_out_of_memory() && count > 1 => at_once = count / 2,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Begins to read slots; returns how many, from the first: those that memory allows. Does not
    /// wait.
    pub fn begin_reads(&mut self, gpu: &Gpu, slots: &[SlotPage]) -> GpuResult<usize> {
        let reading = self.in_flight.len() as u64 * self.slot_bytes;
        let most = IN_FLIGHT_BYTES.saturating_sub(reading).min(gpu.room() / READ_SHARE) / self.slot_bytes;
        let before = self.in_flight.len();
        let mut recorder = gpu.begin("pages");
        for page in slots.iter().take(most as usize) {
            match recorder.read_back("pages", &self.view(*page)?) {
                Ok(read) => self.in_flight.push_back((*page, read)),
                Err(error) if error.is_out_of_memory() => break,
                Err(error) => return Err(error),
            }
        }
        gpu.submit(recorder)?;
        Ok(self.in_flight.len() - before)
    }

    /// Ends the reads that began first, into the payloads of the same slots. Waits for them alone.
    pub fn finish_reads(&mut self, payloads: &mut [(SlotPage, &mut [u8])]) -> GpuResult<()> {
        let count = payloads.len().min(self.in_flight.len());
        let ending: Vec<(SlotPage, Readback)> = self.in_flight.drain(..count).collect();
        if !ending.iter().map(|(page, _)| page).eq(payloads.iter().map(|(page, _)| page)) {
            return Err(wrong_slots("slots whose reads have not begun"));
        }
        ending.into_iter().zip(payloads).try_for_each(|((_, read), (page, payload))| self.fill(*page, read, payload))
    }

    fn read_some(&self, gpu: &Gpu, payloads: &mut [(SlotPage, &mut [u8])]) -> GpuResult<()> {
        let mut recorder = gpu.begin("pages");
        let mut readbacks = Vec::new();
        for (page, _) in payloads.iter() {
            readbacks.push(recorder.read_back("pages", &self.view(*page)?)?);
        }
        gpu.submit(recorder)?;
        payloads.iter_mut().zip(readbacks).try_for_each(|((page, payload), read)| self.fill(*page, read, payload))
    }

    /// Waits for a slot that was read, and copies it to the payload.
    fn fill(&self, page: SlotPage, read: Readback, payload: &mut [u8]) -> GpuResult<()> {
        match self.is_packed {
            true => page.layout.unpack(&read.to_vec::<u32>()?, payload),
            false => read.copy_to(payload)?,
        }
        Ok(())
    }
}

fn no_such_slot() -> GpuError {
    wrong_slots("a slot that does not exist")
}

fn wrong_slots(problem: &str) -> GpuError {
    GpuError::Bindings { stage: "pages".into(), problem: problem.into() }
}
