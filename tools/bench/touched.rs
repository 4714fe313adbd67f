//! `gsscale-bench touched`: how fast forwarding and the optimizer go through the bytes that they touch, beside a plain
//! copy on the same machine.
//!
//! Forwarding (a step's gather) reads value and both moments of every listed row, moves the value to now and writes it into
//! the working set; the optimizer reads that value, both moments and a gradient, and writes value and moments. That is 4
//! and 7 floats a parameter.
//! The optimizer also fetches the old value's line, which it overwrites in parts; that is not counted.
//! A large copy writes past the caches; whoever computes what it writes fetches it first. So beside the copy stand two
//! passes of plain additions over as many tables, read and written alike: what there is to reach.
//! Rows lie in pages as in a run; those that are listed are drawn, or are what views of a scene see before its first step.
//! All are timed in turns, so that whatever else the machine does hits them alike.
//! Prints one line of JSON for each share of rows that is listed, or for each view.

use super::statistics::{extend, median};
use clap::Parser;
use gsscale::base::error::InputError;
use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::config::file::{TrainConfig, TrainOverrides};
use gsscale::config::limits::RunOptions;
use gsscale::dataset::loader::Dataset;
use gsscale::densify::strategy::StrategyName;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::paging::pinned::PinnedPage;
use gsscale::scene::columns::{Column, Columns, row_width};
use gsscale::train::catch_up::{gather, visible_rows};
use gsscale::train::error::TrainError;
use gsscale::train::pages::{PagedScene, numbered};
use gsscale::train::prepare::prepare;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::hint::black_box;
use std::path::PathBuf;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  gsscale-bench touched
  gsscale-bench touched --rows 2000000 --rounds 21 --listed 100,65,10 --threads 1
  gsscale-bench touched scans/city --views 5

65 % is about what views list of the rows in their pages. The copy is one of each thread's own floats, as many bytes in all
as the optimizer touches; bytes read and bytes written both count. The plain passes are additions that read and write
tables as forwarding and the optimizer do. Rows that a view sees lie in runs of rows_in_a_run on average; drawn ones, being apart,
use less of each line of memory. Takes 5 kB a row at degree 3, of a scene 1 kB and 4 kB for each row of a view.";

/// Steps from the oldest stamp to now: rows sleep that long at most.
const SLEEP_STEPS: u32 = 500;

/// Times forwarding and the optimizer against a plain copy and plain passes, and prints a line of JSON for each share of rows
/// or view.
#[derive(Parser)]
#[command(name = "gsscale-bench touched", bin_name = "gsscale-bench touched", version, after_help = EXAMPLES)]
pub struct Args {
    /// Scene whose views list the rows; without one, random rows in the order in which they were drawn
    scene: Option<PathBuf>,
    /// Views of the scene, evenly through its training views
    #[arg(long, default_value_t = 3, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), requires = "scene")]
    views: u32,
    /// Rows, without a scene
    #[arg(long, default_value_t = 500_000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "scene")]
    rows: u32,
    /// Times that each is measured
    #[arg(long, default_value_t = 15, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Rows that a step lists, in percent, without a scene
    #[arg(long, value_delimiter = ',', default_value = "100,65", value_name = "P", conflicts_with = "scene")]
    listed: Vec<f64>,
    /// Config file; flags override it
    #[arg(long)]
    config: Option<PathBuf>,
    #[command(flatten)]
    keys: TrainOverrides,
}

/// Rows in pages, of which some are pinned, all with a past.
struct World {
    scene: PagedScene,
    pages: Vec<PinnedPage>,
    /// The rows of the last forwarding.
    values: Columns,
    degree: u8,
    step: u32,
}

