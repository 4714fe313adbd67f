//! Time to commit to a store and to open a store, on a real drive. (What commits cost a run is in the run's
//! `summary.json`: `commit_overhead_percent`, `commit_bytes`, `commit_interval`.)
//!
//! `cargo bench --bench commit` commits 64 and 1,000 dirty pages of 728 KiB (numbers choose other counts), and opens a
//! store of 100,000 pages. Files are in the folder of temporary files (`TMPDIR`). A test run uses a few small pages.
//!
//! A commit writes the pages, syncs the segments, commits the map's transaction and writes the witness. The opened
//! store has empty sparse segments, because opening reads the map but no page.

#![allow(clippy::expect_used)] // a benchmark that cannot run ends

pub mod support;

use gsscale::base::ids::PageId;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::engine::segment_files::segment_file_name;
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::{SlotRef, StoredAs};
use gsscale::page::map::commit::{CommitConfig, CommitError, Cut, PageChange};
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::paged_store::{PageMoved, PagedStore};
use gsscale::page::versions::slots::SlotLayout;
use std::path::PathBuf;
use std::time::Instant;
use support::Args;

/// Bytes of a page of 1,024 rows at SH degree 3.
const PAGE_BYTES: usize = 745_472;
const CONFIG: CommitConfig = CommitConfig { store: 0xbe, cache_bytes: 16 << 20, reserve_bytes: 0 };
/// Stands for the bounds and counts of a page.
const LABEL: [u8; 64] = [7; 64];

/// Seconds of one measurement.
#[derive(Debug, Clone, Copy)]
pub struct CommitTime {
    /// Seconds to write the pages.
    pub write: f64,
    /// Seconds for sync, transaction and witness.
    pub commit: f64,
}

fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("gsscale-bench-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("the folder of temporary files can be written");
    folder
}

fn layout(capacity: usize) -> SlotLayout {
    SlotLayout::new(capacity, 1 << 16)
}

fn write_pages(store: &mut PagedStore, pages: u32, bytes: usize) -> Vec<PageChange> {
    let mut done = Vec::new();
    for page in 0..pages {
        let mut buffer = store.new_buffer();
        buffer.as_mut_slice()[4096..].fill((page as u8).wrapping_add(1));
        let written = store.write(u64::from(page), PageId::initial(page), &LABEL, bytes, buffer);
        written.map_err(|(error, _)| error).expect("the drive has space");
        while store.in_flight() > 32 {
            store.complete(true, &mut done);
        }
    }
    while store.in_flight() > 0 {
        store.complete(true, &mut done);
    }
    let changes = done.into_iter().map(|end| match end.result {
        Ok(PageMoved::Written(slot)) => PageChange { page: end.page, version: Some((slot, LABEL.to_vec())) },
        other => panic!("a page was not written: {other:?}"),
    });
    changes.collect()
}

/// Seconds to write and to commit `pages` pages of `bytes` bytes, the median of `times`.
pub fn commit_seconds(pages: u32, bytes: usize, times: usize) -> Result<CommitTime, CommitError> {
    let at = folder("commit");
    let engine = open_engine(IoEngine::Auto, &at, 8).expect("an engine works here").store;
    let opened = Opened::create(Box::new(DriveFolder::new(&at)), CONFIG)?;
    let mut store = opened.paged_store(engine, layout(bytes), Codec::Raw)?;
    let mut commits = opened.commits;
    let mut present: Vec<PageChange> = Vec::new();
    let mut measured = Vec::new();
    for _ in 0..times {
        let began = Instant::now();
        let changes = write_pages(&mut store, pages, bytes);
        let write = began.elapsed().as_secs_f64();
        present.iter().filter_map(|c| c.version.as_ref()).for_each(|(slot, _)| store.free(slot));
        let began = Instant::now();
        let cut = Cut { changes: &changes, run_state: &[1; 4096], note: b"", pin: None };
        commits.commit(&mut store, &mut Vec::new(), &cut)?;
        measured.push((write, began.elapsed().as_secs_f64()));
        present = changes;
    }
    let _ = std::fs::remove_dir_all(at);
    let write = support::median(measured.iter().map(|m| m.0));
    Ok(CommitTime { write, commit: support::median(measured.iter().map(|m| m.1)) })
}

/// Seconds to open a store whose map has `pages` pages.
pub fn open_seconds(pages: u32) -> Result<f64, CommitError> {
    let (at, layout) = (folder("open"), layout(PAGE_BYTES));
    let opened = Opened::create(Box::new(DriveFolder::new(&at)), CONFIG)?;
    let mut store = opened.paged_store(Box::new(MemoryEngine::new()), layout, Codec::Raw)?;
    let change = |page: u32| {
        let (place, checksum) = (layout.place(u64::from(page)), u128::from(page) << 64);
        let codec = StoredAs::Raw;
        let slot = SlotRef { place, stored_bytes: 9, payload_bytes: 9, generation: 1, checksum, codec };
        PageChange { page: PageId::initial(page), version: Some((slot, LABEL.to_vec())) }
    };
    let changes: Vec<PageChange> = (0..pages).map(change).collect();
    let mut commits = opened.commits;
    let cut = Cut { changes: &changes, run_state: &[1; 4096], note: b"", pin: None };
    commits.commit(&mut store, &mut Vec::new(), &cut)?;
    drop((commits, store));
    for segment in 0..=layout.place(u64::from(pages - 1)).segment {
        let made = std::fs::File::create(at.join(segment_file_name(segment)));
        made.and_then(|file| file.set_len(layout.segment_bytes())).expect("the drive takes a file of holes");
    }
    let began = Instant::now();
    let opened = Opened::open(Box::new(DriveFolder::new(&at)), CONFIG)?;
    let engine = open_engine(IoEngine::Pread, &at, 8).expect("plain reads work everywhere").store;
    opened.paged_store(engine, layout, Codec::Raw)?;
    let seconds = began.elapsed().as_secs_f64();
    let _ = std::fs::remove_dir_all(at);
    Ok(seconds)
}

/// Commits and opens with small sizes; returns whether all times are positive.
pub fn tiny() -> bool {
    let commit = commit_seconds(5, 5000, 3).expect("a store takes commits");
    let open = open_seconds(300).expect("a store opens");
    commit.write > 0.0 && commit.commit > 0.0 && open > 0.0
}

fn main() {
    let args = Args::read();
    if !args.real {
        assert!(tiny());
        return;
    }
    let sizes = if args.sizes.is_empty() { vec![64, 1000] } else { args.sizes.clone() };
    for dirty in sizes {
        match commit_seconds(dirty as u32, PAGE_BYTES, 5) {
            Ok(CommitTime { write, commit }) => {
                println!("commit {dirty} pages of 728 KiB: write {write:.3} s, commit {:.1} ms", commit * 1e3);
            }
            Err(error) => println!("commit: {error}"),
        }
    }
    match open_seconds(100_000) {
        Ok(seconds) => println!("open a store of 100,000 pages: {seconds:.3} s"),
        Err(error) => println!("open: {error}"),
    }
}
