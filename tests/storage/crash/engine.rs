//! Segments on the simulated disk, one file each, created in the order of the real engine: file, length, sync, folder.
//!
//! Transfers complete one at a time and in any order.

use super::disk::{Disk, DiskFile, Rng};
use gsscale::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use gsscale::page::engine::segment_files::segment_file_name;
use gsscale::page::mutants::{Mutant, active};
use redb::StorageBackend;
use std::collections::BTreeMap;
use std::io;

pub struct SimStore {
    disk: Disk,
    open: BTreeMap<u32, (DiskFile, bool)>,
    waiting: Vec<Completion>,
    rng: Rng,
}

impl SimStore {
    pub fn new(disk: Disk, seed: u64) -> SimStore {
        SimStore { disk, open: BTreeMap::new(), waiting: Vec::new(), rng: Rng(seed) }
    }

    fn file(&mut self, segment: u32) -> io::Result<&mut (DiskFile, bool)> {
        if !self.open.contains_key(&segment) {
            let file = self.disk.open_file(&segment_file_name(segment))?.ok_or(io::ErrorKind::NotFound)?;
            self.open.insert(segment, (file, false));
        }
        self.open.get_mut(&segment).ok_or(io::ErrorKind::NotFound.into())
    }

    fn transfer(&mut self, transfer: &mut Transfer) -> io::Result<()> {
        let (offset, bytes) = (transfer.place.offset, transfer.bytes);
        let (file, is_dirty) = self.file(transfer.place.segment)?;
        match transfer.direction {
            Direction::Read => file.read(offset, &mut transfer.buffer.as_mut_slice()[..bytes]),
            Direction::Write => {
                *is_dirty = true;
                let mut done = 0;
                while done < bytes {
                    done += file.write_some(offset + done as u64, &transfer.buffer.as_slice()[done..bytes])?;
                    if active(Mutant::ShortAccepted) {
                        break;
                    }
                }
                Ok(())
            }
        }
    }
}

impl PageEngine for SimStore {
    fn name(&self) -> &'static str {
        "simulated"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        let name = segment_file_name(segment);
        let file = match self.disk.open_file(&name)? {
            Some(file) => file,
            None => self.disk.create_file(&name)?,
        };
        if file.len()? < bytes {
            file.set_len(bytes)?;
        }
        file.sync_data()?;
        if active(Mutant::FolderNotSyncedForSegment) {
            return Ok(());
        }
        gsscale::page::folder::protocol_files::Folder::sync(&self.disk)
    }

    fn submit(&mut self, mut transfer: Transfer) {
        let result = self.transfer(&mut transfer);
        let at = self.rng.below(self.waiting.len() as u64 + 1) as usize;
        self.waiting.insert(at, Completion { transfer, result });
    }

    fn complete(&mut self, _wait: bool, done: &mut Vec<Completion>) {
        done.extend(self.waiting.pop());
    }

    fn in_flight(&self) -> usize {
        self.waiting.len()
    }

    fn sync(&mut self) -> io::Result<()> {
        for (file, is_dirty) in self.open.values_mut() {
            if std::mem::take(is_dirty) {
                file.sync_data()?;
            }
        }
        Ok(())
    }
}
