//! Whole runs: the end of a schedule, the events of a run, and starts from a trained PLY.

use crate::support::scenes::told;
use crate::support::workdir::{TRAIN, Workdir};
use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::densify::stats::GradHistogram;
use gsscale::densify::strategy::{RoundSteps, RowCount, Strategy, StrategyName, ViewGradients};
use gsscale::optim::bounds::SplitLimits;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::events::EventKind;
use gsscale::train::error::TrainError;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::state::trainer::Trainer;
use std::sync::Arc;

fn run(work: &Workdir, out: &str, more: &str) {
    work.train(&format!("scene --out {out} --quiet {more}"));
}

#[test]
fn the_schedule_of_few_photos_ends_before_the_run() {
    let work = Workdir::city(4, 48, 32, 200);
    let flags = "--out run --device cpu --test-every 0 --keep-checkpoint --schedule run-length --strategy long-axis";
    let said = told(&work.output(TRAIN, &format!("scene --steps 700 {flags}")));
    assert!(said.contains("4 to train on") && said.contains("those after 600 change little"), "{said}");
    let key = |name: &str| {
        let config = work.text("run/config.toml");
        config.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(" = ").map(str::to_string)).unwrap()
    };
    // A fifth of the schedule's 600 steps is without rounds, not of the run's 700.
    let wanted =
        |steps: &str| assert_eq!([key("steps"), key("schedule-steps"), key("refine-stop")], [steps, "600", "480"]);
    wanted("700");
    work.train("--resume run --steps 750 --quiet");
    wanted("750");
}

#[test]
fn every_global_change_is_an_event_in_order() {
    let scene = Workdir::city(12, 96, 64, 400);
    let config = TrainConfig {
        steps: 60,
        sh_degree: 2,
        sh_every: 20,
        refine_start: 5,
        refine_every: 10,
        refine_stop: 50,
        reset_every: 30,
        strategy: StrategyName::Default,
        ..TrainConfig::default()
    };
    let Prepared { dataset, columns, sh_degree_start, .. } = prepare(&scene.scene(), &config).unwrap();
    let options = RunOptions { sh_degree_start, ..RunOptions::new(&config, dataset.scene_scale) };
    let targets = TargetCache::new(&dataset.views, 1 << 24, 1).unwrap();
    let mut trainer = Trainer::new(columns, &dataset, Box::new(CpuRenderer::new()), options).unwrap();
    let mut degrees = Vec::new();
    for _ in 0..config.steps {
        trainer.step(&dataset, &targets).unwrap();
        degrees.push(trainer.render_options().sh_degree);
    }
    // The SH degree follows gsplat: step / 20, at most 2.
    assert!(degrees.iter().enumerate().all(|(step, &d)| usize::from(d) == (step / 20).min(2)), "{degrees:?}");
    let events: Vec<(u32, char)> = trainer.events().events().iter().map(|e| (e.step, letter(e.kind))).collect();
    let want = [(10, 'd'), (19, 's'), (20, 'd'), (30, 'd'), (30, 'r'), (39, 's'), (40, 'd')];
    assert_eq!(events, want);
}

fn letter(kind: EventKind) -> char {
    match kind {
        EventKind::Densify(_) | EventKind::LongAxis(_) | EventKind::Relocate(_) => 'd',
        EventKind::ResetOpacity { .. } => 'r',
        EventKind::RaiseShDegree { .. } => 's',
    }
}

/// Spoils the gradient of one row of each view.
#[derive(Debug)]
struct SpoilOneRow;

impl Strategy for SpoilOneRow {
    fn rounds(&self) -> Option<&RoundSteps> {
        None
    }

    fn add_gradients(&self, view: &mut ViewGradients<'_>) {
        if let Some(drawn) = view.gradients.radii.iter().position(|radii| !radii.contains(&0)) {
            view.gradients.columns.opacities[drawn] = f32::INFINITY;
        }
    }

    fn events_after(&self, _: u32, _: f32, _: RowCount, _: &GradHistogram) -> Vec<EventKind> {
        Vec::new()
    }

    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits::NEVER
    }
}

/// Otherwise the rows that it changed would be written as those of the step before.
#[test]
fn a_step_that_ends_a_diverged_run_counts_if_it_changed_rows() {
    let scene = Workdir::city(12, 96, 64, 400);
    let config = TrainConfig { steps: 60, ..TrainConfig::default() };
    let Prepared { dataset, columns, sh_degree_start, .. } = prepare(&scene.scene(), &config).unwrap();
    let strategy = Arc::new(SpoilOneRow);
    let options = RunOptions { sh_degree_start, strategy, ..RunOptions::new(&config, dataset.scene_scale) };
    let targets = TargetCache::new(&dataset.views, 1 << 24, 1).unwrap();
    let mut trainer = Trainer::new(columns, &dataset, Box::new(CpuRenderer::new()), options).unwrap();
    for _ in 0..2 {
        let outcome = trainer.step(&dataset, &targets).unwrap();
        assert!(outcome.updated > 0 && outcome.rows_skipped == 1, "{outcome:?}");
    }
    let error = trainer.step(&dataset, &targets).unwrap_err();
    assert!(matches!(error, TrainError::NonFinite { step: 2, .. }), "{error}");
    assert_eq!((trainer.steps_done(), trainer.skipped()), (3, (3, 0)));
}

#[test]
fn training_can_start_from_a_trained_ply_and_its_bands_stay_in_use() {
    let work = Workdir::city(24, 160, 112, 1500);
    for (bands, steps, loss) in [
        // Ten steps with fresh moments cannot undo 400; a start from points would be some 10 dB lower.
        ("", 10, 1.5),
        // One step of Adam without history moves every value by its learning rate; without the bands the loss would be
        // several decibels.
        ("--sh-every 50", 1, 0.7),
    ] {
        run(&work, "first", &format!("--overwrite --steps 400 --strategy none {bands}"));
        run(&work, "second", &format!("--overwrite --steps {steps} --strategy none --init-ply first/point_cloud.ply"));
        let (first, second) = (work.psnr("first"), work.psnr("second"));
        assert!(second > first - loss, "{second} after {first}");
    }
    // Rounding in the PLY.
    let again = work.eval_psnr("second scene");
    assert!((again - work.psnr("second")).abs() < 2e-3, "{again} from the PLY, {} in the run", work.psnr("second"));
}
