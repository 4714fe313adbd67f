//! One suite for every I/O engine: written bytes come back whatever else is in flight, and every buffer is returned
//! whatever fails. The system's refusals are real: limits, seccomp filters, truncated files.

use crate::support::child::in_child;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::page::engine::buffer::{ALIGNMENT, PageBuffer};
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::open::{DEPTH, IoEngine, open_engine};
use gsscale::page::engine::page_engine::{Completion, Direction, PageEngine, Place, Transfer};
use gsscale::page::engine::segment_files::segment_file_name;
use gsscale::page::engine::threaded::ThreadedEngine;
#[cfg(target_os = "linux")]
use gsscale::page::engine::uring::UringEngine;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::io::ErrorKind;
use std::path::Path;
use tempfile::TempDir;

const SEGMENT: u64 = 8 << 20;

type Open = fn(&Path) -> Box<dyn PageEngine>;

/// The engines that work on files, with and without the page cache, by name.
fn file_engines() -> Vec<(&'static str, Open)> {
    #[cfg_attr(not(target_os = "linux"), expect(unused_mut))]
    let mut engines: Vec<(&str, Open)> = vec![
        ("pread", |folder| Box::new(ThreadedEngine::pread(folder, 6, true).unwrap())),
        ("pread, buffered", |folder| Box::new(ThreadedEngine::pread(folder, 6, false).unwrap())),
        ("mmap", |folder| Box::new(ThreadedEngine::mmap(folder, 6).unwrap())),
    ];
    #[cfg(target_os = "linux")]
    {
        match UringEngine::open(&std::env::temp_dir(), 1, true) {
            Ok(_) => {
                // A ring of 4 entries is always full in this test.
                engines.push(("uring", |folder| Box::new(UringEngine::open(folder, 32, true).unwrap())));
                engines.push(("uring of 4", |folder| Box::new(UringEngine::open(folder, 4, true).unwrap())));
                engines.push(("uring, buffered", |folder| Box::new(UringEngine::open(folder, 32, false).unwrap())));
            }
            Err(error) => eprintln!("io_uring is left out: {error}"),
        }
    }
    engines
}

fn all_engines() -> Vec<(&'static str, Open)> {
    let mut engines = file_engines();
    engines.push(("memory", |_| Box::new(MemoryEngine::new())));
    engines
}

fn transfer(token: u64, direction: Direction, segment: u32, offset: u64, buffer: PageBuffer) -> Transfer {
    Transfer { token, direction, place: Place { segment, offset }, bytes: buffer.len(), buffer }
}

fn move_one(store: &mut dyn PageEngine, transfer: Transfer) -> Completion {
    let mut done = Vec::new();
    store.submit(transfer);
    assert_eq!(store.in_flight(), 1);
    while done.is_empty() {
        store.complete(true, &mut done);
    }
    assert_eq!((done.len(), store.in_flight()), (1, 0));
    done.remove(0)
}

fn drain(store: &mut dyn PageEngine) -> Vec<Completion> {
    let mut done = Vec::new();
    while store.in_flight() > 0 {
        store.complete(true, &mut done);
    }
    done
}

/// A new folder with an engine whose segment 0 exists.
fn fresh(open: Open) -> (TempDir, Box<dyn PageEngine>) {
    let folder = tempfile::tempdir().unwrap();
    let mut store = open(folder.path());
    store.create_segment(0, SEGMENT).unwrap();
    (folder, store)
}

fn random_buffer(draws: &mut Stream, bytes: usize) -> PageBuffer {
    filled(draws, PageBuffer::zeroed(bytes))
}

fn filled(draws: &mut Stream, mut buffer: PageBuffer) -> PageBuffer {
    for word in buffer.as_mut_slice().chunks_exact_mut(8) {
        word.copy_from_slice(&draws.next_u64().to_le_bytes());
    }
    buffer
}

/// The expected contents of the segments, and the bytes in flight.
struct Model {
    segments: Vec<Vec<u8>>,
    busy: Vec<(u64, Place, usize)>,
}

