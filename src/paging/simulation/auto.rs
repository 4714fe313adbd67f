//! `--view-order auto`: which order a run takes.
//!
//! When all pages fit into memory, nothing is read and the order is the one that training likes best: shuffle. Otherwise the
//! run is replayed for each number of groups (`replay`), and the smallest number of groups that reads little is taken:
//! randomness is given up only for bytes. The order belongs to the run: it is found once and recorded.

use super::replay::{ReplayOptions, replay};
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::plan::cache_model::TooFewFrames;
use crate::scene::camera::Camera;
use crate::schedule::order::{Order, ViewOrder};
use crate::schedule::visibility::ViewPages;

/// Numbers of groups that are tried.
const GROUPS: [u32; 8] = [1, 4, 9, 16, 25, 36, 64, 100];
/// Groups have at least this many views on average, or there is nothing left to shuffle.
const VIEWS_PER_GROUP: usize = 4;
/// Fewest groups within this factor of the least reads ...
const ENOUGH_FACTOR: f64 = 1.5;
/// ... or below this share of the needed pages, which a drive reads mostly beside the steps, are taken. Randomness is worth
/// more than the rest: on seneca at 395 px half of the frames make a shuffle read 16 % and a step take 1.12 times as long,
/// while 4, 9 and 25 groups cost .13, .27 and .55 dB after 3,000 steps; twice the steps bring .62 dB
/// (`gsscale-bench sweep pareto`).
const ENOUGH_SHARE: f64 = 0.15;

/// The order for these views and a cache of `frames` frames for `pages` pages. `plan_bytes` bounds the memory that this
/// takes.
/// Errors: a view needs more pages than there are frames.
pub fn automatic_order(
    views: &ViewPages,
    cameras: &[Camera],
    pages: usize,
    frames: usize,
    seed: u64,
    plan_bytes: u64,
) -> Result<Order, TooFewFrames> {
    if frames >= pages {
        return Ok(Order::Shuffle);
    }
    let mut tried = Vec::new();
    for groups in GROUPS {
        if groups > 1 && views.views() < VIEWS_PER_GROUP * groups as usize {
            break;
        }
        // The second of two epochs: the first reads everything once, whatever the order.
        let (policy, steps) = (EvictPolicy::FarthestNextUse, 2 * views.views() as u32);
        let options = ReplayOptions { frames, policy, reads_ahead: false, steps, plan_bytes };
        let run = replay(views, &[], &ViewOrder::new(Order::Groups(groups), seed, cameras), &options)?;
        let read = 1.0 - run.figures(run.steady()).hit_rate;
        tried.push((groups, read));
        if read <= ENOUGH_SHARE {
            break;
        }
    }
    let least = tried.iter().map(|&(_, read)| read).fold(f64::INFINITY, f64::min);
    let enough = tried.iter().find(|&&(_, read)| read <= ENOUGH_SHARE.max(least * ENOUGH_FACTOR));
    Ok(match enough {
        None | Some((1, _)) => Order::Shuffle,
        Some(&(groups, _)) => Order::Groups(groups),
    })
}
