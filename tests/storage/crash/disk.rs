//! A simulated disk that loses unsynced data: files and folder entries as a drive without power would have them.
//!
//! Every change ticks one clock over all files. At a power failure, unsynced writes are lost, kept, or torn at sector
//! boundaries, in any combination; so are unsynced entries of the folder. A sync can fail once with the behaviour of
//! Linux: dirty data counts as clean afterwards, is still read back, and is on the drive only in part. Images share
//! their blocks, so that copying the whole disk is cheap.

use gsscale::base::rng::mix64;
use gsscale::page::folder::protocol_files::Folder;
use redb::StorageBackend;
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard};

const BLOCK: usize = 4096;
/// Length of the writes to the header of the map's file.
const MAP_HEADER_BYTES: usize = 320;

#[derive(Debug, Clone)]
pub struct Rng(pub u64);

impl Rng {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix64(self.0)
    }

    pub fn below(&mut self, bound: u64) -> u64 {
        ((u128::from(self.next()) * u128::from(bound.max(1))) >> 64) as u64
    }

    pub fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// Bytes in shared blocks; a missing block is zero.
#[derive(Debug, Clone, Default)]
struct Image {
    len: u64,
    blocks: Vec<Option<Arc<[u8; BLOCK]>>>,
}

impl Image {
    fn set_len(&mut self, len: u64) {
        if len < self.len {
            self.blocks.truncate((len as usize).div_ceil(BLOCK));
            let tail = len as usize % BLOCK;
            if tail > 0
                && let Some(Some(block)) = self.blocks.last_mut()
            {
                Arc::make_mut(block)[tail..].fill(0);
            }
        }
        self.len = len;
        self.blocks.resize((len as usize).div_ceil(BLOCK), None);
    }

    /// Bytes beyond the end are dropped.
    fn write(&mut self, offset: u64, data: &[u8]) {
        let end = (offset + data.len() as u64).min(self.len) as usize;
        let mut at = offset as usize;
        while at < end {
            let (block, inside) = (at / BLOCK, at % BLOCK);
            let count = (BLOCK - inside).min(end - at);
            let source = &data[at - offset as usize..][..count];
            let block = self.blocks[block].get_or_insert_with(|| Arc::new([0; BLOCK]));
            Arc::make_mut(block)[inside..inside + count].copy_from_slice(source);
            at += count;
        }
    }

    fn read(&self, offset: u64, out: &mut [u8]) {
        let mut at = offset as usize;
        let end = at + out.len();
        while at < end {
            let (block, inside) = (at / BLOCK, at % BLOCK);
            let count = (BLOCK - inside).min(end - at);
            let target = &mut out[at - offset as usize..][..count];
            match &self.blocks[block] {
                Some(block) => target.copy_from_slice(&block[inside..inside + count]),
                None => target.fill(0),
            }
            at += count;
        }
    }
}

#[derive(Debug, Clone)]
enum Unsynced {
    Write(u64, Arc<[u8]>),
    Length(u64),
}

#[derive(Debug, Clone, Default)]
struct File {
    /// Contents as read.
    now: Image,
    /// Contents that are on the drive for certain.
    durable: Image,
    unsynced: Vec<Unsynced>,
}

#[derive(Debug, Clone)]
enum Entry {
    Create(String, usize),
    Rename(String, String, usize),
    Remove(String),
}

/// The unsynced changes that survive a power failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Survival {
    Nothing,
    Everything,
    /// The first changes, this many of them, whole.
    First(usize),
    /// Whole changes selected by the bits of this number.
    Mask(u64),
    /// Like the mask; of the change at this index only the first sectors of 512 bytes, this many of them.
    Torn(u64, usize, usize),
    /// Random sectors of this many bytes each; with flips, a surviving sector in 64 has a flipped bit.
    Sectors(u64, usize, bool),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    Io,
    /// ENOSPC, for calls that need space.
    Full,
    TooManyFiles,
    /// Writes report fewer bytes, reads report the end of the file.
    Short,
    /// EINTR, passed on without a retry.
    Interrupted,
}

