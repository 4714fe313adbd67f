//! Injected faults of recorded steps, to test that a step that is not taken leaves no trace. `GSSCALE_STEP_FAULT` names steps whose lists
//! have no room, or whose gate closes as for a loss that is not finite. `GSSCALE_STEPS_IN_FLIGHT` limits the steps in flight.
//!
//! Not here: faults of devices (`gpu::injected`).
//!
//! Invariant: no fault and no number of steps changes a bit of the result.

/// Environment variable of the faults: `rows@12,isects@13,closed@20`, 0-based steps.
const FAULTS: &str = "GSSCALE_STEP_FAULT";
/// Environment variable of the steps in flight: 0 for steps that wait for each of their numbers, 1, or 2.
const IN_FLIGHT: &str = "GSSCALE_STEPS_IN_FLIGHT";

/// A fault of a recorded step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StepFault {
    /// Its list of rows has room for one row.
    Rows,
    /// Its lists of tiles have room for one intersection.
    Isects,
    /// Its gate closes whatever its numbers are.
    Closed,
}

/// Faults of the steps of a run.
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

    /// The faults that the environment requests.
    pub fn from_environment() -> StepFaults {
        std::env::var(FAULTS).map_or(StepFaults::default(), |text| StepFaults::parse(&text))
    }

    /// Whether a fault is injected at a step.
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
