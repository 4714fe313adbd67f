//! Whole runs of the page cache on generated aerial surveys.

use gsscale::base::ids::{PageId, PageNo};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::plan::batches::walk;
use gsscale::paging::plan::cache_model::{FAR_STEPS, STEPS_AHEAD};
use gsscale::paging::simulation::replay::{
    DriveModel, Replay, ReplayOptions, Stall, StepTraffic, automatic_order, replay,
};
use gsscale::scene::camera::Camera;
use gsscale::scene::page_meta::{PageBounds, PageMeta};
use gsscale::schedule::order::{Order, ViewOrder};
use gsscale::schedule::visibility::ViewPages;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// A camera at `centre` that looks down, tilted by `tilt` off the vertical towards `heading`, radians.
fn camera(centre: [f64; 3], heading: f64, tilt: f64) -> Camera {
    let (ch, sh) = (libm::cos(heading), libm::sin(heading));
    let (ct, st) = (libm::cos(tilt), libm::sin(tilt));
    let forward = [ch * st, sh * st, -ct];
    let right = [sh, -ch, 0.0];
    let down = [
        forward[1] * right[2] - forward[2] * right[1],
        forward[2] * right[0] - forward[0] * right[2],
        forward[0] * right[1] - forward[1] * right[0],
    ];
    let row = |r: [f64; 3]| {
        [r[0] as f32, r[1] as f32, r[2] as f32, -(r[0] * centre[0] + r[1] * centre[1] + r[2] * centre[2]) as f32]
    };
    Camera::pinhole([right, down, forward].map(row), [900.0, 900.0, 500.0, 375.0], [1000, 750])
}

/// A square city of side 1 in `side` x `side` pages of ground, with strips of views across it.
struct Survey {
    index: Vec<PageMeta>,
    cameras: Vec<Camera>,
}

/// `views` views, each of which sees about `share` of the city; two crossing passes when tilted.
fn survey(views: usize, side: usize, share: f64, tilt: f64) -> Survey {
    let mut draws = Stream::new(1, Purpose::Test, 60, 0);
    let cell = 1.0 / side as f64;
    let page = |i: usize| {
        let (x, y) = ((i % side) as f64 * cell, (i / side) as f64 * cell);
        let bounds = PageBounds {
            lo: [x as f32, y as f32, 0.0],
            hi: [(x + cell) as f32, (y + cell) as f32, (0.02 * cell) as f32],
            sigma_max: (0.01 * cell) as f32,
        };
        PageMeta { id: PageId::initial(i as u32), rows: 1024, sh_degree: 3, events_applied: 0, bounds }
    };
    // A vertical view sees (1000/900 h)(750/900 h).
    let mut height = (share / (1000.0 / 900.0 * 750.0 / 900.0)).sqrt();
    if tilt > 0.0 {
        height *= 0.62;
    }
    let passes = if tilt > 0.0 { 2 } else { 1 };
    let mut cameras = Vec::new();
    for pass in 0..passes {
        let count = views / passes;
        let strips = (count as f64).sqrt().ceil() as usize;
        for v in 0..count {
            let (strip, k) = (v / strips, v % strips);
            let along = (k as f64 + 0.5) / strips as f64;
            let across = (strip as f64 + 0.5) / count.div_ceil(strips) as f64;
            let back = height * libm::tan(tilt);
            let forth = strip % 2 == 0;
            let along = if forth { along } else { 1.0 - along };
            let sign = if forth { 1.0 } else { -1.0 };
            let half = std::f64::consts::FRAC_PI_2;
            let heading = if forth { 0.0 } else { 2.0 * half } + if pass == 1 { half } else { 0.0 };
            let behind = along - sign * back;
            let (x, y) = if pass == 0 { (behind, across) } else { (across, behind) };
            let jitter = 0.02 * height;
            let at = [x + jitter * draws.normal(), y + jitter * draws.normal(), height + jitter * draws.normal()];
            cameras.push(camera(at, heading + 0.03 * draws.normal(), tilt + 0.02 * draws.normal()));
        }
    }
    Survey { index: (0..side * side).map(page).collect(), cameras }
}

fn run(survey: &Survey, pages: &ViewPages, order: Order, policy: EvictPolicy, cache: f64, epochs: u32) -> Replay {
    let order = ViewOrder::new(order, 5, &survey.cameras);
    let bytes = vec![1 << 20; survey.index.len()];
    let frames = (cache * survey.index.len() as f64) as usize;
    let steps = survey.cameras.len() as u32 * epochs;
    replay(pages, &bytes, &order, &ReplayOptions { frames, policy, reads_ahead: false, steps, plan_bytes: 1 << 30 })
        .unwrap()
}

