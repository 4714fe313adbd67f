//! The live page of a run ([`crate::report::live`]), whose pictures (`scene_picture`) are drawn between steps.
//!
//! Invariants: 1. a picture changes no bit of the result: it is drawn like an evaluation, which stores nothing; 2. pictures take at
//! most 5 % of the time before each is begun; the steps after a picture load again what it evicted, which is not counted; 3. a picture that
//! cannot be drawn, or takes too much memory, gives the page an error and does not end the run; 4. a run without a waiting page trains
//! as if it had no page.

use super::scene_picture::{overview, picture};
use crate::base::trace;
use crate::dataset::loader::Dataset;
use crate::dataset::target_cache::TargetCache;
use crate::report::live::{Live, Orbit, PictureTicket, Status};
use crate::train::state::trainer::Trainer;
use std::time::{Duration, Instant};

/// Percent of a run's time that pictures may take.
const PICTURE_PERCENT: u32 = 5;
/// Time between two reports of the status.
const STATUS_EVERY: Duration = Duration::from_millis(200);

/// The live page of a run, and the time that its pictures took.
#[derive(Debug)]
pub struct LivePage {
    live: Live,
    began: Instant,
    /// Time that pictures took.
    spent: Duration,
    told: Option<Instant>,
    /// Name of the scene.
    name: String,
    /// The view that the page shows first; chosen once.
    overview: Option<u32>,
}

impl LivePage {
    /// A page of the scene `name`, whose pictures have taken no time yet.
    pub fn new(live: Live, name: String) -> LivePage {
        LivePage { live, began: Instant::now(), spent: Duration::ZERO, told: None, name, overview: None }
    }

    /// The request that is to be drawn now, if there is one and the share of pictures allows it.
    fn due(&self) -> Option<(PictureTicket, Orbit)> {
        self.live.wanted().filter(|_| self.may_draw())
    }

    /// Whether a picture is to be drawn after the next step.
    pub(super) fn is_due(&self) -> bool {
        self.due().is_some()
    }

    /// Whether the share of pictures allows another one.
    fn may_draw(&self) -> bool {
        100 * self.spent <= PICTURE_PERCENT * self.began.elapsed()
    }

    /// Reports the progress to the page, and draws the picture that the page requests.
    pub(super) fn show(&mut self, trainer: &mut Trainer, dataset: &Dataset, targets: &TargetCache, psnr: Option<f64>) {
        let is_last = trainer.steps_done() == trainer.options.steps;
        if is_last || self.told.is_none_or(|told| told.elapsed() >= STATUS_EVERY) {
            self.told = Some(Instant::now());
            let overview = *self.overview.get_or_insert_with(|| overview(&trainer.scene, dataset));
            self.live.set_status(Status {
                name: self.name.clone(),
                overview,
                is_training: true,
                step: trainer.steps_done(),
                steps: trainer.options.steps,
                psnr,
                picture_percent: PICTURE_PERCENT,
                ..counts(trainer, dataset)
            });
        }
        // A step in flight is finished first; the page waits.
        let Some((ticket, orbit)) = self.due().filter(|_| !trainer.is_ahead()) else { return };
        let started = Instant::now();
        let _span = trace::span("live picture");
        self.live.show((ticket, orbit), picture(trainer, dataset, targets, orbit));
        self.spent += started.elapsed();
    }
}

/// The numbers of a scene, for a page.
pub(super) fn counts(trainer: &Trainer, dataset: &Dataset) -> Status {
    let pager = &trainer.scene.pager;
    Status {
        gaussians: trainer.scene.rows(),
        pages: pager.index().len() as u64,
        pages_in_memory: pager.pages_in_memory() as u64,
        views: dataset.train_views().len() as u32,
        held_out: dataset.test_views().len() as u32,
        ..Status::default()
    }
}

#[cfg(test)]
#[allow(clippy::expect_used)] // a panic is a failed test
mod tests {
    use super::*;

    #[test]
    fn pictures_take_their_share_of_the_time_and_the_first_is_free() {
        let live = Live::begin(std::net::SocketAddr::from(([127, 0, 0, 1], 0))).expect("a free port");
        let page = |spent: u64, seconds: u64| LivePage {
            live: live.clone(),
            began: Instant::now().checked_sub(Duration::from_secs(seconds)).expect("the machine runs for minutes"),
            spent: Duration::from_secs(spent),
            told: None,
            name: String::new(),
            overview: None,
        };
        assert!(page(0, 0).may_draw());
        assert!(page(4, 100).may_draw() && !page(6, 100).may_draw());
    }
}