impl Model {
    /// A place for `bytes` bytes that no transfer in flight touches.
    fn free_place(&self, draws: &mut Stream, bytes: usize) -> Option<Place> {
        let segment = draws.below(self.segments.len() as u64) as u32;
        let blocks = (SEGMENT - bytes as u64) / ALIGNMENT as u64 + 1;
        let place = Place { segment, offset: draws.below(blocks) * ALIGNMENT as u64 };
        let apart = |&(_, at, len): &(u64, Place, usize)| {
            at.segment != segment || at.offset + len as u64 <= place.offset || place.offset + bytes as u64 <= at.offset
        };
        self.busy.iter().all(apart).then_some(place)
    }

    fn take(&mut self, completion: &Completion, engine: &str) {
        let transfer = &completion.transfer;
        let at = self.busy.iter().position(|b| b.0 == transfer.token).expect("a completion of its own transfer");
        let (_, place, bytes) = self.busy.swap_remove(at);
        assert_eq!((transfer.place, transfer.bytes), (place, bytes));
        completion.result.as_ref().unwrap_or_else(|e| panic!("{engine}: {e}"));
        if transfer.direction == Direction::Read {
            let there = &self.segments[place.segment as usize][place.offset as usize..][..bytes];
            assert!(transfer.buffer.as_slice()[..bytes] == *there, "{engine}: other bytes at {place:?}, {bytes}");
        }
    }
}

#[test]
fn pages_round_trip_with_many_in_flight() {
    for (name, open) in all_engines() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(folder.path());
        let mut draws = Stream::new(1, Purpose::Test, 0, 0);
        let mut model = Model { segments: vec![vec![0; SEGMENT as usize]; 3], busy: Vec::new() };
        for segment in 0..3 {
            store.create_segment(segment, SEGMENT).unwrap();
        }
        let mut done = Vec::new();
        for token in 0..400 {
            // One block to 3 MiB, mostly odd numbers of blocks; some transfers are shorter than their buffer.
            let blocks = if token % 7 == 0 { 257 + draws.below(512) } else { 1 + draws.below(120) };
            let bytes = blocks as usize * ALIGNMENT;
            let Some(place) = model.free_place(&mut draws, bytes) else { continue };
            // Every second buffer is mapped memory, as frames are: the ring registers mapped buffers.
            let make = if token % 2 == 0 { PageBuffer::zeroed } else { PageBuffer::mapped };
            let mut buffer = filled(&mut draws, make(bytes + ALIGNMENT * (token % 3) as usize));
            let direction = if draws.below(2) == 0 { Direction::Read } else { Direction::Write };
            if direction == Direction::Write {
                let there = &mut model.segments[place.segment as usize][place.offset as usize..][..bytes];
                there.copy_from_slice(&buffer.as_mut_slice()[..bytes]);
            }
            model.busy.push((token, place, bytes));
            store.submit(Transfer { token, direction, place, bytes, buffer });
            assert_eq!(store.in_flight(), model.busy.len());
            let crowded = model.busy.len() > 24;
            store.complete(crowded, &mut done);
            assert!(!crowded || !done.is_empty(), "{name}: waiting brought nothing");
            done.drain(..).for_each(|c| model.take(&c, name));
        }
        while store.in_flight() > 0 {
            store.complete(true, &mut done);
            done.drain(..).for_each(|c| model.take(&c, name));
        }
        assert!(model.busy.is_empty());
        store.complete(true, &mut done);
        assert!(done.is_empty(), "nothing is in flight, and waiting for it ends at once");
        store.sync().unwrap();
        drop(store);
        if name != "memory" {
            every_engine_reads(folder.path(), &model, name);
        }
    }
}

/// A folder written by one engine is read by every engine.
fn every_engine_reads(folder: &Path, model: &Model, writer: &str) {
    for (name, open) in file_engines() {
        let mut store = open(folder);
        for (segment, bytes) in model.segments.iter().enumerate() {
            store.create_segment(segment as u32, SEGMENT).unwrap();
            let buffer = PageBuffer::zeroed(SEGMENT as usize);
            let end = move_one(&mut *store, transfer(9, Direction::Read, segment as u32, 0, buffer));
            end.result.unwrap();
            assert!(end.transfer.buffer.as_slice() == *bytes, "{name} reads what {writer} wrote");
        }
    }
}