fn miss(run: &Replay) -> f64 {
    1.0 - run.figures(run.steady()).hit_rate
}

#[test]
fn orders_and_policies_read_in_the_order_of_the_design() {
    let survey = survey(400, 32, 0.07, 0.0);
    let pages = ViewPages::new(&survey.index, &survey.cameras);
    let share = pages.total() as f64 / (400.0 * 1024.0);
    assert!((0.06..0.10).contains(&share), "a view sees {share}");
    for cache in [0.18, 0.25, 0.5] {
        let of = |order: &str, policy| miss(&run(&survey, &pages, order.parse().unwrap(), policy, cache, 3));
        let table = ["shuffle", "groups:4", "groups:9", "groups:25"].map(|order| {
            let (lru, known) = (of(order, EvictPolicy::LeastRecentlyUsed), of(order, EvictPolicy::FarthestNextUse));
            assert!(known <= lru, "{order}: knowing the future never reads more");
            known
        });
        // Each refinement of the order saves a good deal. The tour through the city itself remains.
        assert!(table[1] < 0.75 * table[0] && table[2] < 0.75 * table[1] + 0.01, "{table:?}");
        assert!(table[3] < 0.75 * table[2] + 0.01, "{table:?}");
        assert!(of("tour", EvictPolicy::FarthestNextUse) < 0.15 * table[0] + 0.02);
    }
    // In a shuffled order, farthest next use misses clearly fewer pages than least recent use.
    let shuffle = |policy| miss(&run(&survey, &pages, Order::Shuffle, policy, 0.25, 3));
    let (lru, known) = (shuffle(EvictPolicy::LeastRecentlyUsed), shuffle(EvictPolicy::FarthestNextUse));
    assert!((0.6..0.85).contains(&lru) && (0.35..0.6).contains(&known), "{lru} {known}");
}

#[test]
fn bytes_follow_pages_and_everything_that_leaves_is_written() {
    let survey = survey(100, 16, 0.1, 0.7);
    let pages = ViewPages::new(&survey.index, &survey.cameras);
    let needed: BTreeSet<u32> = (0..100).flat_map(|v| pages.of(v).iter().map(|p| p.0)).collect();
    let planned = run(&survey, &pages, Order::Shuffle, EvictPolicy::FarthestNextUse, 0.4, 3);
    let (read, written) = planned.totals();
    let frames = (0.4 * 256.0) as u64;
    assert_eq!(read - written, frames << 20, "what was read and not written is what the frames hold");
    assert!(planned.steps.iter().all(|s| s.bytes_read == u64::from(s.pages_read) << 20 && s.pages_read <= s.pages));
    // With a frame for every page each page is read once and nothing is written.
    let all = run(&survey, &pages, Order::Shuffle, EvictPolicy::FarthestNextUse, 1.0, 3);
    assert_eq!(all.totals(), ((needed.len() as u64) << 20, 0));
    assert_eq!(all.figures(all.steady()).hit_rate, 1.0);
    // A plan with a shorter look-ahead reads no less, and reports that its figure is no bound.
    let order = ViewOrder::new(Order::Shuffle, 5, &survey.cameras);
    let options = ReplayOptions {
        frames: 102,
        policy: EvictPolicy::FarthestNextUse,
        reads_ahead: false,
        steps: 300,
        plan_bytes: 3000,
    };
    let short = replay(&pages, &vec![1 << 20; 256], &order, &options).unwrap();
    assert!(planned.is_exact && !short.is_exact && short.totals().0 > read);
    // A view with one page more than there are frames takes three batches there and two back; the others stay one batch.
    let options = ReplayOptions { frames: pages.most() - 1, plan_bytes: 1 << 28, ..options };
    let cut = replay(&pages, &vec![1 << 20; 256], &order, &options).unwrap();
    assert!(cut.is_exact && cut.totals().0 > read);
    let (read, written) = cut.totals();
    assert!(read - written > (options.frames as u64) << 20, "pages that are only rendered are evicted without a write");
    for (step, traffic) in cut.steps.iter().enumerate() {
        let pages = pages.of(order.clone().view_at(step as u32));
        assert_eq!(
            traffic.batches as usize,
            walk(pages, options.frames).count(),
            "step {step} of {} pages",
            pages.len()
        );
    }
    assert!(cut.steps.iter().any(|s| s.batches > 1) && cut.steps.iter().any(|s| s.batches == 1));
    let error = replay(&pages, &[], &order, &ReplayOptions { frames: 0, ..options }).unwrap_err();
    assert_eq!((error.needed, error.frames), (1, 0));
}

