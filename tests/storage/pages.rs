//! Scenes in pages: events replayed late, by pages that split and widen, give the rows of events applied on time. The
//! bounds of a page stay valid until the page is changed.

use crate::support::apply_event::apply_event;
use crate::support::rounds::{SEED, adam, scene, touch};
use gsscale::base::ids::PageId;
use gsscale::base::rng::{Purpose, Stream, hash64};
use gsscale::densify::default::DefaultStrategy;
use gsscale::densify::long_axis::{GrowthScore, LongAxisStrategy};
use gsscale::densify::mcmc::McmcStrategy;
use gsscale::densify::ops::child_uid;
use gsscale::densify::replay::{PageEdit, PageFacts, PendingEvents};
use gsscale::densify::stats::{DrawnRows, GradHistogram, WEIGHED_VIEWS, accumulate};
use gsscale::densify::strategy::{Effect, Extremes, RoundSteps, RowCount, Strategy, effect_of};
use gsscale::optim::bounds::{SplitLimits, lowest_opacity, page_bounds};
use gsscale::optim::deferred::DeferredAdam;
use gsscale::optim::moments::Moments;
use gsscale::optim::row_kernels::take_step;
use gsscale::scene::columns::{Column, Columns, Gradients};
use gsscale::scene::events::{Event, EventKind, EventLog, LongAxisRound, RelocationRound, RoundThresholds};
use gsscale::scene::page_layout::{PageLayout, capacity_bytes, read_page, write_page};
use gsscale::scene::partition::{first_fill, partition};
use gsscale::scene::rows::mean_grad2d;
use gsscale::scene::sightings::{mean_weight, views};
use gsscale::scene::state::SceneState;
use gsscale::train::step::catch_up::evaluate_all;
use std::collections::{BTreeMap, HashMap};

const STEPS: u32 = 260;

/// Every row as (values, moments, stamp, statistics) by uid: these must agree bit for bit.
fn by_uid<'s>(states: impl IntoIterator<Item = &'s SceneState>) -> BTreeMap<u64, Vec<u32>> {
    let mut rows = BTreeMap::new();
    for state in states {
        for row in 0..state.rows() {
            let mut bits = vec![state.stamp[row], state.grad2d[row].to_bits(), state.count[row]];
            for table in [&state.columns, &state.exp_avg, &state.exp_avg_sq] {
                Column::ALL.iter().for_each(|&c| bits.extend(table.row(c, row).iter().map(|x| x.to_bits())));
            }
            assert!(rows.insert(state.uid[row], bits).is_none(), "uid {} twice", state.uid[row]);
        }
    }
    rows
}

/// Whether the rows that descend from the first rows of this group are drawn at a step.
fn is_drawn(root: u64, uid: u64, step: u32) -> bool {
    hash64(&[root % 16, u64::from(step), 1]).is_multiple_of(19) && !hash64(&[uid, u64::from(step), 2]).is_multiple_of(3)
}

/// A scene trained in one table with every event applied at once, and its history.
struct OnTime<'a> {
    adam: &'a DeferredAdam,
    strategy: &'a dyn Strategy,
    state: SceneState,
    log: EventLog,
    /// Gradients of the rows since the last round.
    histogram: GradHistogram,
    /// Histogram before each event.
    histograms: Vec<GradHistogram>,
    /// The first ancestor of each row.
    root_from_uid: HashMap<u64, u64>,
}

impl<'a> OnTime<'a> {
    fn new(start: &SceneState, adam: &'a DeferredAdam, strategy: &'a dyn Strategy) -> OnTime<'a> {
        OnTime {
            adam,
            strategy,
            state: start.clone(),
            log: EventLog::default(),
            histogram: GradHistogram::default(),
            histograms: Vec::new(),
            root_from_uid: start.uid.iter().map(|&u| (u, u)).collect(),
        }
    }

    fn step(&mut self, step: u32) {
        let (root_from_uid, by) = (&self.root_from_uid, (self.adam, self.strategy));
        touch(&mut self.state, by, step, &mut self.histogram, |uid| is_drawn(root_from_uid[&uid], uid, step));
    }

    fn apply(&mut self, event: Event) {
        let index = self.log.push(event);
        for uid in &self.state.uid {
            let root = self.root_from_uid[uid];
            self.root_from_uid.extend((0..2).map(|child| (child_uid(*uid, index as u64, child), root)));
        }
        self.histograms.push(self.histogram.clone());
        apply_event(&mut self.state, self.adam, SEED, index, &event);
        if matches!(effect_of(&event.kind), Effect::Round(_)) {
            self.histogram.clear();
        }
    }
}

