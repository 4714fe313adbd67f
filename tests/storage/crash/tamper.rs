//! Mistakes of redb itself: the map file is intact and its checksums fit, and the values differ from those written.
//! redb makes the files.

use super::disk::{Disk, Rng};
use gsscale::page::folder::protocol_files::Folder;
use gsscale::page::map::map_file::MapFile;
use redb::{Builder, ReadableTable, TableDefinition};

const PAGES: TableDefinition<'_, (u64, u64), &[u8]> = TableDefinition::new("pages");

/// Changes, exchanges or removes values of the page table.
pub fn with(disk: &Disk, name: &str, rng: &mut Rng) -> String {
    let file = MapFile::new(disk.open(name).unwrap().unwrap());
    let database = Builder::new().set_cache_size(1 << 18).create_with_backend(file).unwrap();
    let mut transaction = database.begin_write().unwrap();
    transaction.set_two_phase_commit(true);
    let what;
    {
        let mut table = transaction.open_table(PAGES).unwrap();
        let entries: Vec<((u64, u64), Vec<u8>)> =
            table.iter().unwrap().map(|e| e.unwrap()).map(|(k, v)| (k.value(), v.value().to_vec())).collect();
        if entries.len() < 2 {
            return "nothing to tamper with".to_string();
        }
        let (a, b) = (rng.below(entries.len() as u64) as usize, rng.below(entries.len() as u64) as usize);
        let (key, mut value) = entries[a].clone();
        what = match rng.below(3) {
            0 => {
                let bit = 64 + rng.below((value.len() as u64 - 8) * 8) as usize;
                value[bit / 8] ^= 1 << (bit % 8);
                table.insert(key, value.as_slice()).unwrap();
                format!("bit {bit} of the value of {key:?} changed")
            }
            1 => {
                table.insert(key, entries[b].1.as_slice()).unwrap();
                table.insert(entries[b].0, value.as_slice()).unwrap();
                format!("values of {key:?} and {:?} exchanged", entries[b].0)
            }
            _ => {
                table.remove(key).unwrap();
                format!("the entry of {key:?} removed")
            }
        };
    }
    transaction.commit().unwrap();
    what
}
