//! What a city costs by phase, from its plan: seconds, and bytes over the network behind the folder of the city and the scene. Also as if
//! the scene was a larger one of the same kind. All of it is modelled.
//!
//! A step of a cell takes the time of one of the prior, times half of what the scene grows by. A photo is read for each step, or once for each
//! leg where `--image-cache` holds the cell's photos. A copy has half of the bytes by which its cell grows. All machines share the network.

use super::plan::{CellPlan, CityPlan};
use super::prior::STEPS_SHARE;
use super::work::COPY_EVERY;
use crate::base::units::{parse_bytes, parse_count};
use crate::config::file::TrainConfig;
use crate::scene::state::row_bytes;
use serde::Serialize;

/// The polish takes one in this many of the steps.
pub(crate) const POLISH_SHARE: u32 = 20;
/// A view is drawn without its gradient in this part of a step.
const DRAWING_SHARE: f64 = 1.0 / 3.0;

/// A larger scene to plan for: `PHOTOS,GAUSSIANS,BYTES,SECONDS`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AsIf {
    /// All training photos.
    pub photos: u64,
    /// Gaussians of the whole scene at its end.
    pub gaussians: u64,
    pub photo_bytes: u64,
    /// Seconds of a step of the prior.
    pub step_seconds: f64,
}

impl std::str::FromStr for AsIf {
    type Err = String;

    fn from_str(text: &str) -> Result<AsIf, String> {
        let form = || "give PHOTOS,GAUSSIANS,BYTES,SECONDS, such as 40000,100M,8MB,0.05".to_string();
        let [photos, gaussians, bytes, seconds] = text.split(',').collect::<Vec<_>>().try_into().map_err(|_| form())?;
        let (photos, gaussians, photo_bytes) = (parse_count(photos)?, parse_count(gaussians)?, parse_bytes(bytes)?);
        let step_seconds = seconds.parse().ok().filter(|seconds| (1e-6..=1e6).contains(seconds)).ok_or_else(form)?;
        let is_in_range = (1..=1_000_000_000).contains(&photos) && (1..=1_000_000_000_000).contains(&gaussians);
        if is_in_range { Ok(AsIf { photos, gaussians, photo_bytes, step_seconds }) } else { Err(form()) }
    }
}

/// The photos of a scene on average, bytes: as files, and decoded at the size at which cells train on them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PhotoBytes {
    pub file: f64,
    pub decoded: f64,
}

/// What the costs of a plan follow from.
pub(crate) struct Basis<'a> {
    pub whole: &'a TrainConfig,
    pub photo: PhotoBytes,
    /// Seconds of a step of the prior.
    pub step_seconds: f64,
    /// Steps of the whole scene.
    pub steps: f64,
    pub prior_degree: u8,
    /// Bytes a second; machines that work on cells.
    pub network: f64,
    pub machines: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhaseCost {
    pub phase: &'static str,
    pub machines: usize,
    pub seconds: f64,
    /// Bytes read and written over the network, by all machines.
    pub network: f64,
    /// The photos among them.
    pub photos: f64,
}