const ROUNDS: RoundSteps = RoundSteps { start: 20, stop: 240, every: 30 };

fn densify(max_gaussians: u64) -> DefaultStrategy {
    DefaultStrategy { rounds: ROUNDS, reset_every: 70, grow_grad2d: 2e-4, max_gaussians, ..DefaultStrategy::default() }
}

/// Splits along the longest axis, and recycling of a tenth of the weighed rows.
fn long_axis(max_gaussians: u64) -> LongAxisStrategy {
    LongAxisStrategy {
        score: GrowthScore::Mixed,
        recycle: 0.1,
        prune_opa: 0.005,
        rounds: ROUNDS,
        checks: ROUNDS,
        shares_room: false,
        max_gaussians,
        growth: None,
    }
}

fn mcmc(max_gaussians: u64) -> McmcStrategy {
    McmcStrategy {
        dead_opacity: 0.005,
        rounds: ROUNDS,
        max_gaussians,
        seed: SEED,
        scene_scale: 1.0,
        rates: *adam(1.0).rates(),
    }
}

fn on_time<'a>(start: &SceneState, adam: &'a DeferredAdam, strategy: &'a dyn Strategy) -> OnTime<'a> {
    let mut whole = OnTime::new(start, adam, strategy);
    for step in 0..STEPS {
        whole.step(step);
        let rows = whole.state.rows() as u64;
        let mut kinds: Vec<EventKind> = strategy.events_after(step, 1.0, RowCount::unlimited(rows), &whole.histogram);
        if step % 85 == 84 {
            kinds.push(EventKind::RaiseShDegree { degree: (step / 85) as u8 + 1 });
        }
        kinds.into_iter().for_each(|kind| whole.apply(Event { step, kind }));
    }
    whole
}

/// A page as a trainer keeps it: its rows in bytes.
struct Page {
    layout: PageLayout,
    payload: Vec<u64>,
    applied: usize,
}

impl Page {
    fn new(state: &SceneState, page_rows: usize, applied: usize) -> Page {
        assert!(state.rows() <= page_rows);
        let mut payload = vec![0; capacity_bytes(page_rows, 3).div_ceil(8)];
        let layout = write_page(state, bytemuck::cast_slice_mut(&mut payload));
        Page { layout, payload, applied }
    }

    fn state(&self) -> SceneState {
        read_page(&self.layout.rows(bytemuck::cast_slice(&self.payload), 0))
    }
}

/// The same training in pages that apply events when they are acquired: drawn pages, and random others.
struct InPages<'a> {
    adam: &'a DeferredAdam,
    strategy: &'a dyn Strategy,
    page_rows: usize,
    pages: BTreeMap<PageId, Page>,
    histogram: GradHistogram,
    /// Upper bound on the rows after all pages have applied all events.
    rows_bound: i64,
    /// Number of pages that were split, and of pages that events left unchanged.
    splits: usize,
    unchanged: usize,
    /// Pages of which it was known before that their statistics would be cleared and nothing else would change.
    foretold: usize,
}

/// What a device would find out about a page.
fn facts_of(state: &SceneState, adam: &DeferredAdam) -> PageFacts {
    let rows = state.view();
    let means = rows.grad2d.iter().zip(rows.count).map(|(&grad2d, &count)| mean_grad2d(grad2d, count));
    let sigma_max = page_bounds(adam, &rows, &SplitLimits::NEVER).sigma_max;
    let weights = rows.count.iter().filter(|&&word| views(word) >= WEIGHED_VIEWS).filter_map(|&word| mean_weight(word));
    PageFacts {
        largest_mean: means.fold(0.0, f32::max),
        least_weight: weights.fold(f32::INFINITY, f32::min),
        extremes: Extremes { lowest_opacity: lowest_opacity(adam, &rows), sigma_max },
        sh_degree: state.sh_degree(),
    }
}

