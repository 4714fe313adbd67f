//! Commits beside steps: a commit holds every page as of its cut, whatever later steps changed, and the store opens
//! with exactly these pages.

use super::world::{Model, PAGE_ROWS, Run, SH_DEGREE, check, config};
use super::{PAGES, STEPS, run_in_memory};
use crate::support::faulty_engine::{Fault, Faults, FaultyEngine, Operation};
use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::page::engine::open::{IoEngine, open_engine};
use gsscale::page::folder::protocol_files::DriveFolder;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::{CommitConfig, Commits};
use gsscale::page::map::opening::Opened;
use gsscale::page::versions::paged_store::PagedStore;
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::error::PagingError;
use gsscale::paging::pager::Pager;
use gsscale::scene::page_layout::capacity_bytes;
use std::io::ErrorKind;
use std::path::Path;

pub const COMMITS: CommitConfig = CommitConfig { store: 9, cache_bytes: 1 << 20, reserve_bytes: 0 };

pub fn paged_store(opened: &Opened, folder: &Path, codec: Codec, faults: &Faults) -> PagedStore {
    let engine = open_engine(IoEngine::Pread, folder, 3).unwrap().store;
    let layout = SlotLayout::new(capacity_bytes(PAGE_ROWS, SH_DEGREE), 40);
    opened.paged_store(Box::new(FaultyEngine::new(engine, faults.clone())), layout, codec).unwrap()
}

/// A run over a new store in `folder`.
fn started(
    folder: &Path,
    seed: u64,
    frames: usize,
    codec: Codec,
    faults: &Faults,
) -> Result<(Run, Commits), PagingError> {
    let opened = Opened::create(Box::new(DriveFolder::new(folder)), COMMITS).unwrap();
    let pager = Pager::new(config(frames), paged_store(&opened, folder, codec, faults));
    Ok((Run::new(pager, seed, PAGES, STEPS)?, opened.commits))
}

fn commit_cut(run: &mut Run, commits: &mut Commits) {
    run.pager.freeze().unwrap();
    run.pager.finish_frozen().unwrap();
    run.pager.commit_frozen(commits, b"state", b"").unwrap().unwrap();
}

/// Asserts that the store holds exactly the pages of `model` that have rows.
pub fn opens_with(folder: &Path, model: &Model) {
    let opened = Opened::open(Box::new(DriveFolder::new(folder)), COMMITS).unwrap();
    let store = paged_store(&opened, folder, Codec::Raw, &Faults::new());
    let mut pager = Pager::open(config(7), store, &opened.pages, 0).unwrap();
    let pages: Vec<PageNo> = (0..pager.index().len() as u32).map(PageNo).collect();
    assert_eq!(pages.len(), model.values().filter(|(meta, _)| meta.rows > 0).count());
    for some in pages.chunks(5) {
        let pinned = pager.acquire_pages(some).unwrap();
        pinned.iter().for_each(|page| check(page, model));
        pager.release(pinned);
    }
}

/// Counts of a run's commits.
#[derive(Default)]
struct Done {
    committed: u32,
    given_up: u32,
    /// Cuts that found pages to write.
    had_to_write: u32,
}

