//! The store survives a power failure at any point. The real store, commits and page map run over a simulated disk.
//!
//! A plain run simulates tens of thousands of crashes. `GSSCALE_CRASHES=5000000` sets the number and uses every core;
//! progress is printed every half minute: `GSSCALE_CRASHES=5000000 cargo test --release --test storage -- --nocapture
//! crash::no_acknowledged`. `GSSCALE_CRASH_SEED` is the first seed; a violation prints its own seed.

mod cut;
mod decay;
mod disk;
mod engine;
mod life;
#[cfg(debug_assertions)]
mod mutants;
mod oracle;
mod random;
mod script;
mod tamper;

use crate::support::hush::hush_library_panics;
use disk::Fault;
use random::run_many;
use std::time::Instant;

const CRASHES: u64 = 50_000;

/// Crashes within which every mutant must be noticed.
#[cfg(debug_assertions)]
const MUTANT_CRASHES: u64 = 20_000;

#[test]
fn no_acknowledged_commit_is_lost_and_no_wrong_byte_returned() {
    hush_library_panics();
    let wanted = std::env::var("GSSCALE_CRASHES").ok().and_then(|n| n.parse().ok()).unwrap_or(CRASHES);
    let first = std::env::var("GSSCALE_CRASH_SEED").ok().and_then(|n| n.parse().ok()).unwrap_or(0);
    let start = Instant::now();
    let counts = run_many(first, wanted).unwrap_or_else(|what| panic!("{what}"));
    let seconds = start.elapsed().as_secs_f64();
    println!("{} crashes, 0 commits lost, 0 wrong bytes in {seconds:.1} s: {counts:?}", counts.crashes);
}

#[test]
#[cfg(debug_assertions)]
fn every_mutant_is_noticed() {
    hush_library_panics();
    let hunters = std::thread::Builder::new().name("mutant".to_string()).spawn(|| {
        let mut survivors = Vec::new();
        for &mutant in mutants::MUTANTS {
            match mutants::hunt(mutant, MUTANT_CRASHES) {
                Some((crashes, what)) => {
                    println!("{mutant:?}: {crashes} crashes: {}", what.lines().next().unwrap_or(""))
                }
                None => survivors.push(mutant),
            }
        }
        survivors
    });
    let survivors = hunters.unwrap().join().unwrap();
    assert!(survivors.is_empty(), "not noticed: {survivors:?}");
}

#[test]
fn every_crash_point_of_a_small_run_opens_at_an_acknowledged_state() {
    hush_library_panics();
    let start = Instant::now();
    let states = script::every_crash_point().unwrap_or_else(|what| panic!("{what}"));
    println!("{states} states after crashes in {:.1} s", start.elapsed().as_secs_f64());
    assert!(states > 5_000, "{states}");
}

#[test]
fn every_call_of_a_small_run_may_fail() {
    hush_library_panics();
    let start = Instant::now();
    let failing = script::every_call_fails().unwrap_or_else(|what| panic!("{what}"));
    println!("{failing:?} in {:.1} s", start.elapsed().as_secs_f64());
    assert!(failing.calls > 200, "{failing:?}");
    for (way, fault) in script::FAULTS.into_iter().enumerate() {
        let [once, for_ever] = failing.met[way];
        if fault == Fault::Full {
            // Once: only calls that need space meet it. For ever: all calls before the last such call meet it.
            assert!(once > 80 && for_ever > once, "{failing:?}");
        } else {
            assert_eq!([once, for_ever], [failing.calls; 2], "{fault:?}");
        }
    }
}
