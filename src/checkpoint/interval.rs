//! The commit interval, computed from the measured costs of commits.
//!
//! `--commit-every auto` limits the loss of a kill to [`LOSS_SECONDS`]. Commits are more frequent while they delay
//! training by less than `CHEAP_OVERHEAD`, which keeps their total cost below [`OVERHEAD`] on drives fast enough for
//! both. On a slower drive the loss limit has priority, and the overhead is reported. The limit of bytes an hour
//! ([`bytes_per_hour`]) has priority over both.
//!
//! Invariants: 1. this file reads no clock; callers pass elapsed times; 2. the interval is a function of the sequence
//! of costs; 3. no result of a run depends on it.

use crate::base::units::{GIB, parse_seconds};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::str::FromStr;

/// Most seconds of work that a kill may cost.
pub const LOSS_SECONDS: f64 = 60.0;
/// Largest share of the run's time that commits may delay it.
pub const OVERHEAD: f64 = 0.03;
/// Commits are more frequent than [`LOSS_SECONDS`] requires while they delay the run by less than this share.
const CHEAP_OVERHEAD: f64 = 0.01;
/// Shortest automatic interval: losing fewer seconds of work does not matter.
pub const SHORTEST_SECONDS: f64 = 10.0;
/// Most bytes that commits write per hour: a drive rated for 300 TB lasts 1,100 hours.
pub const BYTES_PER_HOUR: f64 = 256.0 * GIB as f64;
/// The commits of a run in memory write at most this many times its state an hour: each writes nearly all of it, since a
/// minute of steps changes most pages.
const STATES_PER_HOUR: f64 = 24.0;
/// Bytes an hour that a run in memory may always write: a small scene is committed every few seconds.
const BYTES_PER_HOUR_SMALL: f64 = 16.0 * GIB as f64;
/// Weight of the last commit in the expected cost of the next.
const LAST_WEIGHT: f64 = 0.5;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CommitEvery {
    /// By the cost of commits; see the module page.
    Auto,
    /// Seconds between commits; 0 for no periodic commits.
    Seconds(f64),
}

impl FromStr for CommitEvery {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        if text == "auto" {
            return Ok(CommitEvery::Auto);
        }
        Ok(CommitEvery::Seconds(parse_seconds(text).map_err(|e| format!("{e}, or auto"))?))
    }
}

impl fmt::Display for CommitEvery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CommitEvery::Auto => f.write_str("auto"),
            CommitEvery::Seconds(seconds) => write!(f, "{seconds}"),
        }
    }
}

impl Serialize for CommitEvery {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            CommitEvery::Auto => s.serialize_str("auto"),
            CommitEvery::Seconds(seconds) => s.serialize_f64(*seconds),
        }
    }
}

impl<'de> Deserialize<'de> for CommitEvery {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum SecondsOrText {
            Seconds(f64),
            Text(String),
        }
        match SecondsOrText::deserialize(d)? {
            SecondsOrText::Seconds(seconds) => Ok(CommitEvery::Seconds(seconds)),
            SecondsOrText::Text(text) => text.parse().map_err(serde::de::Error::custom),
        }
    }
}

/// Most bytes that commits write per hour, for a run in memory with `state_bytes` bytes of Gaussians and optimizer state;
/// `None` for a run whose pages are on a drive, where a commit writes what changed since the last.
pub fn bytes_per_hour(state_bytes: Option<u64>) -> f64 {
    let of_state = |bytes: u64| (STATES_PER_HOUR * bytes as f64).clamp(BYTES_PER_HOUR_SMALL, BYTES_PER_HOUR);
    state_bytes.map_or(BYTES_PER_HOUR, of_state)
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CommitCost {
    /// Seconds that training waited for the commit.
    pub waited: f64,
    /// Seconds from its cut until it was durable.
    pub until_durable: f64,
    /// Bytes of pages written only because of the commit.
    pub bytes: u64,
    /// Seconds of work since the previous cut that a kill just before durability would have lost.
    pub at_risk: f64,
}

/// Totals over the commits of a run, for its reports.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct CommitReport {
    pub commits: u64,
    /// Bytes of pages written for them.
    pub commit_bytes: u64,
    /// Seconds that training waited for them.
    pub commit_seconds: f64,
    /// `commit_seconds` in percent of the run's time.
    pub commit_overhead_percent: f64,
    /// Current seconds from the end of a commit to the next cut; 0 without periodic commits.
    pub commit_interval: f64,
    /// Most seconds of work that a kill could have lost so far.
    pub commit_loss_seconds: f64,
}

