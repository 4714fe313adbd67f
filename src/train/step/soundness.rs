//! Checks that training has an effect: warns of skipped rows and steps, and stops a run that has diverged or whose photos
//! are all masked. The error names the cause. Also injected faults of recorded steps, for tests: `GSSCALE_STEP_FAULT` names steps whose
//! lists have no room, or whose gate closes as for a loss that is not finite; `GSSCALE_STEPS_IN_FLIGHT` limits the steps in flight.
//!
//! Invariants: 1. nothing here changes a number of the result: a run is stopped or goes on, and no fault and no number of steps in flight
//! changes a bit; 2. a run that stops here keeps its last commit and writes the last step that it took, which
//! is the unsound one unless that was skipped.

use super::train_step::{Skipped, StepOutcome};
use crate::base::error::{InputError, InputResult};
use crate::checkpoint::run_state::{IdleSteps, TrainerState};
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::train::error::TrainError;
use std::collections::BTreeSet;

/// Photos that a warning names.
const NAMED: usize = 8;
/// Consecutive unsound steps that end a run.
const UNSOUND_STEPS_MAX: u32 = 3;

/// A run in which no training view sees a Gaussian, before its first step or later.
pub(crate) fn no_view_sees(dataset: &Dataset, gaussians: u64) -> InputError {
    let views = dataset.train_views().len();
    if gaussians == 0 {
        return no_gaussian_left(dataset);
    }
    let problem = format!("none of the {views} training views sees any of the {gaussians} Gaussians");
    let remedy = "check that poses and points come from the same reconstruction, and the convention of the poses";
    InputError::new(&dataset.image_folder, problem, remedy)
}

fn no_gaussian_left(dataset: &Dataset) -> InputError {
    let problem = "no Gaussian is left: resets and pruning have removed all of them";
    let remedy = "leave out flags of rates and of pruning (--prune-opa, --prune-scale3d, --reset-every); without any, check the poses";
    InputError::new(&dataset.image_folder, problem, remedy)
}

/// Counts the skipped rows and steps of a step in `state`, and warns of the first. `init_ply` is the file from which the
/// run started, or empty.
///
/// # Errors This step is the last of [`UNSOUND_STEPS_MAX`] unsound steps in a row.
pub(crate) fn note_soundness(
    state: &mut TrainerState,
    outcome: &StepOutcome,
    view: &str,
    init_ply: &str,
) -> Result<(), TrainError> {
    let step = state.step;
    if outcome.rows_skipped > 0 && state.rows_skipped == 0 {
        crate::tell!(
            "warning: at step {step}, view {view}, {} Gaussians keep their values because their gradients are not \
             finite or above 1e18; later ones are counted in summary.json",
            outcome.rows_skipped
        );
    }
    if outcome.skipped.is_some() && state.steps_skipped == 0 {
        let problem = problem_of(outcome);
        crate::tell!(
            "warning: step {step} is skipped: {problem} (view {view}); later ones are counted in summary.json"
        );
    }
    state.rows_skipped += outcome.rows_skipped;
    state.steps_skipped += u32::from(outcome.skipped.is_some());
    if !outcome.is_unsound() {
        state.steps_skipped_in_a_row = 0;
        return Ok(());
    }
    state.steps_skipped_in_a_row += 1;
    if state.steps_skipped_in_a_row < UNSOUND_STEPS_MAX {
        return Ok(());
    }
    let remedy = match init_ply {
        "" => "leave out flags of rates (see config.toml); without any, report this as a bug and attach the scene"
            .to_string(),
        ply => format!(
            "check {ply}, from which the run started: colours (f_dc, f_rest), positions and scales of a sound file are \
             below 1e6; if it is sound, leave out flags of rates"
        ),
    };
    let (problem, count) = (problem_of(outcome), state.steps_skipped_in_a_row);
    Err(TrainError::NonFinite { problem, step, view: view.to_string(), count, remedy })
}