fn traffic(read: &[u64]) -> Replay {
    let step = |&bytes_read: &u64| StepTraffic {
        pages: 370,
        pages_read: (bytes_read / 10) as u32,
        bytes_read,
        bytes_written: bytes_read,
        ..StepTraffic::default()
    };
    Replay { steps: read.iter().map(step).collect(), views: 1000, is_exact: true }
}

#[test]
fn stalls_are_what_the_drive_cannot_do_in_time() {
    // A page of 10 bytes takes a second to read and a second to write; a step takes 2 s.
    let drive = DriveModel { read_rate: 10.0, write_rate: 10.0, step_seconds: 2.0 };
    // Frames become free at the start of the listed steps.
    let with = |read: &[u64], freed: &[usize], drive: &DriveModel| {
        let mut run = traffic(read);
        freed.iter().for_each(|&step| run.steps[step].frames_freed += 1);
        run.stall(0..read.len(), drive)
    };
    assert_eq!(with(&[10, 10, 10, 10], &[0, 0, 1, 2], &drive), Stall::default(), "the drive keeps up");
    // 30 bytes are 6 s of reading and writing, started with the previous step, which takes 2 s.
    let late = Stall { seconds: 4.0, worst_seconds: 4.0, steps: 1 };
    assert_eq!(with(&[0, 0, 0, 30], &[2, 2, 2], &drive), late);
    // Started two steps earlier the transfers cost nothing, even if the last frame is free one step later.
    assert_eq!(with(&[0, 0, 0, 30], &[0, 0, 0], &drive), Stall::default());
    assert_eq!(with(&[0, 0, 0, 30], &[0, 0, 2], &drive), Stall::default());
    // Prefetching does not make the drive faster: 4 s for each step of 2 s; the first two steps' reads start with step
    // 0.
    assert_eq!(with(&[0, 20, 20, 20], &[0; 6], &drive).seconds, 3.0 * 4.0 - 3.0 * 2.0);
    // One frame is free when the previous step has ended: its 2 s follow the other 4 s, which also end 2 s late.
    assert_eq!(with(&[0, 0, 0, 30], &[2, 2, 3], &drive).seconds, 4.0);
    assert_eq!(with(&[0, 0, 0, 20], &[2, 3], &drive).seconds, 2.0);
    // Any free frame serves the next read: the second step waits for the frame that the first has taken.
    assert_eq!(with(&[0, 0, 10, 10], &[0, 3], &drive).seconds, 2.0);
    // Pages that the import left in memory cause no wait.
    let mut begun = traffic(&[0, 0, 0, 30]);
    begun.steps[3] = StepTraffic { bytes_first: 30, pages_first: 3, bytes_written: 0, ..begun.steps[3] };
    assert_eq!((begun.stall(0..4, &drive), begun.read_by_run()), (Stall::default(), 0));
    // Steps before the range have used their frames and cause no wait.
    let mut run = traffic(&[20, 0, 20, 20]);
    [0, 0, 1, 1, 3, 3].into_iter().for_each(|step| run.steps[step].frames_freed += 1);
    assert_eq!(run.stall(1..4, &drive), Stall { seconds: 6.0, worst_seconds: 4.0, steps: 2 });
    let slow = DriveModel { step_seconds: 0.0, ..drive };
    assert_eq!(with(&[0, 20, 20], &[0, 0, 1, 1], &slow).seconds, 8.0);
}

/// A prefetching cache by a scan of all pages at every step: the frames that each step frees.
fn frames_freed(needed: &[BTreeSet<PageNo>], frames: usize) -> (Vec<u32>, u64, usize) {
    let next_use = |page: PageNo, step: usize| needed[step..].iter().position(|n| n.contains(&page)).map(|d| step + d);
    let mut held: BTreeMap<PageNo, usize> = BTreeMap::new();
    let (mut freed, mut read, mut spared) = (vec![0; needed.len()], 0, 0);
    for (step, pages) in needed.iter().enumerate() {
        let absent = pages.iter().filter(|p| !held.contains_key(p)).count();
        read += absent as u64;
        pages.iter().filter(|p| held.contains_key(p)).copied().collect::<Vec<_>>().into_iter().for_each(|p| {
            held.insert(p, step);
        });
        for _ in 0..(held.len() + absent).saturating_sub(frames) {
            // (next use, older, lower number): the greatest is evicted.
            let key = |(&page, &last): (&PageNo, &usize)| {
                (next_use(page, step + 1).unwrap_or(usize::MAX), Reverse(last), Reverse(page))
            };
            let others = held.iter().filter(|&(page, _)| !pages.contains(page));
            let best = others.clone().map(key).max().unwrap();
            let idle = others.filter(|&(_, &last)| last + 1 < step).map(key).max();
            let (_, Reverse(last), Reverse(page)) =
                idle.filter(|key| key.0 > step + FAR_STEPS as usize).unwrap_or(best);
            spared += usize::from(page != best.2.0);
            held.remove(&page);
            freed[(last + 1).max(step.saturating_sub(STEPS_AHEAD as usize))] += 1;
        }
        pages.iter().for_each(|&page| {
            held.insert(page, step);
        });
    }
    (freed, read, spared)
}

