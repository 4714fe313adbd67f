// Stage "gate": whether a step that was recorded without waiting may change rows. A step may not if an earlier step may not, if
// its lists were longer than their buffers, if its loss is not finite, or if too many of its rows have unusable gradients. A
// gate that a step has closed stays closed for all steps behind it, until the host opens it. The twin of src/kernels/gate.rs.

struct GateUniforms {
    /// What the buffers of the step hold: listed rows, intersections, entries of one tile's list.
    rows_room: u32,
    isects_room: u32,
    list_room: u32,
    /// The gate closes if more than one in this many rows has unusable gradients.
    rows_per_unusable: u32,
    /// Word of `counts` with the number of listed rows, word of `offsets` with the number of intersections.
    rows_at: u32,
    isects_at: u32,
    /// 1: the loss has sums.
    has_loss: u32,
    pad: u32,
}

/// What the host reads of a step.
struct StepVerdict {
    /// Bits of REASONS; 0 for a step that was taken.
    closed: u32,
    rows: u32,
    isects: u32,
    list_max: u32,
    /// Rows with unusable gradients.
    unusable: u32,
    /// The sums of the loss, bits of floats.
    sums: array<u32, 4>,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

@group(0) @binding(0) var<uniform> u: GateUniforms;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> offsets: array<u32>;
@group(0) @binding(3) var<storage, read> longest: array<u32>;
@group(0) @binding(4) var<storage, read> unusable: array<u32>;
@group(0) @binding(5) var<storage, read> sums: array<u32>;
/// One word: 0 while the gate is open.
@group(0) @binding(6) var<storage, read_write> gate: array<u32>;
@group(0) @binding(7) var<storage, read_write> verdict: array<StepVerdict>;

/// Why a gate is closed.
const BY_EARLIER: u32 = 1u;
const ROWS: u32 = 2u;
const ISECTS: u32 = 4u;
const LIST: u32 = 8u;
const LOSS: u32 = 16u;
const GRADIENTS: u32 = 32u;

/// Bits of a float that is infinite or not a number.
fn is_no_number(bits: u32) -> bool {
    return (bits & 0x7f800000u) == 0x7f800000u;
}

/// One workgroup; its first invocation decides.
@compute @workgroup_size(256)
fn decide(@builtin(local_invocation_index) lane: u32) {
    if lane != 0u {
        return;
    }
    var v: StepVerdict;
    v.rows = counts[u.rows_at];
    v.isects = offsets[u.isects_at];
    v.list_max = longest[0];
    v.unusable = unusable[0];
    var closed = select(0u, BY_EARLIER, gate[0] != 0u);
    closed |= select(0u, ROWS, v.rows > u.rows_room);
    closed |= select(0u, ISECTS, v.isects > u.isects_room);
    closed |= select(0u, LIST, v.list_max > u.list_room);
    closed |= select(0u, GRADIENTS, v.unusable > v.rows / max(u.rows_per_unusable, 1u));
    if u.has_loss != 0u {
        for (var i = 0u; i < 4u; i++) {
            v.sums[i] = sums[i];
        }
        // The sum of squared differences, the second, is reported and not trained on.
        closed |= select(0u, LOSS, is_no_number(v.sums[0]) || is_no_number(v.sums[2]));
    }
    v.closed = closed;
    gate[0] = closed;
    verdict[0] = v;
}
