//! Commits on a full drive: a transaction is durable although its witness found no space, and the drive may still be
//! full when the map is reopened. Neither case loses a page, and no deleted page comes back. A sync never counts as a lack of space.

use super::beside::{COMMITS, opens_with, paged_store};
use super::run_in_memory;
use super::world::{Model, Run, config, fill, meta};
use super::{PAGES, STEPS};
use crate::support::faulty_engine::Faults;
use crate::support::guarded::{Change, GuardedFolder};
use gsscale::base::ids::PageId;
use gsscale::page::format::codec::Codec;
use gsscale::page::map::commit::{CommitError, Commits, MAP_NAME, WITNESS_NAME};
use gsscale::page::map::opening::Opened;
use gsscale::paging::pager::Pager;
use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Decides when the page map and its witness find no space.
#[derive(Debug, Default)]
struct Shortage {
    syncs: AtomicU64,
    /// Number of the sync after which there is no space.
    after_sync: Mutex<Option<u64>>,
    /// Every later call that needs space fails, not only the next one.
    lasts: AtomicBool,
    is_full: AtomicBool,
}

impl Shortage {
    fn begin_after(&self, syncs: u64, lasts: bool) {
        *self.after_sync.lock().unwrap() = Some(self.syncs.load(Ordering::Relaxed) + syncs);
        self.lasts.store(lasts, Ordering::Relaxed);
    }

    fn end(&self) {
        *self.after_sync.lock().unwrap() = None;
        self.is_full.store(false, Ordering::Relaxed);
    }

    fn check(&self, change: Change) -> io::Result<()> {
        if change == Change::Synced {
            let number = self.syncs.fetch_add(1, Ordering::Relaxed);
            let begins = *self.after_sync.lock().unwrap() == Some(number);
            self.is_full.fetch_or(begins, Ordering::Relaxed);
        }
        let needs_space = matches!(change, Change::SetLen | Change::WriteAt(_));
        match needs_space && self.is_full.fetch_and(self.lasts.load(Ordering::Relaxed), Ordering::Relaxed) {
            true => Err(ErrorKind::StorageFull.into()),
            false => Ok(()),
        }
    }
}

/// A run over a store in `at`, with one commit after twenty steps, and the model at that commit.
fn begun(at: &Path, seed: u64, shortage: &Arc<Shortage>) -> (Run, Commits, Model) {
    let frames = run_in_memory(seed).1 + 5;
    let shortage = Arc::clone(shortage);
    let folder = GuardedFolder::new(at, &[MAP_NAME, WITNESS_NAME], Arc::new(move |change| shortage.check(change)));
    let opened = Opened::create(Box::new(folder), COMMITS).unwrap();
    let pager = Pager::new(config(frames), paged_store(&opened, at, Codec::Raw, &Faults::new()));
    let mut commits = opened.commits;
    let mut run = Run::new(pager, seed, PAGES, STEPS).unwrap();
    steps_to(&mut run, 20);
    run.pager.flush().unwrap();
    run.pager.commit(&mut commits, b"first", b"", None).unwrap();
    let first = run.model.clone();
    (run, commits, first)
}

fn steps_to(run: &mut Run, step: u32) {
    while run.step < step {
        run.step().unwrap();
    }
}

/// Effects of a commit that found no space.
#[derive(Default)]
struct Left {
    durable: u32,
    /// Pages that only this commit held: neither the previous nor the next commit had them.
    short_lived: usize,
}

/// A commit that finds no space after its sync number `nth`, then steps, then a commit; `None` if nothing follows that sync.
fn full_once(seed: u64, nth: u64, beside: bool) -> Option<Left> {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let shortage = Arc::new(Shortage::default());
    let (mut run, mut commits, first) = begun(at, seed, &shortage);
    let mut commit = |run: &mut Run| match beside {
        true => {
            run.pager.freeze().unwrap();
            run.pager.finish_frozen().unwrap();
            run.pager.commit_frozen(&mut commits, b"state", b"").map(|done| done.map(|(generation, _)| generation))
        }
        false => {
            run.pager.flush().unwrap();
            run.pager.commit(&mut commits, b"state", b"", None)
        }
    };
    steps_to(&mut run, 50);
    shortage.begin_after(nth, false);
    let error = commit(&mut run).err()?;
    assert!(error.is_out_of_space(), "{error}");
    let middle = run.model.clone();
    steps_to(&mut run, STEPS as u32 - 10);
    shortage.end();
    commit(&mut run).unwrap().unwrap();
    let has_rows = |model: &Model, id: &PageId| model.get(id).is_some_and(|(meta, _)| meta.rows > 0);
    let lived = |id: &PageId| has_rows(&middle, id) && !has_rows(&first, id) && !has_rows(&run.model, id);
    let short_lived = middle.keys().filter(|id| lived(id)).count();
    // The generation before the last is kept: the one that found no space, if it was durable.
    let kept: Vec<u64> = commits.generations().kept().collect();
    let is_durable = kept == [2, 3];
    assert!(is_durable || kept == [1, 3], "{kept:?}");
    drop(commits);
    opens_with(at, &run.model);
    Some(Left { durable: u32::from(is_durable), short_lived: if is_durable { short_lived } else { 0 } })
}

