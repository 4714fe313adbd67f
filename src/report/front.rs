//! Judges the settings of a sweep: mean and spread over seeds, Pareto front, loss of accuracy against the base.
//!
//! Invariants: 1. a point is on the front unless another point is at least as good in both values and better in one;
//! 2. without a known spread of the base, only settings with the same bits as the base count as free.

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

    /// Highest value minus lowest value.
    pub fn width(&self) -> f64 {
        self.high - self.low
    }
}

/// Accuracy of a setting against the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// The setting is the base.
    Base,
    /// The same bits and the same traffic as the base for every common seed: the setting changed nothing here.
    NoEffect,
    /// The same bits as the base for every common seed.
    SameBits,
    /// PSNR and SSIM are at least the base's means over the common seeds, minus the base's spread over all its seeds.
    WithinSpread,
    /// PSNR or SSIM is lower than that.
    Costs,
    /// The base has only one seed, or base and setting have no common seed.
    Unknown,
}

impl Verdict {
    /// The verdict for people; empty where it is not known.
    pub fn words(self) -> &'static str {
        match self {
            Verdict::Base => "the base",
            Verdict::NoEffect => "changed nothing here",
            Verdict::SameBits => "the same bits",
            Verdict::WithinSpread => "no cost beyond the spread",
            Verdict::Costs => "costs",
            Verdict::Unknown => "",
        }
    }

    /// Whether the setting loses no accuracy beyond the spread.
    pub fn is_free(self) -> bool {
        matches!(self, Verdict::Base | Verdict::NoEffect | Verdict::SameBits | Verdict::WithinSpread)
    }
}

/// A setting with the runs of all its seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// The changed knob.
    pub knob: String,
    /// Name of the setting.
    pub label: String,
    /// The successful runs.
    pub runs: Vec<RunRecord>,
    /// PSNR, dB.
    pub psnr: Option<Spread>,
    pub ssim: Option<Spread>,
    /// Accuracy against the base.
    pub verdict: Verdict,
}

impl Setting {
    /// Mean of a value over the seeds that have it.
    pub fn mean(&self, of: impl Fn(&RunRecord) -> Option<f64>) -> Option<f64> {
        Spread::of(self.runs.iter().filter_map(of)).map(|s| s.mean)
    }
}

/// Groups the successful runs by setting, base first, and judges each setting against the base.
pub fn settings(records: &[RunRecord]) -> Vec<Setting> {
    let mut settings: Vec<Setting> = Vec::new();
    for record in records.iter().filter(|r| r.problem.is_none()) {
        let same = |s: &&mut Setting| s.knob == record.knob && s.label == record.label;
        match settings.iter_mut().find(same) {
            Some(setting) => setting.runs.push(record.clone()),
            None => settings.push(Setting {
                knob: record.knob.clone(),
                label: record.label.clone(),
                runs: vec![record.clone()],
                psnr: None,
                ssim: None,
                verdict: Verdict::Unknown,
            }),
        }
    }
    for setting in &mut settings {
        setting.psnr = Spread::of(setting.runs.iter().filter_map(|r| r.psnr));
        setting.ssim = Spread::of(setting.runs.iter().filter_map(|r| r.ssim));
    }
    settings.sort_by_key(|s| s.knob != "base");
    if let Some(base) = settings.first().filter(|s| s.knob == "base").cloned() {
        settings.iter_mut().for_each(|s| s.verdict = judge(s, &base));
    }
    settings
}

fn judge(setting: &Setting, base: &Setting) -> Verdict {
    if setting.knob == "base" {
        return Verdict::Base;
    }
    let of_seed = |run: &RunRecord| base.runs.iter().find(|b| b.seed == run.seed);
    let pairs: Vec<_> = setting.runs.iter().filter_map(|run| Some((run, of_seed(run)?))).collect();
    if !pairs.is_empty() && pairs.iter().all(|(run, base)| !run.ply.is_empty() && run.ply == base.ply) {
        // Times always differ a little; these figures differ where a setting of memory or drive does something.
        let traffic = |r: &RunRecord| (r.bytes_read, r.bytes_written, r.frames, r.pages, r.steps);
        let is_idle = pairs.iter().all(|(run, base)| traffic(run) == traffic(base));
        return if is_idle { Verdict::NoEffect } else { Verdict::SameBits };
    }
    if base.runs.len() < 2 || against(setting, base, |r| r.psnr).is_none() {
        return Verdict::Unknown;
    }
    let holds = |of: fn(&RunRecord) -> Option<f64>| {
        let width = Spread::of(base.runs.iter().filter_map(of)).map(|s| s.width());
        against(setting, base, of).zip(width).is_some_and(|(difference, width)| difference >= -width)
    };
    match holds(|r| r.psnr) && holds(|r| r.ssim) {
        true => Verdict::WithinSpread,
        false => Verdict::Costs,
    }
}

/// Mean difference to the base over common seeds. Pairing by seed cancels the luck of a seed. `None` without a common
/// seed.
pub fn against(setting: &Setting, base: &Setting, of: impl Fn(&RunRecord) -> Option<f64>) -> Option<f64> {
    let of_base = |seed: u64| base.runs.iter().find(|b| b.seed == seed).and_then(&of);
    Spread::of(setting.runs.iter().filter_map(|run| Some(of(run)? - of_base(run.seed)?))).map(|s| s.mean)
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
    use crate::base::rng::{Purpose, Stream};

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

    fn run(knob: &str, seed: u64, psnr: f64, ssim: f64, ply: &str) -> RunRecord {
        let (psnr, ssim) = (Some(psnr), Some(ssim));
        RunRecord { knob: knob.into(), label: knob.into(), seed, psnr, ssim, ply: ply.into(), ..RunRecord::default() }
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
            settings(runs).into_iter().map(|s| (s.knob, s.verdict)).collect()
        };
        let names = ["base", "slow", "unlucky", "fine", "dull", "paged", "mixed", "idle"].map(str::to_string);
        // The spread of the base is 0.2 dB and .02; seed 1 has 26.0 dB and .80, seed 2 has 26.2 and .82.
        use Verdict::{Base, Costs, NoEffect, SameBits, Unknown, WithinSpread};
        let want = [Base, Costs, Costs, WithinSpread, Costs, SameBits, Costs, NoEffect];
        assert_eq!(verdicts(&runs), names.clone().into_iter().zip(want).collect::<Vec<_>>());
        // With one seed of the base, only equal bits give a verdict.
        runs.remove(3);
        let want = [Base, Unknown, Unknown, Unknown, Unknown, SameBits, NoEffect, NoEffect];
        assert_eq!(verdicts(&runs), names.into_iter().zip(want).collect::<Vec<_>>());
        let paged = &settings(&runs)[5];
        assert_eq!(paged.psnr.map(|s| (s.low, s.high)), Some((26.0, 26.2)));
    }
}
