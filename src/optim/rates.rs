//! Learning rates: a pure function of column and step.
//!
//! Invariants: 1. steps are 0-based; 2. the rate of the means falls exponentially from `means` at step 0 to `means *
//! means_final_factor` at step `steps` and stays there; the others are constant; 3. a rate depends on nothing else, so
//! a resumed run has the same rates.

use crate::scene::columns::Column;

/// Rates of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Positions at step 0, in units of the scene: the nominal rate times the scene scale.
    pub means: f64,
    /// Rotations.
    pub quats: f64,
    /// Log-scales.
    pub scales: f64,
    /// Logit opacities.
    pub opacities: f64,
    /// Constant colour band.
    pub sh0: f64,
    /// Higher colour bands.
    pub sh_n: f64,
    /// Fraction of the means' rate that remains at the end of the schedule.
    pub means_final_factor: f64,
    /// Steps over which the rate of the means falls.
    pub steps: u32,
}

impl Rates {
    /// The defaults of gsplat's trainer for a scene of this scale and a run of this many steps.
    pub fn new(scene_scale: f64, steps: u32) -> Self {
        Rates {
            means: 1.6e-4 * scene_scale,
            quats: 1e-3,
            scales: 5e-3,
            opacities: 5e-2,
            sh0: 2.5e-3,
            sh_n: 2.5e-3 / 20.0,
            means_final_factor: 0.01,
            steps,
        }
    }

    /// Rate of a column at step 0.
    pub fn base(&self, column: Column) -> f64 {
        match column {
            Column::Means => self.means,
            Column::Quats => self.quats,
            Column::Scales => self.scales,
            Column::Opacities => self.opacities,
            Column::Sh0 => self.sh0,
            Column::ShN => self.sh_n,
        }
    }

    /// Factor on the rate of the means at a step: `means_final_factor ^ (step / steps)`.
    pub fn means_factor(&self, step: u32) -> f64 {
        if step >= self.steps {
            return self.means_final_factor;
        }
        libm::pow(self.means_final_factor, f64::from(step) / f64::from(self.steps))
    }

    /// Rate of a column at a step.
    pub fn at(&self, column: Column, step: u32) -> f64 {
        match column {
            Column::Means => self.means * self.means_factor(step),
            _ => self.base(column),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_means_decay() {
        let rates = Rates::new(2.0, 1000);
        assert_eq!(rates.at(Column::Means, 0), 3.2e-4);
        // Half way in the exponent: a tenth. The slack allows for a few roundings of pow.
        assert!((rates.at(Column::Means, 500) / 3.2e-5 - 1.0).abs() < 1e-12);
        assert!((rates.at(Column::Means, 1000) / 3.2e-6 - 1.0).abs() < 1e-12);
        assert_eq!(rates.at(Column::Means, 5000), rates.at(Column::Means, 1000));
        assert_eq!(rates.at(Column::ShN, 700), 1.25e-4);
        assert_eq!(Rates { steps: 0, ..rates }.at(Column::Means, 0), 3.2e-4 * 0.01);
    }
}
