//! A whole run of the cache before it happens: what every step reads and writes, and how long the run waits for the drive.
//!
//! [`replay`] takes steps through the [`Plan`] and the [`CacheModel`] that runs use too. Under
//! [`EvictPolicy::FarthestNextUse`], without reading ahead, and with a plan that looks at least two epochs ahead, it reads
//! Belady's bound: no cache with that many frames can read fewer pages for the same views in the same order.
//!
//! The model of time: one drive serves one request after the other, reads in the order of steps. Each read is preceded by
//! the write-back of the page that is evicted for it. A page is evicted at the end of the step that last needs it, but at
//! most [`STEPS_AHEAD`] steps before the step that needs its frame, and any frame serves any read. A step takes the same
//! time everywhere. The run waits for what is still missing when a step could start. A replay that reads ahead evicts pages
//! as a run does. Not modelled: the limit on bytes in flight, and the moments in a step at which the run polls for
//! completed transfers.
//!
//! Invariants: 1. nothing here knows clocks or files: the same input gives the same report; 2. bytes are counted when a
//! page moves, whole pages only. An evicted page is written only if a step has
//! updated the page since it was read; batches that only render update nothing.

use crate::base::ids::PageNo;
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::plan::batches::walk;
use crate::paging::plan::cache_model::{CacheModel, STEPS_AHEAD, StepChange, TooFewFrames};
use crate::paging::plan::steps::Plan;
use crate::scene::camera::Camera;
use crate::schedule::order::{Order, ViewOrder};
use crate::schedule::visibility::ViewPages;
use std::collections::{HashSet, VecDeque};
use std::ops::Range;

/// Steps of the window whose heaviest place is reported.
pub const WINDOW_STEPS: usize = 20;

/// The run to simulate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayOptions {
    pub frames: usize,
    /// Which page is evicted first.
    pub policy: EvictPolicy,
    /// Whether pages are read ahead of their step, as runs do unless they move pages on demand.
    pub reads_ahead: bool,
    /// Steps to go through.
    pub steps: u32,
    /// Bytes that the plan may take: with fewer bytes it looks ahead less far.
    pub plan_bytes: u64,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StepTraffic {
    /// Batches in which the step walks its view, forwards and back; 1 for a view that fits, 0 for a view without pages.
    pub batches: u32,
    /// Pages needed, by each batch.
    pub pages: u32,
    /// Pages among them that were read for the step.
    pub pages_read: u32,
    /// Bytes of the pages that were read.
    pub bytes_read: u64,
    /// The part of `bytes_read` that fills frames for the first time. A run that has just made its pages has these
    /// pages in memory already.
    pub bytes_first: u64,
    /// Number of pages that are needed before the first eviction.
    pub pages_first: u32,
    /// Bytes of the changed pages that were evicted for the step.
    pub bytes_written: u64,
    /// Frames that become free at the begin of this step: their pages are evicted for this step or one of the next
    /// [`STEPS_AHEAD`].
    pub frames_freed: u32,
}

/// All steps of a replay.
#[derive(Debug, Clone, Default)]
pub struct Replay {
    pub steps: Vec<StepTraffic>,
    /// Steps of an epoch.
    pub views: usize,
    /// Whether every next use was known whenever a page left: then reads under [`EvictPolicy::FarthestNextUse`] are Belady's bound.
    pub is_exact: bool,
}

/// Goes through the steps, each in the batches of [`walk`]. `page_bytes` are bytes on disk by page; pages that are needed but
/// not listed count nothing.
/// Errors: there are no frames.
pub fn replay(
    views: &ViewPages,
    page_bytes: &[u32],
    order: &ViewOrder,
    options: &ReplayOptions,
) -> Result<Replay, TooFewFrames> {
    let mut coming = Coming::new(views, order, options);
    // The plan and the model count batches. A step that fits is one batch.
    let mut plan = Plan::new(0, options.plan_bytes);
    let cache = CacheModel::new(options.frames, options.policy);
    let mut cache = if options.reads_ahead { cache.reading_ahead() } else { cache };
    let mut change = StepChange::default();
    let bytes = |pages: &[PageNo]| -> u64 {
        pages.iter().map(|p| page_bytes.get(p.index()).map_or(0, |&b| u64::from(b))).sum()
    };
    let mut steps = vec![StepTraffic::default(); options.steps as usize];
    let mut frames_left = options.frames;
    let mut frames_freed = vec![0; options.steps as usize];
    let mut changed: HashSet<PageNo> = HashSet::new();
    let mut batch = 0;
    while coming.extend(&mut plan, batch) {
        let step = coming.step_of(batch);
        let pages = plan.pages(batch);
        cache.batch(batch, step, pages, |page| plan.next_use(page, batch + 1), &mut change)?;
        // As long as there are frames without a page nothing leaves, so that each of these is read for the first time.
        let first = change.admit.len().min(frames_left);
        frames_left -= first;
        for last_use in &change.last_uses {
            let free_from = (last_use + 1).max(step.saturating_sub(STEPS_AHEAD)).min(step);
            frames_freed[free_from as usize] += 1;
        }
        let traffic = &mut steps[step as usize];
        traffic.batches += 1;
        traffic.pages += pages.len() as u32;
        traffic.pages_read += change.admit.len() as u32;
        traffic.bytes_read += bytes(&change.admit);
        traffic.bytes_first += bytes(&change.admit[..first]);
        traffic.pages_first += first as u32;
        for page in &change.evict {
            traffic.bytes_written += if changed.remove(page) { bytes(&[*page]) } else { 0 };
        }
        if coming.updates(batch) {
            changed.extend(pages);
        }
        plan.pop();
        batch += 1;
    }
    steps.iter_mut().zip(frames_freed).for_each(|(traffic, frames)| traffic.frames_freed = frames);
    Ok(Replay { steps, views: views.views(), is_exact: coming.is_exact })
}