#[test]
fn impossible_transfers_end_as_errors_with_their_buffers() {
    for (name, open) in all_engines() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(folder.path());
        store.create_segment(3, SEGMENT).unwrap();
        store.create_segment(3, SEGMENT).unwrap();
        assert_eq!(store.create_segment(3, SEGMENT / 2).unwrap_err().kind(), ErrorKind::AlreadyExists, "{name}");
        let bytes = 3 << 20;
        let cases = [
            (2, 0, ErrorKind::NotFound),
            (3, SEGMENT, ErrorKind::UnexpectedEof),
            (3, SEGMENT - (2 << 20), ErrorKind::UnexpectedEof),
            (3, u64::MAX - 4095, ErrorKind::UnexpectedEof),
        ];
        for (segment, offset, expected) in cases {
            for direction in [Direction::Read, Direction::Write] {
                let asked = transfer(7, direction, segment, offset, PageBuffer::zeroed(bytes));
                let end = move_one(&mut *store, asked);
                assert_eq!(end.result.unwrap_err().kind(), expected, "{name}, {segment} {offset} {direction:?}");
                assert_eq!((end.transfer.token, end.transfer.buffer.len()), (7, bytes));
            }
        }
        if name != "memory" {
            let mut asked = transfer(8, Direction::Write, 3, 512, PageBuffer::zeroed(4096));
            assert_eq!(move_one(&mut *store, asked).result.unwrap_err().kind(), ErrorKind::InvalidInput, "{name}");
            asked = transfer(8, Direction::Read, 3, 0, PageBuffer::zeroed(4096));
            asked.bytes = 8192;
            assert_eq!(move_one(&mut *store, asked).result.unwrap_err().kind(), ErrorKind::InvalidInput, "{name}");
            let length = std::fs::metadata(folder.path().join(segment_file_name(3))).unwrap().len();
            assert_eq!(length, SEGMENT, "{name}: a write beyond the end made the file longer");
        }
        // The store still works.
        let fresh = move_one(&mut *store, transfer(9, Direction::Read, 3, 4096, PageBuffer::zeroed(bytes)));
        fresh.result.unwrap();
        assert!(fresh.transfer.buffer.as_slice().iter().all(|&b| b == 0), "{name}: fresh space is zeros");
        store.sync().unwrap();
    }
}

/// Another process truncates or removes a file in use: the result is an error or the bytes, never a signal.
#[test]
fn files_cut_short_or_removed_in_use_are_errors() {
    for (name, open) in file_engines() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = open(folder.path());
        for segment in 0..2 {
            store.create_segment(segment, SEGMENT).unwrap();
            let buffer = random_buffer(&mut Stream::new(2, Purpose::Test, 0, 0), SEGMENT as usize);
            move_one(&mut *store, transfer(0, Direction::Write, segment, 0, buffer)).result.unwrap();
            move_one(&mut *store, transfer(0, Direction::Read, segment, 0, PageBuffer::zeroed(4096))).result.unwrap();
        }
        let path = |segment| folder.path().join(segment_file_name(segment));
        std::fs::OpenOptions::new().write(true).open(path(0)).unwrap().set_len(1 << 20).unwrap();
        let end = move_one(&mut *store, transfer(5, Direction::Read, 0, 0, PageBuffer::zeroed(2 << 20)));
        assert_eq!(end.result.unwrap_err().kind(), ErrorKind::UnexpectedEof, "{name}");
        assert_eq!(end.transfer.buffer.len(), 2 << 20);
        std::fs::remove_file(path(1)).unwrap();
        let end = move_one(&mut *store, transfer(6, Direction::Read, 1, 0, PageBuffer::zeroed(2 << 20)));
        assert_eq!((end.transfer.token, end.transfer.buffer.len()), (6, 2 << 20), "{name}");
        drop(store);
        let mut store = open(folder.path());
        let end = move_one(&mut *store, transfer(7, Direction::Read, 1, 0, PageBuffer::zeroed(4096)));
        assert_eq!(end.result.unwrap_err().kind(), ErrorKind::NotFound, "{name}");
    }
}

