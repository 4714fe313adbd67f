//! Stage "gate": the twin of `shaders/gate.wgsl`.

use gsscale::kernels::gate::{BY_EARLIER, GRADIENTS, GateUniforms, ISECTS, LIST, LOSS, ROWS, StepVerdict};

/// Decides about a step whose numbers are those of `measured` (its `closed` is not read), behind a gate of the bits `gate`.
pub fn decide(u: &GateUniforms, gate: u32, measured: &StepVerdict) -> StepVerdict {
    let is_no_number = |bits: u32| !f32::from_bits(bits).is_finite();
    let reasons = [
        (BY_EARLIER, gate != 0),
        (ROWS, measured.rows > u.rows_room),
        (ISECTS, measured.isects > u.isects_room),
        (LIST, measured.list_max > u.list_room),
        (GRADIENTS, measured.unusable > measured.rows / u.rows_per_unusable.max(1)),
        // The sum of squared differences, the second, is reported and not trained on.
        (LOSS, u.has_loss != 0 && (is_no_number(measured.sums[0]) || is_no_number(measured.sums[2]))),
    ];
    let closed = reasons.iter().filter(|(_, holds)| *holds).fold(0, |bits, (reason, _)| bits | reason);
    let sums = if u.has_loss != 0 { measured.sums } else { [0; 4] };
    StepVerdict { closed, sums, ..*measured }
}
