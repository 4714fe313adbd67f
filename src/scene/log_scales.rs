//! The range of the log-scales of a run, from which every standard deviation and its square stay finite numbers.
//!
//! Log-scales are clamped where Gaussians enter a run, where the optimizer updates them, and where an event rewrites or
//! splits them. A file's Gaussians above the range do not enter a run: at such sizes they cover every picture, and no
//! gradient makes them smaller. Between two updates a log-scale may drift beyond the range by the momentum of its last
//! gradient: such a value is computed, never stored.
//!
//! Invariants: 1. the range is a function of the scene scale, so it is the same for the whole run and on resume; 2. no
//! Gaussian of a scene that trains well comes near the range, which ends at 1e4 scene scales and at 1e-13 units.

/// Largest standard deviation, in scene scales: for cameras a metre apart, a mountain range.
const LARGEST_IN_SCENE_SCALES: f64 = 1e4;
/// Limit of the magnitude of log-scales in any scene: standard deviations of 1e-13 to 1e13 units.
const LIMIT: f32 = 30.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LogScaleRange {
    pub low: f32,
    pub high: f32,
}

impl LogScaleRange {
    /// The range for a scene whose size is unknown.
    pub const ANY_SCENE: LogScaleRange = LogScaleRange { low: -LIMIT, high: LIMIT };

    /// The range for a scene of this scale, local units.
    pub fn of_scene(scene_scale: f32) -> LogScaleRange {
        let high = libm::log(LARGEST_IN_SCENE_SCALES * f64::from(scene_scale)) as f32;
        // A scale of 0 or NaN gives no limit of its own.
        let high = if high > 0.0 { high.min(LIMIT) } else { LIMIT };
        LogScaleRange { low: -LIMIT, high }
    }

    /// The value, moved into the range; the least for NaN.
    #[inline(always)]
    pub fn clamp(&self, log_scale: f32) -> f32 {
        log_scale.max(self.low).min(self.high)
    }

    /// Moves values into the range; returns how many were outside.
    pub fn clamp_all(&self, log_scales: &mut [f32]) -> u64 {
        let mut moved = 0;
        for log_scale in log_scales {
            let inside = self.clamp(*log_scale);
            moved += u64::from(inside != *log_scale);
            *log_scale = inside;
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_keep_standard_deviations_finite_and_ordinary_ones_unchanged() {
        for scene_scale in [0.0, f32::NAN, 1e-30, 1e-3, 1.0, 2.0, 50.0, 1e30] {
            let range = LogScaleRange::of_scene(scene_scale);
            assert!(range.low == -30.0 && range.high > 0.0 && range.high <= 30.0, "{scene_scale}: {range:?}");
            for log_scale in [f32::INFINITY, 1e38, 89.0, f32::NEG_INFINITY, f32::NAN, 0.0] {
                let sigma = f64::from(range.clamp(log_scale)).exp();
                // The fourth power occurs in the determinant of a projected covariance, in f64 when bounds are found.
                assert!(sigma.is_finite() && sigma > 0.0, "{log_scale}");
            }
        }
        let range = LogScaleRange::of_scene(2.0);
        // ln(2e4)
        assert!((range.high - 9.903_487).abs() < 1e-6);
        let mut ordinary = [-20.0, -7.5, 0.0, 3.0, 9.0];
        assert_eq!((range.clamp_all(&mut ordinary), ordinary), (0, [-20.0, -7.5, 0.0, 3.0, 9.0]));
        let mut extreme = [20.0, -7.5, f32::INFINITY];
        assert_eq!((range.clamp_all(&mut extreme), extreme), (2, [range.high, -7.5, range.high]));
    }
}
