//! Learning rates: a pure function of column and step.
//!
//! Invariants: 1. steps are 0-based; 2. the rate of the means falls exponentially from `means` at step 0 to `means *
//! means_final_factor` at step `steps` and stays there; 3. the other rates are constant over the first nine tenths of
//! `steps`, fall exponentially to `others_final_factor` times their base over the last tenth, and stay there; 4. a rate
//! depends on nothing else, so a resumed run has the same rates.
//!
//! Why the others fall at the end: under Adam a value whose gradients have changing signs keeps moving by its rate, so a
//! constant rate leaves noise of that size in every value. A fall over more than the last tenth costs more movement than
//! the noise is worth (`benches/RESULTS.md`, "Rates that settle").

use crate::scene::columns::Column;

/// Share of the steps after which the rates of all columns but the means fall.
const SETTLES_FROM: f64 = 0.9;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Positions at step 0, in units of the scene: the nominal rate times the scene scale.
    pub means: f64,
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
    /// Fraction of the other rates that remains at the end of the schedule; 1 = they are constant.
    pub others_final_factor: f64,
    /// Steps of the schedule.
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
            others_final_factor: 1.0,
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

    /// Factor on the other rates at a step: 1 over nine tenths of the steps, from there on `others_final_factor` to the
    /// power of the share of the rest that has passed.
    pub fn others_factor(&self, step: u32) -> f64 {
        let settles_from = SETTLES_FROM * f64::from(self.steps);
        if step >= self.steps {
            return self.others_final_factor;
        }
        if f64::from(step) <= settles_from {
            return 1.0;
        }
        let passed = (f64::from(step) - settles_from) / (f64::from(self.steps) - settles_from);
        libm::pow(self.others_final_factor, passed)
    }

    /// Factors at a step: on the rate of the means, and on the others.
    pub fn factors(&self, step: u32) -> [f64; 2] {
        [self.means_factor(step), self.others_factor(step)]
    }

    pub fn at(&self, column: Column, step: u32) -> f64 {
        match column {
            Column::Means => self.means * self.means_factor(step),
            _ => self.base(column) * self.others_factor(step),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_other_rates_fall_over_the_last_tenth() {
        let rates = Rates { others_final_factor: 0.1, ..Rates::new(2.0, 1000) };
        let of_steps = |column| [0, 900, 950, 1000, 5000].map(|step| rates.at(column, step) / rates.base(column));
        for column in Column::ALL.into_iter().filter(|&c| c != Column::Means) {
            for (got, want) in of_steps(column).into_iter().zip([1.0, 1.0, 0.1f64.sqrt(), 0.1, 0.1]) {
                // A few roundings of pow.
                assert!((got / want - 1.0).abs() < 1e-12, "{column:?}: {got}");
            }
        }
        assert_eq!(rates.at(Column::Means, 950), Rates::new(2.0, 1000).at(Column::Means, 950));
        assert_eq!(Rates { steps: 0, ..rates }.at(Column::Sh0, 0), 0.1 * rates.sh0);
    }

    #[test]
    fn only_the_means_decay_without_a_factor_of_the_others() {
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