/// Steps with occasional cuts. A cut is committed once its pages are written, or earlier, or abandoned.
fn run_with_commits(seed: u64, frames: usize, codec: Codec, faults: &Faults) -> Result<Done, PagingError> {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (mut run, mut commits) = started(at, seed, frames, codec, faults)?;
    let mut draws = Stream::new(seed, Purpose::Test, 9, 9);
    let mut done = Done::default();
    let (mut cut, mut last): (Option<Model>, Option<Model>) = (None, None);
    while (run.step as usize) < STEPS {
        run.step()?;
        match &cut {
            None if draws.below(4) == 0 => {
                run.pager.freeze()?;
                done.had_to_write += u32::from(!run.pager.is_frozen_written());
                cut = Some(run.model.clone());
            }
            None => {}
            Some(_) if draws.below(24) == 0 => {
                run.pager.abort_cut();
                done.given_up += 1;
                cut = None;
            }
            Some(model) if run.pager.is_frozen_written() || draws.below(8) == 0 => {
                run.pager.finish_frozen()?;
                let committed = run.pager.commit_frozen(&mut commits, b"state", b"").unwrap();
                assert!(committed.is_some());
                done.committed += 1;
                last = Some(model.clone());
                cut = None;
            }
            Some(_) if draws.below(24) == 0 => {
                run.pager.flush()?;
                run.pager.commit(&mut commits, b"state", b"", None).unwrap();
                last = Some(run.model.clone());
                cut = None;
            }
            Some(_) => {}
        }
        // A copy opened as after a crash, while the run continues. Opening writes nothing.
        if done.committed % 4 == 3 && draws.below(6) == 0 {
            drop(commits);
            opens_with(at, last.as_ref().unwrap());
            commits = Opened::open(Box::new(DriveFolder::new(at)), COMMITS).unwrap().commits;
        }
    }
    run.check_all(3)?;
    drop((run, commits));
    if let Some(model) = &last {
        opens_with(at, model);
    }
    Ok(done)
}

#[test]
fn a_cut_is_committed_as_it_was_whatever_the_steps_after_it_do() {
    let (mut committed, mut had_to_write) = (0, 0);
    for seed in 0..6 {
        let (_, fewest) = run_in_memory(seed);
        for (frames, codec) in [(fewest, Codec::Raw), (fewest + 5, Codec::Zstd { level: 1 }), (usize::MAX, Codec::Raw)]
        {
            let faults = Faults::new();
            if seed % 2 == 0 {
                faults.reorder(seed + 7);
            }
            let done = run_with_commits(seed, frames, codec, &faults).unwrap();
            committed += done.committed;
            had_to_write += done.had_to_write;
        }
    }
    assert!(committed > 100 && had_to_write > 100, "{committed} of {had_to_write}");
}

/// A step that has changed rows must not be repeated. If a page of the step cannot be written for the cut, the step
/// gets the page all the same, and the next step gets the error.
#[test]
fn a_failed_write_is_left_to_the_next_step_once_rows_have_changed() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::new();
    let (mut run, _commits) = started(folder.path(), 3, usize::MAX, Codec::Raw, &faults).unwrap();
    (0..20).for_each(|_| run.step().unwrap());
    run.pager.freeze().unwrap();
    faults.add(Operation::Write, faults.count(Operation::Write), true, Fault::Error(ErrorKind::StorageFull));
    let page = (0..PAGES).map(PageNo).find(|p| run.pager.index()[p.index()].rows > 0).unwrap();
    let pinned = run.pager.acquire_in_step(&[page]).expect("the step is seen through");
    pinned.iter().for_each(|page| check(page, &run.model));
    run.pager.release(pinned);
    assert!(!run.pager.is_frozen() && run.step().unwrap_err().is_out_of_space());
}

/// A failing write abandons the cut; the previous commit stands, and steps continue if only space is missing.
#[test]
fn a_failed_write_gives_the_cut_up_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let faults = Faults::new();
    let (mut run, mut commits) = started(at, 3, usize::MAX, Codec::Raw, &faults).unwrap();
    (0..20).for_each(|_| run.step().unwrap());
    commit_cut(&mut run, &mut commits);
    let first = run.model.clone();
    (0..10).for_each(|_| run.step().unwrap());
    faults.add(Operation::Write, faults.count(Operation::Write) + 2, false, Fault::Error(ErrorKind::StorageFull));
    run.pager.freeze().unwrap();
    let error = run.pager.finish_frozen().unwrap_err();
    assert!(error.is_out_of_space() && !run.pager.is_frozen(), "{error}");
    drop(commits);
    opens_with(at, &first);
    let mut commits = Opened::open(Box::new(DriveFolder::new(at)), COMMITS).unwrap().commits;
    while (run.step as usize) < STEPS {
        // The failure was reported already, or is reported once more.
        if let Err(error) = run.step() {
            assert!(error.is_out_of_space(), "{error}");
        }
    }
    commit_cut(&mut run, &mut commits);
    run.check_all(4).unwrap();
    drop(commits);
    opens_with(at, &run.model);
}
