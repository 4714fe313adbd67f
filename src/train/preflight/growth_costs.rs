//! What a run that decides its count will take at the count that it has decided.
//!
//! Before the first step nobody knows that count: among measured scenes it was once to eight times the first one. The plan therefore
//! names both ends, and a check of growth that changes the count says what the run takes from then on.
//!
//! Not here: the time, which the progress bar measures.

use super::forecast::Forecast;
use crate::base::units::format_bytes;

/// Memory and drive of a run by its count. The default knows nothing and says nothing.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct GrowthCosts {
    /// Without growth, and with the most growth that was foreseen.
    ends: [Costs; 2],
}

/// What a run takes with a number of Gaussians.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Costs {
    gaussians: u64,
    /// Peak, bytes.
    memory: u64,
    /// Most bytes.
    drive: u64,
}

impl GrowthCosts {
    /// Those of a run with this forecast.
    pub(crate) fn new(forecast: &Forecast) -> GrowthCosts {
        let costs = |forecast: &Forecast| Costs {
            gaussians: forecast.gaussians[1],
            memory: forecast.memory_at_end().total(),
            drive: forecast.drive_bytes_peak,
        };
        let least = forecast.if_kept.as_deref();
        least.map_or(GrowthCosts::default(), |least| GrowthCosts { ends: [costs(least), costs(forecast)] })
    }

    /// What the run takes with `gaussians`, as a line; `None` if that is unknown. Rows make up memory and drive, so both are interpolated in
    /// their number.
    pub(crate) fn text(&self, gaussians: u64) -> Option<String> {
        let [least, most] = self.ends;
        if most.gaussians <= least.gaussians {
            return None;
        }
        let share = (gaussians as f64 - least.gaussians as f64) / (most.gaussians - least.gaussians) as f64;
        let between = |least: u64, most: u64| (least as f64 + share * (most as f64 - least as f64)) as u64;
        let [memory, drive] = [between(least.memory, most.memory), between(least.drive, most.drive)].map(format_bytes);
        Some(format!("  which takes about {memory} of memory and {drive} of the drive"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_grow_with_the_rows() {
        assert_eq!(GrowthCosts::default().text(1000), None);
        let least = Costs { gaussians: 1000, memory: 100 << 20, drive: 10 << 20 };
        let most = Costs { gaussians: 8000, memory: 800 << 20, drive: 80 << 20 };
        let costs = GrowthCosts { ends: [least, most] };
        let text = |gaussians| costs.text(gaussians).unwrap_or_default();
        assert_eq!(text(4000), "  which takes about 400 MiB of memory and 40.0 MiB of the drive");
        // Also beyond what was foreseen.
        assert!(text(16_000).contains("1.6 GiB") && text(1000).contains("100 MiB"));
    }
}
