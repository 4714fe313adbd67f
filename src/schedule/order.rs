//! The order in which training views are visited.
//!
//! | order | an epoch |
//! | --- | --- |
//! | `shuffle` | all views in random order |
//! | `groups:<n>` | n neighbourhoods of views one after the other, the views of each in random order; cuts and order of the neighbourhoods are drawn anew for every epoch |
//! | `tour` | a short tour through all views, forth in one epoch and back in the next |
//!
//! Pages in memory serve the views of a neighbourhood again and again: the fewer views lie between two views of the same pages,
//! the fewer pages are read. The price is randomness, which training likes.
//!
//! Invariants: 1. the view of a step is a pure function of (seed, cameras, order, step), so the future is known and a run
//! can continue anywhere; 2. every epoch visits every view once.

use super::tour::tour;
use crate::base::rng::{Purpose, Stream};
use crate::scene::camera::Camera;
use crate::schedule::tour::{ViewPlace, cut, mean, places};
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// Cuts between groups move by up to this share of a group's size from epoch to epoch. So no two views are always in different
/// groups, and groups keep half to one and a half times their mean size.
const PLAY: f64 = 0.5;

/// A resolved order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    Shuffle,
    /// This many groups (at least 1).
    Groups(u32),
    /// There and back.
    Tour,
}

impl FromStr for Order {
    type Err = String;

    fn from_str(text: &str) -> Result<Order, String> {
        let groups = text.strip_prefix("groups:").and_then(|n| n.parse().ok()).filter(|&n: &u32| n > 0);
        match (text, groups) {
            ("shuffle", _) => Ok(Order::Shuffle),
            ("tour", _) => Ok(Order::Tour),
            (_, Some(groups)) => Ok(Order::Groups(groups)),
            _ => {
                Err(format!("'{text}' is no order of views; write shuffle, groups:<n> (for example groups:25) or tour"))
            }
        }
    }
}

impl fmt::Display for Order {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Order::Shuffle => write!(f, "shuffle"),
            Order::Groups(groups) => write!(f, "groups:{groups}"),
            Order::Tour => write!(f, "tour"),
        }
    }
}

/// The views of all steps.
#[derive(Debug, Clone)]
pub struct ViewOrder {
    order: Order,
    seed: u64,
    views: usize,
    /// Empty for a shuffle.
    places: Arc<[ViewPlace]>,
    /// The way there; empty but for a tour.
    way: Arc<[u32]>,
    epoch: u64,
    drawn: Vec<u32>,
    /// Where the groups of `drawn` end; empty without groups.
    ends: Vec<usize>,
}

impl ViewOrder {
    /// The order of the views of these cameras (at least one) under `seed`.
    pub fn new(order: Order, seed: u64, cameras: &[Camera]) -> ViewOrder {
        let places = if order == Order::Shuffle { Vec::new() } else { places(cameras) };
        let way = if order == Order::Tour { tour(&places) } else { Vec::new() };
        let mut order = ViewOrder {
            order,
            seed,
            views: cameras.len(),
            places: places.into(),
            way: way.into(),
            epoch: 0,
            drawn: Vec::new(),
            ends: Vec::new(),
        };
        order.draw(0);
        order
    }

    pub fn order(&self) -> Order {
        self.order
    }

    /// Steps of an epoch if its views come region by region; 0 for a shuffle, any stretch of which shows all regions.
    pub fn regional_epoch(&self) -> u32 {
        if self.order == Order::Shuffle { 0 } else { self.views as u32 }
    }

    fn draw(&mut self, epoch: u64) {
        self.epoch = epoch;
        self.drawn.clear();
        self.ends.clear();
        let mut draws = Stream::new(self.seed, Purpose::ViewOrder, epoch, 0);
        match self.order {
            Order::Shuffle => {
                self.drawn.extend(0..self.views as u32);
                draws.shuffle(&mut self.drawn);
            }
            Order::Groups(groups) => {
                let all = (0..self.views as u32).collect();
                let mut groups = cut(&self.places, all, (groups as usize).min(self.views), PLAY, &mut draws);
                order_groups(&self.places, &mut groups, &mut draws);
                for group in &mut groups {
                    draws.shuffle(group);
                    self.drawn.extend_from_slice(group);
                    self.ends.push(self.drawn.len());
                }
            }
            Order::Tour => {
                // Which way comes first is drawn once; then there and back.
                let first = Stream::new(self.seed, Purpose::ViewOrder, 0, 1).below(2);
                self.drawn.extend_from_slice(&self.way);
                if (epoch + first) % 2 == 1 {
                    self.drawn.reverse();
                }
            }
        }
    }

    fn draw_epoch_of(&mut self, step: u32) {
        let epoch = u64::from(step) / self.views as u64;
        if epoch != self.epoch {
            self.draw(epoch);
        }
    }

    /// Position of the view of a 0-based step, in 0..views.
    pub fn view_at(&mut self, step: u32) -> usize {
        self.draw_epoch_of(step);
        self.drawn[step as usize % self.views] as usize
    }

    /// The number of views of the group that ends with this 0-based step; `None` within a group, and in an order without several groups.
    pub fn group_ended_by(&mut self, step: u32) -> Option<usize> {
        self.draw_epoch_of(step);
        let end = step as usize % self.views + 1;
        let group = self.ends.binary_search(&end).ok().filter(|_| self.ends.len() > 1)?;
        Some(end - group.checked_sub(1).map_or(0, |before| self.ends[before]))
    }

    /// Positions of the views of the `count` steps from `step` on.
    pub fn upcoming(&self, step: u32, count: u32, out: &mut Vec<usize>) {
        out.clear();
        let mut ahead = self.clone();
        out.extend((0..count).map(|i| ahead.view_at(step + i)));
    }
}

