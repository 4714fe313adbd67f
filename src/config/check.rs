//! The range of each key, and relations between keys.
//!
//! Not here: whether files exist and whether a run fits, which depends on more than the config.

use super::choice::{Chosen, Device};
use super::file::TrainConfig;
use crate::base::error::{InputError, InputResult};
use crate::checkpoint::interval::CommitEvery;
use crate::densify::strategy::StrategyName;
use crate::optim::adam::EPS_MIN;
use crate::optim::method::{Method, OptimizerPlace};
use crate::optim::moments::Moments;

/// Most steps of a run: the optimizer keeps [`crate::optim::drift::STEP_BYTES`] for each.
const STEPS_MAX: u32 = 10_000_000;
/// Most random points to start from.
const INIT_POINTS_MAX: u32 = 100_000_000;
/// Most worker threads: a typing error must not fill memory with stacks.
const THREADS_MAX: u32 = 1024;

/// Fewest and most rows of a page: below, the index and the headers outweigh the rows; above, a page is 48 MB.
const PAGE_ROWS_MIN: u32 = 16;
const PAGE_ROWS_MAX: u32 = 65_536;

impl TrainConfig {
    /// Checks ranges and relations between keys.
    ///
    /// # Errors
    /// Names the first key that is out of range, with what is allowed.
    pub fn check(&self) -> InputResult<()> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        // Compared in f32, as the run computes: 0.99999998 is 1 there.
        let is_between = |x: f64, least: f32| x as f32 > least && (x as f32) < 1.0;
        let is_interval = !matches!(self.commit_every, CommitEvery::Seconds(s) if !(s >= 0.0 && s.is_finite()));
        refuse_first(&[
            ("data-factor", self.data_factor.is_finite() && self.data_factor >= 1.0, "1 or more"),
            ("near-plane", positive(self.near_plane), "a positive number"),
            ("sh-degree", self.sh_degree <= 3, "0, 1, 2 or 3"),
            ("sh-start", self.sh_start <= self.sh_degree, "0 to --sh-degree"),
            ("page-rows", (PAGE_ROWS_MIN..=PAGE_ROWS_MAX).contains(&self.page_rows), "16 to 65536"),
            ("steps", (1..=STEPS_MAX).contains(&self.steps), "1 to 10,000,000"),
            ("schedule-steps", self.schedule_steps <= STEPS_MAX, "0 to 10,000,000"),
            ("max-gaussians", self.max_gaussians < u64::from(u32::MAX), "less than 4,294,967,295, or 0 for no cap"),
            ("init-points", self.init_points <= INIT_POINTS_MAX, "0 to 100,000,000"),
            ("threads", self.threads <= THREADS_MAX, "0 to 1024"),
            ("ssim-lambda", (0.0..=1.0).contains(&self.ssim_lambda), "0 to 1"),
            ("init-opacity", is_between(self.init_opacity, 0.0), "a number between 0 and 1, at most 0.9999999"),
            ("init-scale", positive(self.init_scale), "a positive number"),
            (
                "max-alpha",
                is_between(self.max_alpha, 0.5),
                "a number between 0.5 and 1, such as 0.99 or 0.999, at most 0.9999999",
            ),
            ("background", self.background.0.iter().all(|c| (0.0..=1.0).contains(c)), "three numbers in 0..1"),
            ("refine-every", self.refine_every > 0, "1 or more"),
            ("commit-every", is_interval, "auto, or a number of seconds from 0 on"),
            ("disk-full-wait", (0.0..=1e9).contains(&self.disk_full_wait), "a number of seconds from 0 on"),
            ("log-every", self.log_every > 0, "1 or more"),
        ])?;
        self.check_thresholds()?;
        self.check_strategy()?;
        self.check_place()?;
        self.check_rates()
    }

    /// What a strategy needs.
    fn check_strategy(&self) -> InputResult<()> {
        if self.strategy == StrategyName::Mcmc && self.max_gaussians == 0 {
            let problem = "it grows up to a cap, and there is none";
            return Err(InputError::new("--strategy mcmc", problem, "give --max-gaussians N, such as 1000000"));
        }
        Ok(())
    }

    /// What an optimizer on a device does not do.
    fn check_place(&self) -> InputResult<()> {
        if self.optimizer_on != Chosen(Some(OptimizerPlace::Device)) {
            return Ok(());
        }
        let needs = [
            (self.device != Device::Cpu, "it needs a GPU", "use --device auto or gpu"),
            (self.optimizer == Method::Deferred, "it supports the deferred form only", "use --optimizer deferred"),
            (!self.refine_poses, "it leaves the gradients of poses on the device", "leave out --refine-poses"),
            (self.strategy != StrategyName::Mcmc, "it adds no noise to means", "leave out --strategy mcmc"),
            (self.moments == Moments::F32, "its moments have 32 bits", "use --moments f32"),
        ];
        match needs.iter().find(|(holds, ..)| !holds) {
            Some((_, problem, remedy)) => {
                let remedy = format!("{remedy}, or --optimizer-on host");
                Err(InputError::new("--optimizer-on device", *problem, &remedy))
            }
            None => Ok(()),
        }
    }

    fn check_thresholds(&self) -> InputResult<()> {
        let thresholds = [
            ("grow-grad2d", self.grow_grad2d),
            ("grow-scale3d", self.grow_scale3d),
            ("prune-opa", self.prune_opa),
            ("prune-scale3d", self.prune_scale3d),
        ];
        for (key, value) in thresholds {
            if !(value >= 0.0 && value.is_finite()) {
                return refuse(key, "a number from 0 on");
            }
        }
        if !(0.0..=0.5).contains(&self.recycle) {
            return refuse("recycle", "a share from 0 to 0.5");
        }
        // Compare in f32, as events store the value.
        if self.prune_opa as f32 >= 0.5 {
            return refuse("prune-opa", "less than 0.5");
        }
        Ok(())
    }

    fn check_rates(&self) -> InputResult<()> {
        let rates = [
            ("means-lr", self.means_lr),
            ("scales-lr", self.scales_lr),
            ("quats-lr", self.quats_lr),
            ("opacities-lr", self.opacities_lr),
            ("sh0-lr", self.sh0_lr),
            ("shn-lr", self.shn_lr),
        ];
        for (key, value) in rates {
            if !(0.0..=1e6).contains(&value) {
                return refuse(key, "a number from 0 to 1e6");
            }
        }
        for (key, fraction) in [("means-lr-final", self.means_lr_final), ("others-lr-final", self.others_lr_final)] {
            if !(fraction > 0.0 && fraction <= 1.0) {
                return refuse(key, "a number above 0 and up to 1");
            }
        }
        self.check_adam_eps()
    }

    fn check_adam_eps(&self) -> InputResult<()> {
        if (EPS_MIN..=1.0).contains(&self.adam_eps) {
            return Ok(());
        }
        let problem = format!(
            "{:e} is out of range: below 1e-16, second moments that f32 rounds to zero let Gaussians leave the bounds \
             of their pages; above 1, training stands still",
            self.adam_eps
        );
        Err(InputError::new("--adam-eps", problem, "use 1e-16 to 1; 1e-15 is usual"))
    }
}