/// Decides when the next commit is due.
#[derive(Debug, Clone)]
pub struct CommitInterval {
    every: CommitEvery,
    expected: Option<CommitCost>,
    /// Most bytes that commits write per hour.
    bytes_per_hour: f64,
    total: CommitReport,
}

impl CommitInterval {
    /// The interval before the first commit.
    pub fn new(every: CommitEvery) -> CommitInterval {
        CommitInterval { every, expected: None, bytes_per_hour: BYTES_PER_HOUR, total: CommitReport::default() }
    }

    /// Limits the bytes that the next commits write, for a run in memory of this size ([`bytes_per_hour`]).
    pub fn limit_bytes(&mut self, state_bytes: u64) {
        self.bytes_per_hour = bytes_per_hour(Some(state_bytes));
    }

    /// Seconds from the end of a commit to the next cut; `None` without periodic commits.
    pub fn seconds(&self) -> Option<f64> {
        match self.every {
            CommitEvery::Seconds(seconds) => (seconds > 0.0).then_some(seconds),
            CommitEvery::Auto => {
                Some(self.expected.map_or(SHORTEST_SECONDS, |cost| automatic(cost, self.bytes_per_hour)))
            }
        }
    }

    /// Whether a commit is due `since` seconds after the last one was durable.
    pub fn is_due(&self, since: f64) -> bool {
        self.seconds().is_some_and(|seconds| since >= seconds)
    }

    pub fn add(&mut self, cost: CommitCost) {
        let before = self.expected.unwrap_or(cost);
        let mean = |before: f64, last: f64| before + LAST_WEIGHT * (last - before);
        self.expected = Some(CommitCost {
            waited: mean(before.waited, cost.waited),
            until_durable: mean(before.until_durable, cost.until_durable),
            bytes: mean(before.bytes as f64, cost.bytes as f64) as u64,
            at_risk: cost.at_risk,
        });
        self.total.commits += 1;
        self.total.commit_bytes += cost.bytes;
        self.total.commit_seconds += cost.waited;
        self.total.commit_loss_seconds = self.total.commit_loss_seconds.max(cost.at_risk);
    }

    /// Totals after `run_seconds` of this process.
    pub fn report(&self, run_seconds: f64) -> CommitReport {
        CommitReport {
            commit_overhead_percent: 100.0 * self.total.commit_seconds
                / run_seconds.max(self.total.commit_seconds).max(1e-9),
            commit_interval: self.seconds().unwrap_or(0.0),
            ..self.total
        }
    }
}