/// Counts in `state` the steps in a row that changed no row.
/// `init_ply` is the file from which the run started, or empty.
/// Errors: no Gaussian is left; or no step changed a row for so long that every view had its turn, because every photo is
/// masked completely, no view sees a Gaussian, or no Gaussian is opaque enough to be drawn.
pub(crate) fn note_idle(
    state: &mut TrainerState,
    outcome: &StepOutcome,
    gaussians: u64,
    dataset: &Dataset,
    init_ply: &str,
) -> Result<(), TrainError> {
    let place = format!("step {}", state.step);
    if gaussians == 0 {
        return Err(no_gaussian_left(dataset).at(place).into());
    }
    let idle = &mut state.idle;
    if outcome.updated > 0 {
        *idle = IdleSteps::default();
    }
    if outcome.updated > 0 || outcome.skipped.is_some() {
        return Ok(());
    }
    idle.steps = idle.steps.saturating_add(1);
    idle.masked += u32::from(outcome.is_masked);
    idle.with_rows += u32::from(outcome.rows > 0);
    idle.with_drawn += u32::from(outcome.drawn > 0);
    let views = dataset.train_views().len();
    // Among so many steps in a row is a whole epoch.
    let most = 2 * views as u64;
    if u64::from(idle.steps) < most {
        return Ok(());
    }
    if idle.masked == idle.steps {
        return Err(all_masked(dataset).at(place).into());
    }
    // Whether an earlier step has changed rows: then the poses are not to blame.
    let has_trained = idle.steps <= state.step;
    if idle.with_rows == 0 {
        let unseen = no_view_sees(dataset, gaussians).at(place);
        let moved = "training has moved them out of all pictures: leave out flags of rates";
        return Err(if has_trained { InputError { remedy: moved.to_string(), ..unseen } } else { unseen }.into());
    }
    if idle.with_drawn == 0 {
        let problem = format!("none of the {views} training views draws a Gaussian: all are too transparent or small");
        let remedy = match init_ply {
            "" => "leave out flags of rates, of opacity (--init-opacity) and of resets (--reset-every); without any, check the poses"
                .to_string(),
            ply => format!("check opacities and scales in {ply}, from which the run started; if they are sound, leave out flags of rates"),
        };
        return Err(InputError::new(&dataset.image_folder, problem, remedy).at(place).into());
    }
    if u64::from(idle.steps) == most {
        let why = match outcome.loss.loss == 0.0 {
            true => "no photo differs from its picture",
            false => {
                "no photo has a gradient: Gaussians may be black, opaque or hidden, and flags of rates may be the cause"
            }
        };
        crate::tell!("warning: up to {place}, no Gaussian was changed in an epoch: {why}");
    }
    Ok(())
}

/// The training photos of which no pixel counts, as the steps of a process meet them.
#[derive(Default)]
pub(crate) struct MaskedPhotos {
    steps: usize,
    views: BTreeSet<usize>,
    is_undecided_told: bool,
}

impl MaskedPhotos {
    /// Warns once that nothing can be measured by which a run would decide its count.
    pub fn tell_undecided(&mut self) {
        if !std::mem::replace(&mut self.is_undecided_told, true) {
            crate::tell!(
                "warning: masks exclude every pixel of the training photos that the run holds out, or of those that it compares with them, so \
                 the number of Gaussians cannot be decided and stays near its start; --max-gaussians sets another"
            );
        }
    }

    /// Notes the photo of a step, and warns once of all masked ones: after an epoch, or after the last step. The `held_out` training views
    /// have no step then.
    pub fn note(
        &mut self,
        outcome: &StepOutcome,
        view: usize,
        is_last: bool,
        (dataset, targets): (&Dataset, &TargetCache),
        held_out: impl Iterator<Item = usize>,
    ) {
        let photos = dataset.train_views().len();
        if self.steps >= photos {
            return;
        }
        self.steps = if is_last { photos } else { self.steps + 1 };
        if outcome.is_masked {
            self.views.insert(view);
        }
        if self.steps < photos {
            return;
        }
        // A photo that cannot be read is an error of its step.
        self.views.extend(held_out.filter(|&view| targets.get(view).is_ok_and(|target| !target.counts())));
        if self.views.is_empty() {
            return;
        }
        let names: Vec<&str> = self.views.iter().take(NAMED).map(|&view| dataset.views[view].name.as_str()).collect();
        let (masked, more) = (self.views.len(), if self.views.len() > NAMED { " and others" } else { "" });
        crate::tell!(
            "warning: the masks of {masked} of {photos} training photos exclude every pixel, so these photos train nothing: {}{more}; white \
             means keep (see --invert-masks)",
            names.join(", ")
        );
    }
}

