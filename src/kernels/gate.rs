//! Stage "gate": whether a step that was recorded without waiting may change rows. `shaders/gate.wgsl` decides; the numbers that
//! it reads and writes are here.
//!
//! A device works on a step behind the gate while the host records the next one. A step may change rows only if all earlier steps
//! did, its lists had room, its loss is finite, and few of its rows have unusable gradients.
//!
//! Invariants: 1. a gate that is closed stays closed until the host opens it; 2. the host would take each step that passes
//! the gate, had it waited for all numbers of the step.

crate::wgsl_struct! {
    pub struct GateUniforms {
        pub rows_room: u32,
        pub isects_room: u32,
        pub list_room: u32,
        pub rows_per_unusable: u32,
        pub rows_at: u32,
        pub isects_at: u32,
        pub has_loss: u32,
        pub pad: u32,
    }

    /// What the host reads of a step: `StepVerdict` in `shaders/gate.wgsl`.
    pub struct StepVerdict {
        /// Bits of the reasons for which the gate is closed; 0 for a step that was taken.
        pub closed: u32,
        /// Listed rows.
        pub rows: u32,
        /// Intersections, saturated.
        pub isects: u32,
        /// Longest list of a tile.
        pub list_max: u32,
        /// Rows with unusable gradients.
        pub unusable: u32,
        /// The sums of the loss, bits of floats.
        pub sums: [u32; 4],
        pub pad0: u32,
        pub pad1: u32,
        pub pad2: u32,
    }
}

/// An earlier step closed the gate.
pub const BY_EARLIER: u32 = 1;
/// More rows are listed than there is room for.
pub const ROWS: u32 = 2;
/// There are more intersections than there is room for.
pub const ISECTS: u32 = 4;
/// A tile's list is longer than the recorded blending.
pub const LIST: u32 = 8;
/// The loss is not finite.
pub const LOSS: u32 = 16;
/// Too many rows have unusable gradients.
pub const GRADIENTS: u32 = 32;
