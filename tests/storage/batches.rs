//! A view larger than the frames: the pager walks it in batches, forwards and back, and the training step survives faults in
//! either pass.

use crate::support::faulty_engine::{Fault, Faults, FaultyEngine, Operation};
use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::densify::strategy::StrategyName;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::format::codec::Codec;
use gsscale::page::versions::paged_store::{PagedStore, PagedStoreConfig};
use gsscale::page::versions::slots::SlotLayout;
use gsscale::paging::error::PagingError;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::render::RenderOptions;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::camera::Camera;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::image::Target;
use gsscale::scene::page_layout::capacity_bytes;
use gsscale::train::error::TrainError;
use gsscale::train::step::batch::RowsInHost;
use gsscale::train::step::comparison::Comparison;
use gsscale::train::step::pages::{PagedScene, WorkingSet};
use gsscale::train::step::train_step::{StepOutcome, StepView, train_step};
use std::io::ErrorKind;

const STEPS: u32 = 5;
const FRAMES: usize = 8;

fn options() -> RunOptions {
    let config = TrainConfig { page_rows: 16, sh_degree: 1, steps: STEPS, ..TrainConfig::default() };
    RunOptions::new(&TrainConfig { strategy: StrategyName::None, ..config }, 1.0)
}

/// Some 40 pages in front of a camera that sees all of them.
fn columns() -> Columns {
    let mut draws = Stream::new(31, Purpose::Test, 0, 0);
    let mut columns = Columns::zeros(600, 1);
    columns.means.iter_mut().for_each(|x| *x = draws.range(-2.0, 2.0) as f32);
    columns.quats.chunks_exact_mut(4).for_each(|q| q[0] = 1.0);
    columns.scales.iter_mut().for_each(|x| *x = draws.range(-3.5, -2.0) as f32);
    columns.opacities.iter_mut().for_each(|x| *x = draws.range(-1.0, 3.0) as f32);
    columns.sh0.iter_mut().for_each(|x| *x = draws.normal() as f32);
    columns
}

fn camera() -> Camera {
    let viewmat = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 4.5]];
    Camera::pinhole(viewmat, [50.0, 50.0, 40.0, 30.0], [80, 60])
}

/// The scene in frames over a store that fails by `faults`; in memory without them.
fn scene(faults: Option<&Faults>) -> PagedScene {
    let options = options();
    let Some(faults) = faults else {
        let pager = Pager::in_memory(PagerConfig::in_memory(options.page_rows, options.sh_degree));
        return PagedScene::new(&columns(), pager, &options).unwrap();
    };
    // Segments of 16 slots, so that a run needs some of them.
    let layout = SlotLayout::new(capacity_bytes(options.page_rows, options.sh_degree), 16);
    let config = PagedStoreConfig { store: 5, layout, codec: Codec::Raw, generation: 1, serial: 0 };
    let engine = FaultyEngine::new(Box::new(MemoryEngine::new()), faults.clone());
    let store = PagedStore::new(Box::new(engine), config);
    let in_memory = PagerConfig::in_memory(options.page_rows, options.sh_degree);
    let config = PagerConfig { frames: FRAMES, prefetch_bytes: 1 << 20, plan_bytes: 1 << 20, ..in_memory };
    PagedScene::new(&columns(), Pager::new(config, store), &options).unwrap()
}

fn step(scene: &mut PagedScene, step: u32) -> Result<StepOutcome, TrainError> {
    let (options, camera) = (options(), camera());
    let rgb = (0..3 * camera.pixels()).map(|i| ((i * 7 + step as usize) % 256) as u8).collect();
    let target = Target::new([camera.width, camera.height], rgb);
    let (mut working, mut renderer) = (WorkingSet::default(), CpuRenderer::new());
    let render = RenderOptions { sh_degree: scene.rules.sh_degree, ..options.render };
    let (rows, comparison) = (&mut RowsInHost::new(&mut renderer), &mut Comparison::new(&target, options.loss));
    let view = StepView { step, camera: &camera, render: &render, collects: false, pages_most: usize::MAX };
    train_step(scene, &mut working, rows, &view, comparison)
}