impl InPages<'_> {
    fn acquire(&mut self, id: PageId, log: &EventLog) -> Vec<PageId> {
        let page = self.pages.get_mut(&id).unwrap();
        let pending = PendingEvents::new(self.adam, SEED, self.page_rows, log);
        let before = page.state();
        let facts = facts_of(&before, self.adam);
        let only_clears = self.strategy.collects_on_device() && pending.only_clears(page.applied, &facts);
        let mut rows = page.layout.rows_mut(bytemuck::cast_slice_mut(&mut page.payload), 0);
        let replay = pending.apply(id, page.applied, &mut rows).unwrap();
        page.applied = log.len();
        for round in &replay.rounds {
            self.rows_bound += round.rows_change - round.promised as i64;
        }
        let is_same = page.state() == before;
        if only_clears {
            self.foretold += 1;
            assert!(matches!(replay.edit, PageEdit::Unchanged | PageEdit::Cleared), "{:?}", replay.edit);
            assert!(replay.rounds.iter().all(|round| (round.rows_change, round.promised) == (0, 0)));
        }
        match replay.edit {
            PageEdit::Unchanged => assert!(is_same),
            PageEdit::InPlace => assert!(!is_same),
            PageEdit::Cleared => {
                let mut cleared = before;
                cleared.grad2d.fill(0.0);
                cleared.count.fill(0);
                assert!(!is_same && page.state() == cleared);
            }
            PageEdit::Replaced(parts) => {
                self.splits += parts.len() - 1;
                self.pages.remove(&id);
                for (id, state) in &parts {
                    self.pages.insert(*id, Page::new(state, self.page_rows, log.len()));
                }
                return parts.into_iter().map(|(id, _)| id).collect();
            }
        }
        self.unchanged += usize::from(is_same && !replay.rounds.is_empty());
        vec![id]
    }

    fn step(&mut self, step: u32, log: &EventLog, root_from_uid: &HashMap<u64, u64>, chance: u64) {
        for id in self.pages.keys().copied().collect::<Vec<_>>() {
            let state = self.pages[&id].state();
            let is_seen = |uid: &u64| hash64(&[root_from_uid[uid] % 16, u64::from(step), 1]).is_multiple_of(19);
            let is_needed =
                state.uid.iter().any(is_seen) || hash64(&[id.to_bits(), u64::from(step), chance]) % 1000 < chance;
            if !is_needed {
                continue;
            }
            for id in self.acquire(id, log) {
                let mut state = self.pages[&id].state();
                let is_drawn = |uid| is_drawn(root_from_uid[&uid], uid, step);
                touch(&mut state, (self.adam, self.strategy), step, &mut self.histogram, is_drawn);
                let applied = self.pages[&id].applied;
                self.pages.insert(id, Page::new(&state, self.page_rows, applied));
            }
        }
    }

    /// Updates the statistics and the bound on the rows when an event enters the log.
    fn log_event(&mut self, event: Event) {
        if let Effect::Round(round) = effect_of(&event.kind) {
            self.rows_bound += round.promised(&self.histogram) as i64;
            self.histogram.clear();
        }
    }

    fn rows(&self) -> i64 {
        self.pages.values().map(|page| page.layout.rows as i64).sum()
    }
}

fn in_pages<'a>(
    start: &SceneState,
    (adam, strategy): (&'a DeferredAdam, &'a dyn Strategy),
    page_rows: usize,
    first_rows: usize,
) -> InPages<'a> {
    let parts = partition(&start.columns.means, &start.columns.scales, first_rows);
    let page = |(index, rows): (usize, &Vec<u32>)| {
        let id = PageId::initial(index as u32);
        (id, Page::new(&start.select(rows), page_rows, 0))
    };
    InPages {
        adam,
        strategy,
        page_rows,
        pages: parts.iter().enumerate().map(page).collect(),
        histogram: GradHistogram::default(),
        rows_bound: start.rows() as i64,
        splits: 0,
        unchanged: 0,
        foretold: 0,
    }
}

#[test]
fn events_that_pages_replay_late_give_the_rows_of_events_applied_at_once() {
    let cases = [(128, first_fill(128, true), 0), (128, 90, 30), (40, 40, 1000), (2500, 2500, 3), (7, 5, 10)];
    late_equals_at_once(&adam(1.0), &densify(3000), &cases);
    late_equals_at_once(&adam(1.0), &long_axis(2600), &cases);
    // Growth is slower, so first pages are nearly full.
    let fuller = [(128, 125, 0), (128, 120, 30), (40, 40, 1000), (2500, 2500, 3), (7, 6, 10)];
    late_equals_at_once(&adam(1.0), &mcmc(2600), &fuller);
}