/// Refuses the first key whose check failed; each entry is a key, whether its value is allowed, and what is allowed.
fn refuse_first(checks: &[(&str, bool, &str)]) -> InputResult<()> {
    checks.iter().find(|(_, is_allowed, _)| !is_allowed).map_or(Ok(()), |(key, _, allowed)| refuse(key, allowed))
}

/// The error about a key whose value is out of range.
fn refuse(key: &str, allowed: &str) -> InputResult<()> {
    Err(InputError::new(format!("--{key}"), "the value is out of range", format!("use {allowed}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        let bad = TrainConfig { sh_degree: 4, ..TrainConfig::default() };
        assert!(bad.check().is_err_and(|e| e.to_string().contains("--sh-degree")));
        // As a 32-bit number this is half.
        let bad = TrainConfig { prune_opa: 0.499_999_999, ..TrainConfig::default() };
        assert!(bad.check().is_err_and(|e| e.to_string().contains("--prune-opa")));
        // As 32-bit numbers these are 1 and 0.
        for init_opacity in [0.999_999_98, 1e-60] {
            let bad = TrainConfig { init_opacity, ..TrainConfig::default() };
            assert!(bad.check().is_err_and(|e| e.to_string().contains("--init-opacity")));
        }
        let bad = TrainConfig { max_alpha: 0.999_999_98, ..TrainConfig::default() };
        assert!(bad.check().is_err_and(|e| e.to_string().contains("--max-alpha")));
        assert!(TrainConfig::default().check().is_ok());
    }

    #[test]
    fn relocation_needs_a_cap_and_the_host() {
        let uncapped = TrainConfig { strategy: StrategyName::Mcmc, ..TrainConfig::default() };
        let refusal = uncapped.check().err().map(|e| e.to_string()).unwrap_or_default();
        assert!(refusal.contains("--strategy mcmc") && refusal.contains("give --max-gaussians"), "{refusal}");
        let capped = TrainConfig { max_gaussians: 1000, ..uncapped };
        assert!(capped.check().is_ok());
        let on_device = TrainConfig { optimizer_on: Chosen(Some(OptimizerPlace::Device)), ..capped };
        let refusal = on_device.check().err().map(|e| e.to_string()).unwrap_or_default();
        assert!(refusal.contains("leave out --strategy mcmc, or --optimizer-on host"), "{refusal}");
    }
}
