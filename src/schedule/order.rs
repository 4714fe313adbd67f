//! The order in which training views are visited.
//!
//! Invariants: 1. the view of a step is a pure function of (seed, number of views, step), so the future is known and
//! a run can continue anywhere; 2. every epoch visits every view once.

use crate::base::rng::{Purpose, Stream};

/// Uniform shuffle, drawn anew for every epoch.
#[derive(Debug, Clone)]
pub struct ShuffledOrder {
    seed: u64,
    views: usize,
    epoch: u64,
    order: Vec<u32>,
}

impl ShuffledOrder {
    /// The order of `views` views (at least one) under `seed`.
    pub fn new(seed: u64, views: usize) -> Self {
        let mut order = ShuffledOrder { seed, views, epoch: 0, order: Vec::new() };
        order.draw(0);
        order
    }

    fn draw(&mut self, epoch: u64) {
        self.epoch = epoch;
        self.order.clear();
        self.order.extend(0..self.views as u32);
        Stream::new(self.seed, Purpose::ViewOrder, epoch, 0).shuffle(&mut self.order);
    }

    /// Position of the view of a 0-based step, in 0..views.
    pub fn view_at(&mut self, step: u32) -> usize {
        let epoch = u64::from(step) / self.views as u64;
        if epoch != self.epoch {
            self.draw(epoch);
        }
        self.order[step as usize % self.views] as usize
    }

    /// Positions of the views of the `count` steps from `step` on.
    pub fn upcoming(&self, step: u32, count: u32, out: &mut Vec<usize>) {
        out.clear();
        let mut ahead = self.clone();
        out.extend((0..count).map(|i| ahead.view_at(step + i)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_epoch_visits_every_view_once_and_orders_differ() {
        let mut order = ShuffledOrder::new(3, 11);
        let epochs: Vec<Vec<usize>> = (0..4).map(|e| (0..11).map(|i| order.view_at(e * 11 + i)).collect()).collect();
        for epoch in &epochs {
            let mut sorted = epoch.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..11).collect::<Vec<_>>());
        }
        assert_ne!(epochs[0], epochs[1]);
        assert_eq!(ShuffledOrder::new(3, 11).view_at(25), epochs[2][3], "a step's view does not depend on history");
    }
}
