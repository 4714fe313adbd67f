//! Judges the settings of a sweep: mean and spread over seeds, Pareto front, loss of accuracy against the reference.
//!
//! Invariants: 1. a point is on the front unless another point is at least as good in both values and better in one;
//! 2. without a known spread of the reference, only settings with the same bits as the reference count as free.

use super::record::RunRecord;

/// Mean and range of a value over seeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    pub mean: f64,
    pub low: f64,
    pub high: f64,
}

impl Spread {
    /// Over the finite values; `None` if there are none.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Spread> {
        let values: Vec<f64> = values.filter(|v| v.is_finite()).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (!values.is_empty()).then(|| Spread { mean: values.iter().sum::<f64>() / values.len() as f64, low, high })
    }

    pub fn width(&self) -> f64 {
        self.high - self.low
    }
}

/// Accuracy of a setting against the reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    Reference,
    /// The same bits and the same traffic as the reference for every common seed: the setting changed nothing here.
    NoEffect,
    /// The same bits as the reference for every common seed.
    SameBits,
    /// PSNR and SSIM are at least the reference's means over the common seeds, minus the reference's spread over all its seeds.
    WithinSpread,
    /// PSNR or SSIM is lower than that.
    Costs,
    /// The reference has only one seed, or reference and setting have no common seed.
    Unknown,
}