impl Basis<'_> {
    /// The plan of the larger scene, of which this one is a model: with as many photos on each part of the ground, which see as far. So a
    /// ring keeps its width, and photos that a cell shares with neighbours become more by the root of the factor.
    pub fn enlarge(&mut self, plan: &mut CityPlan, larger: AsIf) {
        let by_photos = larger.photos as f64 / plan.views as f64;
        let by_rows = larger.gaussians as f64 / (plan.growth * plan.gaussians as f64);
        let by_width = by_photos.sqrt();
        let own_views = plan.views as f64 / plan.cells.len() as f64;
        let times = |of: f64, by: f64| (of * by).ceil() as u64;
        let (growth, step_seconds) = (plan.growth, larger.step_seconds / self.step_seconds);
        let cells = plan.cells.iter().map(|cell| {
            let views = cell.train_views as f64;
            let own = views.min(own_views);
            let by_views = (own * by_photos + (views - own) * by_width) / views;
            let (trained, frozen) =
                (times(cell.trained as f64, by_rows), times(cell.frozen as f64, by_rows / by_width));
            let max_gaussians = times(trained as f64, growth) + frozen;
            CellPlan {
                train_views: times(views, by_views) as usize,
                test_views: times(cell.test_views as f64, by_views) as usize,
                steps: times(cell.steps.into(), by_views) as u32,
                trained,
                frozen,
                max_gaussians,
                bytes: times(max_gaussians as f64, cell.bytes as f64 / cell.max_gaussians as f64),
                seconds: cell.seconds * by_views * step_seconds,
                ..cell.clone()
            }
        });
        plan.cells = cells.collect();
        (plan.views, plan.gaussians) = (larger.photos as usize, times(plan.gaussians as f64, by_rows));
        let decoded = self.photo.decoded * larger.photo_bytes as f64 / self.photo.file.max(1.0);
        self.photo = PhotoBytes { file: larger.photo_bytes as f64, decoded };
        (self.step_seconds, self.steps) = (larger.step_seconds, self.steps * by_photos);
    }

    /// The phases of a city, in order.
    pub fn phases(&self, plan: &CityPlan) -> Vec<PhaseCost> {
        let prior_bytes = (plan.gaussians as usize * row_bytes(self.prior_degree)) as f64;
        let ply = |rows: f64, degree: u8| rows * row_bytes(degree) as f64 / 3.0;
        let whole_ply = ply(plan.gaussians as f64 * plan.growth, self.whole.sh_degree);
        let one = |phase, seconds, photos, others| PhaseCost {
            phase,
            machines: 1,
            seconds,
            network: photos + others,
            photos,
        };
        let [prior_steps, polish_steps] = [STEPS_SHARE, POLISH_SHARE].map(|share| self.steps / f64::from(share));
        let prior_photos = self.photos_read(plan.views as f64, prior_steps, 1.0);
        let prior_others = ply(plan.gaussians as f64, self.prior_degree) + prior_bytes;
        let polish_photos = self.photos_read(plan.views as f64, polish_steps, 1.0);
        let copies: f64 = plan.cells.iter().map(|cell| cell.bytes as f64).sum();
        vec![
            one("prior", prior_steps * self.step_seconds, prior_photos, prior_others),
            one("cut", plan.views as f64 * self.step_seconds * DRAWING_SHARE, 0.0, prior_bytes),
            self.cells(plan, prior_bytes / plan.gaussians as f64),
            one("merge", (copies + whole_ply) / self.network, 0.0, copies + whole_ply),
            one("polish", polish_steps * self.step_seconds * plan.growth, polish_photos, 2.0 * whole_ply),
        ]
    }

    /// The cells: the longest first, each to the machine that is free first.
    fn cells(&self, plan: &CityPlan, prior_row_bytes: f64) -> PhaseCost {
        let (mut busy, mut photos, mut others) = (vec![0.0f64; self.machines.clamp(1, plan.cells.len())], 0.0, 0.0);
        let mut longest: Vec<&CellPlan> = plan.cells.iter().collect();
        longest.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
        for cell in longest {
            let legs = (cell.seconds / COPY_EVERY).floor() + 1.0;
            let rows = (cell.trained + cell.frozen) as f64;
            let copied = legs * 0.5 * (1.0 + rows / cell.max_gaussians.max(1) as f64) * cell.bytes as f64;
            let views = (cell.train_views + cell.test_views) as f64;
            photos += self.photos_read(views, cell.steps.into(), legs);
            others += copied + rows * prior_row_bytes;
            if let Some(first) = busy.iter_mut().min_by(|a, b| a.total_cmp(b)) {
                // Photos are read beside the steps, copies are made between legs.
                *first += cell.seconds + copied / self.network;
            }
        }
        let longest = busy.iter().copied().fold(0.0, f64::max);
        let network = photos + others;
        PhaseCost {
            phase: "cells",
            machines: busy.len(),
            seconds: longest.max(network / self.network),
            network,
            photos,
        }
    }

    /// Bytes of the photos that a run of so many legs reads.
    fn photos_read(&self, views: f64, steps: f64, legs: f64) -> f64 {
        let is_cached = views * self.photo.decoded <= self.whole.image_cache.0 as f64;
        self.photo.file * if is_cached { (legs * views).min(steps) } else { steps }
    }
}