/// Measures.
///
/// # Errors
/// Bad input.
pub fn start(args: &Args, print: &mut dyn FnMut(&Value)) -> Result<(), TrainError> {
    let mut config = super::settle(args.config.as_deref(), &args.keys)?;
    if let Some(share) = args.listed.iter().find(|s| !(**s > 0.0 && **s <= 100.0)) {
        let problem = format!("{share} is no share");
        return Err(InputError::new("--listed", problem, "write for example 100,65").into());
    }
    // All bands are in use, and no row grows.
    config.sh_start = config.sh_degree;
    config.strategy = StrategyName::None;
    let Some(scene) = &args.scene else {
        let options = RunOptions::new(&config, 1.0);
        let mut world = World::new(&random_columns(args.rows as usize, options.sh_degree, 1.0, 1), &options)?;
        let all: Vec<PageNo> = (0..world.scene.pager.index().len() as u32).map(PageNo).collect();
        world.pin(&all)?;
        for &share in &args.listed {
            print(&line(args, &config, &mut world, &listed(args.rows, share / 100.0)));
        }
        return Ok(());
    };
    let prepared = prepare(scene, &config)?;
    let dataset = &prepared.dataset;
    let mut world = World::new(&prepared.columns, &RunOptions::new(&config, dataset.scene_scale))?;
    let views = dataset.train_views();
    let count = views.len().min(args.views as usize);
    // All before the first is measured, which moves rows.
    let lists: Result<Vec<_>, TrainError> =
        (0..count).map(|i| views[i * views.len() / count]).map(|view| Ok((view, world.seen(dataset, view)?))).collect();
    for (view, (pages, list)) in lists? {
        let mut line = match list.is_empty() {
            true => json!({ "rows_listed": 0 }),
            false => {
                world.pin(&pages)?;
                line(args, &config, &mut world, &list)
            }
        };
        extend(&mut line, &json!({ "scene": scene, "view": dataset.views[view].name }));
        print(&line);
    }
    Ok(())
}

/// What one list of the pinned rows costs.
fn line(args: &Args, config: &TrainConfig, world: &mut World, list: &[u32]) -> Value {
    let rows = world.rows();
    let mut line = world.measure(list, args.rounds);
    let facts = json!({
        "listed_percent": 100.0 * list.len() as f64 / rows as f64, "rows_listed": list.len(), "rows": rows,
        "rows_in_a_run": rows_in_a_run(list), "page_rows": config.page_rows, "sh_degree": world.degree,
        "rounds": args.rounds, "threads": rayon::current_num_threads(),
        "simd": gsscale::config::limits::simd_path(config).name(), "version": env!("CARGO_PKG_VERSION"),
    });
    extend(&mut line, &facts);
    line
}

/// Rows one after the other that are all listed, on average.
fn rows_in_a_run(list: &[u32]) -> f64 {
    let runs = list.windows(2).filter(|pair| pair[0] + 1 != pair[1]).count() + 1;
    list.len() as f64 / runs as f64
}

/// A share of the rows, drawn.
fn listed(rows: u32, share: f64) -> Vec<u32> {
    let mut draws = Stream::new(1, Purpose::Test, 7, 7);
    (0..rows).filter(|_| draws.uniform() < share).collect()
}

fn random_columns(rows: usize, degree: u8, scale: f64, number: u64) -> Columns {
    let mut columns = Columns::zeros(rows, degree);
    for (i, column) in Column::ALL.into_iter().enumerate() {
        columns.column_mut(column).par_chunks_mut(1 << 14).enumerate().for_each(|(chunk, values)| {
            let mut draws = Stream::new(number, Purpose::Test, i as u64, chunk as u64);
            values.iter_mut().for_each(|x| *x = draws.range(-scale, scale) as f32);
        });
    }
    columns
}