#[test]
fn frames_are_free_when_no_step_needs_them_and_pages_just_used_are_spared() {
    let survey = survey(120, 16, 0.12, 0.7);
    let views = ViewPages::new(&survey.index, &survey.cameras);
    let order = ViewOrder::new(Order::Groups(4), 3, &survey.cameras);
    let most = views.most();
    let (mut spared, mut busy) = (0, 0);
    for frames in [most, most + most / 4, 2 * most, 4 * most, 256] {
        let options = ReplayOptions {
            frames,
            policy: EvictPolicy::FarthestNextUse,
            reads_ahead: true,
            steps: 360,
            plan_bytes: 1 << 28,
        };
        let run = replay(&views, &vec![4096; 256], &order, &options).unwrap();
        let best = replay(&views, &vec![4096; 256], &order, &ReplayOptions { reads_ahead: false, ..options });
        let mut coming = order.clone();
        let needed: Vec<BTreeSet<PageNo>> =
            (0..360).map(|step| views.of(coming.view_at(step)).iter().copied().collect()).collect();
        let (freed, read, others) = frames_freed(&needed, frames);
        assert_eq!(run.steps.iter().map(|s| s.frames_freed).collect::<Vec<_>>(), freed, "{frames} frames");
        let reads = |run: &Replay| run.steps.iter().map(|s| u64::from(s.pages_read)).sum::<u64>();
        assert_eq!(reads(&run), read);
        let least = reads(&best.unwrap());
        // At most one read in FAR_STEPS for each frame.
        assert!((least..=least + 360 / u64::from(FAR_STEPS) * frames as u64).contains(&read), "{read} {least}");
        (spared, busy) = (spared + others, busy + freed.iter().filter(|&&f| f > 0).count());
    }
    assert!(spared > 100 && busy > 400, "hardly tested: {spared} {busy}");
}

#[test]
fn figures_name_the_worst_window_and_the_heaviest_steps() {
    let mut read = vec![10u64; 100];
    read[40..60].fill(100);
    read[50] = 1000;
    let figures = traffic(&read).figures(0..100);
    assert_eq!((figures.worst_window, figures.worst_per_step), (40, 2.0 * 2900.0 / 20.0));
    // 5 of 100 steps: 1000 and four times 100, of 800 + 19 x 100 + 1000.
    assert!((figures.heaviest_share - 1400.0 / 3700.0).abs() < 1e-12);
    assert_eq!((figures.hit_rate, figures.read_per_step), (0.99, 37.0));
    assert_eq!(traffic(&read).figures(70..80).worst_window, 70);
}

#[test]
fn the_automatic_order_gives_up_randomness_only_for_bytes() {
    let survey = survey(400, 32, 0.07, 0.7);
    let views = ViewPages::new(&survey.index, &survey.cameras);
    let auto = |frames| automatic_order(&views, &survey.cameras, 1024, frames, 1, 1 << 28);
    assert_eq!(auto(1024), Ok(Order::Shuffle));
    let groups = |frames| match auto(frames).unwrap() {
        Order::Groups(groups) => groups,
        Order::Shuffle => 1,
        Order::Tour => panic!("a tour with {frames} frames"),
    };
    let (tight, half, ample) = (groups(views.most() + 20), groups(512), groups(950));
    assert!(tight >= 16 && (2..=9).contains(&half), "{tight} groups in a small cache, {half} in half of the pages");
    assert_eq!(ample, 1, "what a shuffle reads with nearly all pages in memory is no reason to give it up");
    // Views of several batches read most of their pages twice in any order, so that no order is worth its price.
    assert_eq!(auto(20), Ok(Order::Shuffle));
}
