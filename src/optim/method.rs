//! When Gaussians take the optimizer steps in which they have no gradient.

/// What a step does to rows without a gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// They take the step when somebody looks: dense Adam's values at the cost of the rows that are seen.
    #[default]
    Deferred,
    /// They take it at once: every row is rewritten at every step. Slow; what the deferred form is compared with.
    Dense,
    /// They never take it: values and moments stay as their last gradient left them. Not Adam; what trainers with
    /// "sparse" or "selective" optimizers do.
    Sparse,
}