#[test]
fn dropping_a_store_carries_out_what_was_submitted() {
    for (name, open) in file_engines() {
        let (folder, mut store) = fresh(open);
        let mut draws = Stream::new(3, Purpose::Test, 0, 0);
        let expected: Vec<PageBuffer> = (0..8).map(|_| random_buffer(&mut draws, 1 << 20)).collect();
        let mut draws = Stream::new(3, Purpose::Test, 0, 0);
        for token in 0..8 {
            let buffer = random_buffer(&mut draws, 1 << 20);
            store.submit(transfer(token, Direction::Write, 0, token << 20, buffer));
        }
        drop(store);
        let mut store = open(folder.path());
        for (i, bytes) in expected.iter().enumerate() {
            let asked = transfer(0, Direction::Read, 0, (i as u64) << 20, PageBuffer::zeroed(1 << 20));
            let end = move_one(&mut *store, asked);
            assert!(end.transfer.buffer.as_slice() == bytes.as_slice(), "{name}: write {i} is lost");
        }
    }
}

/// A thread submits and ends; another thread takes the completions. (The kernel cancels requests of a ring whose thread
/// has ended.)
#[test]
fn transfers_outlive_the_thread_that_submitted_them() {
    for (name, open) in all_engines() {
        let (_folder, mut store) = fresh(open);
        for round in 0..20u8 {
            let submitting = std::thread::spawn(move || {
                for token in 0..8 {
                    let mut buffer = PageBuffer::zeroed(1 << 20);
                    buffer.as_mut_slice().fill(round + token as u8);
                    let direction = if round % 2 == 0 { Direction::Write } else { Direction::Read };
                    store.submit(transfer(token, direction, 0, token << 20, buffer));
                }
                store
            });
            store = submitting.join().unwrap();
            let done = drain(&mut *store);
            assert_eq!(done.len(), 8);
            for end in done {
                end.result.unwrap_or_else(|e| panic!("{name}: {e}"));
                let expected = round - round % 2 + end.transfer.token as u8;
                assert!(end.transfer.buffer.as_slice().iter().all(|&b| b == expected), "{name}, round {round}");
            }
        }
    }
}

#[test]
fn more_segments_than_open_files() {
    if !in_child(module_path!(), "more_segments_than_open_files") {
        return;
    }
    setrlimit(Resource::Nofile, Rlimit { current: Some(64), maximum: Some(64) }).unwrap();
    let segments = 150;
    let folder = tempfile::tempdir().unwrap();
    for (name, open) in file_engines() {
        let mut store = open(folder.path());
        // The rest of the process holds files as well, more than expected: all but four.
        let mut others: Vec<_> = std::iter::from_fn(|| std::fs::File::open("/dev/null").ok()).collect();
        others.truncate(others.len() - 4);
        for segment in 0..segments {
            store.create_segment(segment, 16384).unwrap();
            move_one(&mut *store, transfer(0, Direction::Read, segment, 0, PageBuffer::zeroed(8192))).result.unwrap();
        }
        drop(others);
        for direction in [Direction::Write, Direction::Read] {
            for segment in 0..segments {
                let mut buffer = PageBuffer::zeroed(8192);
                if direction == Direction::Write {
                    buffer.as_mut_slice().fill((segment as u8).wrapping_add(name.len() as u8));
                }
                store.submit(transfer(u64::from(segment), direction, segment, 4096, buffer));
            }
            let done = drain(&mut *store);
            store.sync().unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(done.len(), segments as usize);
            for end in done {
                end.result.unwrap_or_else(|e| panic!("{name}: segment {}: {e}", end.transfer.token));
                let expected = (end.transfer.token as u8).wrapping_add(name.len() as u8);
                assert!(end.transfer.buffer.as_slice().iter().all(|&b| b == expected), "{name}");
            }
        }
    }
}

/// Handles SIGXFSZ, so that a write beyond the limit on file sizes is an error. Without a handler the signal ends the
/// process.
fn outlive_the_signal_of_large_files() {
    let told = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, told).unwrap();
}

/// Limits the size of files: writes beyond `bytes` fail. `None` lifts the limit.
pub(super) fn limit_files(bytes: Option<u64>) {
    let maximum = getrlimit(Resource::Fsize).maximum;
    setrlimit(Resource::Fsize, Rlimit { current: bytes.or(maximum), maximum }).unwrap();
}