/// Refuses a run whose training photos are all masked, before it spends its time. Decodes photos up to the first that counts.
/// Errors: no training photo has a pixel that counts.
pub fn refuse_all_masked(dataset: &Dataset, targets: &TargetCache) -> InputResult<()> {
    let views = dataset.train_views();
    // A photo that cannot be read is an error of its step.
    if views.is_empty() || views.iter().any(|&view| targets.get(view).map_or(true, |target| target.counts())) {
        return Ok(());
    }
    Err(all_masked(dataset))
}

fn all_masked(dataset: &Dataset) -> InputError {
    let views = dataset.train_views().len();
    let problem = format!("the masks of all {views} training views exclude every pixel: nothing is trained");
    let remedy = "white in masks/ and opaque in photos means keep: see --invert-masks, or use --masks=false";
    InputError::new(&dataset.image_folder, problem, remedy)
}

/// What is wrong with an unsound step.
fn problem_of(outcome: &StepOutcome) -> String {
    let of_rows =
        |rows: u64| format!("gradients of {rows} of {} Gaussians are not finite or far too large", outcome.rows);
    match outcome.skipped {
        Some(Skipped::Loss) => "the loss is not finite".to_string(),
        Some(Skipped::Gradients(rows)) => of_rows(rows),
        None => of_rows(outcome.rows_skipped),
    }
}

/// Environment variable of the faults: `rows@12,isects@13,closed@20`, 0-based steps.
const FAULTS: &str = "GSSCALE_STEP_FAULT";
/// Environment variable of the steps in flight: 0 for steps that wait for each of their numbers, 1, or 2.
const IN_FLIGHT: &str = "GSSCALE_STEPS_IN_FLIGHT";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StepFault {
    /// Its columns have room for one row.
    Rows,
    /// Its lists of tiles have room for one intersection.
    Isects,
    /// Its gate closes whatever its numbers are.
    Closed,
}

#[derive(Debug, Clone, Default)]
pub(super) struct StepFaults(Vec<(StepFault, u32)>);

impl StepFaults {
    /// Parses text such as `rows@12,closed@13`; ignores anything else.
    fn parse(text: &str) -> StepFaults {
        let fault = |part: &str| {
            let (kind, step) = part.trim().split_once('@')?;
            let kind = match kind {
                "rows" => StepFault::Rows,
                "isects" => StepFault::Isects,
                "closed" => StepFault::Closed,
                _ => return None,
            };
            Some((kind, step.parse().ok()?))
        };
        StepFaults(text.split(',').filter_map(fault).collect())
    }

    pub fn from_environment() -> StepFaults {
        std::env::var(FAULTS).map_or(StepFaults::default(), |text| StepFaults::parse(&text))
    }

    pub fn is_injected_at(&self, fault: StepFault, step: u32) -> bool {
        self.0.contains(&(fault, step))
    }
}

/// The most steps in flight, `most` unless the environment asks for fewer.
pub(super) fn steps_in_flight(most: usize) -> usize {
    let asked = std::env::var(IN_FLIGHT).ok().and_then(|text| text.trim().parse().ok());
    asked.unwrap_or(most).min(most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_strike_the_steps_they_name() {
        let faults = StepFaults::parse("rows@12, closed@13,fire@1,isects@,closed");
        assert!(faults.is_injected_at(StepFault::Rows, 12) && faults.is_injected_at(StepFault::Closed, 13));
        assert!(!faults.is_injected_at(StepFault::Rows, 13) && !faults.is_injected_at(StepFault::Isects, 12));
        assert_eq!(faults.0.len(), 2);
        assert!(StepFaults::parse("").0.is_empty());
    }
}
