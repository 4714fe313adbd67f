//! Run states of earlier program versions: what they lack. A value that is missing is read as that of a run without it.
//!
//! Version 8 has a place in the layout for each kind of values of photos, and checks of growth look at held-out views only. Version 7 lacks first exposures, poses and the trials of
//! growth. Version 6 also lacks blocks of photos, version 5 outliers and checks of growth, version 4 appearance. Versions 1 to 3 are
//! not read: no program that others use wrote them.
//!
//! Invariants: 1. up to version 8, missing values stand at the end of the layout, so an older state with [`missing_values`] behind it
//! has the layout of version 8, but for the checks of growth ([`OlderGrowth`]); 2. nothing here writes a state.

use crate::appearance::state::AppearanceState;
use crate::densify::growth::{GrowthCheck, GrowthState};
use crate::outliers::blocks::BlockOutliers;
use crate::outliers::views::ViewState;
use crate::page::format::encoding::{self, EncodingError};
use crate::photos::saved::{Encoded, SavedValues};
use crate::poses::state::PoseState;
use serde::Deserialize;

/// The oldest version that is read, and the newest one that lacks something.
pub(super) const OLDEST: u32 = 4;
pub(super) const NEWEST: u32 = 7;

/// The end of the layout up to version 8, with checks of growth as `G`.
#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
pub(super) struct OlderEnd<G> {
    pub appearance: AppearanceState,
    pub outliers: Vec<ViewState>,
    pub growth: G,
    pub blocks: BlockOutliers,
    pub first_exposures: u32,
    pub poses: PoseState,
}

impl<G: Into<GrowthState>> OlderEnd<G> {
    /// The end of today's layout: values of photos under the names of their kinds.
    pub(super) fn today(self) -> Result<(GrowthState, SavedValues), EncodingError> {
        let values = [
            ("appearance", Encoded::of(&(self.appearance, self.first_exposures))?),
            ("outliers", Encoded::of(&self.outliers)?),
            ("blocks", Encoded::of(&self.blocks)?),
            ("poses", Encoded::of(&self.poses)?),
        ];
        Ok((self.growth.into(), values.map(|(name, values)| (name.to_string(), values)).into()))
    }
}

/// Checks of growth before trials.
#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
pub(super) struct OlderGrowth {
    first: u64,
    checks: Vec<OlderCheck>,
}

/// Checks of growth up to version 8.
#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
pub(super) struct GrowthOf8 {
    first: u64,
    checks: Vec<CheckOf8>,
}

#[derive(Deserialize)]
#[cfg_attr(test, derive(serde::Serialize))]
struct CheckOf8 {
    step: u32,
    gaussians: u64,
    psnr: f64,
    lost: f64,
    pays_from: f64,
    is_trial: bool,
    allowed: u64,
}

/// Only a first check looks at trained views, so it does not matter later that they seem no better.
impl From<GrowthOf8> for GrowthState {
    fn from(older: GrowthOf8) -> GrowthState {
        let with_trained = |CheckOf8 { step, gaussians, psnr, lost, pays_from, is_trial, allowed }| GrowthCheck {
            step,
            gaussians,
            psnr,
            trained_psnr: psnr,
            lost,
            pays_from,
            is_trial,
            allowed,
        };
        GrowthState { first: older.first, checks: older.checks.into_iter().map(with_trained).collect() }
    }
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
            trained_psnr: 0.0,
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
    let (outliers, growth, blocks) = (Vec::<ViewState>::new(), GrowthState::default(), BlockOutliers::default());
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
    use crate::checkpoint::run_state::RunState;
    use crate::checkpoint::run_state::tests::{end_of_8, sample};
    use serde::Serialize;

    fn growth_of_8(state: &GrowthState) -> GrowthOf8 {
        let of_8 = |check: &GrowthCheck| {
            let &GrowthCheck { step, gaussians, psnr, lost, pays_from, is_trial, allowed, .. } = check;
            CheckOf8 { step, gaussians, psnr, lost, pays_from, is_trial, allowed }
        };
        GrowthOf8 { first: state.first, checks: state.checks.iter().map(of_8).collect() }
    }

    fn older_growth(state: &GrowthState) -> OlderGrowth {
        let older = |check: &GrowthCheck| {
            let &GrowthCheck { step, gaussians, lost, pays_from, allowed, .. } = check;
            OlderCheck { step, gaussians, lost, pays_from, allowed }
        };
        OlderGrowth { first: state.first, checks: state.checks.iter().map(older).collect() }
    }

    /// The sample as a program of `version` would have written it: today's bytes with another end.
    fn older_bytes<G: Serialize>(end: &OlderEnd<G>, version: u32) -> Vec<u8> {
        let state = sample();
        let [today, older] =
            [encoding::to_bytes(&(&state.trainer.growth, &state.photos)), encoding::to_bytes(end)].map(Result::unwrap);
        let bytes = state.to_bytes().unwrap();
        let before = bytes[4..].strip_suffix(&today[..]).unwrap();
        let mut bytes = [&version.to_le_bytes(), before, &older].concat();
        if version <= NEWEST {
            let lacking = missing_values(version).unwrap().unwrap();
            assert!(bytes.ends_with(&lacking));
            bytes.truncate(bytes.len() - lacking.len());
        }
        bytes
    }

    #[test]
    fn states_of_earlier_versions_come_back_without_later_values() {
        let read = |bytes: &[u8]| RunState::from_bytes(bytes).unwrap();
        let OlderEnd { appearance, outliers, growth, blocks, first_exposures, poses } = end_of_8();
        let of_8 = OlderEnd { appearance, outliers, growth: growth_of_8(&growth), blocks, first_exposures, poses };
        assert_eq!(read(&older_bytes(&of_8, 8)), sample());
        for version in OLDEST..=NEWEST {
            let OlderEnd { appearance, outliers, growth, blocks, .. } = end_of_8();
            let has = |since: u32| version >= since;
            let end = OlderEnd {
                appearance: if has(5) { appearance } else { AppearanceState::default() },
                outliers: if has(6) { outliers } else { Vec::new() },
                growth: older_growth(&if has(6) { growth } else { GrowthState::default() }),
                blocks: if has(7) { blocks } else { BlockOutliers::default() },
                first_exposures: 0,
                poses: PoseState::default(),
            };
            let bytes = older_bytes(&end, version);
            let mut state = sample();
            (state.trainer.growth, state.photos) = end.today().unwrap();
            assert_eq!(read(&bytes), state);
        }
    }
}