/// The system refuses writes beyond the first 2.5 MiB of any file, in the middle of a request.
#[test]
fn refused_writes_are_errors_with_their_buffers() {
    if !in_child(module_path!(), "refused_writes_are_errors_with_their_buffers") {
        return;
    }
    outlive_the_signal_of_large_files();
    let engines = file_engines();
    let stores: Vec<_> = engines
        .iter()
        .map(|(name, open)| {
            let (folder, store) = fresh(*open);
            (name, folder, store)
        })
        .collect();
    limit_files(Some(5 << 19));
    for (name, folder, mut store) in stores {
        let mut buffer = PageBuffer::zeroed(3 << 20);
        buffer.as_mut_slice().fill(7);
        let end = move_one(&mut *store, transfer(1, Direction::Write, 0, 1 << 20, buffer));
        assert_eq!(end.result.unwrap_err().kind(), ErrorKind::FileTooLarge, "{name}");
        assert_eq!(end.transfer.buffer.len(), 3 << 20);
        let file = std::fs::read(folder.path().join(segment_file_name(0))).unwrap();
        // The request at the limit was short; only its rest was refused.
        let wrote = |from: usize, to: usize| file[from..to].iter().all(|&b| b == 7);
        assert!(wrote(2 << 20, 5 << 19), "{name}: nothing of the last request came through");
        let end = move_one(&mut *store, transfer(2, Direction::Write, 0, 0, PageBuffer::zeroed(2 << 20)));
        end.result.unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

/// A new folder with a ring whose segment 0 exists, if this system has rings.
#[cfg(target_os = "linux")]
fn ring(entries: usize, direct: bool) -> Option<(TempDir, UringEngine)> {
    let folder = tempfile::tempdir().unwrap();
    let opened = UringEngine::open(folder.path(), entries, direct);
    let mut store = opened.inspect_err(|error| eprintln!("skipped: io_uring is refused here: {error}")).ok()?;
    store.create_segment(0, SEGMENT).unwrap();
    Some((folder, store))
}

/// A request of the ring that the system cuts short is resumed. The limit is lifted before the completion is taken.
#[cfg(target_os = "linux")]
#[test]
fn a_short_answer_of_the_ring_is_resumed() {
    use gsscale::page::engine::uring::REQUEST_BYTES;
    const { assert!(REQUEST_BYTES <= 1 << 20, "larger requests may end with EAGAIN") };
    if !in_child(module_path!(), "a_short_answer_of_the_ring_is_resumed") {
        return;
    }
    outlive_the_signal_of_large_files();
    for direct in [true, false] {
        let Some((folder, mut store)) = ring(32, direct) else { return };
        let buffer = random_buffer(&mut Stream::new(3, Purpose::Test, 0, 0), 3 << 20);
        let bytes = buffer.as_slice().to_vec();
        let (cut, path) = (5 << 19, folder.path().join(segment_file_name(0)));
        limit_files(Some(cut as u64));
        store.submit(transfer(1, Direction::Write, 0, 0, buffer));
        let began = std::time::Instant::now();
        while std::fs::read(&path).unwrap()[..cut] != bytes[..cut] {
            assert!(began.elapsed().as_secs() < 20, "nothing was written");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        // The kernel has finished its own retries by now.
        std::thread::sleep(std::time::Duration::from_millis(200));
        let file = std::fs::read(&path).unwrap();
        assert!(file[cut..].iter().all(|&b| b == 0), "the request was not cut short");
        limit_files(None);
        drain(&mut store).remove(0).result.unwrap();
        let file = std::fs::read(&path).unwrap();
        assert!(file[..bytes.len()] == bytes && file[bytes.len()..].iter().all(|&b| b == 0), "direct {direct}");
    }
}

#[test]
fn auto_takes_what_works_and_says_what_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let mut opened = open_engine(IoEngine::Auto, folder.path(), 8).unwrap();
    assert!(["uring", "pread"].contains(&opened.store.name()));
    assert_eq!(opened.store.name() == "pread", !opened.notes.is_empty());
    opened.store.create_segment(0, SEGMENT).unwrap();
    for engine in [IoEngine::Pread, IoEngine::Mmap] {
        let opened = open_engine(engine, folder.path(), 8).unwrap();
        assert_eq!(opened.store.name(), engine.name());
    }
}

/// Submits writes of random bytes, each of `bytes`, to places `from..to` of segment 0, takes no completion, and waits
/// until all bytes are in the file.
fn write_unasked(store: &mut dyn PageEngine, folder: &Path, places: std::ops::Range<usize>, bytes: usize) {
    const PIECE: usize = 64 << 10;
    let mut draws = Stream::new(1, Purpose::Test, 48, 0);
    for i in places.clone() {
        let buffer = random_buffer(&mut draws, bytes);
        store.submit(transfer(i as u64, Direction::Write, 0, (i * bytes) as u64, buffer));
    }
    let began = std::time::Instant::now();
    loop {
        let file = std::fs::read(folder.join(segment_file_name(0))).unwrap();
        let lacks = |i: &usize| file[(i + 1) * PIECE - 64..(i + 1) * PIECE].iter().all(|&b| b == 0);
        let missing: Vec<usize> = (places.start * bytes / PIECE..places.end * bytes / PIECE).filter(lacks).collect();
        if missing.is_empty() {
            return;
        }
        assert!(began.elapsed().as_secs() < 60, "{}: pieces {missing:?} wait to be asked for", store.name());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

/// While a step computes, nobody takes completions, and the drive must stay busy. All requests of the ring belong to
/// one transfer, because each further transfer takes completions to make room.
#[test]
fn three_times_the_usual_depth_completes_without_polling() {
    const MIB: usize = 1 << 20;
    let cases =
        [(IoEngine::Uring, 1, 3 * DEPTH * MIB), (IoEngine::Pread, 3 * DEPTH, MIB), (IoEngine::Mmap, 3 * DEPTH, MIB)];
    for (engine, transfers, bytes) in cases {
        let folder = tempfile::tempdir().unwrap();
        let mut store = match open_engine(engine, folder.path(), DEPTH) {
            Ok(opened) => opened.store,
            Err(error) if engine == IoEngine::Uring => {
                eprintln!("io_uring is left out: {error}");
                continue;
            }
            Err(error) => panic!("{error}"),
        };
        store.create_segment(0, (transfers * bytes) as u64).unwrap();
        write_unasked(&mut *store, folder.path(), 0..transfers, bytes);
        let done = drain(&mut *store);
        assert!(done.len() == transfers && done.iter().all(|end| end.result.is_ok()));
    }
}

/// Completed requests make room for others before their completions are taken.
#[cfg(target_os = "linux")]
#[test]
fn a_ring_of_ended_requests_is_not_full() {
    let Some((folder, mut store)) = ring(4, true) else { return };
    for first in (0..16).step_by(4) {
        write_unasked(&mut store, folder.path(), first..first + 4, 64 << 10);
        // The completion follows soon after the bytes are in the file, but not at once.
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    let done = drain(&mut store);
    assert!(done.len() == 16 && done.iter().all(|end| end.result.is_ok()));
}

/// Bytes of this process that the kernel has pinned.
#[cfg(target_os = "linux")]
fn pinned_bytes() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let kib = status.lines().find_map(|line| line.strip_prefix("VmPin:")).and_then(|v| v.trim().strip_suffix(" kB"));
    kib.unwrap().trim().parse::<usize>().unwrap() << 10
}

/// Waits until the kernel has pinned exactly `bytes` bytes. Before Linux 6.4 the kernel unpins a second late.
#[cfg(target_os = "linux")]
fn expect_pinned(bytes: usize) {
    let began = std::time::Instant::now();
    while pinned_bytes() != bytes {
        assert!(began.elapsed().as_secs() < 10, "{} bytes are held, not {bytes}", pinned_bytes());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

/// A ring with a table of registered buffers, if this system has one.
#[cfg(target_os = "linux")]
fn ring_with_table(folder: &Path) -> Option<UringEngine> {
    let store = UringEngine::open(folder, 8, true);
    match &store {
        Ok(store) if store.supports_registration() => {}
        Ok(_) => eprintln!("skipped: this kernel has no table for buffers"),
        Err(error) => eprintln!("skipped: io_uring is refused here: {error}"),
    }
    store.ok().filter(|store| store.supports_registration())
}

/// Writes other bytes from each buffer and reads them back into it.
#[cfg(target_os = "linux")]
fn write_and_read(store: &mut dyn PageEngine, draws: &mut Stream, buffers: Vec<PageBuffer>) -> Vec<PageBuffer> {
    let turn = |(i, buffer): (usize, PageBuffer)| {
        let buffer = filled(draws, buffer);
        let bytes = buffer.as_slice().to_vec();
        let at = (i * bytes.len()) as u64;
        let end = move_one(store, transfer(1, Direction::Write, 0, at, buffer));
        end.result.unwrap();
        let mut buffer = end.transfer.buffer;
        buffer.as_mut_slice().fill(0);
        let end = move_one(store, transfer(2, Direction::Read, 0, at, buffer));
        end.result.unwrap();
        assert!(end.transfer.buffer.as_slice() == bytes, "other bytes in buffer {i}");
        end.transfer.buffer
    };
    buffers.into_iter().enumerate().map(turn).collect()
}

#[cfg(target_os = "linux")]
#[test]
fn the_ring_registers_long_lived_buffers_and_releases_them() {
    use rustix::thread::{CapabilitySet, capabilities};
    // Two buffers fit the smallest common limit on locked memory, which other processes of this user share.
    let all = capabilities(None).unwrap().effective.contains(CapabilitySet::IPC_LOCK);
    let bytes = if all { 256 << 10 } else { 32 << 10 };
    if !in_child(module_path!(), "the_ring_registers_long_lived_buffers_and_releases_them") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let Some(mut store) = ring_with_table(folder.path()) else { return };
    store.create_segment(0, SEGMENT).unwrap();
    let mut draws = Stream::new(5, Purpose::Test, 0, 0);
    // Heap memory is not registered.
    write_and_read(&mut store, &mut draws, (0..4).map(|_| PageBuffer::zeroed(bytes)).collect());
    assert_eq!(store.registered(), 0);
    let before = pinned_bytes();
    // Only the part of a buffer that has moved is pinned.
    let mut buffer = PageBuffer::mapped(bytes);
    for (moved, held) in [(bytes / 4, bytes / 4), (4096, bytes / 4), (bytes, bytes), (bytes / 2, bytes)] {
        let part = Transfer { bytes: moved, ..transfer(3, Direction::Read, 0, 0, buffer) };
        let end = move_one(&mut store, part);
        end.result.unwrap();
        buffer = end.transfer.buffer;
        if !all && store.registered() == 0 {
            return eprintln!("skipped: the limit on locked memory is used up");
        }
        assert_eq!(store.registered(), 1);
        if all {
            expect_pinned(before + held);
        }
    }
    drop(buffer);
    store.complete(false, &mut Vec::new());

    let mut buffers: Vec<PageBuffer> = (0..8).map(|_| PageBuffer::mapped(bytes)).collect();
    for _ in 0..3 {
        buffers = write_and_read(&mut store, &mut draws, buffers);
        if !all && store.registered() < 8 {
            return eprintln!("skipped: the limit on locked memory is used up");
        }
        assert_eq!(store.registered(), 8, "once each");
        expect_pinned(before + 8 * bytes);
    }
    // Freed frames are unregistered, and new frames take their places in the table.
    buffers.truncate(3);
    store.complete(false, &mut Vec::new());
    assert_eq!(store.registered(), 3);
    expect_pinned(before + 3 * bytes);
    buffers.extend((0..4).map(|_| PageBuffer::mapped(bytes)));
    buffers = write_and_read(&mut store, &mut draws, buffers);
    assert!(store.registered() == 7 || !all);
    expect_pinned(before + store.registered() * bytes);
    // A buffer outlives its ring and is then registered with another.
    drop(store);
    let Some(mut store) = ring_with_table(folder.path()) else { panic!("the second ring is refused") };
    buffers = write_and_read(&mut store, &mut draws, buffers);
    assert!(store.registered() == 7 || !all);
    drop(buffers);
    store.complete(false, &mut Vec::new());
    assert_eq!(store.registered(), 0);
}

/// The child gives up the right to lock any amount of memory, and sets the limit.
#[cfg(target_os = "linux")]
#[test]
fn beyond_the_limit_on_locked_memory_buffers_move_unregistered() {
    use rustix::process::getrlimit;
    use rustix::thread::{CapabilitySet, capabilities, set_capabilities};
    const BYTES: usize = 256 << 10;
    if !in_child(module_path!(), "beyond_the_limit_on_locked_memory_buffers_move_unregistered") {
        return;
    }
    let limit = getrlimit(Resource::Memlock).maximum.map_or(1 << 20, |hard| hard.min(1 << 20));
    setrlimit(Resource::Memlock, Rlimit { current: Some(limit), maximum: Some(limit) }).unwrap();
    let mut own = capabilities(None).unwrap();
    let was_free = own.effective.contains(CapabilitySet::IPC_LOCK);
    own.effective.remove(CapabilitySet::IPC_LOCK);
    set_capabilities(None, own).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let Some(mut store) = ring_with_table(folder.path()) else { return };
    store.create_segment(0, SEGMENT).unwrap();
    let mut draws = Stream::new(6, Purpose::Test, 0, 0);
    let buffers = (0..24).map(|_| PageBuffer::mapped(BYTES)).collect();
    let buffers = write_and_read(&mut store, &mut draws, buffers);
    let registered = store.registered();
    assert!(registered <= limit as usize / BYTES, "{registered}");
    // For a user without a limit, only the ring itself counts against the new limit, and the ring is smaller than a
    // buffer: the refusals began after the expected buffers.
    let least = if was_free { (limit as usize / BYTES).saturating_sub(1) } else { 0 };
    assert!(registered >= least, "{registered} of {least}");
    let mut buffers = write_and_read(&mut store, &mut draws, buffers);
    assert_eq!(store.registered(), registered);
    // After some buffers are freed, others take their places.
    buffers.drain(..registered.min(2));
    store.complete(false, &mut Vec::new());
    assert_eq!(store.registered(), registered - registered.min(2));
    write_and_read(&mut store, &mut draws, buffers);
    assert!(store.registered() <= registered && (store.registered() == registered || !was_free));
}

/// Containers forbid io_uring with a seccomp filter; the filter of this test covers one thread.
#[cfg(target_os = "linux")]
#[test]
fn a_refused_ring_falls_back_with_the_reason() {
    use seccompiler::{BpfProgram, SeccompAction, SeccompFilter, apply_filter};
    const SETUP: i64 = 425;
    const ENTER: i64 = 426;
    let cases = [(SETUP, 1, "Operation not permitted"), (SETUP, 38, "not implemented"), (ENTER, 1, "not permitted")];
    for (call, errno, reason) in cases {
        let refused = std::thread::spawn(move || {
            let rules = [(call, Vec::new())].into_iter().collect();
            let machine = std::env::consts::ARCH.try_into().unwrap();
            let filter = SeccompFilter::new(rules, SeccompAction::Allow, SeccompAction::Errno(errno), machine);
            let program: BpfProgram = filter.unwrap().try_into().unwrap();
            apply_filter(&program).unwrap();
            let folder = tempfile::tempdir().unwrap();
            let mut opened = open_engine(IoEngine::Auto, folder.path(), 8).unwrap();
            assert_eq!((opened.store.name(), opened.notes.len()), ("pread", 1));
            assert!(opened.notes[0].contains(reason) && opened.notes[0].contains("pread"), "{:?}", opened.notes);
            opened.store.create_segment(0, SEGMENT).unwrap();
            let buffer = random_buffer(&mut Stream::new(4, Purpose::Test, 0, 0), 1 << 20);
            move_one(&mut *opened.store, transfer(1, Direction::Write, 0, 0, buffer)).result.unwrap();
            let by_name = open_engine(IoEngine::Uring, folder.path(), 8).err().unwrap().to_string();
            assert!(by_name.contains(reason) && by_name.contains("--io auto"), "{by_name}");
        });
        refused.join().unwrap();
    }
}

#[test]
fn iotune_prints_lines_for_a_config_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let tune = |args: &[&str]| {
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_gsscale-iotune"));
        program.arg(folder.path()).args(args).output().unwrap()
    };
    let output = tune(&["--file", "192MiB", "--seconds", "4", "--written", "64MiB"]);
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}{errors}");
    for key in ["io = \"", "page-rows = ", "spill-codec = \""] {
        assert_eq!(said.lines().filter(|l| l.starts_with(key)).count(), 1, "{key} in: {said}");
    }
    let refused = tune(&["--file", "1023GiB"]);
    let errors = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(1));
    assert!(errors.contains("are free") && errors.contains("remedy"), "{errors}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left");
}
