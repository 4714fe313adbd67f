//! The gather and the optimizer on randomly chosen rows, against the bandwidth of a plain copy.
//!
//! Per parameter, the gather moves 4 floats: it reads value and both moments, applies deferred Adam, and writes the
//! value to the working set. The optimizer moves 7 floats: it reads value, both moments and gradient, and writes value
//! and moments. Before each round every row gets the stamp of a random earlier step, so that the gather has deferred
//! updates to apply. (Views of a scene list neighbouring rows; the parts `gather` and `adam+statistics+bounds` of a
//! whole step measure that case.)

use super::{checked, median, paged, terrain, time};
use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::base::simd::SimdPath;
use gsscale::optim::row_kernels::step_rows;
use gsscale::paging::pinned::PinnedPage;
use gsscale::scene::columns::{Column, Columns, row_width};
use gsscale::train::step::catch_up::gather;
use gsscale::train::step::pages::{PagedScene, row_tables};
use serde_json::{Value, json};
use std::hint::black_box;

/// Largest age of a stamp, steps.
const SLEEP_STEPS: u32 = 500;

/// CPU seconds and bytes for one list of rows.
#[derive(Debug, Clone, Copy)]
pub struct Touched {
    listed: usize,
    gather_seconds: f64,
    optimizer_seconds: f64,
    bytes: f64,
}

impl Touched {
    /// Bytes per CPU second and thread, divided by the rate of a copy.
    pub fn share_of_copy(&self, copy_rate: f64) -> f64 {
        self.bytes / (self.gather_seconds + self.optimizer_seconds) / copy_rate
    }

    /// A line of text.
    pub fn text(&self, name: &str, copy_rate: f64) -> String {
        format!(
            "{name}: {} rows, gather {:.2} ms CPU, optimizer {:.2} ms CPU, {:.0} % of copy bandwidth",
            self.listed,
            1e3 * self.gather_seconds,
            1e3 * self.optimizer_seconds,
            100.0 * self.share_of_copy(copy_rate)
        )
    }

    /// A line of JSON.
    pub fn json(&self, name: &str, copy_rate: f64) -> Value {
        json!({
            "case": name, "rows": self.listed, "gather_cpu_seconds": self.gather_seconds,
            "optimizer_cpu_seconds": self.optimizer_seconds, "bytes": self.bytes,
            "share_of_copy": self.share_of_copy(copy_rate),
        })
    }
}

/// Medians of `rounds` rounds over `percent` of `rows` rows in pages.
pub fn touched(rows: usize, percent: u32, rounds: usize, simd: SimdPath) -> Touched {
    let (mut scene, options) = paged(&terrain(rows, 64, 64).0, 1.0, simd);
    let all: Vec<PageNo> = (0..scene.pager.index().len() as u32).map(PageNo).collect();
    let mut pages = checked(scene.pager.acquire_pages(&all));
    let mut draws = Stream::new(1, Purpose::Test, 7, 7);
    let list: Vec<u32> = (0..rows as u32).filter(|_| draws.below(100) < u64::from(percent)).collect();
    let mut gradients = Columns::zeros(list.len(), options.sh_degree);
    for column in Column::ALL {
        gradients.column_mut(column).iter_mut().for_each(|x| *x = draws.range(-1e-3, 1e-3) as f32);
    }
    let mut values = Columns::zeros(0, options.sh_degree);
    let mut measured = Vec::new();
    // The first round creates the moments and allocates memory; it does not count.
    for _ in 0..=rounds {
        let now = fall_asleep(&mut pages);
        let gathered = time(|| {
            gather(&row_tables(&pages), options.sh_degree, &scene.rules.adam, now, &list, &mut values);
            black_box(&values);
        });
        let optimized = time(|| optimize(&mut pages, &scene, now, &list, &values, &gradients));
        measured.push([gathered.cpu, optimized.cpu]);
    }
    scene.pager.release(pages);
    // Four and seven floats a parameter; the gather reads the stamps, the optimizer reads and writes them.
    let bytes = 4.0 * list.len() as f64 * (11.0 * row_width(options.sh_degree) as f64 + 3.0);
    let [gather_seconds, optimizer_seconds] = [0, 1].map(|part| median(measured[1..].iter().map(|m| m[part])));
    Touched { listed: list.len(), gather_seconds, optimizer_seconds, bytes }
}

/// Stamps every row with an earlier step; returns the step after all stamps.
fn fall_asleep(pages: &mut [PinnedPage]) -> u32 {
    let mut draws = Stream::new(1, Purpose::Test, 8, 8);
    for page in pages {
        let count = page.meta.rows as usize;
        let stamps = page.rows_mut(0).stamp;
        stamps[..count].iter_mut().for_each(|stamp| *stamp = 1 + draws.below(u64::from(SLEEP_STEPS)) as u32);
    }
    SLEEP_STEPS + 1
}

/// The optimizer step on the gathered rows, pages in parallel, as in training.
fn optimize(
    pages: &mut [PinnedPage],
    scene: &PagedScene,
    now: u32,
    rows: &[u32],
    values: &Columns,
    gradients: &Columns,
) {
    let at = scene.rules.adam.at(now);
    let (mut rest, mut values, mut gradients, mut end) = (rows, values.view(), gradients.view(), 0);
    rayon::scope(|scope| {
        for page in pages {
            let first = end;
            end += page.meta.rows as usize;
            let count = rest.partition_point(|&row| (row as usize) < end);
            let (own, rest_rows) = rest.split_at(count);
            let (own_values, rest_values) = values.split_at(count);
            let (own_gradients, rest_gradients) = gradients.split_at(count);
            (rest, values, gradients) = (rest_rows, rest_values, rest_gradients);
            let at = &at;
            scope.spawn(move |_| {
                step_rows(at, page.rows_mut(first), own, own_values, own_gradients);
            });
        }
    });
}
