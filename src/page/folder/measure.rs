//! Measures how fast a drive moves pages: in about a second, for plans ([`DriveRate`]), or by engine, request size and queue depth
//! ([`sweep`]). Knows the codec that suits a drive.
//!
//! The measurement uses the same engines as a run. Each engine has a segment of its own, because direct I/O on bytes
//! that the page cache holds behaves differently. The segment files are unlinked before the measurement, so nothing is
//! left behind, unless the process is killed while it makes them. Reads are as cold as the machine allows (direct I/O, or dropped from the page
//! cache); caches of the drive itself, or of the host below a virtual drive, are part of the figure.
//!
//! Invariants: 1. every round visits every case, so that a drive whose speed varies treats all cases alike; figures are
//! medians over rounds; 2. [`Limits`] bounds bytes on the drive, bytes written and seconds (a case that has started
//! runs to its end, and the first case is always measured).

use crate::base::error::{InputError, InputResult};
use crate::base::identity::draw_identity;
use crate::base::rng::{Purpose, Stream};
use crate::base::units::format_bytes;
use crate::page::engine::buffer::PageBuffer;
use crate::page::engine::open::{DEPTH, IoEngine, open_engine};
use crate::page::engine::page_engine::{Completion, Direction, PageEngine, Place, Transfer};
use crate::page::folder::file_system::free_bytes;
use crate::page::format::codec::Codec;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Target number of rounds.
const ROUNDS: usize = 5;
/// Bytes per request of the first fill.
const FILL_BYTES: usize = 1 << 20;
/// Requests in flight during the first fill.
const FILL_DEPTH: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Bytes on the drive, divided among the engines.
    pub file_bytes: u64,
    /// Approximate total time, seconds.
    pub seconds: f64,
    /// Approximate bytes written besides the first fill.
    pub written_bytes: u64,
}

/// One combination of engine, transfer size and queue depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Case {
    pub engine: IoEngine,
    pub bytes: usize,
    /// Transfers in flight.
    pub depth: usize,
}

/// A case with its rates, bytes per second; `None` if time ran out before it was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredCase {
    pub case: Case,
    /// Rate of random reads.
    pub read: Option<f64>,
    /// Rate of random writes, fsync included.
    pub write: Option<f64>,
}

impl MeasuredCase {
    /// Bytes per second of an equal mix of reads and writes, which is training's pattern: nearly every page read is
    /// changed.
    pub fn both(&self) -> Option<f64> {
        Some(2.0 / (1.0 / self.read? + 1.0 / self.write?))
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    /// One entry per case, in the order of the cases.
    pub measured: Vec<MeasuredCase>,
    /// Messages for the user: engines that do not work here, missing direct I/O.
    pub notes: Vec<String>,
    pub rounds: usize,
    pub written_bytes: u64,
}

/// Measures all `cases` on the drive of `folder`. Cases whose engine does not work here get no rates. Calls `progress`
/// with the fraction done.
/// Errors: too little space, the folder cannot be written, the drive fails.
pub fn sweep(folder: &Path, cases: &[Case], limits: Limits, progress: &mut dyn FnMut(f64)) -> InputResult<Sweep> {
    let begin = Instant::now();
    let depth_max = cases.iter().map(|c| c.depth).max().unwrap_or(1);
    let mut engines: Vec<IoEngine> = Vec::new();
    cases.iter().filter(|c| c.depth > 0).for_each(|c| {
        if !engines.contains(&c.engine) {
            engines.push(c.engine);
        }
    });
    let mut scratch = ScratchSegments::new(folder, &engines, limits.file_bytes, depth_max)?;
    let failed = |e: io::Error| InputError::io(folder, "measuring the drive", &e);
    scratch.fill(Duration::from_secs_f64(limits.seconds / 2.0)).map_err(failed)?;
    let filled = scratch.written_bytes;
    let slice = (limits.seconds - begin.elapsed().as_secs_f64()) / (2 * ROUNDS * cases.len().max(1)) as f64;
    let slice = Duration::from_secs_f64(slice.max(0.005));
    let written_max = limits.written_bytes / (ROUNDS * cases.len().max(1)) as u64;
    let mut rates = vec![[const { Vec::new() }; 2]; cases.len()];
    let mut rounds = 0;
    'rounds: while rounds < ROUNDS {
        for turn in 0..cases.len() {
            // Each round starts at another case, because the last cases are the ones that may run out of time.
            let i = (turn + rounds * cases.len() / ROUNDS) % cases.len();
            let case = cases[i];
            if !scratch.has(case.engine) {
                continue;
            }
            for direction in [Direction::Read, Direction::Write] {
                let begun = rounds > 0 || turn > 0;
                if begun && begin.elapsed().as_secs_f64() > limits.seconds {
                    break 'rounds;
                }
                // A case writes twice its depth at least.
                let least = 2 * (case.depth * case.bytes) as u64;
                if direction == Direction::Write && scratch.written_bytes - filled + least > limits.written_bytes {
                    continue;
                }
                let bytes_max = if direction == Direction::Write { written_max } else { u64::MAX };
                let rate = scratch.rate(case, direction, slice, bytes_max).map_err(failed)?;
                rates[i][usize::from(direction == Direction::Write)].push(rate);
            }
            progress(begin.elapsed().as_secs_f64() / limits.seconds);
        }
        rounds += 1;
    }
    let measure = |(&case, [read, write]): (&Case, &mut [Vec<f64>; 2])| MeasuredCase {
        case,
        read: median(read),
        write: median(write),
    };
    let measured = cases.iter().zip(&mut rates).map(measure).collect();
    Ok(Sweep { measured, notes: scratch.notes, rounds, written_bytes: scratch.written_bytes })
}

