//! Derives the options of each module from a config. Other modules receive their own option structs and never see the
//! config.

use super::file::TrainConfig;
use super::values::Up;
use crate::base::simd::SimdPath;
use crate::dataset::loader::LoadOptions;
use crate::dataset::read::ReadOptions;
use crate::densify::default::DefaultStrategy;
use crate::densify::growth::GrowthRule;
use crate::densify::long_axis::LongAxisStrategy;
use crate::densify::mcmc::McmcStrategy;
use crate::densify::strategy::{NoStrategy, RoundSteps, Strategy, StrategyName};
use crate::exchange::meta::ExportFrame;
use crate::optim::adam::AdamConfig;
use crate::optim::method::{Method, OptimizerPlace};
use crate::optim::moments::Moments;
use crate::optim::rates::Rates;
use crate::photos::PhotoOptions;
use crate::photos::outlier::blocks::BlockMasks;
use crate::render::color_correct::ColorCorrect;
use crate::render::metrics::SsimVariant;
use crate::render::{LossOptions, RenderOptions};
use crate::scene::init::InitOptions;
use crate::schedule::order::Order;
use std::path::PathBuf;
use std::sync::Arc;

/// Resolved options of the training loop.
#[derive(Debug, Clone)]
pub struct RunOptions {
    pub steps: u32,
    pub seed: u64,
    pub sh_degree: u8,
    /// Steps between raises of the SH degree; 0 = full degree from the start.
    pub sh_every: u32,
    /// SH degree at step 0: that of the config or of the Gaussians from which the run starts.
    pub sh_degree_start: u8,
    pub page_rows: usize,
    /// View order; a shuffle until `auto` has been decided.
    pub view_order: Order,
    /// Render options, except for the current SH degree.
    pub render: RenderOptions,
    pub loss: LossOptions,
    pub rates: Rates,
    pub adam: AdamConfig,
    pub optimizer: Method,
    pub optimizer_on: OptimizerPlace,
    pub moments: Moments,
    pub strategy: Arc<dyn Strategy>,
    /// Scene scale, local units.
    pub scene_scale: f32,
    pub ssim_variant: SsimVariant,
    /// Method of the colour-corrected PSNR; `None` for none.
    pub color_correct: Option<ColorCorrect>,
    pub photos: PhotoOptions,
    pub export_frame: ExportFrame,
    /// Whether result files leave out Gaussians that few photos see; `None` decides by their share.
    pub export_clean: Option<bool>,
    /// The direction of the dataset that is up in PLY files; `None` where they keep the axes of the dataset, and while
    /// `--up auto` is unresolved.
    pub up: Option<[f64; 3]>,
    /// Steps between evaluations; 0 = only at the end.
    pub eval_every: u32,
    /// Steps between PLY files; 0 = only at the end.
    pub save_every: u32,
    /// Steps between lines of metrics.
    pub log_every: u32,
    /// The file or store from which the run starts, for messages; empty for the points of the dataset.
    pub init_ply: String,
}

impl RunOptions {
    /// Options of a checked config for a scene of this scale (local units).
    pub fn new(config: &TrainConfig, scene_scale: f32) -> RunOptions {
        RunOptions {
            steps: config.steps,
            seed: config.seed,
            sh_degree: config.sh_degree,
            sh_every: config.sh_every,
            sh_degree_start: first_sh_degree(config),
            page_rows: config.page_rows as usize,
            view_order: config.view_order.0.unwrap_or(Order::Shuffle),
            render: RenderOptions {
                sh_degree: config.sh_degree,
                max_alpha: config.max_alpha as f32,
                background: config.background.0.map(|c| c as f32),
                simd: simd_path(config),
                ..RenderOptions::default()
            },
            loss: loss_options(config),
            rates: rates(config, scene_scale),
            adam: AdamConfig { eps: config.adam_eps, ..AdamConfig::default() },
            optimizer: config.optimizer,
            optimizer_on: config.optimizer_on.0.unwrap_or_default(),
            moments: config.moments,
            strategy: strategy(config, scene_scale),
            scene_scale,
            ssim_variant: config.ssim_variant,
            color_correct: config.color_correct.0,
            photos: PhotoOptions {
                appearance: config.appearance.0.unwrap_or_default(),
                // Read when a run begins.
                first_appearance: None,
                robust_views: config.robust_views.is_on(),
                robust_pixels: match config.robust_pixels.0 {
                    Some(true) => BlockMasks::On,
                    Some(false) => BlockMasks::Off,
                    None => BlockMasks::IfNeeded,
                },
                // Drawn when a run begins.
                landmarks: Vec::new(),
                refine_poses: config.refine_poses.is_on(),
                // A resume with more or fewer steps leaves the phases of refined poses and masks as they were.
                steps: schedule_steps(config),
                scene_scale,
            },
            export_frame: config.export_frame,
            export_clean: config.export_clean.0,
            up: match config.up {
                Up::Along(up) => Some(up),
                Up::Auto | Up::Keep => None,
            },
            eval_every: config.eval_every,
            save_every: config.save_every,
            log_every: config.log_every,
            init_ply: config.init_ply.clone(),
        }
    }

