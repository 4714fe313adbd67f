// Deferred Adam of single values: the twin of src/kernels/deferred.rs, which documents the tables.

/// Sums of a gap at unit base rate.
struct SeriesSums {
    first: f32,
    second: f32,
    third: f32,
}

/// Words of the tables before their entries.
const HEADER_WORDS: u32 = 16u;
/// Places, in the header, of what the tables hold: first words and lengths, then numbers.
const LIMITS: u32 = 0u;
const LIMITS_LENGTH: u32 = 1u;
const BIAS: u32 = 2u;
const BIAS_LENGTH: u32 = 3u;
const RATE_FACTORS: u32 = 4u;
const RATE_FACTORS_LENGTH: u32 = 5u;
const DECAY_POWERS: u32 = 6u;
const DIRECT_TERMS: u32 = 7u;
const DECAYS: u32 = 8u;
const DECAYS_LENGTH: u32 = 9u;
const EPS: u32 = 10u;
const FLOOR: u32 = 11u;
const ONE_MINUS_BETA1: u32 = 12u;
const ONE_MINUS_BETA2: u32 = 13u;
const LOG_SCALE_LOW: u32 = 14u;
const LOG_SCALE_HIGH: u32 = 15u;

/// Words of an entry of sums: three for the means, one unused, three for the other columns, one unused.
const SUMS_WORDS: u32 = 8u;
/// Steps of a movement without end.
const FOR_EVER: u32 = 0xffffffffu;
/// 2^-126, the smallest normal number.
const SMALLEST: f32 = 1.17549435e-38;

fn flush(x: f32) -> f32 {
    return select(x, 0.0, abs(x) < SMALLEST);
}

/// The value after a gap, by the series.
fn drifted(value: f32, m: f32, v: f32, sums: SeriesSums, rate: f32, eps: f32) -> f32 {
    let inv = 1.0 / sqrt(v);
    let e = eps * inv;
    let moved = flush(value - (m * inv) * (sums.first - e * (sums.second - e * sums.third)) * rate);
    // Without a first moment nothing moves.
    return select(moved, value, m == 0.0);
}
