//! A densification strategy of one's own, in a training loop of one's own: every 20 steps it removes Gaussians that are nearly transparent.
//! `cargo run --release --example own_strategy -- scans/village`

use gsscale::config::file::TrainConfig;
use gsscale::config::limits::RunOptions;
use gsscale::dataset::target_cache::TargetCache;
use gsscale::densify::stats::GradHistogram;
use gsscale::densify::strategy::{RoundSteps, RowCount, Strategy};
use gsscale::optim::bounds::SplitLimits;
use gsscale::render::cpu::CpuRenderer;
use gsscale::scene::events::{EventKind, RoundThresholds};
use gsscale::train::error::TrainError;
use gsscale::train::start::first_scene::{Prepared, prepare};
use gsscale::train::state::trainer::Trainer;
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(Debug)]
struct RemoveFaint(RoundSteps);

impl Strategy for RemoveFaint {
    fn rounds(&self) -> Option<&RoundSteps> {
        Some(&self.0)
    }

    fn grows(&self) -> bool {
        false
    }

    fn events_after(&self, step: u32, _: f32, _: RowCount, _: &GradHistogram) -> Vec<EventKind> {
        let (grow_grad2d, split_scale, prune_scale) = (f32::INFINITY, f32::INFINITY, f32::INFINITY);
        let round = RoundThresholds { grow_grad2d, split_scale, prune_opacity: 0.08, prune_scale };
        if self.0.is_round(step) { vec![EventKind::Densify(round)] } else { Vec::new() }
    }

    fn split_limits(&self, _: f32) -> SplitLimits {
        SplitLimits::NEVER
    }
}

fn main() -> Result<(), TrainError> {
    let scene = PathBuf::from(std::env::args_os().nth(1).unwrap_or_else(|| "runs/demo/scene".into()));
    train(&scene).map(|(rounds, psnr)| gsscale::say!("{rounds} rounds, PSNR {psnr:.2} dB"))
}

/// Rounds, and the PSNR of the held-out photos, dB.
pub fn train(scene: &Path) -> Result<(usize, f64), TrainError> {
    let config = TrainConfig { steps: 200, max_resolution: 400, ..TrainConfig::default() };
    let Prepared { dataset, columns, sh_degree_start, .. } = prepare(scene, &config)?;
    let strategy = Arc::new(RemoveFaint(RoundSteps { start: 50, stop: 200, every: 20 }));
    let options = RunOptions { sh_degree_start, strategy, ..RunOptions::new(&config, dataset.scene_scale) };
    let photos = TargetCache::new(&dataset.views, 1 << 30, 2)?;
    let mut trainer = Trainer::new(columns, &dataset, Box::new(CpuRenderer::new()), options)?;
    for _ in 0..config.steps {
        trainer.step(&dataset, &photos)?;
    }
    let test = trainer.evaluate(&dataset, &photos, None, &|_| ())?;
    Ok((trainer.events().events().len(), test.map_or(0.0, |test| test.psnr)))
}