/// The bits of every row, column by column.
fn rows(scene: &mut PagedScene) -> Vec<Vec<u32>> {
    let mut all = vec![Vec::new(); Column::ALL.len()];
    let mut append = |rows: &Columns| {
        for (all, column) in all.iter_mut().zip(Column::ALL) {
            all.extend(rows.column(column).iter().map(|x| x.to_bits()));
        }
        Ok::<(), PagingError>(())
    };
    scene.for_all_rows(STEPS, &mut append).unwrap();
    all
}

fn trained_in_memory() -> Vec<Vec<u32>> {
    let mut scene = scene(None);
    (0..STEPS).for_each(|s| assert_eq!(step(&mut scene, s).unwrap().batches, 1));
    rows(&mut scene)
}

/// Every page is read and written about once a pass, and the bound counts each batch as an access.
#[test]
fn a_view_of_five_times_the_frames_reads_little_more_than_it_must() {
    let want = trained_in_memory();
    let mut scene = scene(Some(&Faults::new()));
    let pages = scene.pager.pages_of_view(&camera()).len();
    assert!(pages > 4 * FRAMES, "{pages} pages");
    for s in 0..STEPS {
        let outcome = step(&mut scene, s).unwrap();
        assert_eq!((outcome.pages, outcome.batches), (pages, pages.div_ceil(FRAMES / 2)));
    }
    let stats = scene.pager.stats();
    assert!(stats.pinned_max <= FRAMES / 2, "{stats:?}");
    // Two passes, of which the second finds the last batches in memory, and the first some of those that the step before left.
    let most = u64::from(STEPS) * 2 * pages as u64;
    assert!(stats.pages_read < most - u64::from(STEPS) * (FRAMES / 2) as u64, "{} of {most}", stats.pages_read);
    let (bound, read) = (stats.belady_bytes_read, stats.bytes_read - stats.other_bytes_read);
    assert!(bound <= read && read < bound + bound / 10, "{read} bytes read, {bound} at least");
    assert!(rows(&mut scene) == want);
}

/// A read that fails in the pass in costs the step; in the pass out it costs the state, which the error says.
#[test]
fn a_read_that_fails_gives_the_step_up_or_is_said_to_tear_it() {
    let want = trained_in_memory();
    let (mut given_up, mut torn) = (0, 0);
    for nth in (0..).step_by(7) {
        let faults = Faults::new();
        let mut scene = scene(Some(&faults));
        let first = faults.count(Operation::Read);
        // A read is tried twice before it fails.
        faults.add(Operation::Read, first + nth, true, Fault::Error(ErrorKind::Other));
        let failed = (0..STEPS).find_map(|s| step(&mut scene, s).err().map(|error| (s, error)));
        faults.clear();
        let Some((s, error)) = failed else { break };
        if let TrainError::Torn { source } = &error {
            assert!(matches!(**source, TrainError::Paging(_)) && error.to_string().contains("--resume"), "{error}");
            torn += 1;
            continue;
        }
        given_up += 1;
        (s..STEPS).for_each(|s| assert!(step(&mut scene, s).unwrap().skipped.is_none()));
        assert!(rows(&mut scene) == want, "after read {nth} failed in step {s}");
    }
    assert!(given_up > 3 && torn > 3, "{given_up} given up, {torn} torn");
}

/// Space for everything that the pass out may write back is made before it, so that a full drive never tears a step.
#[test]
fn a_full_drive_never_tears_a_step() {
    let want = trained_in_memory();
    let mut failures = 0;
    for nth in 0..8 {
        let faults = Faults::new();
        let mut scene = scene(Some(&faults));
        let first = faults.count(Operation::Create) + nth;
        faults.add(Operation::Create, first, true, Fault::Error(ErrorKind::StorageFull));
        for s in 0..STEPS {
            while let Err(error) = step(&mut scene, s) {
                assert!(error.is_out_of_space() && !matches!(error, TrainError::Torn { .. }), "{error}");
                failures += 1;
                faults.clear();
            }
        }
        assert!(rows(&mut scene) == want, "segment {nth} found no space");
    }
    assert!(failures > 1, "{failures}");
}

