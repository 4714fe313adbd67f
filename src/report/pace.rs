//! Compares the times of runs on a machine whose speed changes between them.
//!
//! A sweep trains the base for a few steps before and after each run, always the same steps. The seconds of this short training are
//! the pace of the machine at that run.
//!
//! Invariant: times of computing change, in proportion to the pace. Time that a run waited for the drive, bytes, counts and quality
//! stay as measured.

use super::record::RunRecord;

/// Converts the times of all runs to the median of their paces. Runs without a pace keep their times.
pub fn convert_to_one_pace(records: &mut [RunRecord]) {
    let pace = |record: &RunRecord| record.pace_seconds.filter(|pace| pace.is_finite() && *pace > 0.0);
    let mut paces: Vec<f64> = records.iter().filter_map(pace).collect();
    paces.sort_unstable_by(f64::total_cmp);
    let Some(&median) = paces.get(paces.len() / 2) else { return };
    for record in records {
        let Some(factor) = pace(record).map(|own| median / own) else { continue };
        // A slow processor does not slow the drive.
        record.seconds = record.stall_seconds + (record.seconds - record.stall_seconds).max(0.0) * factor;
        record.cpu_seconds = record.cpu_seconds.map(|seconds| seconds * factor);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(seconds: f64, stall_seconds: f64, pace_seconds: Option<f64>) -> RunRecord {
        RunRecord { seconds, stall_seconds, cpu_seconds: Some(2.0 * seconds), pace_seconds, ..RunRecord::default() }
    }

    #[test]
    fn times_are_those_at_the_median_pace() {
        let slow = run(160.0, 0.0, Some(6.0));
        let mut records = [run(50.0, 5.0, None), run(80.0, 0.0, Some(3.0)), slow, run(70.0, 10.0, Some(2.0))];
        convert_to_one_pace(&mut records);
        assert_eq!(records[0], run(50.0, 5.0, None));
        assert_eq!(records.each_ref().map(|record| record.seconds), [50.0, 80.0, 80.0, 100.0]);
        assert_eq!(records.each_ref().map(|record| record.cpu_seconds), [100.0, 160.0, 160.0, 210.0].map(Some));
    }

    #[test]
    fn a_pace_that_is_no_time_changes_nothing() {
        let records = [0.0, -1.0, f64::NAN, f64::INFINITY].map(|pace| run(9.0, 1.0, Some(pace)));
        let mut converted = records.clone();
        convert_to_one_pace(&mut converted);
        assert_eq!(converted.each_ref().map(|record| record.seconds), [9.0; 4]);
    }
}
