//! The visibility test of pages against the test of rows: every row that the row test would draw lies in a listed page.

use crate::support::random_rotation;
use gsscale::base::ids::{PageId, PageNo};
use gsscale::base::rng::{Purpose, Stream};
use gsscale::scene::camera::Camera;
use gsscale::scene::frustum::Frustum;
use gsscale::scene::page_meta::{PageBounds, PageMeta};
use gsscale::schedule::visibility::visible_pages;

#[derive(Clone, Copy)]
struct Row {
    mean: [f32; 3],
    sigma_max: f32,
}

fn bounds_of(rows: &[Row]) -> PageBounds {
    rows.iter().fold(PageBounds::EMPTY, |b, row| PageBounds {
        lo: std::array::from_fn(|i| b.lo[i].min(row.mean[i])),
        hi: std::array::from_fn(|i| b.hi[i].max(row.mean[i])),
        sigma_max: b.sigma_max.max(row.sigma_max),
    })
}

fn meta(page: usize, bounds: PageBounds) -> PageMeta {
    PageMeta { id: PageId::initial(page as u32), rows: 1, sh_degree: 0, events_applied: 0, bounds }
}

/// A random camera: any direction, wide to narrow, principal points up to far outside the image, small and large
/// worlds.
fn camera(draws: &mut Stream) -> Camera {
    let r = random_rotation(draws);
    let far_out = libm::pow(10.0, draws.range(-1.0, 4.0));
    let viewmat =
        std::array::from_fn(|i| [r[i][0] as f32, r[i][1] as f32, r[i][2] as f32, (draws.normal() * far_out) as f32]);
    let (width, height) = (16 + draws.below(4000) as u32, 16 + draws.below(3000) as u32);
    let f = f64::from(width) * draws.range(0.2, 3.0);
    let near = libm::pow(10.0, draws.range(-3.0, 1.0));
    let [fy, cx, cy] = [
        f * draws.range(0.7, 1.4),
        f64::from(width) * draws.range(-0.6, 1.6),
        f64::from(height) * draws.range(-0.6, 1.6),
    ];
    let far_plane = if draws.below(2) == 0 { 1e10 } else { (near * draws.range(2.0, 1e4)) as f32 };
    let pinhole = Camera::pinhole(viewmat, [f, fy, cx, cy].map(|x| x as f32), [width, height]);
    Camera { near_plane: near as f32, far_plane, ..pinhole }
}

/// Rows of one page: a cluster of any size anywhere around the camera, sigmas from nothing to larger than the world.
fn cluster(draws: &mut Stream, around: [f32; 3], world: f64) -> Vec<Row> {
    let away = world * libm::pow(10.0, draws.range(-2.0, 1.0));
    let centre: [f64; 3] = std::array::from_fn(|i| f64::from(around[i]) + away * draws.normal());
    let extent = world * libm::pow(10.0, draws.range(-6.0, 0.5));
    let sigma = world * libm::pow(10.0, draws.range(-7.0, 0.7));
    let row = |draws: &mut Stream| Row {
        mean: std::array::from_fn(|i| (centre[i] + extent * draws.normal()) as f32),
        sigma_max: (sigma * draws.uniform()) as f32,
    };
    (0..1 + draws.below(24)).map(|_| row(draws)).collect()
}