/// The batches that are still to be planned, in order.
struct Coming<'a> {
    views: &'a ViewPages,
    order: ViewOrder,
    options: &'a ReplayOptions,
    /// The step of each batch that is planned, and whether the batch updates its pages.
    batches: Vec<(u32, bool)>,
    /// Batches of the step that is planned now and are not planned yet.
    waiting: VecDeque<Vec<PageNo>>,
    /// Number of the batches in `waiting` before the one at the turn, which is pinned once: from that batch on the step updates.
    forwards: usize,
    next_step: u32,
    /// Whether every next use was known whenever a page left.
    is_exact: bool,
}

impl<'a> Coming<'a> {
    fn new(views: &'a ViewPages, order: &ViewOrder, options: &'a ReplayOptions) -> Coming<'a> {
        let (batches, waiting) = (Vec::new(), VecDeque::new());
        Coming { views, order: order.clone(), options, batches, waiting, forwards: 0, next_step: 0, is_exact: true }
    }

    fn step_of(&self, batch: u32) -> u32 {
        self.batches[batch as usize].0
    }

    /// Whether the batch changes its pages: a step in several batches reads the first ones to render alone.
    fn updates(&self, batch: u32) -> bool {
        self.batches[batch as usize].1
    }

    /// Plans the next two epochs after `batch`, as far as they fit: each page is needed in every epoch, so its next use
    /// lies less than two epochs ahead. `false` when no batch is left.
    fn extend(&mut self, plan: &mut Plan, batch: u32) -> bool {
        let now = self.batches.get(batch as usize).map_or(self.next_step, |&(step, _)| step);
        // The run ends; what would come after it is not needed by anyone.
        let reach = self.options.steps.min(now.saturating_add(2 * self.views.views() as u32));
        loop {
            if let Some(pages) = self.waiting.front() {
                if !plan.push(pages) {
                    self.is_exact = false;
                    break;
                }
                self.waiting.pop_front();
                self.batches.push((self.next_step - 1, self.forwards == 0));
                self.forwards = self.forwards.saturating_sub(1);
            } else if self.next_step < reach {
                let pages = self.views.of(self.order.view_at(self.next_step));
                self.waiting.extend(walk(pages, self.options.frames).map(<[PageNo]>::to_vec));
                // There and back, with one batch at the turn.
                self.forwards = self.waiting.len() / 2;
                self.next_step += 1;
            } else {
                break;
            }
        }
        !plan.steps().is_empty()
    }
}

/// Rates of a drive, and the time of a step without the drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveModel {
    /// Bytes per second.
    pub read_rate: f64,
    /// Bytes per second.
    pub write_rate: f64,
    /// Seconds of a step that waits for nothing.
    pub step_seconds: f64,
}

/// Waiting for the drive.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Stall {
    /// Seconds, all steps together.
    pub seconds: f64,
    /// Of the worst step.
    pub worst_seconds: f64,
    /// Steps that wait.
    pub steps: u32,
}

/// Figures over some steps.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Figures {
    /// How many steps.
    pub steps: u32,
    /// Pages needed by a step, mean.
    pub pages_per_step: f64,
    /// Share of the needed pages that are in memory already.
    pub hit_rate: f64,
    /// Bytes read by a step, mean.
    pub read_per_step: f64,
    /// Bytes written by a step, mean.
    pub written_per_step: f64,
    /// Share of all reads that falls on the heaviest twentieth of the steps.
    pub heaviest_share: f64,
    /// First of the [`WINDOW_STEPS`] steps in a row that move most.
    pub worst_window: u32,
    /// Bytes that these read and write, per step.
    pub worst_per_step: f64,
}