impl Verdict {
    /// The verdict for people; empty where it is not known.
    pub fn words(self) -> &'static str {
        match self {
            Verdict::Reference => "the reference",
            Verdict::NoEffect => "changed nothing here",
            Verdict::SameBits => "the same bits",
            Verdict::WithinSpread => "no cost beyond the spread",
            Verdict::Costs => "costs",
            Verdict::Unknown => "",
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// Group and name, `group/name`.
    pub name: String,
    pub runs: Vec<RunRecord>,
    /// Why a run of it failed.
    pub problem: Option<String>,
    /// Accuracy against the reference.
    pub verdict: Verdict,
}

impl Setting {
    /// A value over the seeds that have it.
    pub fn spread(&self, of: impl Fn(&RunRecord) -> Option<f64>) -> Option<Spread> {
        Spread::of(self.runs.iter().filter_map(of))
    }
}

/// Groups the runs by setting, in their order, and judges each setting against the reference.
pub fn settings(records: &[RunRecord], reference: &str) -> Vec<Setting> {
    let mut settings: Vec<Setting> = Vec::new();
    for record in records {
        let at = settings.iter().position(|s| s.name == record.name).unwrap_or_else(|| {
            let (name, runs) = (record.name.clone(), Vec::new());
            settings.push(Setting { name, runs, problem: None, verdict: Verdict::Unknown });
            settings.len() - 1
        });
        match &record.problem {
            None => settings[at].runs.push(record.clone()),
            Some(problem) => settings[at].problem = Some(problem.clone()),
        }
    }
    if let Some(reference) = settings.iter().find(|s| s.name == reference && !s.runs.is_empty()).cloned() {
        settings.iter_mut().for_each(|s| s.verdict = judge(s, &reference));
    }
    settings
}

fn judge(setting: &Setting, reference: &Setting) -> Verdict {
    if setting.name == reference.name {
        return Verdict::Reference;
    }
    let of_seed = |run: &RunRecord| reference.runs.iter().find(|b| b.seed == run.seed);
    let pairs: Vec<_> = setting.runs.iter().filter_map(|run| Some((run, of_seed(run)?))).collect();
    if !pairs.is_empty() && pairs.iter().all(|(run, own)| !run.ply.is_empty() && run.ply == own.ply) {
        // Times always differ a little; these figures differ where a setting of memory or drive does something.
        let traffic = |r: &RunRecord| (r.bytes_read, r.bytes_written, r.frames, r.pages, r.steps);
        let is_idle = pairs.iter().all(|(run, own)| traffic(run) == traffic(own));
        return if is_idle { Verdict::NoEffect } else { Verdict::SameBits };
    }
    if reference.runs.len() < 2 || against(setting, reference, |r| r.psnr).is_none() {
        return Verdict::Unknown;
    }
    let holds = |of: fn(&RunRecord) -> Option<f64>| {
        let width = reference.spread(of).map(|s| s.width());
        against(setting, reference, of).zip(width).is_some_and(|(difference, width)| difference.mean >= -width)
    };
    match holds(|r| r.psnr) && holds(|r| r.ssim) {
        true => Verdict::WithinSpread,
        false => Verdict::Costs,
    }
}

/// Difference to the reference over common seeds. Pairing by seed cancels the luck of a seed. `None` without a common seed.
pub fn against(setting: &Setting, reference: &Setting, of: impl Fn(&RunRecord) -> Option<f64>) -> Option<Spread> {
    let of_reference = |seed: u64| reference.runs.iter().find(|b| b.seed == seed).and_then(&of);
    setting.spread(|run| Some(of(run)? - of_reference(run.seed)?))
}

/// The Pareto front: indices of the points (cost, value) that no other point beats, by ascending cost. Lower cost and
/// higher value are better. Equal points are all on the front.
pub fn pareto_front(points: &[(f64, f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.retain(|&i| points[i].0.is_finite() && points[i].1.is_finite());
    order.sort_by(|&a, &b| {
        points[a].0.total_cmp(&points[b].0).then(points[b].1.total_cmp(&points[a].1)).then(a.cmp(&b))
    });
    let mut front: Vec<usize> = Vec::new();
    for i in order {
        if front.last().is_none_or(|&best| points[i].1 > points[best].1 || points[i] == points[best]) {
            front.push(i);
        }
    }
    front
}

#[cfg(test)]
mod tests {
    use super::*;
    use gsscale::base::rng::{Purpose, Stream};

    #[test]
    fn the_front_is_what_brute_force_finds() {
        let mut draws = Stream::new(3, Purpose::Test, 0, 0);
        for round in 0..300 {
            // Few distinct values give ties in one or both coordinates; some values are NaN.
            let draw = |draws: &mut Stream| if draws.below(30) == 0 { f64::NAN } else { draws.below(6) as f64 };
            let points: Vec<(f64, f64)> = (0..round % 17).map(|_| (draw(&mut draws), draw(&mut draws))).collect();
            let is_finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
            let beats = |a: &(f64, f64), b: &(f64, f64)| is_finite(a) && a.0 <= b.0 && a.1 >= b.1 && a != b;
            let mut want: Vec<usize> = (0..points.len()).filter(|&i| is_finite(&points[i])).collect();
            want.retain(|&i| !points.iter().any(|p| beats(p, &points[i])));
            let mut got = pareto_front(&points);
            assert!(got.windows(2).all(|w| points[w[0]].0 <= points[w[1]].0));
            got.sort_unstable();
            assert_eq!(got, want, "{points:?}");
        }
    }

    fn run(name: &str, seed: u64, psnr: f64, ssim: f64, ply: &str) -> RunRecord {
        let (psnr, ssim) = (Some(psnr), Some(ssim));
        RunRecord { name: name.into(), seed, psnr, ssim, ply: ply.into(), ..RunRecord::default() }
    }

    #[test]
    fn settings_are_judged_by_the_spread_of_the_base() {
        let mut runs = vec![
            run("slow", 1, 25.79, 0.8, "x"),
            run("unlucky", 2, 25.9, 0.82, "x"),
            run("base", 1, 26.0, 0.80, "p1"),
            run("base", 2, 26.2, 0.82, "p2"),
            run("fine", 1, 25.81, 0.781, "x"),
            run("dull", 1, 26.5, 0.77, "x"),
            RunRecord { frames: 4, ..run("paged", 1, 26.0, 0.80, "p1") },
            run("paged", 2, 26.2, 0.82, "p2"),
            run("mixed", 1, 26.0, 0.80, "p1"),
            run("mixed", 2, 20.0, 0.82, "x"),
            // A setting that never comes into effect, such as a cap that is not reached.
            run("idle", 1, 26.0, 0.80, "p1"),
        ];
        runs.push(RunRecord { problem: Some("died".into()), ..run("base", 3, 1.0, 0.1, "") });
        let verdicts = |runs: &[RunRecord]| -> Vec<(String, Verdict)> {
            settings(runs, "base").into_iter().map(|s| (s.name, s.verdict)).collect()
        };
        let names = ["slow", "unlucky", "base", "fine", "dull", "paged", "mixed", "idle"].map(str::to_string);
        // The spread of the base is 0.2 dB and .02; seed 1 has 26.0 dB and .80, seed 2 has 26.2 and .82.
        use Verdict::{Costs, NoEffect, Reference, SameBits, Unknown, WithinSpread};
        let want = [Costs, Costs, Reference, WithinSpread, Costs, SameBits, Costs, NoEffect];
        assert_eq!(verdicts(&runs), names.clone().into_iter().zip(want).collect::<Vec<_>>());
        // With one seed of the base, only equal bits give a verdict.
        runs.remove(3);
        let want = [Unknown, Unknown, Reference, Unknown, Unknown, SameBits, NoEffect, NoEffect];
        assert_eq!(verdicts(&runs), names.into_iter().zip(want).collect::<Vec<_>>());
        let paged = &settings(&runs, "base")[5];
        assert_eq!(paged.spread(|r| r.psnr).map(|s| (s.low, s.high)), Some((26.0, 26.2)));
    }
}