#[test]
fn so_they_do_with_moments_in_sixteen_bits() {
    let adam = adam(1.0).with_moments(Moments::Bf16);
    let state = late_equals_at_once(&adam, &densify(3000), &[(64, 50, 30), (7, 5, 0)]);
    for table in [&state.exp_avg, &state.exp_avg_sq] {
        let is_short = |column: Column| table.column(column).iter().all(|x| x.to_bits() & 0xffff == 0);
        assert!(Column::ALL.into_iter().all(is_short), "every moment is a bfloat16");
    }
}

/// Each case gives the rows of a page, the rows of a first page, and unneeded acquisitions per 1,000 pages and steps.
/// Returns the rows.
fn late_equals_at_once(adam: &DeferredAdam, by: &dyn Strategy, cases: &[(usize, usize, u64)]) -> SceneState {
    let start = scene(2000, 0);
    let whole = on_time(&start, adam, by);
    let grown = whole.state.uid.iter().filter(|&&uid| uid >= 2000).count();
    assert!(whole.log.len() >= 10 && grown > 300, "{} events, {grown} new rows: too easy", whole.log.len());
    let want = by_uid([&whole.state]);
    for &(page_rows, first_rows, chance) in cases {
        let mut pages = in_pages(&start, (adam, by), page_rows, first_rows);
        let mut log = EventLog::default();
        for step in 0..STEPS {
            pages.step(step, &log, &whole.root_from_uid, chance);
            assert!(pages.rows_bound >= pages.rows());
            let pending = whole.log.events().iter().enumerate().skip(log.len());
            for (index, &event) in pending.filter(|(_, e)| e.step == step) {
                assert!(pages.histogram == whole.histograms[index], "what a round decides by, event {index}");
                log.push(event);
                pages.log_event(event);
            }
        }
        let case = format!("{page_rows} rows a page, chance {chance}");
        // As an export sees the rows, before and after the last events are applied.
        let pending = PendingEvents::new(adam, SEED, page_rows, &log);
        let export = |page: &Page| {
            let mut state = page.state();
            pending.apply_to_table(PageId::initial(0), page.applied, &mut state);
            state
        };
        let seen: Vec<SceneState> = pages.pages.values().map(export).collect();
        assert!(by_uid(&seen) == want, "{case}: export");
        for id in pages.pages.keys().copied().collect::<Vec<_>>() {
            pages.acquire(id, &log);
        }
        let states: Vec<SceneState> = pages.pages.values().map(Page::state).collect();
        assert!(by_uid(&states) == want, "{case}");
        assert_eq!(pages.rows_bound, whole.state.rows() as i64, "{case}: promises are kept to the row");
        assert!(pages.splits > 0 || page_rows == 2500, "{case}: no page was split");
        assert!(pages.unchanged > 0 || page_rows != 7, "{case}: no round left a page alone");
        println!("{case}: of {} pages it was known that nothing but statistics would change", pages.foretold);
        assert!(pages.foretold > 0 || page_rows != 7 || !by.collects_on_device(), "{case}: no page was known to stay");
    }
    whole.state
}