impl Replay {
    /// Steps after the first epoch, in which the cache fills and everything is read once; all if there are no others.
    pub fn steady(&self) -> Range<usize> {
        let first = if self.steps.len() > self.views { self.views } else { 0 };
        first..self.steps.len()
    }

    /// Bytes read and written by all steps.
    pub fn totals(&self) -> (u64, u64) {
        self.steps.iter().fold((0, 0), |(read, written), s| (read + s.bytes_read, written + s.bytes_written))
    }

    /// Bytes that a run reads which has just made its pages.
    pub fn read_by_run(&self) -> u64 {
        self.steps.iter().map(|s| s.bytes_read - s.bytes_first).sum()
    }

    /// Figures over a range of steps.
    pub fn figures(&self, range: Range<usize>) -> Figures {
        let steps = &self.steps[range.clone()];
        if steps.is_empty() {
            return Figures::default();
        }
        let count = steps.len() as f64;
        let sum = |of: &dyn Fn(&StepTraffic) -> u64| steps.iter().map(of).sum::<u64>() as f64;
        let pages = sum(&|s| u64::from(s.pages));
        let read = sum(&|s| s.bytes_read);
        let mut heaviest: Vec<u64> = steps.iter().map(|s| s.bytes_read).collect();
        heaviest.sort_unstable_by(|a, b| b.cmp(a));
        let heavy: u64 = heaviest[..steps.len().div_ceil(20)].iter().sum();
        let width = WINDOW_STEPS.min(steps.len());
        let moved: Vec<u64> = steps.iter().map(|s| s.bytes_read + s.bytes_written).collect();
        let mut window: u64 = moved[..width].iter().sum();
        let mut worst = (window, 0);
        for first in 1..=steps.len() - width {
            window = window - moved[first - 1] + moved[first + width - 1];
            if window > worst.0 {
                worst = (window, first);
            }
        }
        Figures {
            steps: steps.len() as u32,
            pages_per_step: pages / count,
            hit_rate: 1.0 - sum(&|s| u64::from(s.pages_read)) / pages.max(1.0),
            read_per_step: read / count,
            written_per_step: sum(&|s| s.bytes_written) / count,
            heaviest_share: heavy as f64 / read.max(1.0),
            worst_window: (range.start + worst.1) as u32,
            worst_per_step: worst.0 as f64 / width as f64,
        }
    }

    /// How long a range of steps waits for the drive, in a run that has just made its pages. The range's first reads count as
    /// done: the run waits for them once, before it begins.
    pub fn stall(&self, range: Range<usize>, drive: &DriveModel) -> Stall {
        let mut stall = Stall::default();
        let mut began = vec![0.0f64; range.end];
        let mut drive_free = 0.0f64;
        // Frames free in the steps up to `freed_by`, beyond those of the reads so far.
        let (mut freed_by, mut free) = (0, self.steps.first().map_or(0, |s| i64::from(s.frames_freed)));
        for (step, traffic) in self.steps[..range.end].iter().enumerate() {
            let mut pages = i64::from(traffic.pages_read - traffic.pages_first);
            let page = 1.0 / pages.max(1) as f64;
            let read = page * (traffic.bytes_read - traffic.bytes_first) as f64 / drive.read_rate;
            let busy = read + page * traffic.bytes_written as f64 / drive.write_rate;
            let is_timed = step > range.start;
            let ready = if is_timed { began[step - 1] + drive.step_seconds } else { 0.0 };
            let waited = pages > 0;
            while pages > 0 {
                if free <= 0 && freed_by < step {
                    freed_by += 1;
                    free += i64::from(self.steps[freed_by].frames_freed);
                    continue;
                }
                // The frames that this step waits for are free when it could start.
                let (now, from) = if freed_by < step { (free.min(pages), began[freed_by]) } else { (pages, ready) };
                if is_timed {
                    drive_free = drive_free.max(from) + now as f64 * busy;
                }
                (pages, free) = (pages - now, free - now);
            }
            if !is_timed {
                continue;
            }
            let waits = if waited { (drive_free - ready).max(0.0) } else { 0.0 };
            began[step] = ready + waits;
            stall.seconds += waits;
            stall.worst_seconds = stall.worst_seconds.max(waits);
            stall.steps += u32::from(waits > 0.0);
        }
        stall
    }
}

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

/// `--view-order auto`: the order for these views and a cache of `frames` frames for `pages` pages. `plan_bytes` bounds the memory that this
/// takes. When all pages fit into memory, nothing is read and the order is the one that training likes best: shuffle. Otherwise the
/// run is replayed for each number of groups, and the smallest number that reads little is taken: randomness is given up only for
/// bytes. The order belongs to the run: it is found once and recorded.
/// Errors: there are no frames.
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