impl World {
    fn new(columns: &Columns, options: &RunOptions) -> Result<World, TrainError> {
        let degree = options.sh_degree;
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, degree));
        let scene = PagedScene::new(columns, pager, options)?;
        Ok(World { scene, pages: Vec::new(), values: Columns::zeros(0, degree), degree, step: 0 })
    }

    /// The pages of a view, and which of their rows it lists.
    fn seen(&mut self, dataset: &Dataset, view: usize) -> Result<(Vec<PageNo>, Vec<u32>), TrainError> {
        let camera = &dataset.views[view].camera;
        let numbers = self.scene.pager.pages_of_view(camera);
        let pages = self.scene.pager.acquire_pages(&numbers)?;
        let mut list = Vec::new();
        visible_rows(&numbered(&pages), &self.scene.rules.adam, self.step, camera, &mut list);
        self.scene.pager.release(pages);
        Ok((numbers, list))
    }

    /// Goes on with these pages. Each of their rows gets a past, a different one for every page.
    fn pin(&mut self, pages: &[PageNo]) -> Result<(), TrainError> {
        let mut before = std::mem::take(&mut self.pages);
        before.iter_mut().for_each(|page| page.dirty = true);
        self.scene.pager.release(before);
        self.pages = self.scene.pager.acquire_pages(pages)?;
        let everything: Vec<u32> = (0..self.rows() as u32).collect();
        let gradients = random_columns(everything.len(), self.degree, 1e-3, 2);
        // They may have one already, of an earlier view.
        self.fall_asleep();
        self.forward(&everything);
        self.optimize(&everything, &gradients);
        self.fall_asleep();
        Ok(())
    }

    /// Rows of the pinned pages.
    fn rows(&self) -> usize {
        self.pages.iter().map(|page| page.meta.rows as usize).sum()
    }

    /// Every row was touched last at a step of its own again: a call that is timed finds work to catch up with. The
    /// optimizer leaves all stamps at its step, so a second call would find none.
    fn fall_asleep(&mut self) {
        let mut draws = Stream::new(1, Purpose::Test, 8, 8);
        for page in &mut self.pages {
            let count = page.meta.rows as usize;
            let stamps = page.rows_mut(0).stamp;
            (0..count).for_each(|row| stamps[row] = 1 + draws.below(u64::from(SLEEP_STEPS)) as u32);
        }
        self.step = SLEEP_STEPS + 1;
    }

    /// The values of listed rows now.
    fn forward(&mut self, rows: &[u32]) {
        gather(&numbered(&self.pages), self.degree, &self.scene.rules.adam, self.step, rows, &mut self.values);
        black_box(&self.values);
    }

    /// The optimizer's step on the rows that were forwarded, page by page in parallel, as a training step does it.
    fn optimize(&mut self, rows: &[u32], gradients: &Columns) {
        let at = self.scene.rules.adam.at(self.step);
        let (mut rest, mut values, mut grads, mut first_row) = (rows, self.values.view(), gradients.view(), 0);
        let mut shares = Vec::with_capacity(self.pages.len());
        for page in &mut self.pages {
            let first = first_row;
            first_row += page.meta.rows as usize;
            let count = rest.partition_point(|&row| (row as usize) < first_row);
            let (own, rest_rows) = rest.split_at(count);
            let (own_values, rest_values) = values.split_at(count);
            let (own_grads, rest_grads) = grads.split_at(count);
            shares.push((page, first, own, own_values, own_grads));
            (rest, values, grads) = (rest_rows, rest_values, rest_grads);
        }
        shares.into_par_iter().for_each(|(page, first, own, own_values, own_grads)| {
            at.step_rows(page.rows_mut(first), own, own_values, own_grads);
        });
        self.step += 1;
    }

    fn measure(&mut self, rows: &[u32], rounds: u32) -> Value {
        let parameters = (rows.len() * row_width(self.degree)) as f64;
        // Values, moments and gradients, and the stamps.
        let stamps = 4.0 * rows.len() as f64;
        let touched = [4.0 * 4.0 * parameters + stamps, 7.0 * 4.0 * parameters + 2.0 * stamps];
        let gradients = random_columns(rows.len(), self.degree, 1e-3, 3);
        let mut copy = PlainCopy::new(touched[1] as usize / 8);
        let mut plain = PlainPasses::new(rows.len() * row_width(self.degree));
        let bytes = [touched[0], touched[1], copy.bytes(), plain.floats() * 16.0, plain.floats() * 28.0];
        let mut rates: [Vec<f64>; 5] = Default::default();
        // The first round takes memory from the system and is not counted.
        for round in 0..=rounds {
            self.fall_asleep();
            let seconds = [
                timed(|| self.forward(rows)),
                timed(|| self.optimize(rows, &gradients)),
                timed(|| copy.run()),
                timed(|| plain.forward()),
                timed(|| plain.optimize()),
            ];
            if round > 0 {
                (0..5).for_each(|i| rates[i].push(bytes[i] / seconds[i]));
            }
        }
        let both = |[forwarding, optimizer]: [usize; 2]| -> Vec<f64> {
            let seconds = |i: usize| touched[0] / rates[forwarding][i] + touched[1] / rates[optimizer][i];
            (0..rounds as usize).map(|i| (touched[0] + touched[1]) / seconds(i)).collect()
        };
        let ratio = |own: &[f64], other: &[f64]| median(own.iter().zip(other).map(|(own, other)| own / other));
        let [forwarding, optimizer, copied, plain_forwarding, plain_optimizer] = &rates;
        json!({
            "forwarding_bytes_per_second": median(forwarding.iter().copied()),
            "optimizer_bytes_per_second": median(optimizer.iter().copied()),
            "copy_bytes_per_second": median(copied.iter().copied()),
            "plain_forwarding_bytes_per_second": median(plain_forwarding.iter().copied()),
            "plain_optimizer_bytes_per_second": median(plain_optimizer.iter().copied()),
            "forwarding_over_copy": ratio(forwarding, copied), "optimizer_over_copy": ratio(optimizer, copied),
            "both_over_copy": ratio(&both([0, 1]), copied),
            "forwarding_over_plain": ratio(forwarding, plain_forwarding),
            "optimizer_over_plain": ratio(optimizer, plain_optimizer),
            "both_over_plain": ratio(&both([0, 1]), &both([3, 4])),
        })
    }
}

