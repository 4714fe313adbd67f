//! Compares the times of runs on a machine whose speed changes between them.
//!
//! A sweep trains the base for a few steps before and after each run, always the same steps. The time of this short training is the pace
//! of the machine at that run.
//!
//! Invariants: 1. only paces of one training are compared; 2. times of computing change in proportion to the pace. Time that a run waited
//! for the drive, bytes, counts and quality stay as measured.

use super::record::{Pace, RunRecord};

/// Converts `seconds` and `cpu_seconds` of all runs to the median of their paces, in place. Times stay as measured unless every run that
/// succeeded has a pace of the same training. Returns a sentence for readers that says which of the two the times are.
pub fn convert_to_one_pace(records: &mut [RunRecord]) -> &'static str {
    let paces: Vec<Option<&Pace>> = records.iter().filter(|r| r.problem.is_none()).map(|r| r.pace.as_ref()).collect();
    let first = paces.first().copied().flatten();
    let is_like = |pace: &Option<&Pace>| {
        pace.zip(first).is_some_and(|(own, first)| own.key == first.key && own.seconds.is_finite() && own.seconds > 0.0)
    };
    if paces.is_empty() || !paces.iter().all(is_like) {
        return "times as measured";
    }
    let (seconds, cpu_seconds) = (median(records, |pace| Some(pace.seconds)), median(records, |pace| pace.cpu_seconds));
    for record in records {
        let Some(pace) = &record.pace else { continue };
        if let Some(median) = seconds {
            // A slow processor does not slow the drive.
            let computing = (record.seconds - record.stall_seconds).max(0.0);
            record.seconds = record.stall_seconds + computing * median / pace.seconds;
        }
        if let (Some(median), Some(own), Some(measured)) = (cpu_seconds, pace.cpu_seconds, record.cpu_seconds) {
            record.cpu_seconds = Some(measured * median / own);
        }
    }
    "times converted to the median pace of the machine"
}

/// The upper median of a value above 0; `None` if a pace lacks it.
fn median(records: &[RunRecord], of: impl Fn(&Pace) -> Option<f64>) -> Option<f64> {
    let paces = records.iter().filter_map(|record| record.pace.as_ref());
    let mut values: Vec<f64> = paces.map(|pace| of(pace).filter(|v| *v > 0.0)).collect::<Option<_>>()?;
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(seconds: f64, stall_seconds: f64, pace: f64) -> RunRecord {
        let pace = Pace { key: "base".into(), seconds: pace, cpu_seconds: Some(20.0 * pace) };
        RunRecord { seconds, stall_seconds, cpu_seconds: Some(2.0 * seconds), pace: Some(pace), ..RunRecord::default() }
    }

    #[test]
    fn times_are_those_at_the_median_pace() {
        let mut records = [run(80.0, 0.0, 3.0), run(160.0, 0.0, 6.0), run(70.0, 10.0, 2.0)];
        assert!(convert_to_one_pace(&mut records).contains("converted"));
        assert_eq!(records.each_ref().map(|record| record.seconds), [80.0, 80.0, 100.0]);
        assert_eq!(records.each_ref().map(|record| record.cpu_seconds), [160.0, 160.0, 210.0].map(Some));
        // A run that failed needs no pace.
        let failed = RunRecord { problem: Some("no memory".into()), ..RunRecord::default() };
        let mut records = [run(80.0, 0.0, 3.0), failed.clone(), run(160.0, 0.0, 6.0)];
        assert!(convert_to_one_pace(&mut records).contains("converted"));
        assert_eq!(records.each_ref().map(|record| record.seconds), [160.0, 0.0, 160.0]);
        assert_eq!(records[1], failed);
    }

    #[test]
    fn times_stay_where_paces_cannot_be_compared() {
        let without = RunRecord { pace: None, ..run(9.0, 1.0, 1.0) };
        let of_another = Pace { key: "other".into(), seconds: 2.0, cpu_seconds: None };
        let of_another = RunRecord { pace: Some(of_another), ..run(9.0, 1.0, 1.0) };
        for other in [without, of_another, run(9.0, 1.0, 0.0), run(9.0, 1.0, f64::NAN), run(9.0, 1.0, -1.0)] {
            let mut records = [run(9.0, 1.0, 2.0), other];
            assert_eq!(convert_to_one_pace(&mut records), "times as measured");
            assert_eq!(records.each_ref().map(|record| record.seconds), [9.0; 2]);
        }
        assert_eq!(convert_to_one_pace(&mut []), "times as measured");
    }
}
