//! Whole runs of the cache on made-up aerial surveys.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

use gsscale::base::ids::PageId;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::scene::camera::Camera;
use gsscale::scene::page_meta::{PageBounds, PageMeta};
use gsscale::schedule::model::Policy;
use gsscale::schedule::order::{Order, ViewOrder};
use gsscale::schedule::replay::{Replay, ReplayOptions, replay};
use gsscale::schedule::visibility::ViewPages;

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
    Camera {
        viewmat: [row(right), row(down), row(forward)],
        fx: 900.0,
        fy: 900.0,
        cx: 500.0,
        cy: 375.0,
        width: 1000,
        height: 750,
        near_plane: 0.1,
        far_plane: 1e10,
    }
}

/// Square city of side 1 in `side` x `side` pages of ground; strips of views across it.
struct Survey {
    index: Vec<PageMeta>,
    cameras: Vec<Camera>,
}

/// `views` views, each of which sees about `share` of the city, from two crossing passes when tilted.
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

fn run(survey: &Survey, pages: &ViewPages, order: Order, policy: Policy, cache: f64, epochs: u32) -> Replay {
    let order = ViewOrder::new(order, 5, &survey.cameras);
    let bytes = vec![1 << 20; survey.index.len()];
    let frames = (cache * survey.index.len() as f64) as usize;
    let steps = survey.cameras.len() as u32 * epochs;
    replay(pages, &bytes, &order, &ReplayOptions { frames, policy, steps, plan_bytes: 1 << 30 }).unwrap()
}

/// Prints the table of the design; not a test of anything.
#[test]
#[ignore = "prints the table of orders"]
fn table() {
    for (name, tilt) in [("vertical", 0.0), ("tilted", 0.7)] {
        let survey = survey(1000, 64, 0.07, tilt);
        let began = std::time::Instant::now();
        let pages = ViewPages::new(&survey.index, &survey.cameras);
        let share = pages.total() as f64 / 1000.0 / 4096.0;
        println!("{name}: share {share:.3}, most {}, {:?}", pages.most(), began.elapsed());
        for order in ["groups:4", "groups:9", "groups:25", "groups:100", "tour"] {
            let mut line = format!("{order:12}");
            for cache in [0.13, 0.25, 0.5] {
                let figures = Policy::ALL.map(|policy| {
                    let replay = run(&survey, &pages, order.parse().unwrap(), policy, cache, 4);
                    assert!(replay.is_exact);
                    replay.figures(replay.steady())
                });
                let [b, l] = figures;
                line += &format!(
                    " | lru {:.3} belady {:.3} top5 {:.2}",
                    1.0 - l.hit_rate,
                    1.0 - b.hit_rate,
                    b.heaviest_share
                );
            }
            println!("{line}");
        }
    }
}