/// Orders groups along a short tour through their centres, from a random group in a random direction, so that
/// neighbouring groups follow each other. On a survey whose views see 7 % of the pages, with a quarter of the pages in
/// memory, 25 groups read .021 of what they need in this order and .040 in random order, 100 groups .021 and .084
/// (`tests/storage/replay.rs` prints such figures); the price is that a neighbouring group comes next, and the next epoch
/// draws another direction anyway.
fn order_groups(places: &[ViewPlace], groups: &mut Vec<Vec<u32>>, draws: &mut Stream) {
    let middles: Vec<ViewPlace> = groups.iter().map(|group| mean(places, group)).collect();
    let mut way = tour(&middles);
    if draws.below(2) == 1 {
        way.reverse();
    }
    let first = draws.below(way.len() as u64) as usize;
    way.rotate_left(first);
    *groups = way.iter().map(|&g| std::mem::take(&mut groups[g as usize])).collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras that look down on a square of side `side`.
    fn cameras(side: usize) -> Vec<Camera> {
        let camera = |i: usize| {
            let (x, y) = ((i % side) as f32, (i / side) as f32);
            let viewmat = [[1.0, 0.0, 0.0, -x], [0.0, -1.0, 0.0, y], [0.0, 0.0, -1.0, 5.0]];
            Camera::pinhole(viewmat, [100.0, 100.0, 50.0, 50.0], [100, 100])
        };
        (0..side * side).map(camera).collect()
    }

    fn epoch(order: &mut ViewOrder, epoch: u32) -> Vec<usize> {
        let views = order.views as u32;
        (epoch * views..(epoch + 1) * views).map(|step| order.view_at(step)).collect()
    }

    const ORDERS: [&str; 6] = ["shuffle", "groups:1", "groups:9", "groups:49", "groups:500", "tour"];

    #[test]
    fn every_epoch_visits_every_view_once_and_a_step_does_not_depend_on_history() {
        for text in ORDERS {
            let kind: Order = text.parse().unwrap_or(Order::Shuffle);
            assert_eq!(kind.to_string(), text);
            for side in [1, 7] {
                let mut order = ViewOrder::new(kind, 3, &cameras(side));
                let epochs: Vec<Vec<usize>> = (0..5).map(|e| epoch(&mut order, e)).collect();
                for epoch in &epochs {
                    let mut sorted = epoch.clone();
                    sorted.sort_unstable();
                    assert_eq!(sorted, (0..side * side).collect::<Vec<_>>(), "{text}");
                }
                assert!(side == 1 || epochs[0] != epochs[1], "{text}");
                let mut fresh = ViewOrder::new(kind, 3, &cameras(side));
                let step = 3 * side * side + side / 2;
                assert_eq!(fresh.view_at(step as u32), epochs[3][side / 2], "{text}");
                let mut ahead = Vec::new();
                fresh.upcoming(0, (2 * side * side) as u32, &mut ahead);
                assert_eq!(ahead, epochs[..2].concat(), "{text}");
            }
        }
        for wrong in ["groups:0", "groups", "groups:x", "groups:-1", "", "Tour"] {
            assert!(wrong.parse::<Order>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn groups_are_compact_and_their_borders_move() {
        let side = 30;
        let mut order = ViewOrder::new(Order::Groups(9), 1, &cameras(side));
        let mut firsts = Vec::new();
        for e in 0..6 {
            let views = epoch(&mut order, e);
            firsts.push(views[..20].to_vec());
            // A window of a third of a mean group (100 views) lies in one group or in two neighbours: it spans no more
            // than two groups of the largest size along an axis (30/3 x 1.5 each), and mostly one.
            let spans = views.windows(33).map(|window| {
                let span = |of: fn(usize) -> usize| {
                    let all = window.iter().map(|&v| of(v));
                    all.clone().max().unwrap_or(0) - all.min().unwrap_or(0)
                };
                span(|v| v % 30).max(span(|v| v / 30))
            });
            let spans: Vec<usize> = spans.collect();
            let wide = spans.iter().filter(|&&span| span > 18).count();
            assert!(wide * 4 < spans.len(), "{wide} of {}", spans.len());
        }
        firsts.dedup();
        assert!(firsts.len() > 4, "epochs start in other places");
    }

    #[test]
    fn groups_end_where_their_views_end() {
        for (text, ends) in [("groups:9", 9), ("groups:1", 0), ("shuffle", 0), ("tour", 0)] {
            let mut order = ViewOrder::new(text.parse().unwrap_or(Order::Tour), 1, &cameras(30));
            for epoch in 0..3 {
                let steps = epoch * 900..(epoch + 1) * 900;
                let last: Vec<u32> = steps.filter(|&step| order.group_ended_by(step).is_some()).collect();
                assert_eq!(last.len(), ends, "{text}");
                assert!(ends == 0 || last.last() == Some(&(epoch * 900 + 899)), "{text}: {last:?}");
                // A group has the steps since the end of the one before.
                let mut before = epoch * 900;
                for step in last {
                    assert_eq!(order.group_ended_by(step), Some((step + 1 - before) as usize), "{text}");
                    before = step + 1;
                }
            }
        }
    }

    #[test]
    fn a_tour_goes_from_neighbour_to_neighbour_and_back() {
        let mut order = ViewOrder::new(Order::Tour, 1, &cameras(12));
        let [there, mut back] = [0, 1].map(|e| epoch(&mut order, e));
        back.reverse();
        assert_eq!(there, back);
        let far = there.windows(2).filter(|p| (p[0] % 12).abs_diff(p[1] % 12) + (p[0] / 12).abs_diff(p[1] / 12) > 1);
        // The shortest way through a grid has none.
        assert!(far.count() < 4);
    }
}
