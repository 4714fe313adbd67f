//! The dataset's points in its own coordinates; they may exceed memory.
//!
//! Invariants: 1. points keep the order of their file; 2. measurements equal those of points in memory
//! (`Extent`), bit for bit.

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
    pub cloud: &'a Cloud,
    /// Decides which points are too far.
    pub extent: Extent,
    pub frame: Frame,
}

impl Cloud {
    /// Spools all points that `read` produces.
    /// Errors: `read` failed, or the budget's folder cannot be written.
    pub fn gather(budget: &Budget<'_>, read: impl FnOnce(&mut TakePoint<'_>) -> InputResult<()>) -> InputResult<Cloud> {
        let mut points = SpoolWriter::new(budget.space());
        read(&mut |position, [r, g, b]| points.push(RawPoint { position, color: [r, g, b, 0, 0, 0, 0, 0] }))?;
        Ok(Cloud { points: points.finish()? })
    }

    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Calls `take` with every point in order.
    /// Errors: the file cannot be read, or `take` failed.
    pub fn for_each(&self, mut take: impl FnMut(DVec3, [u8; 3]) -> InputResult<()>) -> InputResult<()> {
        self.points.for_each(|p| take(DVec3::from_array(p.position), [p.color[0], p.color[1], p.color[2]]))
    }

    /// Median distance of the usable points from a position (for an even number the mean of the middle two); 0 without
    /// points.
    /// Errors: the file cannot be read.
    pub fn median_distance(&self, from: DVec3) -> InputResult<f64> {
        let mut count = 0u64;
        self.for_each(|p, _| {
            count += u64::from(usable(p));
            Ok(())
        })?;
        if count == 0 {
            return Ok(0.0);
        }
        // Non-negative numbers are ordered like their bits.
        let distance = |p: DVec3| usable(p).then(|| p.distance(from).to_bits());
        let of_rank = |rank| {
            let search = RankSearch::new(rank, count);
            let search = self.points.search(search, |p| distance(DVec3::from_array(p.position)))?;
            InputResult::Ok(f64::from_bits(search.key().unwrap_or(0)))
        };
        let upper = of_rank(count / 2)?;
        Ok(if count.is_multiple_of(2) { (of_rank(count / 2 - 1)? + upper) / 2.0 } else { upper })
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