/// Decides rounds as a run does, without looking at rows: by the histogram and the bound on the rows, which counts rows
/// that a page has yet to prune. The cap holds at every step, and the result equals the same events applied at once.
#[test]
fn a_cap_by_which_pages_decide_is_never_exceeded_and_gives_the_rows_of_events_applied_at_once() {
    let adam = adam(1.0);
    let start = scene(2000, 0);
    let mut decided_otherwise = 0;
    let cases = [(2040, 128, 100, 0), (2150, 90, 90, 30), (2150, 40, 40, 1000), (2400, 7, 5, 10), (1000, 64, 60, 0)];
    for ((cap, page_rows, first_rows, chance), is_long) in cases.into_iter().flat_map(|c| [(c, false), (c, true)]) {
        let (usual, long) = (densify(cap), long_axis(cap));
        let config: &dyn Strategy = if is_long { &long } else { &usual };
        let mut whole = OnTime::new(&start, &adam, config);
        let mut pages = in_pages(&start, (&adam, config), page_rows, first_rows);
        let most = cap.max(2000) as i64;
        let (mut capped, mut recycled) = (0, 0);
        let mut case = format!("cap {cap}, {page_rows} rows a page, chance {chance}, long axis {is_long}");
        for step in 0..STEPS {
            pages.step(step, &whole.log, &whole.root_from_uid, chance);
            whole.step(step);
            assert!(pages.histogram == whole.histogram, "{case}: statistics at step {step}");
            let rows = [whole.state.rows() as i64, pages.rows()];
            assert!(rows.iter().all(|rows| *rows <= pages.rows_bound), "{case}: {rows:?} at step {step}");
            assert!(chance < 1000 || pages.rows_bound == rows[0], "{case}: every page is up to date at every step");
            let bound = pages.rows_bound as u64;
            let kinds: Vec<EventKind> = config.events_after(step, 1.0, RowCount::unlimited(bound), &pages.histogram);
            let at_once: Vec<EventKind> =
                config.events_after(step, 1.0, RowCount::unlimited(rows[0] as u64), &whole.histogram);
            decided_otherwise += usize::from(kinds != at_once);
            for kind in kinds {
                match kind {
                    EventKind::Densify(thresholds) => {
                        capped += usize::from(thresholds.grow_grad2d > usual.grow_grad2d);
                    }
                    EventKind::LongAxis(round) => {
                        capped += usize::from(round.split_from_bin > 1);
                        recycled += usize::from(round.remove_below_bin > 0);
                    }
                    _ => {}
                }
                let event = Event { step, kind };
                pages.log_event(event);
                whole.apply(event);
            }
            let now = pages.rows_bound.max(whole.state.rows() as i64);
            assert!(now <= most, "{case}: {now} rows after step {step}");
        }
        for id in pages.pages.keys().copied().collect::<Vec<_>>() {
            pages.acquire(id, &whole.log);
        }
        case += &format!(", {} rows at the end", whole.state.rows());
        assert!(capped > 0, "{case}: no round met the cap");
        assert!(recycled > 0 || !is_long, "{case}: no round recycled");
        assert_eq!(pages.rows_bound, whole.state.rows() as i64, "{case}: promises are kept to the row");
        let states: Vec<SceneState> = pages.pages.values().map(Page::state).collect();
        assert!(by_uid(&states) == by_uid([&whole.state]), "{case}");
    }
    assert!(decided_otherwise > 0, "no prune was ever waiting, so it does not matter how they count");
}

/// Rows with moments of a few steps, down to sizes where eps matters, and statistics.
fn moving_page(rows: usize, adam: &DeferredAdam, key: u64) -> SceneState {
    let mut draws = Stream::new(9, Purpose::Test, key, 0);
    let mut state = scene(rows, 0);
    let mut histogram = GradHistogram::default();
    let first = draws.below(300) as u32;
    for step in first..first + 6 {
        let listed: Vec<u32> = (0..rows as u32).filter(|_| draws.below(3) > 0).collect();
        let mut grads = Columns::zeros(listed.len(), 0);
        for column in Column::ALL {
            grads.column_mut(column).iter_mut().for_each(|g| {
                *g = (draws.normal() * libm::pow(10.0, -draws.range(0.0, 17.0))) as f32;
            });
        }
        take_step(adam, &mut state, &listed, &grads, step);
        let means2d = listed.iter().map(|_| [(draws.normal() * 3e-5) as f32, 0.0]).collect();
        let gradients = Gradients { means2d, radii: vec![[1, 1]; listed.len()], ..Gradients::default() };
        let drawn = DrawnRows { step, rows: &listed, gradients: &gradients, first: 0, image_size: [20, 20] };
        accumulate(&mut state.view_mut(), &drawn, &mut histogram);
    }
    state
}

