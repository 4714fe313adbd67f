// A division whose result is that of the CPU, to the bit: devices may divide with an error of 2.5 units in the last
// place, and the histogram counts rows of both. The twin of `mean_grad2d` in src/scene/rows.rs and of src/scene/sightings.rs.

/// Low bits of a word of sightings: the number of views (src/scene/sightings.rs). The rest is the sum of weights, without its low bits.
const VIEWS_BITS: u32 = 12u;
const VIEWS_MOST: u32 = 4095u;
const DROPPED_BITS: u32 = 11u;
/// A row is judged by its weight from this many views on, as in src/densify/stats.rs.
const WEIGHED_VIEWS: u32 = 3u;

/// `sum / count`, rounded to nearest, for a sum of 0 or between 1e-30 and the largest number, and a count from 1 to 4095.
fn quotient(sum: f32, count: u32) -> f32 {
    if !(sum > 0.0) || count < 2u {
        return sum;
    }
    let s = bitcast<u32>(sum);
    let c = bitcast<i32>(count);
    var q = bitcast<u32>(sum / f32(count));
    // The remainder in units of the quotient's last place is small and exact, also modulo 2^32. No tie can occur: the
    // product of a midpoint and the divisor has more digits than the sum.
    for (var i = 0u; i < 8u; i++) {
        let shift = ((s >> 23u) - (q >> 23u)) & 31u;
        let scaled = ((s & 0x7fffffu) | 0x800000u) << shift;
        let rest = bitcast<i32>(scaled - count * ((q & 0x7fffffu) | 0x800000u));
        let is_power_of_two = (q & 0x7fffffu) == 0u;
        if 2 * rest > c {
            q += 1u;
        } else if 2 * rest < -c || (is_power_of_two && 4 * rest < -c) {
            q -= 1u;
        } else {
            break;
        }
    }
    return bitcast<f32>(q);
}

/// Sum of the weights in a word of sightings.
fn weight_sum(word: u32) -> f32 {
    return bitcast<f32>((word >> VIEWS_BITS) << DROPPED_BITS);
}

/// Whether a row is judged by its weight.
fn is_weighed(word: u32) -> bool {
    return (word & VIEWS_MOST) >= WEIGHED_VIEWS && (word >> VIEWS_BITS) != 0u;
}

/// Mean weight of a view, of a row that is weighed.
fn mean_weight(word: u32) -> f32 {
    return quotient(weight_sum(word), word & VIEWS_MOST);
}
