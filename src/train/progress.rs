//! Progress display: a bar on a terminal, lines elsewhere, nothing with `--quiet`.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::Instant;

/// Progress of a loop over steps.
pub struct Progress {
    bar: Option<ProgressBar>,
    quiet: bool,
    /// Steps done before this process.
    first: u32,
    total: u32,
    started: Instant,
    last_line: Instant,
}

impl Progress {
    /// A display for `total` steps.
    pub fn new(total: u32, quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(u64::from(total));
            let template = "{bar:32.cyan/blue} {pos}/{len} {per_sec} {msg} {eta} left";
            bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar
        });
        let now = Instant::now();
        Progress { bar, quiet, first: 0, total, started: now, last_line: now }
    }

    /// The display of a run resumed after `first` steps; these do not count in the rate.
    pub fn after(self, first: u32) -> Self {
        if let Some(bar) = &self.bar {
            bar.set_position(u64::from(first));
            bar.reset_eta();
        }
        Progress { first, ..self }
    }

    /// Shows that `done` steps are done. `message` is called only if it is shown.
    pub fn step(&mut self, done: u32, message: impl FnOnce() -> String) {
        if let Some(bar) = &self.bar {
            bar.set_position(u64::from(done));
            if self.last_line.elapsed().as_millis() > 100 {
                bar.set_message(message());
                self.last_line = Instant::now();
            }
            return;
        }
        // Without a terminal, one line every ten seconds keeps logs small.
        if !self.quiet && (self.last_line.elapsed().as_secs() >= 10 || done == self.total) {
            self.last_line = Instant::now();
            let [rate, left] = rate(self.first, done, self.total, self.started.elapsed().as_secs_f64());
            eprintln!("step {done}/{}  {rate:.1}/s  {}  {left:.0} s left", self.total, message());
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Steps per second of this process, and estimated seconds left.
fn rate(first: u32, done: u32, total: u32, seconds: f64) -> [f64; 2] {
    let rate = f64::from(done.saturating_sub(first)) / seconds.max(1e-9);
    [rate, f64::from(total.saturating_sub(done)) / rate.max(1e-9)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_earlier_lives_make_no_run_faster() {
        assert_eq!(rate(0, 100, 300, 10.0), [10.0, 20.0]);
        assert_eq!(rate(900, 1000, 1200, 10.0), [10.0, 20.0]);
        let after = Progress::new(1200, true).after(900);
        assert_eq!((after.first, after.total), (900, 1200));
    }
}
