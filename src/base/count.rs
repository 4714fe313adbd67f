//! Progress of a task that counts parts: a bar on a terminal, lines elsewhere, nothing if the caller is quiet.
//!
//! Not here: progress of training steps (`train::log`).

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time between two lines without a terminal: logs stay small.
pub const LINE_EVERY: Duration = Duration::from_secs(10);

/// Progress of one task: photos, views. May be shown from any thread.
pub struct Count {
    bar: Option<ProgressBar>,
    quiet: bool,
    what: &'static str,
    total: u32,
    last_line: Mutex<Instant>,
}

impl Count {
    /// A display for `total` parts, called `what` (`photos made`).
    pub fn new(what: &'static str, total: u32, quiet: bool) -> Count {
        let template = format!("{{bar:32.cyan/blue}} {{pos}}/{{len}} {what}  {{eta}} left");
        let bar =
            (!quiet && total > 0 && std::io::stderr().is_terminal()).then(|| new_bar(u64::from(total), &template));
        Count { bar, quiet, what, total, last_line: Mutex::new(Instant::now()) }
    }

    /// Shows that `done` parts are done.
    pub fn show(&self, done: u32) {
        if let Some(bar) = &self.bar {
            bar.set_position(u64::from(done));
            return;
        }
        // A thread that panicked while it held the time left a valid time.
        let mut last = self.last_line.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.quiet && last.elapsed() >= LINE_EVERY {
            *last = Instant::now();
            crate::tell!("{done}/{} {}", self.total, self.what);
        }
    }
}

impl Drop for Count {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

pub fn new_bar(total: u64, template: &str) -> ProgressBar {
    let bar = ProgressBar::new(total);
    bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}
