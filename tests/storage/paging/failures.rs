//! Failing stores: the error names the page, no buffer and no page is lost, and the run can continue or write out its
//! rows.

use super::world::{Run, config, store};
use super::{PAGES, STEPS, run_in_memory};
use crate::support::faulty_engine::{Fault, Faults, Operation};
use gsscale::page::format::codec::Codec;
use gsscale::paging::error::PagingError;
use gsscale::paging::pager::Pager;
use std::io::ErrorKind;

fn run(seed: u64, frames: usize, faults: &Faults) -> Run {
    Run::new(Pager::new(config(frames), store(Codec::Raw, faults)), seed, PAGES, STEPS).unwrap()
}

fn frames_of(seed: u64) -> usize {
    run_in_memory(seed).1 + 3
}

/// Occasional failures of reads and of space are passed on with the page's name; the repeated step works.
#[test]
fn a_step_that_failed_can_be_tried_again() {
    let frames = frames_of(1);
    for fault in [Fault::Error(ErrorKind::Other), Fault::FlipBit(40_000), Fault::Short, Fault::Torn] {
        let faults = Faults::new();
        let mut run = run(1, frames, &faults);
        let (mut failed, mut tried) = (0, u32::MAX);
        while (run.step as usize) < STEPS {
            let is_first_try = std::mem::replace(&mut tried, run.step) != run.step;
            // A read is retried once before it counts as failed.
            if run.step.is_multiple_of(3) && is_first_try {
                let n = faults.count(Operation::Read) + u64::from(run.step % 2);
                (n..n + 2).for_each(|n| faults.add(Operation::Read, n, false, fault));
            }
            if let Err(error) = run.step() {
                assert!(matches!(error, PagingError::Store { doing: "reading", .. }), "{error}");
                assert!(error.to_string().contains("reading page") && !error.is_out_of_space(), "{error}");
                failed += 1;
            }
            faults.clear();
        }
        run.check_all(4).unwrap();
        assert!(failed > 1, "{failed}");
    }
}

#[test]
fn a_full_drive_can_be_waited_for() {
    let frames = frames_of(2);
    let faults = Faults::new();
    let mut run = run(2, frames, &faults);
    let (mut failed, mut tried) = (0, u32::MAX);
    while (run.step as usize) < STEPS {
        let is_first_try = std::mem::replace(&mut tried, run.step) != run.step;
        if run.step.is_multiple_of(4) && is_first_try {
            faults.add(Operation::Write, faults.count(Operation::Write), true, Fault::Error(ErrorKind::StorageFull));
        }
        if let Err(error) = run.step() {
            assert!(error.is_out_of_space() && error.to_string().contains("writing page"), "{error}");
            failed += 1;
        }
        faults.clear();
    }
    run.check_all(4).unwrap();
    assert!(failed > 3, "{failed}");
}

/// After a drive error nothing more is written, the run ends, and everything can still be exported, even if every frame
/// is dirty.
#[test]
fn a_drive_that_fails_for_ever_loses_nothing_that_is_in_memory() {
    for (seed, nth) in [(3, 0), (3, 40), (4, 7), (5, 20), (6, 33)] {
        let faults = Faults::new();
        let frames = frames_of(seed);
        let mut run = run(seed, frames, &faults);
        let n = faults.count(Operation::Write) + nth;
        faults.add(Operation::Write, n, true, Fault::Error(ErrorKind::Other));
        let error = (0..STEPS).find_map(|_| run.step().err()).expect("writing fails");
        assert!(matches!(error, PagingError::Store { doing: "writing", .. }), "{error}");
        run.check_all(1).unwrap();
        let again = run.step().map(|()| run.step()).and_then(|r| r);
        assert!(again.is_ok() || matches!(again, Err(PagingError::Store { doing: "writing", .. })));
        run.check_all(1).unwrap();
    }
}

/// An import that fails. The remedy names more space only if space is missing.
#[test]
fn a_segment_that_cannot_be_made_says_why_and_what_helps() {
    for (kind, remedy) in [
        (ErrorKind::StorageFull, "free space"),
        (ErrorKind::PermissionDenied, "make the spill directory writable"),
        (ErrorKind::AlreadyExists, "remove the file"),
        (ErrorKind::Other, "check the drive"),
    ] {
        let faults = Faults::new();
        faults.add(Operation::Create, 0, true, Fault::Error(kind));
        let pager = Pager::new(config(9), store(Codec::Raw, &faults));
        let error = Run::new(pager, 1, PAGES, STEPS).map(|_| ()).unwrap_err();
        let (text, is_full) = (error.to_string(), kind == ErrorKind::StorageFull);
        assert!(text.contains("writing page") && text.contains(remedy), "{text}");
        assert_eq!([error.is_out_of_space(), text.contains("free space")], [is_full; 2], "{text}");
    }
}

#[test]
fn frames_that_cannot_be_emptied_go_when_there_is_space_again() {
    let frames = frames_of(4);
    let faults = Faults::new();
    let mut run = run(4, 2 * frames, &faults);
    (0..STEPS / 2).for_each(|_| run.step().unwrap());
    faults.add(Operation::Write, faults.count(Operation::Write), true, Fault::Error(ErrorKind::StorageFull));
    run.pager.limit_frames(frames);
    assert!(run.pager.frames() > frames && run.pager.frames_max() == frames, "{} frames", run.pager.frames());
    let error = run.step().expect_err("the step after it is told");
    assert!(error.is_out_of_space(), "{error}");
    faults.clear();
    while (run.step as usize) < STEPS {
        run.pager.limit_frames(frames);
        assert_eq!(run.pager.frames(), frames);
        run.step().unwrap();
    }
    run.check_all(4).unwrap();
}
