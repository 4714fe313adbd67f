//! Vectors that grow with an eighth to spare, but at most 262,144 values, instead of doubling as `Vec` does, because
//! a run's memory is bounded and these are its largest parts.

/// Most spare values of a vector. The allocator moves vectors of this length by remapping their memory, so that growing
/// often costs little.
const SPARE_MOST: usize = 1 << 18;

/// As [`Vec::resize`]; keeps the allocation while it is large enough.
pub fn resize<T: Copy>(values: &mut Vec<T>, len: usize, value: T) {
    reserve(values, len);
    values.resize(len, value);
}

/// `len` times `value`; keeps the allocation while it is large enough. The old values are lost, so that a larger allocation
/// does not exist beside the old one while values are copied, as it would for types of large alignment, which the allocator
/// cannot remap.
pub fn renew<T: Copy>(values: &mut Vec<T>, len: usize, value: T) {
    if len > values.capacity() && values.capacity() > 0 {
        *values = Vec::new();
        values.reserve_exact(len + (len / 8).min(SPARE_MOST));
    }
    resize(values, len, value);
}

/// As [`Vec::resize_with`]; keeps the allocation while it is large enough.
pub fn resize_with<T>(values: &mut Vec<T>, len: usize, value: impl FnMut() -> T) {
    reserve(values, len);
    values.resize_with(len, value);
}

pub fn extend<T: Copy>(values: &mut Vec<T>, more: &[T]) {
    reserve(values, values.len() + more.len());
    values.extend_from_slice(more);
}

/// Reserves capacity for `len` values in total. The first allocation is exact, for vectors that never grow.
pub fn reserve<T>(values: &mut Vec<T>, len: usize) {
    if len > values.capacity() {
        let to_spare = if values.capacity() == 0 { 0 } else { (len / 8).min(SPARE_MOST) };
        values.reserve_exact(len + to_spare - values.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growth_leaves_little_to_spare() {
        let mut values = Vec::new();
        resize(&mut values, 1000, 1.0f32);
        assert_eq!((values.len(), values.capacity()), (1000, 1000));
        resize(&mut values, 1001, 2.0);
        assert_eq!((values.len(), values.capacity(), values[999], values[1000]), (1001, 1126, 1.0, 2.0));
        extend(&mut values, &[3.0; 125]);
        assert_eq!((values.len(), values.capacity()), (1126, 1126));
        extend(&mut values, &[4.0]);
        assert_eq!((values.len(), values.capacity(), values[1126]), (1127, 1267, 4.0));
        resize_with(&mut values, 10, f32::default);
        assert_eq!((values.len(), values.capacity()), (10, 1267));
        renew(&mut values, 20, 5.0);
        assert_eq!((values.len(), values.capacity(), values[19]), (20, 1267, 5.0));
        renew(&mut values, 2000, 6.0);
        assert_eq!((values.len(), values.capacity(), values[0]), (2000, 2250, 6.0));
    }
}