#[test]
fn no_row_that_may_be_drawn_lies_in_a_page_that_is_not_listed() {
    let mut draws = Stream::new(1, Purpose::Test, 40, 0);
    let (mut drawn_pages, mut listed_pages, mut all_pages, mut list) = (0, 0, 0, Vec::new());
    for _ in 0..400 {
        let camera = camera(&mut draws);
        let frustum = Frustum::new(&camera);
        let world = f64::from(camera.viewmat[0][3].abs().max(0.1));
        let pages: Vec<Vec<Row>> = (0..203).map(|_| cluster(&mut draws, camera.centre(), world)).collect();
        let index: Vec<PageMeta> = pages.iter().enumerate().map(|(p, rows)| meta(p, bounds_of(rows))).collect();
        visible_pages(&index, &camera, &mut list);
        assert!(list.windows(2).all(|pair| pair[0] < pair[1]));
        for (page, rows) in pages.iter().enumerate() {
            let is_listed = list.binary_search(&PageNo(page as u32)).is_ok();
            // The scalar and the SIMD form are the same test.
            assert_eq!(frustum.planes().may_intersect(&index[page].bounds), is_listed);
            let drawn = rows.iter().any(|row| frustum.may_draw(row.mean, row.sigma_max));
            assert!(is_listed || !drawn, "page {page} of {camera:?}");
            drawn_pages += usize::from(drawn);
        }
        listed_pages += list.len();
        all_pages += pages.len();
    }
    // Boxes are wider than their rows, and one test covers a page: it still leaves out most pages that are not drawn.
    assert!(drawn_pages > 10_000 && drawn_pages * 3 < all_pages * 2, "{drawn_pages} of {all_pages}");
    assert!(listed_pages - drawn_pages < (all_pages - drawn_pages) / 6, "{listed_pages} listed for {drawn_pages}");
}

/// Moves a row from inside to outside until the row test flips between two neighbouring values, where roundings decide.
/// Asks for its page there: with the row alone, and with the row as the innermost of rows that reach outwards.
#[test]
fn the_last_row_that_is_drawn_is_in_a_listed_page() {
    let mut draws = Stream::new(2, Purpose::Test, 40, 0);
    let (mut flips, mut list) = (0, Vec::new());
    for _ in 0..10_000 {
        let camera = camera(&mut draws);
        let frustum = Frustum::new(&camera);
        let world = f64::from(camera.viewmat[0][3].abs().max(0.1));
        let [a, b] = [0; 2].map(|_| cluster(&mut draws, camera.centre(), world)[0]);
        let at = |t: f64| Row {
            mean: std::array::from_fn(|i| {
                let (from, to) = (f64::from(a.mean[i]), f64::from(b.mean[i]));
                (from + t * (to - from)) as f32
            }),
            sigma_max: a.sigma_max,
        };
        let is_drawn = |t: f64| frustum.may_draw(at(t).mean, a.sigma_max);
        if !is_drawn(0.0) || is_drawn(1.0) {
            continue;
        }
        let (mut inside, mut outside) = (0.0, 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (inside + outside);
            if is_drawn(middle) { inside = middle } else { outside = middle }
        }
        flips += 1;
        let index =
            [meta(0, bounds_of(&[at(inside)])), meta(1, bounds_of(&[at(inside), at(outside), at(1.0), at(1.5)]))];
        visible_pages(&index, &camera, &mut list);
        assert_eq!(list, [PageNo(0), PageNo(1)], "{camera:?}");
    }
    assert!(flips > 500, "{flips}");
}

#[test]
fn pages_without_rows_are_never_needed_and_unusable_bounds_always() {
    let mut draws = Stream::new(3, Purpose::Test, 40, 0);
    let mut list = Vec::new();
    let everywhere = PageBounds { lo: [f32::NEG_INFINITY; 3], hi: [f32::INFINITY; 3], sigma_max: 1.0 };
    let huge = PageBounds { lo: [1.0; 3], hi: [2.0; 3], sigma_max: f32::INFINITY };
    let unknown = PageBounds { lo: [f32::NAN; 3], hi: [f32::NAN; 3], sigma_max: 0.0 };
    for pages in [4, 40] {
        let cycle = [PageBounds::EMPTY, everywhere, huge, unknown].into_iter().cycle().take(pages);
        let index: Vec<PageMeta> = cycle.enumerate().map(|(p, bounds)| meta(p, bounds)).collect();
        for _ in 0..100 {
            let camera = camera(&mut draws);
            visible_pages(&index, &camera, &mut list);
            let kinds: [usize; 4] = std::array::from_fn(|kind| list.iter().filter(|p| p.index() % 4 == kind).count());
            assert_eq!(kinds, [0, pages / 4, pages / 4, pages / 4]);
        }
    }
}
