//! Run states of earlier program versions: what they lack. A value that is missing is read as that of a run without it.
//!
//! Version 7 lacks first exposures, poses and the trials of growth. Version 6 also lacks blocks of photos, version 5 outliers and checks of
//! growth, version 4 appearance. Versions 1 to 3 are not read: no program that others use wrote them.
//!
//! Invariants: 1. missing values stand at the end of the layout, so an older state with [`missing_values`] behind it has the layout of
//! today, but for the checks of growth ([`OlderGrowth`]); 2. nothing here writes a state.

use crate::appearance::state::AppearanceState;
use crate::densify::growth::{GrowthCheck, GrowthState};
use crate::outliers::blocks::BlockOutliers;
use crate::outliers::views::ViewOutliers;
use crate::page::format::encoding::{self, EncodingError};
use crate::poses::state::PoseState;
use serde::Deserialize;

/// The oldest version that is read, and the newest one that lacks something.
pub(super) const OLDEST: u32 = 4;
pub(super) const NEWEST: u32 = 7;

/// Checks of growth before trials.
#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
pub(super) struct OlderGrowth {
    first: u64,
    checks: Vec<OlderCheck>,
}

#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
struct OlderCheck {
    step: u32,
    gaussians: u64,
    lost: f64,
    pays_from: f64,
    allowed: u64,
}

/// A run that has begun to decide without trials goes on without trials.
impl From<OlderGrowth> for GrowthState {
    fn from(older: OlderGrowth) -> GrowthState {
        let with_trial_fields = |OlderCheck { step, gaussians, lost, pays_from, allowed }| GrowthCheck {
            step,
            gaussians,
            psnr: 0.0,
            lost,
            pays_from,
            is_trial: false,
            allowed,
        };
        GrowthState { first: older.first, checks: older.checks.into_iter().map(with_trial_fields).collect() }
    }
}

/// The encoded values that a state of this version lacks, in the order of the layout; `None` for a version that is not read.
pub(super) fn missing_values(version: u32) -> Result<Option<Vec<u8>>, EncodingError> {
    let (outliers, growth, blocks) = (ViewOutliers::default(), GrowthState::default(), BlockOutliers::default());
    let before = match version {
        OLDEST => encoding::to_bytes(&(AppearanceState::default(), outliers, growth, blocks))?,
        5 => encoding::to_bytes(&(outliers, growth, blocks))?,
        6 => encoding::to_bytes(&blocks)?,
        NEWEST => Vec::new(),
        _ => return Ok(None),
    };
    Ok(Some([before, encoding::to_bytes(&(0u32, PoseState::default()))?].concat()))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::checkpoint::run_state::tests::sample;
    use crate::checkpoint::run_state::{RunState, TrainerState};

    fn older_growth(state: &GrowthState) -> OlderGrowth {
        let older = |check: &GrowthCheck| {
            let &GrowthCheck { step, gaussians, lost, pays_from, allowed, .. } = check;
            OlderCheck { step, gaussians, lost, pays_from, allowed }
        };
        OlderGrowth { first: state.first, checks: state.checks.iter().map(older).collect() }
    }

    /// The bytes that a program of `version` would have written: those of today without what it lacked.
    fn older_bytes(state: &RunState, version: u32) -> Vec<u8> {
        let growth = &state.trainer.growth;
        let [today, older] =
            [encoding::to_bytes(growth), encoding::to_bytes(&older_growth(growth))].map(Result::unwrap);
        let bytes = state.to_bytes().unwrap();
        let at = bytes.windows(today.len()).rposition(|part| part == today).unwrap();
        let mut bytes = [&version.to_le_bytes(), &bytes[4..at], &older, &bytes[at + today.len()..]].concat();
        let lacking = missing_values(version).unwrap().unwrap();
        assert!(bytes.ends_with(&lacking));
        bytes.truncate(bytes.len() - lacking.len());
        bytes
    }

    #[test]
    fn states_of_earlier_versions_come_back_without_later_values() {
        let state = sample();
        let (outliers, blocks) = (ViewOutliers::default(), BlockOutliers::default());
        let mut of_7 = TrainerState { first_exposures: 0, poses: PoseState::default(), ..state.trainer.clone() };
        of_7.growth.checks.iter_mut().for_each(|check| check.psnr = 0.0);
        let of_6 = TrainerState { blocks, ..of_7.clone() };
        let of_5 = TrainerState { outliers, growth: GrowthState::default(), ..of_6.clone() };
        let of_4 = TrainerState { appearance: AppearanceState::default(), ..of_5.clone() };
        for (version, trainer) in (OLDEST..=NEWEST).zip([of_4, of_5, of_6, of_7]) {
            let without = RunState { trainer, ..state.clone() };
            assert_eq!(RunState::from_bytes(&older_bytes(&without, version)), Ok(without));
        }
    }
}