impl Fault {
    fn error(self) -> io::Error {
        match self {
            Fault::Io => io::Error::from_raw_os_error(5),
            Fault::Full => io::Error::from_raw_os_error(28),
            Fault::TooManyFiles => io::Error::from_raw_os_error(24),
            Fault::Short => io::ErrorKind::UnexpectedEof.into(),
            Fault::Interrupted => io::ErrorKind::Interrupted.into(),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub struct FaultPlan {
    /// Number of the first call that fails, reads included.
    pub at_call: u64,
    /// Number of calls that fail from there on. [`Fault::Full`] fails only the calls that need space.
    pub calls: u64,
    pub fault: Fault,
}

#[derive(Debug, Clone)]
struct State {
    files: Vec<File>,
    entries: BTreeMap<String, usize>,
    durable_entries: BTreeMap<String, usize>,
    unsynced_entries: Vec<Entry>,
    clock: u64,
    calls: u64,
    crash_at: u64,
    crashed: bool,
    fault: Option<FaultPlan>,
    /// Number of the failing sync, counted from now.
    failing_sync: Option<u64>,
    faults_given: u64,
    rng: Rng,
    short_write: Option<u64>,
}

/// The simulated disk. Clones share one disk.
#[derive(Debug, Clone)]
pub struct Disk(Arc<Mutex<State>>);

impl Disk {
    pub fn new(seed: u64) -> Disk {
        Disk(Arc::new(Mutex::new(State {
            files: Vec::new(),
            entries: BTreeMap::new(),
            durable_entries: BTreeMap::new(),
            unsynced_entries: Vec::new(),
            clock: 0,
            calls: 0,
            crash_at: u64::MAX,
            crashed: false,
            fault: None,
            failing_sync: None,
            faults_given: 0,
            rng: Rng(seed),
            short_write: None,
        })))
    }

    pub fn fork(&self) -> Disk {
        Disk(Arc::new(Mutex::new(self.state().clone())))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap()
    }

    /// Changes so far.
    pub fn clock(&self) -> u64 {
        self.state().clock
    }

    /// Calls so far, reads included.
    pub fn calls(&self) -> u64 {
        self.state().calls
    }

    pub fn crash_at(&self, clock: u64) {
        self.state().crash_at = clock;
    }

    pub fn has_crashed(&self) -> bool {
        self.state().crashed
    }

    pub fn set_fault(&self, plan: Option<FaultPlan>) {
        self.state().fault = plan;
    }

    pub fn faults_given(&self) -> u64 {
        self.state().faults_given
    }

    /// Ends the shortage: the drive has space again.
    pub fn end_shortage(&self) {
        let mut state = self.state();
        if state.fault.is_some_and(|plan| plan.fault == Fault::Full) {
            state.fault = None;
        }
    }

    /// Drops pending injected errors and resets their count.
    pub fn forget_faults(&self) {
        let mut state = self.state();
        (state.crash_at, state.fault, state.failing_sync) = (u64::MAX, None, None);
        (state.short_write, state.faults_given) = (None, 0);
    }

    pub fn fail_sync(&self, after: Option<u64>) {
        self.state().failing_sync = after;
    }

    /// Makes a later write short: all but its last sectors arrive. `after` counts writes from now.
    pub fn short_write(&self, after: Option<u64>) {
        self.state().short_write = after;
    }

    /// Number of changes that a power failure now could lose.
    pub fn unsynced(&self) -> usize {
        let state = self.state();
        state.files.iter().map(|f| f.unsynced.len()).sum::<usize>() + state.unsynced_entries.len()
    }

    /// For every file whose last unsynced change is a write: its index among all changes, and its number of sectors.
    pub fn last_writes(&self) -> Vec<(usize, usize)> {
        let state = self.state();
        let mut index = 0;
        let mut last = Vec::new();
        for file in &state.files {
            index += file.unsynced.len();
            if let Some(Unsynced::Write(_, bytes)) = file.unsynced.last() {
                last.push((index - 1, bytes.len().div_ceil(512)));
            }
        }
        last
    }

    /// The power fails and comes back.
    pub fn power_cycle(&self, survival: Survival) {
        let mut state = self.state();
        let mut rng = match survival {
            Survival::Sectors(seed, ..) => Rng(seed),
            _ => Rng(0),
        };
        let mut index = 0;
        let State { files, .. } = &mut *state;
        for file in files {
            for change in std::mem::take(&mut file.unsynced) {
                survive(&mut file.durable, &change, survival, index, &mut rng);
                index += 1;
            }
            file.now = file.durable.clone();
        }
        let mut entries = state.durable_entries.clone();
        for entry in std::mem::take(&mut state.unsynced_entries) {
            let kept = match survival {
                Survival::Sectors(..) => rng.one_in(2),
                _ => is_whole(survival, index),
            };
            if kept {
                apply_entry(&mut entries, &entry);
            }
            index += 1;
        }
        state.durable_entries = entries.clone();
        state.entries = entries;
        drop(state);
        self.process_killed();
    }

    /// The process ends and the machine keeps running: nothing is lost.
    pub fn process_killed(&self) {
        let mut state = self.state();
        (state.crashed, state.crash_at, state.fault, state.failing_sync) = (false, u64::MAX, None, None);
        state.short_write = None;
    }

    pub fn names(&self) -> Vec<String> {
        self.state().entries.keys().cloned().collect()
    }

    pub fn file_len(&self, name: &str) -> u64 {
        let state = self.state();
        state.entries.get(name).map_or(0, |&i| state.files[i].now.len)
    }

    /// Changes the bytes of a file on the drive.
    fn spoil(&self, name: &str, change: impl FnOnce(&mut Image)) {
        let mut state = self.state();
        let index = state.entries[name];
        let file = &mut state.files[index];
        change(&mut file.now);
        file.durable = file.now.clone();
        file.unsynced.clear();
    }

    pub fn flip(&self, name: &str, bit: u64) {
        self.spoil(name, |file| {
            let mut byte = [0];
            file.read(bit / 8, &mut byte);
            file.write(bit / 8, &[byte[0] ^ 1 << (bit % 8)]);
        });
    }

    /// Copies bytes of a file to another place in it: a misdirected write.
    pub fn copy_within(&self, name: &str, from: u64, to: u64, bytes: usize) {
        self.spoil(name, |file| {
            let mut moved = vec![0; bytes];
            file.read(from, &mut moved);
            file.write(to, &moved);
        });
    }

    pub fn contents(&self, name: &str) -> Vec<u8> {
        let state = self.state();
        let image = &state.files[state.entries[name]].now;
        let mut bytes = vec![0; image.len as usize];
        image.read(0, &mut bytes);
        bytes
    }

    pub fn replace(&self, name: &str, bytes: &[u8]) {
        self.spoil(name, |file| {
            file.set_len(bytes.len() as u64);
            file.write(0, bytes);
        });
    }
}

fn is_whole(survival: Survival, index: usize) -> bool {
    match survival {
        Survival::Nothing => false,
        Survival::Everything => true,
        Survival::First(count) => index < count,
        Survival::Mask(mask) | Survival::Torn(mask, ..) => index >= 64 || mask >> index & 1 == 1,
        Survival::Sectors(..) => true,
    }
}

fn survive(image: &mut Image, change: &Unsynced, survival: Survival, index: usize, rng: &mut Rng) {
    match (change, survival) {
        (Unsynced::Write(offset, bytes), Survival::Torn(_, torn, sectors)) if torn == index => {
            image.write(*offset, &bytes[..bytes.len().min(sectors * 512)]);
        }
        (Unsynced::Write(offset, bytes), Survival::Sectors(_, sector, flips)) => {
            // The map's first sector is excepted: no store survives a drive that damages this sector while overwriting
            // it.
            let flips = flips && bytes.len() != MAP_HEADER_BYTES;
            // Most changes are whole or lost; some are torn in pieces.
            let torn = rng.one_in(3);
            let whole = rng.one_in(2);
            if !torn && whole {
                image.write(*offset, bytes);
            }
            if torn {
                let mut sectors = bytes.to_vec();
                for (i, piece) in sectors.chunks_mut(sector).enumerate() {
                    if rng.one_in(2) {
                        if flips && rng.one_in(64) {
                            let bit = rng.below(piece.len() as u64 * 8) as usize;
                            piece[bit / 8] ^= 1 << (bit % 8);
                        }
                        image.write(offset + (i * sector) as u64, piece);
                    }
                }
            }
        }
        (Unsynced::Length(len), _) => {
            let kept =
                if matches!(survival, Survival::Sectors(..)) { rng.one_in(2) } else { is_whole(survival, index) };
            image.set_len(if kept { *len } else { image.len });
        }
        (Unsynced::Write(offset, bytes), _) if is_whole(survival, index) => image.write(*offset, bytes),
        (Unsynced::Write(..), _) => {}
    }
}

fn apply_entry(entries: &mut BTreeMap<String, usize>, entry: &Entry) {
    match entry {
        Entry::Create(name, file) => {
            entries.insert(name.clone(), *file);
        }
        Entry::Rename(from, to, file) => {
            entries.remove(from);
            entries.insert(to.clone(), *file);
        }
        Entry::Remove(name) => {
            entries.remove(name);
        }
    }
}

impl State {
    /// Counts a call, and fails if the plan says so.
    fn call(&mut self, needs_space: bool) -> io::Result<()> {
        if self.crashed {
            return Err(io::Error::other("the power is off"));
        }
        self.calls += 1;
        if let Some(plan) = self.fault
            && self.calls.checked_sub(plan.at_call).is_some_and(|since| since < plan.calls)
            && (needs_space || plan.fault != Fault::Full)
        {
            self.faults_given += 1;
            return Err(plan.fault.error());
        }
        Ok(())
    }

    /// Counts a change. The power may fail after the change began.
    fn tick(&mut self) -> io::Result<()> {
        self.clock += 1;
        if self.clock >= self.crash_at {
            self.crashed = true;
            return Err(io::Error::other("the power fails"));
        }
        Ok(())
    }

    fn write(&mut self, file: usize, offset: u64, data: &[u8]) -> io::Result<usize> {
        let mut failed = self.call(true);
        let mut count = data.len();
        if failed.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::UnexpectedEof) {
            // A short write is no error: it reports the bytes written, and writes nothing below two sectors.
            failed = Ok(());
            count = data.len() / 1024 * 512;
        } else if failed.is_err() && !self.crashed {
            // A failed write may have reached the file in part.
            count = self.rng.below(data.len() as u64 / 512 + 1) as usize * 512;
        }
        if self.crashed {
            return Err(io::Error::other("the power is off"));
        }
        if let Some(left) = self.short_write {
            self.short_write = left.checked_sub(1);
            if left == 0 && count > 512 {
                count -= 512 * (1 + self.rng.below(count as u64 / 1024) as usize);
            }
        }
        let data = &data[..count.min(data.len())];
        let image = &mut self.files[file].now;
        if offset + data.len() as u64 > image.len {
            let len = offset + data.len() as u64;
            image.set_len(len);
            self.files[file].unsynced.push(Unsynced::Length(len));
        }
        let target = &mut self.files[file];
        target.now.write(offset, data);
        target.unsynced.push(Unsynced::Write(offset, data.into()));
        self.tick()?;
        failed.map(|()| data.len())
    }

    fn sync(&mut self, file: usize) -> io::Result<()> {
        self.call(false)?;
        self.tick()?;
        if let Some(left) = self.failing_sync {
            self.failing_sync = left.checked_sub(1);
            if left == 0 {
                self.faults_given += 1;
                // Dirty data counts as clean; some of it reached the drive.
                let target = &mut self.files[file];
                for change in std::mem::take(&mut target.unsynced) {
                    let seed = self.rng.next();
                    let mut rng = Rng(seed);
                    survive(&mut target.durable, &change, Survival::Sectors(seed, 512, false), 0, &mut rng);
                    // The length is metadata: journaled with the next sync, independent of the data.
                }
                let len = target.now.len;
                target.durable.set_len(len);
                return Err(io::Error::from_raw_os_error(5));
            }
        }
        let target = &mut self.files[file];
        for change in std::mem::take(&mut target.unsynced) {
            survive(&mut target.durable, &change, Survival::Everything, 0, &mut Rng(0));
        }
        Ok(())
    }

    fn sync_folder(&mut self) -> io::Result<()> {
        self.call(false)?;
        self.tick()?;
        self.unsynced_entries.clear();
        self.durable_entries = self.entries.clone();
        Ok(())
    }

    fn change_entry(&mut self, entry: Entry) -> io::Result<()> {
        self.call(matches!(entry, Entry::Create(..)))?;
        apply_entry(&mut self.entries, &entry);
        self.unsynced_entries.push(entry);
        self.tick()
    }
}

#[derive(Debug)]
pub struct DiskFile {
    disk: Disk,
    file: usize,
}

impl DiskFile {
    /// One write as the system performs it, possibly short. A write of zero bytes is an error, as in the standard
    /// library.
    pub fn write_some(&self, offset: u64, data: &[u8]) -> io::Result<usize> {
        match self.disk.state().write(self.file, offset, data) {
            Ok(0) if !data.is_empty() => Err(io::ErrorKind::WriteZero.into()),
            other => other,
        }
    }
}

impl StorageBackend for DiskFile {
    fn len(&self) -> io::Result<u64> {
        let mut state = self.disk.state();
        state.call(false)?;
        Ok(state.files[self.file].now.len)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let mut state = self.disk.state();
        state.call(false)?;
        let image = &state.files[self.file].now;
        if offset + out.len() as u64 > image.len {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        image.read(offset, out);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut state = self.disk.state();
        state.call(true)?;
        let file = &mut state.files[self.file];
        file.now.set_len(len);
        file.unsynced.push(Unsynced::Length(len));
        state.tick()
    }

    fn sync_data(&self) -> io::Result<()> {
        self.disk.state().sync(self.file)
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut done = 0;
        while done < data.len() {
            done += self.write_some(offset + done as u64, &data[done..])?;
        }
        Ok(())
    }
}

impl Folder for Disk {
    fn open(&self, name: &str) -> io::Result<Option<Arc<dyn StorageBackend>>> {
        let mut state = self.state();
        state.call(false)?;
        let file = state.entries.get(name).copied();
        Ok(file.map(|file| Arc::new(DiskFile { disk: self.clone(), file }) as Arc<dyn StorageBackend>))
    }

    fn create(&self, name: &str) -> io::Result<Arc<dyn StorageBackend>> {
        Ok(Arc::new(self.create_file(name)?))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let mut state = self.state();
        let file = *state.entries.get(from).ok_or(io::ErrorKind::NotFound)?;
        state.change_entry(Entry::Rename(from.to_string(), to.to_string(), file))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let mut state = self.state();
        if !state.entries.contains_key(name) {
            return state.call(false);
        }
        state.change_entry(Entry::Remove(name.to_string()))
    }

    fn sync(&self) -> io::Result<()> {
        self.state().sync_folder()
    }
}

impl Disk {
    pub fn create_file(&self, name: &str) -> io::Result<DiskFile> {
        let mut state = self.state();
        let file = state.files.len();
        state.files.push(File::default());
        state.change_entry(Entry::Create(name.to_string(), file))?;
        drop(state);
        Ok(DiskFile { disk: self.clone(), file })
    }

    pub fn open_file(&self, name: &str) -> io::Result<Option<DiskFile>> {
        let mut state = self.state();
        state.call(false)?;
        Ok(state.entries.get(name).map(|&file| DiskFile { disk: self.clone(), file }))
    }
}