    /// SH degree at 0-based `step`.
    pub fn sh_degree_at(&self, step: u32) -> u8 {
        let raised = step.checked_div(self.sh_every).unwrap_or(u32::MAX);
        raised.max(u32::from(self.sh_degree_start)).min(u32::from(self.sh_degree)) as u8
    }
}

fn rates(config: &TrainConfig, scene_scale: f32) -> Rates {
    Rates {
        means: config.means_lr * f64::from(scene_scale),
        means_final_factor: config.means_lr_final,
        others_final_factor: config.others_lr_final,
        scales: config.scales_lr,
        quats: config.quats_lr,
        opacities: config.opacities_lr,
        sh0: config.sh0_lr,
        sh_n: config.shn_lr,
        steps: schedule_steps(config),
    }
}

fn strategy(config: &TrainConfig, scene_scale: f32) -> Arc<dyn Strategy> {
    let or_never = |n: u32| if n == 0 { u32::MAX } else { n };
    let rounds = RoundSteps { start: config.refine_start, stop: config.refine_stop, every: config.refine_every };
    let prune_opa = config.prune_opa as f32;
    let max_gaussians = if config.max_gaussians == 0 { u64::MAX } else { config.max_gaussians };
    match config.strategy {
        StrategyName::None => Arc::new(NoStrategy),
        StrategyName::Default => Arc::new(DefaultStrategy {
            grow_grad2d: config.grow_grad2d as f32,
            grow_scale3d: config.grow_scale3d as f32,
            prune_opa,
            prune_scale3d: config.prune_scale3d as f32,
            rounds,
            reset_every: or_never(config.reset_every),
            schedule_steps: schedule_steps(config),
            max_gaussians,
        }),
        StrategyName::LongAxis => Arc::new(LongAxisStrategy {
            score: config.growth_score,
            recycle: config.recycle,
            prune_opa,
            rounds,
            checks: rounds,
            shares_room: false,
            max_gaussians,
            growth: growth_rule(config),
        }),
        StrategyName::Mcmc => Arc::new(McmcStrategy {
            dead_opacity: prune_opa,
            rounds,
            max_gaussians: config.max_gaussians,
            seed: config.seed,
            scene_scale: f64::from(scene_scale),
            rates: rates(config, scene_scale),
        }),
    }
}

fn loss_options(config: &TrainConfig) -> LossOptions {
    LossOptions { ssim_lambda: config.ssim_lambda as f32, padding: config.ssim_padding, simd: simd_path(config) }
}

impl Default for LossOptions {
    fn default() -> LossOptions {
        loss_options(&TrainConfig::default())
    }
}

/// How a run decides its count; `None` for a run that does not.
pub fn growth_rule(config: &TrainConfig) -> Option<GrowthRule> {
    let decides = config.strategy == StrategyName::LongAxis && config.max_gaussians == 0;
    decides.then(|| GrowthRule::new(config.quality, schedule_steps(config)))
}

/// Steps over which the learning rate decays.
pub fn schedule_steps(config: &TrainConfig) -> u32 {
    if config.schedule_steps == 0 { config.steps } else { config.schedule_steps }
}

/// The instruction path of a config on this machine.
pub fn simd_path(config: &TrainConfig) -> SimdPath {
    config.simd.0.unwrap_or_else(SimdPath::best)
}

pub fn read_options(config: &TrainConfig) -> ReadOptions {
    ReadOptions {
        images: (!config.images.is_empty()).then(|| config.images.clone()),
        allow_missing: config.allow_missing,
        points_later: false,
    }
}

pub fn load_options(config: &TrainConfig) -> LoadOptions {
    LoadOptions {
        data_factor: config.data_factor,
        max_resolution: (config.max_resolution > 0).then_some(config.max_resolution),
        test_every: (config.test_every > 0).then_some(config.test_every),
        test_after: (config.test_after >= 0).then(|| u32::try_from(config.test_after).unwrap_or(u32::MAX)),
        masks: config.masks,
        background: config.background.0.map(|c| (255.0 * c).round() as u8),
        invert_masks: config.invert_masks,
        allow_missing: config.allow_missing,
        near_plane: config.near_plane,
        views_file: (!config.views_file.is_empty()).then(|| PathBuf::from(&config.views_file)),
    }
}

/// SH degree of the first step, unless the given Gaussians have more.
pub fn first_sh_degree(config: &TrainConfig) -> u8 {
    if config.sh_every == 0 { config.sh_degree } else { config.sh_start.min(config.sh_degree) }
}

/// Options for creating first Gaussians, without SH bands above the first degree.
pub fn init_options(config: &TrainConfig) -> InitOptions {
    InitOptions {
        sh_degree: first_sh_degree(config),
        opacity: config.init_opacity as f32,
        scale_factor: config.init_scale as f32,
        seed: config.seed,
        max_gaussians: (config.max_gaussians > 0).then_some(config.max_gaussians as usize),
        ..InitOptions::default()
    }
}