/// A generation may be durable although its commit reported an error. Pages that were created in it and deleted before
/// the next generation must be absent from the next generation; otherwise they would stay in the map with duplicate
/// rows.
#[test]
fn pages_of_a_commit_that_was_durable_after_all_go_with_the_next_one() {
    for beside in [false, true] {
        let (mut failed, mut all) = (0, Left::default());
        for seed in 0..4 {
            for left in (0..).map_while(|nth| full_once(seed, nth, beside)) {
                failed += 1;
                all.durable += left.durable;
                all.short_lived += left.short_lived;
            }
        }
        assert!(all.durable > 0 && failed > all.durable && all.short_lived > 3, "{failed}, {}", all.durable);
    }
}

/// Committing a page that was never written is an error; otherwise the commit would drop the page.
#[test]
fn a_commit_without_its_writes_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (mut run, mut commits, first) = begun(at, 1, &Arc::new(Shortage::default()));
    let new = meta(PageId::initial(PAGES), 3.0, 2, 1);
    run.pager.insert(new, |payload| fill(payload, &new, 77)).unwrap();
    let error = run.pager.commit(&mut commits, b"state", b"", None).unwrap_err();
    assert!(matches!(&error, CommitError::Contradiction(what) if what.contains(&new.id.to_string())), "{error}");
    drop(commits);
    opens_with(at, &first);
}

/// A drive that is still full when the map is reopened costs another commit, not the run.
#[test]
fn a_drive_that_stays_full_costs_commits_and_not_the_run() {
    for nth in 0..2 {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let shortage = Arc::new(Shortage::default());
        let (mut run, mut commits, _) = begun(at, 2, &shortage);
        steps_to(&mut run, 40);
        shortage.begin_after(nth, true);
        for round in 0..3 {
            run.pager.flush().unwrap();
            let error = run.pager.commit(&mut commits, b"state", b"", None).unwrap_err();
            assert!(error.is_out_of_space(), "attempt {round}: {error}");
            assert!(commits.poison().is_none());
            steps_to(&mut run, 60 + 20 * round);
        }
        shortage.end();
        run.pager.flush().unwrap();
        run.pager.commit(&mut commits, b"state", b"", None).unwrap().unwrap();
        drop(commits);
        opens_with(at, &run.model);
    }
}

/// After a failed sync the system takes lost bytes for written, so a commit that went on after one could acknowledge what never reached the
/// drive.
#[test]
fn a_sync_without_space_ends_all_commits() {
    for name in [&[MAP_NAME], &[WITNESS_NAME]] {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let fails = Arc::new(AtomicBool::new(false));
        let fails_now = Arc::clone(&fails);
        let guard = move |change: Change| match change == Change::Sync && fails_now.load(Ordering::Relaxed) {
            true => Err(ErrorKind::StorageFull.into()),
            false => Ok(()),
        };
        let opened = Opened::create(Box::new(GuardedFolder::new(at, name, Arc::new(guard))), COMMITS).unwrap();
        let pager = Pager::new(config(1000), paged_store(&opened, at, Codec::Raw, &Faults::new()));
        let mut commits = opened.commits;
        let mut run = Run::new(pager, 1, PAGES, STEPS).unwrap();
        run.pager.flush().unwrap();
        fails.store(true, Ordering::Relaxed);
        let error = run.pager.commit(&mut commits, b"state", b"", None).unwrap_err();
        assert!(!error.is_out_of_space() && !error.to_string().contains("free space"), "{name:?}: {error}");
        fails.store(false, Ordering::Relaxed);
        let error = run.pager.commit(&mut commits, b"state", b"", None).unwrap_err();
        assert!(matches!(error, CommitError::Poisoned(_)), "{name:?}: {error}");
    }
}
