//! Masks of what moved on photos (`--robust-pixels`): [`crate::outliers::blocks`] in the steps of a run. A run that masks
//! nothing keeps the blocks of an earlier part of the run that did.
//!
//! Not here: which block is masked.

use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter, PhotoStep};
use super::saved::{Encoded, ValuesError};
use crate::dataset::loader::Dataset;
use crate::outliers::blocks::{self, BlockOutliers, BlockState};
use crate::outliers::blocks::{counts_masked_blocks, first_look_at_blocks};
use crate::page::format::encoding::EncodingError;
use crate::report::html::Page;
use crate::scene::camera::Camera;
use crate::scene::image::Target;
use serde_json::Value;
use std::path::Path;

/// In summary.json, the share of the blocks of training photos that are masked; absent in runs that masked none.
const FIGURE: &str = "masked_share";

pub(super) const KIND: Kind = Kind { name: "blocks", file: None, first, check, section };

/// What a step does with the blocks of its photo.
#[derive(Debug, Clone, Copy)]
struct Now {
    /// The view; `None` for blocks that were not looked at yet.
    view: Option<usize>,
    /// The masks stay as they are, because the picture is unusable for a judgement (for example after an opacity reset).
    are_kept: bool,
    /// All blocks count in this step, masked or not.
    all_count: bool,
}

struct MaskedBlocks {
    is_on: bool,
    state: BlockOutliers,
    steps: u32,
    train_views: usize,
    /// `None` in a step that masks nothing.
    now: Option<Now>,
    /// The blocks of the photo after a look at the last picture; `None` without one.
    found: Option<Vec<BlockState>>,
    /// The photo without its masked blocks.
    masked: Target,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    Some(Box::new(MaskedBlocks {
        is_on: options.robust_pixels,
        state: BlockOutliers::new(dataset.views.len()),
        steps: options.steps,
        train_views: dataset.train_views().len(),
        now: None,
        found: None,
        masked: Target::default(),
    }))
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    saved.decoded(BlockOutliers::check).map(drop)
}

impl PhotoParameter for MaskedBlocks {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded) -> Result<(), ValuesError> {
        saved.restore(&mut self.state, BlockOutliers::check, BlockOutliers::has_same_counts)
    }

    fn needs_host(&self) -> bool {
        self.is_on
    }

    fn begin_step(&mut self, at: &PhotoStep<'_>) {
        (self.now, self.found) = (None, None);
        if !self.is_on || at.is_left_out {
            return;
        }
        if at.is_rehearsal {
            self.now = Some(Now { view: None, are_kept: false, all_count: false });
            return;
        }
        let is_begun = !self.state.of_view(at.view).is_empty() || at.step >= first_look_at_blocks(self.steps);
        let are_kept = at.follows_reset();
        let all_count = counts_masked_blocks(at.step, self.steps, self.train_views);
        self.now = is_begun.then_some(Now { view: Some(at.view), are_kept, all_count });
    }

    fn needs_picture(&self) -> bool {
        self.now.is_some_and(|now| !now.are_kept)
    }

    fn target<'a>(&'a mut self, picture: Option<&[f32]>, photo: &'a Target) -> &'a Target {
        let Some(Now { view, are_kept, all_count }) = self.now else { return photo };
        let states = view.map_or(&[][..], |view| self.state.of_view(view));
        self.found = picture.filter(|_| !are_kept).and_then(|picture| blocks::look(states, picture, photo));
        if all_count {
            return photo;
        }
        match &self.found {
            Some(found) => blocks::mask(found, picture, photo, &mut self.masked),
            // Without a look at the picture there are no rims.
            None => blocks::mask(states, None, photo, &mut self.masked),
        }
        &self.masked
    }

    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        if let (Some(found), true) = (self.found.take(), outcome.has_trained()) {
            self.state.learn(outcome.view, found);
        }
        Vec::new()
    }

    fn buffer_bytes(&self) -> u64 {
        self.masked.bytes()
    }

    fn free_buffers(&mut self) {
        self.masked = Target::default();
    }

    /// The states of all blocks, with the two copies that a commit makes.
    fn value_bytes(&self, dataset: &Dataset) -> u64 {
        let of_view = |view: usize| {
            let Camera { width, height, .. } = dataset.views[view].camera;
            BlockOutliers::bytes_of_view(width, height)
        };
        if self.is_on { 3 * dataset.train_views().into_iter().map(of_view).sum::<u64>() } else { 0 }
    }

    fn figures(&self, _: &Dataset) -> Vec<(&'static str, Value)> {
        self.state.masked_share().map(|share| (FIGURE, share.into())).into_iter().collect()
    }
}

/// How much of the photos is masked because it shows what the scene does not, if the run masks such blocks.
fn section(page: &mut Page, _: &Path, summary: &Value) {
    let Some(share) = summary[FIGURE].as_f64() else { return };
    page.heading("Parts of photos that contradict the scene");
    page.paragraph(&format!(
        "At the end, blocks of {:.1} % of the area of the training photos did not count (--robust-pixels), because they differ \
         from the pictures as cars, people or shadows that moved do; rims of objects come on top. Much more than such things \
         take suggests wrong poses or changing exposures.",
        100.0 * share
    ));
}
