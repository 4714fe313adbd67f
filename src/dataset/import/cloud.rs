//! The dataset's points in its own coordinates; they may exceed memory.
//!
//! Invariants: 1. points keep the order of their file; 2. measurements equal those of points in memory
//! ([`Extent`](crate::dataset::frame::Extent)), bit for bit.

use super::spool::{Spool, SpoolWriter};
use super::{Budget, PointSource};
use crate::base::error::InputResult;
use crate::dataset::frame::{Extent, Frame, usable};
use crate::dataset::model::TakePoint;
use crate::scene::select::RankSearch;
use glam::DVec3;

/// A point as a file gives it.
#[derive(Debug, Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C)]
struct RawPoint {
    position: [f64; 3],
    color: [u8; 8],
}

/// Points spooled from a file of any format.
#[derive(Debug)]
pub struct Cloud {
    points: Spool<RawPoint>,
}

/// The points of a [`Cloud`] in the local frame, without implausibly far ones.
#[derive(Debug)]
pub struct LocalCloud<'a> {
    /// The points.
    pub cloud: &'a Cloud,
    /// Decides which points are too far.
    pub extent: Extent,
    /// The local frame.
    pub frame: Frame,
}

impl Cloud {
    /// Spools all points that `read` produces.
    ///
    /// # Errors
    /// `read` failed, or the budget's folder cannot be written.
    pub fn gather(budget: &Budget<'_>, read: impl FnOnce(&mut TakePoint<'_>) -> InputResult<()>) -> InputResult<Cloud> {
        let mut points = SpoolWriter::new(budget.space());
        read(&mut |position, [r, g, b]| points.push(RawPoint { position, color: [r, g, b, 0, 0, 0, 0, 0] }))?;
        Ok(Cloud { points: points.finish()? })
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Calls `take` with every point in order.
    ///
    /// # Errors
    /// The file cannot be read, or `take` failed.
    pub fn for_each(&self, mut take: impl FnMut(DVec3, [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        self.points.for_each(|p| take(DVec3::from_array(p.position), [p.color[0], p.color[1], p.color[2]]))
    }

    /// Median distance of the usable points from a position (for an even number the mean of the middle two); 0 without
    /// points.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn median_distance(&self, from: DVec3) -> InputResult<f64> {
        let mut count = 0u64;
        self.for_each(|p, _| {
            count += u64::from(usable(p));
            Ok(())
        })?;
        if count == 0 {
            return Ok(0.0);
        }
        let (mut below, mut above) = (RankSearch::new((count - 1) / 2, count), RankSearch::new(count / 2, count));
        while !above.is_done() {
            self.for_each(|p, _| {
                if usable(p) {
                    // Non-negative numbers are ordered like their bits.
                    let key = p.distance(from).to_bits();
                    below.count(key);
                    above.count(key);
                }
                Ok(())
            })?;
            below.next_pass();
            above.next_pass();
        }
        let of = |search: &RankSearch| f64::from_bits(search.key().unwrap_or(0));
        Ok(if count.is_multiple_of(2) { (of(&below) + of(&above)) / 2.0 } else { of(&above) })
    }
}

impl PointSource for LocalCloud<'_> {
    fn read(&self, take: &mut dyn FnMut([f32; 3], [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        self.cloud.for_each(|position, color| {
            if !self.extent.is_plausible(position) {
                return Ok(());
            }
            take(self.frame.to_local(position).as_vec3().to_array(), color)
        })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    #[test]
    fn extents_of_clouds_in_files_equal_those_in_memory() {
        let folder = tempfile::tempdir().unwrap();
        let centres: Vec<DVec3> = (0..9).map(|i| DVec3::new(f64::from(i), 2.0, -1.0)).collect();
        for count in [0, 1, 2, 7, 500, 501] {
            let mut draws = Stream::new(3, Purpose::Test, count, 0);
            let mut points: Vec<[f64; 3]> =
                (0..count).map(|_| std::array::from_fn(|_| draws.normal() * 50.0 + 5e5)).collect();
            points.extend(if count == 7 { vec![[f64::NAN; 3], [1e200; 3]] } else { vec![] });
            let budget = Budget { folder: folder.path(), bytes: 1000 };
            let read = |take: &mut TakePoint<'_>| points.iter().try_for_each(|&p| take(p, [1, 2, 3]));
            let cloud = Cloud::gather(&budget, read).unwrap();
            assert_eq!(cloud.len(), points.len());
            let got = Extent::measure_by(&centres, |centre| cloud.median_distance(centre)).unwrap();
            assert_eq!(got, Extent::measure(&centres, &points));
        }
    }
}
