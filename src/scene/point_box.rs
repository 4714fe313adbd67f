//! The bounding box of some points. Invariant: the distance to a box is computed as that to a point, so rounding never makes a box farther than a point
//! in it.

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointBox {
    /// Lower corner; greater than `hi` without points.
    pub lo: [f32; 3],
    pub hi: [f32; 3],
}

impl PointBox {
    pub const EMPTY: PointBox = PointBox { lo: [f32::INFINITY; 3], hi: [f32::NEG_INFINITY; 3] };

    pub fn of(points: impl Iterator<Item = [f32; 3]>) -> PointBox {
        let mut all = PointBox::EMPTY;
        points.for_each(|point| all.add(point));
        all
    }

    pub fn add(&mut self, point: [f32; 3]) {
        *self = self.union(PointBox { lo: point, hi: point });
    }

    #[must_use]
    pub fn union(mut self, other: PointBox) -> PointBox {
        for i in 0..3 {
            self.lo[i] = self.lo[i].min(other.lo[i]);
            self.hi[i] = self.hi[i].max(other.hi[i]);
        }
        self
    }

    /// The longest axis of the box; the first of equal ones.
    pub fn longest_axis(&self) -> usize {
        let extent = |i: usize| self.hi[i] - self.lo[i];
        (1..3).fold(0, |widest, i| if extent(i) > extent(widest) { i } else { widest })
    }

    /// Squared distance of the box from a point; never greater than that of a point in the box.
    #[inline]
    pub fn dist2(&self, q: [f32; 3]) -> f32 {
        norm2(std::array::from_fn(|i| (self.lo[i] - q[i]).max(q[i] - self.hi[i]).max(0.0)))
    }
}

#[inline]
pub fn norm2(d: [f32; 3]) -> f32 {
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}
