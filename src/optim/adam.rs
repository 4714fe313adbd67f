//! The numbers of Adam: decay rates, eps, and the smallest eps that training allows.
//!
//! Kingma and Ba 2015 (arXiv 1412.6980), with eps outside the bias-corrected root as in torch: `value -= lr / (1 -
//! beta1^t) * m / (sqrt(v) / sqrt(1 - beta2^t) + eps)`, with t counted from 1.
//!
//! Not here: the deferred form that training uses ([`super::deferred`]).

/// The smallest eps allowed in training.
///
/// State in f32 flushes second moments below the smallest normal float, whose root is 1.1e-19, to zero. A value with
/// such a moment moves by m / eps instead of m / (root + eps), so eps must be far larger than that root. At 1e-16 the
/// movement errs by 1e-3, which the bounds of pages allow for ([`super::bounds`]); at smaller eps it errs by more. For
/// still smaller eps, (400 eps)^2, where the series ends ([`super::drift`]), is subnormal as well, m / eps overflows,
/// and rows have no finite bounds.
pub const EPS_MIN: f64 = 1e-16;

/// Decay rates of the moments, and eps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamConfig {
    /// Decay of the first moment per step.
    pub beta1: f64,
    /// Decay of the second moment per step.
    pub beta2: f64,
    /// Added to the bias-corrected root; training refuses values below [`EPS_MIN`].
    pub eps: f64,
}

impl Default for AdamConfig {
    fn default() -> Self {
        AdamConfig { beta1: 0.9, beta2: 0.999, eps: 1e-15 }
    }
}
