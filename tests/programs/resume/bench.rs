//! A small scene and runs on it in which rounds, resets and raises of the SH degree each happen several times.

use crate::support::workdir::{Running, Workdir};
use std::ops::Deref;
use std::path::PathBuf;

pub const STEPS: u32 = 200;

pub const BUSY: &str = "scene --steps 200 --page-rows 32 --grow-grad2d 0.001 --refine-start 60 --refine-every 30 --reset-every 80 \
    --sh-every 50 --view-order groups:4 --log-every 7 --test-every 24 --device cpu --quiet";

/// Commits only when a run is asked to stop, and at the end.
pub const SELDOM: &str = "--commit-every 0";

/// Where a run keeps its pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    Memory,
    /// In a spill directory, with this many frames.
    Spill(u64),
}

/// Runs go to `out`, unless a test says otherwise, and their pages to `spill`.
pub struct Bench(Workdir);

impl Deref for Bench {
    type Target = Workdir;

    fn deref(&self) -> &Workdir {
        &self.0
    }
}

pub struct Alone {
    pub ply: Vec<u8>,
    /// Steps in metrics.jsonl.
    pub logged: Vec<u64>,
    pub pages: u64,
    /// The most pages of a step.
    pub fewest: u64,
}

impl Bench {
    pub fn new() -> Bench {
        Bench(Workdir::city_of(24, [64, 48], 6000, 20))
    }

    pub fn alone(&self, more: &str) -> Alone {
        self.train(&format!("{BUSY} --out alone {more}"));
        let [rows, pages, fewest] = ["gaussians", "pages", "pages_pinned_max"].map(|key| self.count("alone", key));
        assert_ne!(rows, 6000, "no round changed anything, so the test shows little");
        let alone = Alone { ply: self.ply("alone"), logged: self.logged("alone", "step"), pages, fewest };
        self.remove("alone");
        alone
    }

    pub fn flags(&self, place: Place, more: &str) -> String {
        match place {
            Place::Memory => format!("{BUSY} --out out {more}"),
            // A given codec saves the second of measuring the drive.
            Place::Spill(frames) => {
                format!("{BUSY} --out out --spill-dir spill --frames {frames} --spill-codec raw {more}")
            }
        }
    }

    pub fn start(&self, place: Place, more: &str) -> Running<'_> {
        self.begin(&self.flags(place, more))
    }

    /// Starts a run in `out`, asks it to stop after some lines of metrics, and returns what it said.
    pub fn stopped(&self, place: Place, lines: usize, more: &str) -> String {
        self.start(place, &format!("{SELDOM} {more}")).after_lines("out", lines).stop()
    }

    pub fn resume(&self, more: &str) -> Running<'_> {
        self.begin(&format!("--resume out --quiet {more}"))
    }

    /// Resumes the run in `out` to its end; returns what it said.
    pub fn go_on(&self, more: &str) -> String {
        self.train(&format!("--resume out --quiet {more}"))
    }

    /// The run in `out` does not go on; returns why.
    pub fn does_not_go_on(&self, more: &str, words: &[&str]) -> String {
        self.refuses(&format!("--resume out --quiet {more}"), words)
    }

    pub fn checkpoint(&self, place: Place) -> PathBuf {
        self.path(if place == Place::Memory { "out/checkpoint" } else { "spill" })
    }

    /// Removes the run in `out` and its pages.
    pub fn clear(&self) {
        self.remove("out");
        self.remove("spill");
    }
}
