//! The three ways of handling optimizer steps without a gradient, and where the optimizer runs.

use crate::base::names::names;

/// How a step treats rows without a gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// They take the step when they are next read: dense Adam's values at the cost of the seen rows only.
    #[default]
    Deferred,
    /// They take it at once: every row is rewritten at every step. Slow; the reference for the deferred form.
    Dense,
    /// They never take it: values and moments stay as their last gradient left them. This is not Adam; trainers with
    /// "sparse" or "selective" optimizers do it.
    Sparse,
}

/// Where rows are gathered and updated. Another place gives another rounding, so it belongs to the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OptimizerPlace {
    /// In host memory, whatever device renders.
    #[default]
    Host,
    /// On the device that renders, in pages that stay there as long as there is room.
    Device,
}

names!(OptimizerPlace { Host = "host", Device = "device" });