/// The median; `None` for an empty slice.
fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Unlinked segments, one per engine.
struct ScratchSegments {
    engines: Vec<MeasuredEngine>,
    /// Where open files keep their names. After `engines`, which close the files first.
    _folder: Option<FolderToRemove>,
    segment_bytes: u64,
    buffers: Vec<PageBuffer>,
    draws: Stream,
    pub notes: Vec<String>,
    pub written_bytes: u64,
}

/// A folder of this process that goes with the value.
struct FolderToRemove(PathBuf);

impl Drop for FolderToRemove {
    fn drop(&mut self) {
        // What is left is in the user's sight.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// An open engine with its segment.
struct MeasuredEngine {
    engine: IoEngine,
    segment: u32,
    store: Box<dyn PageEngine>,
    /// Bytes from the start of the segment that were written at least once. Reads beyond would not reach the drive.
    filled_bytes: u64,
}

impl ScratchSegments {
    /// Makes the segments, of `file_bytes` bytes together, and opens each engine of `engines` that works here.
    /// Errors: too little space; the folder cannot be written; no engine works.
    pub fn new(folder: &Path, engines: &[IoEngine], file_bytes: u64, depth: usize) -> InputResult<ScratchSegments> {
        let failed = |doing: &'static str| move |e: io::Error| InputError::io(folder, doing, &e);
        let free = free_bytes(folder).map_err(failed("reading the free space"))?;
        if let Some(free) = free.filter(|&free| free < file_bytes + file_bytes / 4) {
            let problem =
                format!("{} are free, but measuring needs {}", format_bytes(free), format_bytes(file_bytes * 5 / 4));
            return Err(InputError::new(folder, problem, "free space on that drive, or measure with a smaller file"));
        }
        // A name of its own: what is removed below is what this process has made.
        let own = folder.join(format!("gsscale-measure-{:032x}", draw_identity()));
        std::fs::create_dir(&own).map_err(failed("creating a folder for the measurement"))?;
        let opened = ScratchSegments::open_all(&own, engines, file_bytes, depth);
        if cfg!(not(unix)) {
            let folder = FolderToRemove(own);
            return opened.map(|scratch| ScratchSegments { _folder: Some(folder), ..scratch });
        }
        // Unlinks the segments: the system frees their space when this process ends, at the latest.
        std::fs::remove_dir_all(&own).map_err(failed("removing the folder of the measurement"))?;
        opened
    }

    fn open_all(own: &Path, engines: &[IoEngine], file_bytes: u64, depth: usize) -> InputResult<ScratchSegments> {
        let mut scratch = ScratchSegments {
            engines: Vec::new(),
            _folder: None,
            segment_bytes: file_bytes / engines.len().max(1) as u64 / FILL_BYTES as u64 * FILL_BYTES as u64,
            buffers: Vec::new(),
            draws: Stream::new(1, Purpose::Test, 0, 0),
            notes: Vec::new(),
            written_bytes: 0,
        };
        let mut refused = None;
        for (segment, &engine) in (0..).zip(engines) {
            let mut opened = match open_engine(engine, own, depth) {
                Ok(opened) => opened,
                Err(error) => {
                    scratch.notes.push(format!("{}: {}", error.file.display(), error.problem));
                    refused = Some(error);
                    continue;
                }
            };
            let failed = |e: io::Error| InputError::io(own, "creating a test file", &e);
            opened.store.create_segment(segment, scratch.segment_bytes).map_err(failed)?;
            // The engine opens the file now, while it has a name, and keeps it open.
            let buffer = PageBuffer::zeroed(4096);
            let place = Place { segment, offset: 0 };
            opened.store.submit(Transfer { token: 0, direction: Direction::Read, place, bytes: 4096, buffer });
            finish(&mut *opened.store).map_err(failed)?;
            scratch.engines.push(MeasuredEngine { engine, segment, store: opened.store, filled_bytes: 0 });
            scratch.notes.extend(opened.notes);
        }
        scratch.notes.dedup();
        match refused {
            Some(error) if scratch.engines.is_empty() => Err(error),
            _ => Ok(scratch),
        }
    }

    fn has(&self, engine: IoEngine) -> bool {
        self.engines.iter().any(|o| o.engine == engine)
    }

    /// Writes every segment from its start until the segment is full or its share of the time is over. Returns bytes
    /// per second, fsync included.
    /// Errors: the drive's I/O errors.
    pub fn fill(&mut self, time: Duration) -> io::Result<f64> {
        self.prepare_buffers(FILL_DEPTH, FILL_BYTES);
        let (begin, mut moved) = (Instant::now(), 0);
        let share = time / self.engines.len().max(1) as u32;
        for opened in &mut self.engines {
            let places = (0..self.segment_bytes / FILL_BYTES as u64).map(|i| i * FILL_BYTES as u64);
            let case = Case { engine: opened.engine, bytes: FILL_BYTES, depth: FILL_DEPTH };
            opened.filled_bytes =
                opened.run(Direction::Write, case, places, &mut self.buffers, Instant::now() + share)?;
            opened.store.sync()?;
            moved += opened.filled_bytes;
        }
        self.written_bytes += moved;
        Ok(moved as f64 / begin.elapsed().as_secs_f64())
    }

    /// Bytes per second of one case, measured over about `time` and at most about `bytes_max` bytes.
    /// Errors: the drive's I/O errors.
    pub fn rate(&mut self, case: Case, direction: Direction, time: Duration, bytes_max: u64) -> io::Result<f64> {
        self.prepare_buffers(case.depth, case.bytes);
        let bytes = case.bytes as u64;
        let Some(opened) = self.engines.iter_mut().find(|o| o.engine == case.engine) else {
            return Err(io::ErrorKind::Unsupported.into());
        };
        let mut places: Vec<u64> = (0..opened.filled_bytes / bytes).map(|i| i * bytes).collect();
        self.draws.shuffle(&mut places);
        // At least twice the queue depth, so that the case's depth is reached.
        places.truncate((bytes_max / bytes).max(2 * case.depth as u64) as usize);
        let begin = Instant::now();
        let moved = opened.run(direction, case, places.into_iter(), &mut self.buffers, begin + time)?;
        if direction == Direction::Write {
            opened.store.sync()?;
            self.written_bytes += moved;
        }
        Ok(moved as f64 / begin.elapsed().as_secs_f64())
    }

    /// At least `depth` buffers of at least `bytes` bytes, filled with incompressible noise.
    fn prepare_buffers(&mut self, depth: usize, bytes: usize) {
        if self.buffers.iter().filter(|b| b.len() >= bytes).count() >= depth {
            return;
        }
        self.buffers.retain(|b| b.len() >= bytes);
        while self.buffers.len() < depth {
            let mut buffer = PageBuffer::zeroed(bytes);
            for word in buffer.as_mut_slice().chunks_exact_mut(8) {
                word.copy_from_slice(&self.draws.next_u64().to_le_bytes());
            }
            self.buffers.push(buffer);
        }
    }
}

impl MeasuredEngine {
    /// Moves bytes at `places` until all are moved or time is over. Returns the number of bytes moved.
    fn run(
        &mut self,
        direction: Direction,
        Case { bytes, depth, .. }: Case,
        mut places: impl Iterator<Item = u64>,
        buffers: &mut Vec<PageBuffer>,
        end: Instant,
    ) -> io::Result<u64> {
        let mut moved = 0;
        let mut done: Vec<Completion> = Vec::new();
        let mut error = None;
        loop {
            while self.store.in_flight() < depth && error.is_none() && (moved == 0 || Instant::now() < end) {
                let Some(at) = buffers.iter().position(|b| b.len() >= bytes) else { break };
                let Some(offset) = places.next() else { break };
                let place = Place { segment: self.segment, offset };
                let buffer = buffers.swap_remove(at);
                self.store.submit(Transfer { token: offset, direction, place, bytes, buffer });
            }
            if self.store.in_flight() == 0 {
                return error.map_or(Ok(moved), Err);
            }
            self.store.complete(true, &mut done);
            for completion in done.drain(..) {
                moved += completion.transfer.bytes as u64;
                buffers.push(completion.transfer.buffer);
                error = error.or(completion.result.err());
            }
        }
    }
}

/// Waits for all transfers in flight.
fn finish(store: &mut dyn PageEngine) -> io::Result<()> {
    let mut done = Vec::new();
    while store.in_flight() > 0 {
        store.complete(true, &mut done);
    }
    done.into_iter().try_for_each(|c| c.result)
}

/// Bytes per second below which compression pays. A core compresses 0.8 GB/s and decompresses 3.7 GB/s, and saves a
/// seventh of the bytes, so on faster drives compression only costs.
const CODEC_PAYS_BELOW: f64 = 0.5e9;
/// Size of the test file, bytes.
const MEASURED_BYTES: u64 = 128 << 20;
/// Bytes of one transfer: about a page.
const TRANSFER_BYTES: usize = 768 << 10;
/// Measuring time per direction.
const TIME: Duration = Duration::from_millis(450);

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveRate {
    /// Bytes per second of random reads.
    pub read: f64,
    /// Bytes per second of writes, fsync included.
    pub write: f64,
}

impl DriveRate {
    /// A common NVMe drive.
    pub const COMMON: DriveRate = DriveRate { read: 3e9, write: 2e9 };

    /// Measures the drive of `folder`. Leaves no file behind.
    /// Errors: too little space, the folder cannot be written, the drive fails.
    pub fn measure(folder: &Path) -> InputResult<DriveRate> {
        let failed = |e: io::Error| InputError::io(folder, "measuring the drive", &e);
        let engine = IoEngine::Auto;
        let mut scratch = ScratchSegments::new(folder, &[engine], MEASURED_BYTES, DEPTH)?;
        // Writes to fresh space, as an import and the first spills do.
        let write = scratch.fill(TIME).map_err(failed)?;
        let case = Case { engine, bytes: TRANSFER_BYTES, depth: DEPTH / 2 };
        let read = scratch.rate(case, Direction::Read, TIME, u64::MAX).map_err(failed)?;
        Ok(DriveRate { read, write })
    }
}

/// The codec for a drive that moves this many bytes per second, reads and writes mixed.
pub fn codec_for(bytes_per_second: f64) -> Codec {
    if bytes_per_second < CODEC_PAYS_BELOW { Codec::Zstd { level: 1 } } else { Codec::Raw }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_is_written_than_allowed() {
        let folder = tempfile::tempdir().unwrap();
        let case = |bytes, depth| Case { engine: IoEngine::Pread, bytes, depth };
        let limits = Limits { file_bytes: 32 << 20, seconds: 20.0, written_bytes: 3 << 20 };
        // Twice the depth of the second case is 4 MiB.
        let swept = sweep(folder.path(), &[case(65_536, 1), case(1 << 20, 2)], limits, &mut |_| ()).unwrap();
        assert!(swept.written_bytes <= limits.file_bytes + limits.written_bytes, "{swept:?}");
        assert!(swept.measured[0].write.is_some() && swept.measured[1].write.is_none(), "{swept:?}");
        assert!(swept.measured.iter().all(|measured| measured.read.is_some()));
    }

    #[test]
    fn too_little_space_is_refused_before_anything_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let case = Case { engine: IoEngine::Pread, bytes: 65_536, depth: 1 };
        let limits = Limits { file_bytes: 1 << 60, seconds: 1.0, written_bytes: 0 };
        let refused = sweep(folder.path(), &[case], limits, &mut |_| ()).unwrap_err().to_string();
        assert!(refused.contains("free") && refused.contains("smaller"), "{refused}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
