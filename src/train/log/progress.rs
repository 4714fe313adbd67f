//! Progress display on standard error: bars on a terminal, lines elsewhere, nothing with `--quiet`.
//!
//! Invariants: 1. a line, and a bar on a terminal of 80 columns, fits 80 columns for any number of steps and Gaussians;
//! 2. rate and time left follow from the last half minute, since steps become slower while a scene grows.

use crate::base::count::{LINE_EVERY, new_bar};
use crate::base::say::visible;
use crate::base::units::{format_count, format_seconds};
use indicatif::ProgressBar;
use std::collections::VecDeque;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

const COLUMNS: usize = 80;
/// Columns of the text beside `done/total`: see the test.
const WORDS: usize = 54;
/// Time between two changes of a bar's text.
const BAR_EVERY: Duration = Duration::from_millis(100);
/// The rate is that of this time.
const RECENT: f64 = 30.0;
/// Least time between two samples of the rate.
const SAMPLE_EVERY: f64 = 1.0;
/// Weight of the last view in the shown PSNR, which varies by decibels from view to view.
const PSNR_WEIGHT: f64 = 0.05;

/// What a step shows.
#[derive(Debug, Clone, Copy)]
pub struct ShownStep {
    pub gaussians: u64,
    /// PSNR of the step's view, dB; `None` if no pixel of its photo counts.
    pub psnr: Option<f64>,
}

/// Progress of a loop over steps.
pub struct RunProgress {
    bar: Option<ProgressBar>,
    quiet: bool,
    /// Steps done before this process.
    first: u32,
    total: u32,
    rate: RecentRate,
    started: Instant,
    last_shown: Instant,
    /// Running mean of the views' PSNR.
    psnr: Option<f64>,
}

impl RunProgress {
    /// A display for `total` steps, of which an earlier process has done the first `first`: these do not count in the rate.
    pub fn new(first: u32, total: u32, quiet: bool) -> Self {
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let width = COLUMNS.saturating_sub(WORDS + 2 * digits(total) + 4).max(4);
            let bar = new_bar(u64::from(total), &format!("{{bar:{width}.cyan/blue}} {{pos}}/{{len}}  {{msg}}"));
            bar.set_position(u64::from(first));
            bar
        });
        let now = Instant::now();
        let rate = RecentRate::default();
        RunProgress { bar, quiet, first, total, rate, started: now, last_shown: now, psnr: None }
    }

    /// Shows that `done` steps are done.
    pub fn step(&mut self, done: u32, shown: ShownStep) {
        self.psnr = match (self.psnr, shown.psnr) {
            (Some(mean), Some(psnr)) => Some(mean + PSNR_WEIGHT * (psnr - mean)),
            (mean, psnr) => mean.or(psnr),
        };
        if self.quiet {
            return;
        }
        let steps = done.saturating_sub(self.first);
        let rate = self.rate.after(steps, self.started.elapsed().as_secs_f64());
        let every = if self.bar.is_some() { BAR_EVERY } else { LINE_EVERY };
        let is_last = done == self.total;
        if let Some(bar) = &self.bar {
            bar.set_position(u64::from(done));
        }
        if self.last_shown.elapsed() < every && !is_last {
            return;
        }
        self.last_shown = Instant::now();
        let words = words(ShownStep { psnr: self.psnr, ..shown }, rate, self.total.saturating_sub(done));
        match &self.bar {
            Some(bar) => bar.set_message(words),
            None => crate::tell!("step {done}/{}  {words}", self.total),
        }
    }

    /// Prints a line above the bar.
    pub fn say(&self, line: &str) {
        match &self.bar {
            _ if self.quiet => {}
            Some(bar) => bar.println(visible(line)),
            None => crate::tell!("{line}"),
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn digits(n: u32) -> usize {
    n.checked_ilog10().unwrap_or(0) as usize + 1
}

/// `1.25M Gaussians  PSNR 24.31  103/s  12 min left`.
fn words(shown: ShownStep, rate: f64, steps_left: u32) -> String {
    let rate_text = if rate < 9.95 { format!("{rate:.1}") } else { format!("{rate:.0}") };
    let left = match steps_left {
        0 => "0 s".to_string(),
        _ if rate <= 0.0 => "unknown time".to_string(),
        steps => format_seconds((f64::from(steps) / rate).min(99.0 * 86400.0)),
    };
    let gaussians = format_count(shown.gaussians);
    let psnr = shown.psnr.map_or("-".to_string(), |psnr| format!("{psnr:.2}"));
    format!("{gaussians} Gaussians  PSNR {psnr}  {rate_text}/s  {left} left")
}

/// Steps per second over the last [`RECENT`] seconds.
#[derive(Debug, Default)]
struct RecentRate {
    /// (seconds, steps), oldest first.
    samples: VecDeque<(f64, u32)>,
}

impl RecentRate {
    /// The rate when `steps` are done after `seconds`.
    fn after(&mut self, steps: u32, seconds: f64) -> f64 {
        if self.samples.is_empty() {
            self.samples.push_back((0.0, 0));
        }
        if self.samples.back().is_some_and(|last| seconds - last.0 >= SAMPLE_EVERY) {
            self.samples.push_back((seconds, steps));
        }
        // The oldest sample stays as long as the next one is not old enough.
        while self.samples.get(1).is_some_and(|next| seconds - next.0 >= RECENT) {
            self.samples.pop_front();
        }
        let (then, before) = self.samples.front().copied().unwrap_or_default();
        f64::from(steps.saturating_sub(before)) / (seconds - then).max(1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_the_recent_one() {
        let mut rate = RecentRate::default();
        let mut last = 0.0;
        // 100 steps a second for a minute, then 10.
        for second in 1..=60 {
            last = rate.after(100 * second, f64::from(second));
        }
        assert_eq!(last, 100.0);
        for second in 1..=40 {
            last = rate.after(6000 + 10 * second, 60.0 + f64::from(second));
        }
        assert_eq!(last, 10.0, "the fast minute is over");
        assert_eq!(RecentRate::default().after(5, 0.5), 10.0);
    }

    #[test]
    fn every_line_fits_eighty_columns() {
        for total in [1, 30_000, 10_000_000] {
            for gaussians in [0, 999, 1_250_000, 4_294_967_294] {
                for (rate, psnr) in [(0.0, 0.0), (0.01, 24.31), (103.4, 100.0), (99_999.0, 9.5)] {
                    for left in [0, 1, total] {
                        let words = words(ShownStep { gaussians, psnr: Some(psnr) }, rate, left);
                        assert!(words.len() <= WORDS, "{words}");
                        let line = format!("step {total}/{total}  {words}");
                        assert!(line.len() <= COLUMNS, "{line}");
                    }
                }
            }
        }
        let words = words(ShownStep { gaussians: 1_250_000, psnr: Some(24.312) }, 41.7, 30_000);
        assert_eq!(words, "1.25M Gaussians  PSNR 24.31  42/s  12 min left");
    }
}
