//! When pages move, and for whom. Neither changes a bit of what a step gets.

/// When pages move. No choice changes what a step gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transfers {
    /// Ahead of their step, while steps compute.
    #[default]
    Overlap,
    /// Ahead of their step, but every call waits until its pages have moved: the plan without the overlap, for comparison.
    Ahead,
    /// When a step needs them: neither plan nor overlap, for comparison.
    Demand,
}

/// Who asks for pages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Asker {
    /// A training step that can still be done again: a failed write ends the call.
    Step,
    /// A training step that has changed rows already: uses and waits count as the step's. A failed write is left to the next step,
    /// since this step must not be done twice.
    RestOfStep,
    /// Evaluation, export or checks.
    Other,
}

impl Asker {
    /// Whether uses, reads and waits count as a step's.
    pub fn is_step(self) -> bool {
        self != Asker::Other
    }

    /// Whether a failed write ends the call.
    pub fn fails_on_write_error(self) -> bool {
        self == Asker::Step
    }
}
