//! Dense Adam, one step at a time: the reference for the deferred form.
//!
//! Every value takes every step, seen or not: the formula of `gsscale::optim::adam`. Invariant: t counts steps from 1.

use gsscale::optim::adam::AdamConfig;
use std::ops::{Add, Div, Mul, Sub};

/// A float type for dense Adam.
pub trait Real: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> {
    fn from_f64(x: f64) -> Self;
    fn sqrt(self) -> Self;
}

impl Real for f32 {
    fn from_f64(x: f64) -> Self {
        x as f32
    }
    fn sqrt(self) -> Self {
        f32::sqrt(self)
    }
}

impl Real for f64 {
    fn from_f64(x: f64) -> Self {
        x
    }
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
}

/// Values with their moments; each step updates all of them.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseAdam<F> {
    config: AdamConfig,
    pub steps: u32,
    pub values: Vec<F>,
    /// First moments, without bias correction.
    pub exp_avg: Vec<F>,
    /// Second moments, without bias correction.
    pub exp_avg_sq: Vec<F>,
}

impl<F: Real> DenseAdam<F> {
    pub fn new(config: AdamConfig, values: Vec<F>) -> Self {
        let zeros = vec![F::from_f64(0.0); values.len()];
        DenseAdam { config, steps: 0, values, exp_avg: zeros.clone(), exp_avg_sq: zeros }
    }

    pub fn step(&mut self, grads: &[F], lr: f64) {
        assert_eq!(grads.len(), self.values.len());
        self.steps += 1;
        let AdamConfig { beta1, beta2, eps } = self.config;
        let t = f64::from(self.steps);
        let step_size = F::from_f64(lr / (1.0 - libm::pow(beta1, t)));
        let root_correction = F::from_f64(libm::sqrt(1.0 - libm::pow(beta2, t)));
        let (b2, eps) = (F::from_f64(beta2), F::from_f64(eps));
        let (one_minus_b1, one_minus_b2) = (F::from_f64(1.0 - beta1), F::from_f64(1.0 - beta2));
        for i in 0..grads.len() {
            let g = grads[i];
            let m = self.exp_avg[i];
            let m = m + one_minus_b1 * (g - m);
            let v = b2 * self.exp_avg_sq[i] + one_minus_b2 * (g * g);
            self.exp_avg[i] = m;
            self.exp_avg_sq[i] = v;
            self.values[i] = self.values[i] - step_size * (m / (v.sqrt() / root_correction + eps));
        }
    }
}