/// Rounds, resets and raises at random later steps; in half of the cases the first round is as early as possible.
fn random_log(key: u64, from: u32, limits: &SplitLimits) -> EventLog {
    let is_long = limits.split_scale == 0.0;
    let mut draws = Stream::new(10, Purpose::Test, key, 0);
    let mut log = EventLog::default();
    let mut step = from;
    for _ in 0..draws.below(6) {
        step += if draws.below(2) == 0 { 0 } else { draws.below(400) as u32 };
        let kind = match draws.below(4) {
            0 => EventKind::ResetOpacity { max_opacity: 0.01 },
            1 => EventKind::RaiseShDegree { degree: 1 + draws.below(2) as u8 },
            _ if *limits == SplitLimits::NEVER => EventKind::Relocate(RelocationRound {
                copy_from_bin: if draws.below(2) == 0 { 1 } else { 0x3900 },
                dead_opacity: 0.005,
            }),
            _ if is_long => EventKind::LongAxis(LongAxisRound {
                split_from_bin: if draws.below(2) == 0 { 1 } else { 0x3900 },
                remove_below_bin: 0,
                remove_views: 3,
                prune_opacity: 0.005,
            }),
            _ => EventKind::Densify(RoundThresholds {
                grow_grad2d: limits.grow_grad2d * if draws.below(2) == 0 { 1.0 } else { 1.7 },
                split_scale: limits.split_scale,
                prune_opacity: 0.005,
                prune_scale: 0.5,
            }),
        };
        log.push(Event { step, kind });
    }
    log
}

/// With splits of large rows; with splits of every row with statistics along its longest axis in half of the rounds, so that
/// children lie at the edge of the boxes; and with splits in place, for which bounds leave no room.
#[test]
fn bounds_hold_at_every_later_step_whatever_happens_meanwhile() {
    let random = SplitLimits { grow_grad2d: 2e-4, split_scale: 0.01, reach: 3.33 };
    let (along, in_place) = (long_axis(1).split_limits(1.0), mcmc(1).split_limits(1.0));
    assert_eq!((along.reach, in_place), (0.75, SplitLimits::NEVER));
    let short = |scale| adam(scale).with_moments(Moments::Bf16);
    // A learning rate of the means of 1000 is large, so that rows move as far as the distance to their neighbours.
    for (adam, limits, most) in [
        // In some page without growth, the box equals the range of its rows up to the slack of 1e-3, with moments in 16
        // bits of 2 %.
        (adam(1000.0), random, 1.01),
        (short(1000.0), random, 1.05),
        (adam(1000.0), along, f64::INFINITY),
        (short(1.0), along, f64::INFINITY),
        (adam(1000.0), in_place, f64::INFINITY),
        (short(1.0), in_place, f64::INFINITY),
    ] {
        let tightest = tightest_bounds(&adam, &limits);
        assert!(tightest < most, "{tightest}");
    }
}

/// Asserts that bounds hold; returns the least ratio of a box to the range of its rows.
fn tightest_bounds(adam: &DeferredAdam, limits: &SplitLimits) -> f64 {
    let (mut children, mut at_edge, mut tightest) = (0, 0, f64::INFINITY);
    for key in 0..60 {
        let state = moving_page(37, adam, key);
        let bounds = page_bounds(adam, &state.view(), limits);
        let last = state.stamp.iter().copied().max().unwrap();
        let log = random_log(key, last, limits);
        let mut exact = [f32::INFINITY, f32::NEG_INFINITY];
        for later in (0..12).map(|i| [0, 1, 2, 5, 9, 15, 40, 150, 399, 400, 1300, 4000][i]) {
            let now = last + later;
            let due = EventLog::from_events(log.events().iter().copied().filter(|e| e.now() <= now).collect()).unwrap();
            let mut late = state.clone();
            PendingEvents::new(adam, SEED, 1 << 20, &due).apply_to_table(PageId::initial(0), 0, &mut late);
            let values = evaluate_all(&[late.view()], late.sh_degree(), adam, now);
            for row in 0..values.rows() {
                let (mean, scales) = (values.row(Column::Means, row), values.row(Column::Scales, row));
                let sigma = scales.iter().map(|&s| gsscale::base::math::exp32(s)).fold(0.0, f32::max);
                let inside = (0..3).all(|c| bounds.lo[c] <= mean[c] && mean[c] <= bounds.hi[c]);
                assert!(inside && sigma <= bounds.sigma_max, "case {key}, step {now}: {mean:?} {sigma} in {bounds:?}");
                children += usize::from(late.uid[row] >= 37);
                at_edge += usize::from(sigma * (1.0 + 1e-3) > bounds.sigma_max);
                exact = [exact[0].min(mean[0]), exact[1].max(mean[0])];
            }
        }
        tightest = tightest.min(f64::from(bounds.hi[0] - bounds.lo[0]) / f64::from(exact[1] - exact[0]));
    }
    assert!(children > 2000 && at_edge > 50, "{children} children, {at_edge} at the bound: too easy");
    tightest
}