/// The bits of the rows of a view, as evaluations and checks of growth gather them.
fn rows_of_view(scene: &mut PagedScene) -> Vec<u32> {
    let (pages, mut working) = (scene.pager.pages_of_view(&camera()), WorkingSet::default());
    scene.gather_pages(&pages, &[], &camera(), STEPS, &mut working).unwrap();
    Column::ALL.into_iter().flat_map(|column| working.columns.column(column)).map(|x| x.to_bits()).collect()
}

/// Checks of growth, evaluation and export come between steps. Each reads pages although no dirty page can be written, and leaves
/// the failure to the next step, which waits for space.
#[test]
fn every_row_can_be_read_while_the_drive_is_full() {
    let mut in_memory = scene(None);
    let faults = Faults::new();
    let mut scene = scene(Some(&faults));
    for s in 0..STEPS {
        assert!(step(&mut in_memory, s).unwrap().skipped.is_none() && step(&mut scene, s).unwrap().skipped.is_none());
    }
    let (want, want_of_view) = (rows(&mut in_memory), rows_of_view(&mut in_memory));
    faults.add(Operation::Write, faults.count(Operation::Write), true, Fault::Error(ErrorKind::StorageFull));
    for _ in 0..2 {
        assert!(rows(&mut scene) == want && rows_of_view(&mut scene) == want_of_view);
        assert!(scene.pager.frames() <= FRAMES + 1, "{} frames", scene.pager.frames());
    }
    let error = step(&mut scene, STEPS).unwrap_err();
    assert!(error.is_out_of_space() && !matches!(error, TrainError::Torn { .. }), "{error}");
    faults.clear();
    assert!(rows(&mut scene) == want);
}

/// Pages of the next batch are read ahead, and none of them is evicted again before its use. No step has asked for them.
#[test]
fn a_pass_between_steps_reads_no_page_twice() {
    let mut scene = scene(Some(&Faults::new()));
    assert!(step(&mut scene, 0).unwrap().skipped.is_none());
    let (pages, before) = (scene.pager.pages_of_view(&camera()).len() as u64, scene.pager.stats());
    let rows = rows_of_view(&mut scene);
    let stats = scene.pager.stats();
    let read = stats.pages_read - before.pages_read;
    assert!((pages - FRAMES as u64..=pages).contains(&read), "{read} reads of {pages} pages");
    assert_eq!(stats.bytes_read - before.bytes_read, stats.other_bytes_read - before.other_bytes_read);
    assert!(!rows.is_empty());
}

/// A walk of other batches than the pager's own, with uses that are told to it: what comes back is evicted last.
#[test]
fn pages_that_return_stay_longer_than_pages_that_are_done() {
    use gsscale::paging::plan::look_ahead::UseInStep;
    let mut scene = scene(Some(&Faults::new()));
    let pager = &mut scene.pager;
    let pages = pager.begin_view(0, &camera()).unwrap();
    let numbers: Vec<PageNo> = pages.iter().copied().take(3 * FRAMES).collect();
    let batches: Vec<&[PageNo]> = numbers.chunks(FRAMES / 2).collect();
    pager.set_use_in_step(0, numbers.iter().copied(), UseInStep::Coming);
    for (i, batch) in batches.iter().enumerate() {
        let pinned = pager.pin_batch(0, batch, false).unwrap();
        let how = if i % 2 == 0 { UseInStep::Returning } else { UseInStep::Done };
        pager.set_use_in_step(0, batch.iter().copied(), how);
        pager.release(pinned);
    }
    let kept = |batch: &[PageNo]| batch.iter().filter(|page| scene.pager.is_in_memory(**page)).count();
    // Of the last two returning batches all pages are kept but those that made room for the last batch, which is done.
    assert!(kept(batches[4]) > kept(batches[3]), "{:?}", batches.iter().map(|b| kept(b)).collect::<Vec<_>>());
    scene.pager.end_batches();
}