fn timed(work: impl FnOnce()) -> f64 {
    let began = Instant::now();
    work();
    began.elapsed().as_secs_f64()
}

/// A copy of floats, one stretch for each thread.
struct PlainCopy {
    pairs: Vec<(Vec<f32>, Vec<f32>)>,
}

impl PlainCopy {
    /// Of this many floats in all.
    fn new(floats: usize) -> PlainCopy {
        let threads = rayon::current_num_threads();
        let each = floats.div_ceil(threads).max(1);
        PlainCopy { pairs: (0..threads).map(|_| (vec![1.0; each], vec![0.0; each])).collect() }
    }

    /// Read and written.
    fn bytes(&self) -> f64 {
        self.pairs.iter().map(|(from, _)| 8.0 * from.len() as f64).sum()
    }

    fn run(&mut self) {
        self.pairs.par_iter_mut().for_each(|(from, to)| to.copy_from_slice(black_box(from)));
        black_box(&self.pairs);
    }
}

/// Additions over five tables of floats, one stretch for each thread.
struct PlainPasses {
    tables: Vec<[Vec<f32>; 5]>,
}

impl PlainPasses {
    /// Over tables of this many floats in all.
    fn new(floats: usize) -> PlainPasses {
        let threads = rayon::current_num_threads();
        let each = floats.div_ceil(threads).max(1);
        PlainPasses { tables: (0..threads).map(|_| std::array::from_fn(|_| vec![1.0; each])).collect() }
    }

    /// Floats of a table, all stretches.
    fn floats(&self) -> f64 {
        self.tables.iter().map(|[a, ..]| a.len() as f64).sum()
    }

    /// As forwarding: reads value and moments, writes what they come to.
    fn forward(&mut self) {
        self.tables.par_iter_mut().for_each(|[value, m, v, now, _]| forward_plainly(value, m, v, now));
        black_box(&self.tables);
    }

    /// As the optimizer: reads what they came to, moments and gradients, writes value and moments.
    fn optimize(&mut self) {
        self.tables.par_iter_mut().for_each(|[value, m, v, now, grads]| optimize_plainly(value, m, v, now, grads));
        black_box(&self.tables);
    }
}

fn forward_plainly(value: &[f32], m: &[f32], v: &[f32], now: &mut [f32]) {
    for (((value, m), v), now) in value.iter().zip(m).zip(v).zip(now) {
        *now = *value + *m + *v;
    }
}

fn optimize_plainly(value: &mut [f32], m: &mut [f32], v: &mut [f32], now: &[f32], grads: &[f32]) {
    for ((((value, m), v), now), g) in value.iter_mut().zip(m).zip(v).zip(now).zip(grads) {
        (*value, *m, *v) = (*now + *g, *m + *g, *v + *g);
    }
}
