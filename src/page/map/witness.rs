//! The witness: the number of the last acknowledged map transaction, kept outside the map.
//!
//! One flipped bit in the map's file can make redb open the transaction before the last one, which is complete with
//! valid checksums (the bit that selects one of redb's two roots is under no checksum). So can restoring an old copy of
//! the file. The witness holds the number of the last acknowledged transaction; an older map is refused by name.
//!
//! The file has two slots of 4 KiB, written alternately, each synced before the other is touched. After a crash at
//! least one is valid, and it is at most one transaction behind. A witness behind its map is an ordinary crash.

use crate::page::map::entries::{SEAL_BYTES, SealScope};
use crate::page::map::map_file::sync;
use crate::page::mutants::{Mutant, active};
use redb::StorageBackend;
use std::io;
use std::sync::Arc;

/// Bytes of one slot: at least a sector on every drive.
const SLOT_BYTES: usize = 4096;
const SLOTS: u64 = 2;
const TABLE: u8 = 255;
const MAGIC: [u8; 8] = *b"gsw\x01ack\n";
/// Bytes of magic and sequence number.
const BODY_BYTES: usize = 16;

/// The file that holds the number of the last acknowledged transaction.
#[derive(Debug)]
pub struct Witness {
    file: Arc<dyn StorageBackend>,
    store: u128,
    sequence: u64,
}

impl Witness {
    /// Fills the empty `file` and syncs it. The caller syncs the folder.
    /// Errors: the file cannot be written.
    pub fn create(file: Arc<dyn StorageBackend>, store: u128) -> io::Result<Witness> {
        file.set_len(SLOTS * SLOT_BYTES as u64)?;
        let mut witness = Witness { file, store, sequence: 0 };
        witness.record(0)?;
        Ok(witness)
    }

    /// Reads `file`; an invalid slot is ignored.
    /// Errors: the file cannot be read, or has no valid slot: [`io::ErrorKind::InvalidData`].
    pub fn open(file: Arc<dyn StorageBackend>, store: u128) -> io::Result<Witness> {
        let mut sequence = None;
        for slot in 0..SLOTS {
            let mut bytes = [0u8; SLOT_BYTES];
            if file.len()? < (slot + 1) * SLOT_BYTES as u64 {
                continue;
            }
            file.read(slot * SLOT_BYTES as u64, &mut bytes)?;
            sequence = sequence.max(read_slot(store, slot, &bytes));
        }
        match sequence {
            Some(sequence) => Ok(Witness { file, store, sequence }),
            None => Err(io::Error::new(io::ErrorKind::InvalidData, "neither slot of the witness is valid")),
        }
    }

    /// Number of the last acknowledged transaction.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Writes `sequence` durably.
    /// Errors: the file cannot be written; it then holds the old or the new number.
    pub fn record(&mut self, sequence: u64) -> io::Result<()> {
        let slot = if active(Mutant::WitnessInOneSlot) { 0 } else { sequence % SLOTS };
        let mut body = MAGIC.to_vec();
        body.extend_from_slice(&sequence.to_le_bytes());
        let mut bytes = scope(self.store).seal(&slot.to_le_bytes(), &body);
        bytes.resize(SLOT_BYTES, 0);
        self.file.write(slot * SLOT_BYTES as u64, &bytes)?;
        sync(&*self.file)?;
        self.sequence = sequence;
        Ok(())
    }
}

fn scope(store: u128) -> SealScope {
    SealScope { store, table: TABLE }
}

fn read_slot(store: u128, slot: u64, bytes: &[u8]) -> Option<u64> {
    let sealed = bytes.get(..SEAL_BYTES + BODY_BYTES)?;
    let (body, _) = scope(store).unseal(&slot.to_le_bytes(), sealed).ok()?;
    let (magic, sequence) = body.split_first_chunk::<8>()?;
    (*magic == MAGIC).then_some(u64::from_le_bytes(sequence.try_into().ok()?))
}