/// The automatic interval for an expected cost.
fn automatic(cost: CommitCost, bytes_per_hour: f64) -> f64 {
    // A kill loses the interval plus the time until the next commit is durable.
    let longest = (LOSS_SECONDS - cost.until_durable).max(LOSS_SECONDS / 2.0);
    let cheap = cost.waited * (1.0 / CHEAP_OVERHEAD - 1.0);
    let wear = 3600.0 * cost.bytes as f64 / bytes_per_hour - cost.until_durable;
    cheap.clamp(SHORTEST_SECONDS, longest).max(wear)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cost(waited: f64, until_durable: f64, bytes: u64) -> CommitCost {
        CommitCost { waited, until_durable, bytes, at_risk: 0.0 }
    }

    fn after(costs: &[CommitCost]) -> f64 {
        let mut interval = CommitInterval::new(CommitEvery::Auto);
        costs.iter().for_each(|&cost| interval.add(cost));
        interval.seconds().unwrap()
    }

    #[test]
    fn cheap_commits_come_often_and_dear_ones_every_minute() {
        assert_eq!(CommitInterval::new(CommitEvery::Auto).seconds(), Some(10.0));
        assert_eq!(after(&[cost(0.0, 0.0, 0)]), 10.0);
        assert_eq!(after(&[cost(0.05, 0.05, GIB / 8)]), 10.0);
        // One percent of the time, while a minute allows it.
        assert!((after(&[cost(0.3, 0.3, GIB)]) - 0.3 * 99.0).abs() < 1e-9);
        assert!((after(&[cost(1.7, 1.7, GIB)]) - 58.3).abs() < 1e-9);
    }

    /// Whatever a commit takes, the loss is bounded by a minute, unless bytes forbid it; and commits that three percent
    /// of a minute allow for take no more than that.
    #[test]
    fn the_bounds_hold_for_every_cost() {
        for tenths in 0..600 {
            let seconds = f64::from(tenths) / 10.0;
            let interval = after(&[cost(seconds, seconds, GIB)]);
            assert!((SHORTEST_SECONDS..=LOSS_SECONDS).contains(&interval), "{seconds}: {interval}");
            if seconds <= LOSS_SECONDS / 2.0 {
                assert!(interval + seconds <= LOSS_SECONDS + 1e-9, "{seconds}: {interval}");
            }
            if seconds <= OVERHEAD * LOSS_SECONDS {
                assert!(seconds / (interval + seconds) <= OVERHEAD + 1e-9, "{seconds}: {interval}");
            }
            let of_many = after(&[cost(seconds, seconds, 16 * GIB)]);
            assert!(16.0 * 3600.0 / (of_many + seconds) <= 256.0 + 1e-6, "{seconds}: {of_many}");
        }
    }

    #[test]
    fn the_interval_follows_a_drive_that_changes() {
        let slow = cost(6.0, 6.0, GIB);
        let fast = cost(0.1, 0.1, GIB);
        let mut interval = CommitInterval::new(CommitEvery::Auto);
        interval.add(slow);
        let mut last = interval.seconds().unwrap();
        assert_eq!(last, 54.0);
        for _ in 0..12 {
            interval.add(fast);
            let now = interval.seconds().unwrap();
            assert!(now <= LOSS_SECONDS, "{now}");
            last = now;
        }
        // 3,600 s x 1 GiB / 256 GiB are 14 s: by now the bytes decide.
        assert!((13.0..15.0).contains(&last), "{last}");
    }

    /// A run in memory commits all of its state each time.
    #[test]
    fn commits_of_a_run_in_memory_are_bounded_by_its_size() {
        for (state, most) in [(GIB / 10, 16), (GIB, 24), (4 * GIB, 96), (64 * GIB, 256)] {
            let mut interval = CommitInterval::new(CommitEvery::Auto);
            interval.limit_bytes(state);
            interval.add(cost(0.5, 0.5, state));
            let written = state as f64 * 3600.0 / (interval.seconds().unwrap() + 0.5);
            // A few roundings.
            assert!(written <= (most * GIB) as f64 * (1.0 + 1e-9), "{state}: {written}");
        }
    }

    #[test]
    fn a_plain_number_stays_what_it_is() {
        for (seconds, since, is_due) in [(5.0, 4.9, false), (5.0, 5.0, true), (0.0, 1e9, false)] {
            let mut interval = CommitInterval::new(CommitEvery::Seconds(seconds));
            interval.add(cost(100.0, 100.0, 1 << 50));
            assert_eq!(interval.is_due(since), is_due, "{seconds}");
        }
    }

    #[test]
    fn totals_are_of_the_whole_run() {
        let mut interval = CommitInterval::new(CommitEvery::Auto);
        assert_eq!(interval.report(0.0).commit_overhead_percent, 0.0);
        interval.add(CommitCost { waited: 0.5, until_durable: 2.0, bytes: 7, at_risk: 12.0 });
        interval.add(CommitCost { waited: 1.5, until_durable: 2.0, bytes: 8, at_risk: 11.0 });
        let report = interval.report(100.0);
        assert_eq!((report.commits, report.commit_bytes, report.commit_seconds), (2, 15, 2.0));
        assert_eq!((report.commit_overhead_percent, report.commit_loss_seconds), (2.0, 12.0));
    }

    #[test]
    fn values_are_read_as_they_are_written() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct File {
            every: CommitEvery,
        }
        for (text, every) in
            [("\"auto\"", CommitEvery::Auto), ("60", CommitEvery::Seconds(60.0)), ("0.5", CommitEvery::Seconds(0.5))]
        {
            let file: File = toml::from_str(&format!("every = {text}")).unwrap();
            assert_eq!(file.every, every);
            assert_eq!(toml::from_str::<File>(&toml::to_string(&file).unwrap()).unwrap(), file);
            assert_eq!(every.to_string().parse(), Ok(every));
        }
        assert!("often".parse::<CommitEvery>().is_err_and(|e| e.contains("often")));
    }
}
