//! Transient objects (`--robust-pixels`): which blocks of a photo show something that the scene does not contain.
//!
//! A car that drove on is visible on one photo only. All others agree on the road below, so the picture shows the road, and the mean
//! colours of photo and picture differ over a whole area. Fine detail that the scene has not learnt yet differs less in the mean, and
//! lies where the photo has much contrast. So the score of a block is the running mean of its residuals (`grid`) over the
//! contrast of the photo around it.
//!
//! At each visit of a view, a block is masked if its score lies far above the median of the view, in units of the median absolute
//! deviation. Half of that distance suffices if the block touches a masked block or was masked before. Masked blocks are still measured:
//! a block counts again once the scene, trained on the other photos, shows the same. The rims of masked blocks are masked, too.
//!
//! Masks cost clean scenes decibels. So a run that masks [`BlockMasks::IfNeeded`] measures residuals for some passes without masks, and
//! decides by its landmarks ([`super::landmarks`]).
//!
//! Invariants: 1. running means are fixed-point numbers, and which blocks are masked follows from them, the photo and the blocks
//! masked before; 2. at most a quarter of the blocks of a view are masked; 3. the number of blocks of a view is bounded; 4. a run that
//! masks nothing keeps the blocks of an earlier part of the run that did.

use super::super::PhotoOptions;
use super::super::parameter::{
    Encoded, Finding, Kind, PastViews, PhotoOutcome, PhotoParameter, PhotoStep, ValuesError,
};
use super::grid::{BlockGrid, NO_PIXELS, PER_UNIT, RESIDUAL_LEAST, contrasts, mask_rims, residuals};
use super::landmarks::{LANDMARKS_MOST, ViewResiduals, contradicted_share};
use super::{MAD_OF_NORMAL, median_and_deviation};
use crate::dataset::loader::Dataset;
use crate::page::format::encoding::EncodingError;
use crate::scene::camera::Camera;
use crate::scene::image::{Image, Target};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::cmp::Reverse;

/// At most one block in four is masked.
const MASKED_MOST: usize = 4;
/// A score is far above the others if it exceeds the median of its view by this many standard deviations (estimated from the
/// median absolute deviation), and [`SCORE_LEAST`].
const DEVIATIONS: f64 = 4.0;
const SCORE_LEAST: f64 = 0.7;
/// Blocks beside a masked block, and blocks that were masked before, need this share of that distance from the median.
const NEAR: f64 = 0.5;
/// Added to the contrast, since plain areas of photos are noisy too.
const CONTRAST_LEAST: f64 = 0.03;
/// Blocks are judged after a tenth of the run, at the latest after [`FIRST_LOOK_LATEST`] steps.
const FIRST_LOOK_PART: u32 = 10;
const FIRST_LOOK_LATEST: u32 = 500;

/// Passes over the photos between [`first_look_at_blocks`] and the decision whether blocks are masked. The decision falls in the first half of
/// the run, after [`PASSES_LEAST`] passes and [`DECIDED_FROM`] steps, or not at all: what a rough scene has not learnt yet looks
/// contradicted (4 % of a clean city after 55 steps, 3 % of clean seneca after 450).
const PASSES: usize = 6;
const PASSES_LEAST: usize = 3;
const DECIDED_FROM: usize = 600;
/// Residuals are measured during this many passes before the decision, but during at most this many steps.
const PASSES_MEASURED: usize = 2;
const STEPS_MEASURED: usize = 600;
/// Blocks are masked if this share of the landmarks in photos is contradicted. Measured: .001 to .016 on clean scenes; .033 to .08 with 20 boxes
/// on each photo, where masks win .1 to .6 dB; .024 with four, where they lose .3 dB on photos that overlap much.
const SHARE: f64 = 0.03;

/// Which blocks of photos are masked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockMasks {
    Off,
    /// As `Off` until landmarks show that masks are needed, then as `On`.
    IfNeeded,
    On,
}

/// The first step that judges blocks, in a run of `steps` steps: pictures have the mean colours of the scene by then.
pub fn first_look_at_blocks(steps: u32) -> u32 {
    (steps / FIRST_LOOK_PART).min(FIRST_LOOK_LATEST)
}

/// Whether masked blocks count in the loss at `step` too: in every other epoch of the first half of a run of `steps` steps on `views`
/// views. A part of the scene that few photos show has a large residual at first, and a mask would keep the residual
/// large. While the part counts, its residual falls and its mask ends. The residual of a moving object rises again by the next visit,
/// because all other photos contradict the object.
pub fn counts_masked_blocks(step: u32, steps: u32, views: usize) -> bool {
    step < steps / 2 && (step as usize / views.max(1)).is_multiple_of(2)
}

/// The state of a block: twice its running mean, plus one if the block is masked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct BlockState(u16);

impl BlockState {
    fn new(mean: u16, is_masked: bool) -> BlockState {
        BlockState(mean << 1 | u16::from(is_masked))
    }

    /// [`NO_PIXELS`] for a block without used pixels.
    fn mean(self) -> u16 {
        self.0 >> 1
    }

    fn is_masked(self) -> bool {
        self.0 & 1 == 1
    }
}

/// The running means after another look, from the states before.
fn running_means(before: &[BlockState], now: Vec<u16>) -> Vec<u16> {
    // Photos of another size have other blocks.
    if before.len() != now.len() {
        return now;
    }
    let mean = |(before, now): (&BlockState, u16)| match before.mean() {
        before if before == NO_PIXELS || now == NO_PIXELS => now,
        before => ((u32::from(before) + u32::from(now)).div_ceil(2)) as u16,
    };
    before.iter().zip(now).map(mean).collect()
}

/// The residual that a running mean stands for; 0 for a block without used pixels.
fn residual(mean: u16) -> f64 {
    if mean == NO_PIXELS { 0.0 } else { f64::from(mean) / f64::from(PER_UNIT) }
}

/// The limits for the scores of a view: far above the others, and half as far. `None` if no block has used pixels.
fn limits(means: &[u16], scores: &[f64]) -> Option<[f64; 2]> {
    let used = means.iter().zip(scores).filter(|(mean, _)| **mean != NO_PIXELS);
    let mut used: Vec<f64> = used.map(|(_, &score)| score).collect();
    let (middle, deviation) = median_and_deviation(&mut used)?;
    let above = (DEVIATIONS * deviation / MAD_OF_NORMAL).max(SCORE_LEAST - middle);
    Some([middle + above, middle + NEAR * above])
}

/// The blocks of a view after a look at its picture `[3][height][width]`, from the blocks after the look before, if there was
/// one; `None` if the picture says nothing.
///
/// # Panics
/// Picture and photo differ in size.
pub fn look(before: &[BlockState], picture: &[f32], photo: &Target) -> Option<Vec<BlockState>> {
    let grid = BlockGrid::of(photo.width, photo.height);
    let means = running_means(before, residuals(picture, photo, &grid)?);
    let scored = means.iter().zip(contrasts(photo, &grid));
    let scores: Vec<f64> = scored.map(|(&mean, contrast)| residual(mean) / (contrast + CONTRAST_LEAST)).collect();
    let [far, near] = limits(&means, &scores)?;
    let is_masked = |&block: &usize| {
        let was_masked = before.len() == means.len() && before[block].is_masked();
        let touches = || grid.neighbours(block).any(|beside| scores[beside] > far);
        residual(means[block]) >= RESIDUAL_LEAST
            && (scores[block] > far || (scores[block] > near && (was_masked || touches())))
    };
    let mut masked: Vec<usize> = (0..means.len()).filter(is_masked).collect();
    let most = means.iter().filter(|&&mean| mean != NO_PIXELS).count() / MASKED_MOST;
    if masked.len() > most {
        // Scores are positive here, so their bits are in the order of their values.
        masked.sort_unstable_by_key(|&block| (Reverse(scores[block].to_bits()), block));
        masked.truncate(most);
    }
    let mut states: Vec<BlockState> = means.iter().map(|&mean| BlockState::new(mean, false)).collect();
    masked.iter().for_each(|&block| states[block] = BlockState::new(means[block], true));
    Some(states)
}

/// Writes the photo without its masked blocks into `masked`, whose memory is used again. With the `picture` (`[3][height][width]`, values
/// in 0..1) that the masks come from, the rims of the masked blocks are left out too.
pub fn mask(states: &[BlockState], picture: Option<&[f32]>, photo: &Target, masked: &mut Target) {
    let grid = BlockGrid::of(photo.width, photo.height);
    (masked.width, masked.height) = (photo.width, photo.height);
    masked.rgb.clone_from(&photo.rgb);
    let mask = masked.mask.get_or_insert_default();
    match &photo.mask {
        Some(of_photo) => mask.clone_from(of_photo),
        None => {
            mask.clear();
            mask.resize(photo.pixels(), u8::MAX);
        }
    }
    if states.len() != grid.blocks() {
        return;
    }
    for (block, _) in states.iter().enumerate().filter(|(_, state)| state.is_masked()) {
        let (columns, rows) = grid.pixels(block);
        rows.for_each(|y| mask[y * photo.width as usize..][columns.clone()].fill(0));
    }
    if let Some(picture) = picture {
        let is_masked: Vec<bool> = states.iter().map(|state| state.is_masked()).collect();
        mask_rims(&is_masked, picture, photo, mask);
    }
}

/// Checks the blocks of all views from a file. Errors: names what no run can have written.
fn check_views(views: &[Vec<BlockState>]) -> Result<(), &'static str> {
    let is_possible = |view: &Vec<BlockState>| {
        let masked = || view.iter().filter(|state| state.is_masked());
        view.len() <= BlockGrid::BLOCKS_MOST
            && masked().count() <= view.len() / MASKED_MOST
            && masked().all(|state| state.mean() != NO_PIXELS)
    };
    if views.iter().all(is_possible) { Ok(()) } else { Err("the blocks of a photo are invalid") }
}

/// In summary.json, the share of the blocks of training photos that are masked; absent in runs that masked none.
pub const MASKED_SHARE: &str = "masked_share";
/// In summary.json, the share of the landmarks in photos that was contradicted; absent in runs that did not judge it.
const CONTRADICTED: &str = "contradicted_share";

pub(in crate::photos) const KIND: Kind = Kind { name: "blocks", file: None, first, check, finding };

/// What a step does with the blocks of its photo.
#[derive(Debug, Clone, Copy)]
struct BlocksNow {
    /// The view; `None` for blocks that were not looked at yet.
    view: Option<usize>,
    /// The masks stay as they are, because the picture is unusable for a judgement (for example after an opacity reset).
    are_kept: bool,
    /// All blocks count in this step, masked or not.
    all_count: bool,
}

/// What a commit holds.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Blocks {
    /// By view; empty for a view that was not looked at yet. All are empty once a run has decided to mask none.
    views: Vec<Vec<BlockState>>,
    /// The share of the landmarks in photos that was contradicted, once it is judged.
    contradicted: Option<f64>,
    /// Empty once they have been judged.
    landmarks: Vec<[f32; 3]>,
}

impl Blocks {
    /// Errors: names what no run can have written.
    fn check(&self) -> Result<(), &'static str> {
        let is_finite =
            self.contradicted.is_none_or(f64::is_finite) && self.landmarks.as_flattened().iter().all(|x| x.is_finite());
        if !is_finite || self.landmarks.len() > LANDMARKS_MOST {
            return Err("the landmarks of photos are invalid");
        }
        check_views(&self.views)
    }

    /// Reads what a commit holds. Earlier versions wrote the blocks of the views alone.
    fn decoded(saved: &Encoded) -> Result<Blocks, ValuesError> {
        let of_views = |views| Blocks { views, ..Blocks::default() };
        saved.decoded(Blocks::check).or_else(|error| {
            let views: Result<Vec<_>, _> = saved.decoded(|views: &Vec<_>| check_views(views));
            views.map(of_views).map_err(|_| error)
        })
    }
}

/// When a run decides whether blocks are masked.
struct Decision {
    /// The first step whose residuals count for it.
    first: u32,
    /// Steps done when it falls.
    after: u32,
}

struct MaskedBlocks {
    masks: BlockMasks,
    blocks: Blocks,
    steps: u32,
    train_views: usize,
    /// `None` in a step that masks nothing.
    now: Option<BlocksNow>,
    /// The blocks of the photo after a look at the last picture; `None` without one.
    found: Option<Vec<BlockState>>,
    masked: Target,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    Some(Box::new(MaskedBlocks {
        masks: options.robust_pixels,
        blocks: Blocks {
            views: vec![Vec::new(); dataset.views.len()],
            contradicted: None,
            landmarks: options.landmarks.clone(),
        },
        steps: options.steps,
        train_views: dataset.train_views().len(),
        now: None,
        found: None,
        masked: Target::default(),
    }))
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    Blocks::decoded(saved).map(drop)
}

impl PhotoParameter for MaskedBlocks {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.blocks)
    }

    fn restore(&mut self, saved: &Encoded, past: &PastViews) -> Result<(), ValuesError> {
        let saved = Blocks::decoded(saved)?;
        self.blocks = Blocks { views: past.of(&saved.views), ..saved };
        Ok(())
    }

    fn needs_host(&self, step: u32) -> bool {
        self.is_masking() || self.decision().is_some_and(|decision| step >= decision.first)
    }

    fn begin_step(&mut self, at: &PhotoStep<'_>) {
        (self.now, self.found) = (None, None);
        if at.is_left_out || !(self.needs_host(at.step) || (at.is_rehearsal && self.decision().is_some())) {
            return;
        }
        if at.is_rehearsal {
            self.now = Some(BlocksNow { view: None, are_kept: false, all_count: false });
            return;
        }
        let is_begun = self.blocks.views.get(at.view).is_some_and(|states| !states.is_empty())
            || at.step >= first_look_at_blocks(self.steps);
        let are_kept = at.follows_reset();
        let all_count = !self.is_masking() || counts_masked_blocks(at.step, self.steps, self.train_views);
        self.now = is_begun.then_some(BlocksNow { view: Some(at.view), are_kept, all_count });
    }

    fn needs_picture(&self) -> bool {
        self.now.is_some_and(|now| !now.are_kept)
    }

    fn target<'a>(&'a mut self, picture: Option<&Image>, photo: &'a Target) -> &'a Target {
        let picture = picture.map(|picture| picture.rgb.as_slice());
        let Some(BlocksNow { view, are_kept, all_count }) = self.now else { return photo };
        let states = view.and_then(|view| self.blocks.views.get(view)).map_or(&[][..], Vec::as_slice);
        self.found = picture.filter(|_| !are_kept).and_then(|picture| look(states, picture, photo));
        if all_count {
            return photo;
        }
        match &self.found {
            Some(found) => mask(found, picture, photo, &mut self.masked),
            // Without a look at the picture there are no rims.
            None => mask(states, None, photo, &mut self.masked),
        }
        &self.masked
    }

    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        let found = self.found.take().filter(|_| outcome.has_trained());
        if let (Some(found), Some(states)) = (found, self.blocks.views.get_mut(outcome.view)) {
            *states = found;
        }
        let is_due = self.decision().is_some_and(|decision| outcome.step + 1 >= decision.after);
        is_due.then(|| self.judge(outcome.dataset)).flatten().into_iter().collect()
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
            (size_of::<Vec<BlockState>>() + size_of::<BlockState>() * BlockGrid::of(width, height).blocks()) as u64
        };
        if self.is_masking() || self.decision().is_some() {
            3 * dataset.train_views().into_iter().map(of_view).sum::<u64>()
        } else {
            0
        }
    }

    fn figures(&self, _: &Dataset) -> Vec<(&'static str, Value)> {
        let blocks = || self.blocks.views.iter().flatten();
        let (count, masked) = (blocks().count(), blocks().filter(|state| state.is_masked()).count());
        let share =
            (count > 0 && self.decision().is_none()).then(|| (MASKED_SHARE, (masked as f64 / count as f64).into()));
        let contradicted = self.blocks.contradicted.map(|share| (CONTRADICTED, share.into()));
        share.into_iter().chain(contradicted).collect()
    }
}

impl MaskedBlocks {
    fn is_masking(&self) -> bool {
        match self.masks {
            BlockMasks::Off => false,
            BlockMasks::IfNeeded => self.blocks.contradicted.is_some_and(|share| share >= SHARE),
            BlockMasks::On => true,
        }
    }

    /// The steps of the decision that is still to come; `None` in a run without landmarks, or too short for it.
    fn decision(&self) -> Option<Decision> {
        if self.masks != BlockMasks::IfNeeded || self.blocks.landmarks.is_empty() {
            return None;
        }
        let begin = first_look_at_blocks(self.steps) as usize;
        let of_passes = |passes: usize| passes.saturating_mul(self.train_views);
        let after = (begin + of_passes(PASSES)).max(DECIDED_FROM).min(self.steps as usize / 2);
        let first = after.saturating_sub(of_passes(PASSES_MEASURED).min(STEPS_MEASURED));
        let is_long_enough = after >= DECIDED_FROM.max(begin + of_passes(PASSES_LEAST));
        is_long_enough.then_some(Decision { first: first as u32, after: after as u32 })
    }

    /// Decides whether blocks are masked. Returns what the user is told.
    fn judge(&mut self, dataset: &Dataset) -> Option<String> {
        let landmarks = std::mem::take(&mut self.blocks.landmarks);
        let residuals = |states: &Vec<BlockState>| {
            let of = |state: &BlockState| (state.mean() != NO_PIXELS).then(|| residual(state.mean()));
            states.iter().map(of).collect()
        };
        let seen = self.blocks.views.iter().enumerate().filter(|(_, states)| !states.is_empty());
        let views: Vec<ViewResiduals<'_>> = seen
            .map(|(view, states)| ViewResiduals { camera: &dataset.views[view].camera, of_block: residuals(states) })
            .collect();
        let share = contradicted_share(&landmarks, &views);
        self.blocks.contradicted = share;
        if self.is_masking() {
            let percent = 100.0 * share.unwrap_or_default();
            return Some(format!(
                "{percent:.1} % of the first points in photos look wrong on one photo alone, as things that moved do: such parts of photos are \
                 masked from here on (--robust-pixels off keeps them)"
            ));
        }
        self.blocks.views.iter_mut().for_each(Vec::clear);
        None
    }
}

/// How much of the photos is masked because it shows what the scene does not, if the run masks such blocks.
fn finding(_: &Value, summary: &Value) -> Option<Finding> {
    let text = format!(
        "At the end, blocks of {:.1} % of the area of the training photos did not count (--robust-pixels), because they differ \
         from the pictures as cars, people or shadows that moved do; rims of objects come on top. Much more than such things \
         take suggests wrong poses or changing exposures.",
        100.0 * summary[MASKED_SHARE].as_f64()?
    );
    Some(Finding { title: "Parts of photos that contradict the scene", text, ..Finding::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 64;
    const HEIGHT: usize = 48;

    /// A photo whose brightness rises from left to right, with a bright square of 12 pixels where asked, on which `picture` shows
    /// the same without the square, and with errors of single pixels.
    fn scene(square: Option<(usize, usize)>) -> (Target, Vec<f32>) {
        let value = |x: usize, y: usize| 60 + x + y % 3;
        let mut photo = Target::new([WIDTH as u32, HEIGHT as u32], Vec::new());
        let mut picture = vec![0.0; 3 * WIDTH * HEIGHT];
        for (x, y) in (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x, y))) {
            let is_inside =
                square.is_some_and(|(left, top)| (left..left + 12).contains(&x) && (top..top + 12).contains(&y));
            photo.rgb.extend([if is_inside { 230 } else { value(x, y) as u8 }; 3]);
            let error = if (x + y).is_multiple_of(2) { 0.06 } else { -0.05 };
            (0..3).for_each(|c| picture[c * WIDTH * HEIGHT + y * WIDTH + x] = value(x, y) as f32 / 255.0 + error);
        }
        (photo, picture)
    }

    fn masked_pixels(states: &[BlockState], photo: &Target) -> Vec<usize> {
        let mut masked = Target::default();
        mask(states, None, photo, &mut masked);
        assert_eq!(masked.rgb, photo.rgb);
        (0..photo.pixels()).filter(|&i| masked.mask.as_ref().unwrap()[i] == 0).collect()
    }

    #[test]
    fn an_object_on_one_photo_is_masked_whole_and_fine_errors_are_not() {
        let (photo, picture) = scene(None);
        let states = look(&[], &picture, &photo).unwrap();
        assert_eq!(masked_pixels(&states, &photo), [0; 0]);
        let (photo, picture) = scene(Some((20, 16)));
        let states = look(&[], &picture, &photo).unwrap();
        let inside: Vec<usize> = (16..28).flat_map(|y| (20..32).map(move |x| y * WIDTH + x)).collect();
        assert_eq!(masked_pixels(&states, &photo), inside);
    }

    #[test]
    fn an_object_across_blocks_is_masked_with_its_rim() {
        let (photo, picture) = scene(Some((21, 18)));
        let states = look(&[], &picture, &photo).unwrap();
        let object: Vec<usize> = (18..30).flat_map(|y| (21..33).map(move |x| y * WIDTH + x)).collect();
        let blocks = masked_pixels(&states, &photo);
        assert!(!blocks.is_empty() && object.iter().any(|pixel| !blocks.contains(pixel)), "blocks alone leave a rim");
        let mut masked = Target::default();
        mask(&states, Some(&picture), &photo, &mut masked);
        let mask = masked.mask.unwrap();
        let is_out = |pixel: &usize| object.contains(pixel) || blocks.contains(pixel);
        let want: Vec<usize> = (0..photo.pixels()).filter(is_out).collect();
        assert_eq!((0..photo.pixels()).filter(|&pixel| mask[pixel] == 0).collect::<Vec<_>>(), want);
    }

    #[test]
    fn a_block_returns_when_the_picture_comes_to_show_it() {
        let (photo, picture) = scene(Some((20, 16)));
        let mut states = look(&[], &picture, &photo).unwrap();
        let right: Vec<f32> =
            (0..3).flat_map(|c| photo.rgb.iter().skip(c).step_by(3)).map(|&byte| f32::from(byte) / 255.0).collect();
        let looks = (1..9).find(|_| {
            states = look(&states, &right, &photo).unwrap();
            masked_pixels(&states, &photo).is_empty()
        });
        assert!(looks.is_some_and(|looks| looks > 1), "{looks:?}: one look is not enough");
    }

    #[test]
    fn pixels_under_a_mask_stay_masked_and_say_nothing() {
        let (mut photo, picture) = scene(Some((20, 16)));
        let mut of_user = vec![u8::MAX; photo.pixels()];
        (16..28).for_each(|y| of_user[y * WIDTH + 20..][..12].fill(0));
        photo.mask = Some(of_user.clone());
        let states = look(&[], &picture, &photo).unwrap();
        let mut masked = Target::default();
        mask(&states, None, &photo, &mut masked);
        assert_eq!(masked.mask.unwrap(), of_user);
        photo.mask = Some(vec![0; photo.pixels()]);
        assert_eq!(look(&[], &picture, &photo), None);
    }

    #[test]
    fn blocks_of_earlier_versions_are_read() {
        let views = vec![
            [(9, true), (5, false), (5, false), (5, false)].map(|(mean, is)| BlockState::new(mean, is)).repeat(2),
            Vec::new(),
        ];
        let read = Blocks::decoded(&Encoded::of(&views).unwrap()).unwrap();
        assert_eq!((read.views, read.contradicted, read.landmarks.len()), (views.clone(), None, 0));
        let now = Blocks { views, contradicted: Some(0.04), landmarks: vec![[1.0; 3]] };
        let read = Blocks::decoded(&Encoded::of(&now).unwrap()).unwrap();
        assert_eq!((read.views, read.contradicted, read.landmarks), (now.views, Some(0.04), vec![[1.0; 3]]));
        let masked = vec![vec![BlockState::new(9, true); 2]];
        assert!(Blocks::decoded(&Encoded::of(&masked).unwrap()).is_err(), "more than a quarter is masked");
    }

    #[test]
    fn a_run_decides_in_its_first_half_or_not_at_all() {
        let decision = |steps: u32, train_views: usize| {
            let blocks = Blocks { landmarks: vec![[0.0; 3]], ..Blocks::default() };
            let masks = BlockMasks::IfNeeded;
            let run =
                MaskedBlocks { masks, blocks, steps, train_views, now: None, found: None, masked: Target::default() };
            let needs_host = |step: &u32| run.needs_host(*step);
            let needed = (0..steps).filter(needs_host).map(|step| [step, steps]);
            run.decision().inspect(|of| assert_eq!(needed.clone().next(), Some([of.first, steps]))).map(|of| of.after)
        };
        assert_eq!(decision(30_000, 144), Some(500 + 6 * 144));
        assert_eq!(decision(3000, 15), Some(600));
        assert_eq!(decision(1500, 132), Some(750));
        assert_eq!(decision(30_000, 2000), Some(12_500));
        assert_eq!([decision(1100, 15), decision(1500, 240), decision(30_000, 10_000)], [None; 3]);
    }

    #[test]
    fn at_most_a_quarter_is_masked_the_worst_first() {
        let (photo, mut picture) = scene(None);
        // The right half differs, more towards the right.
        for (i, value) in picture.iter_mut().enumerate().filter(|(i, _)| i % WIDTH >= WIDTH / 2) {
            *value = 0.7 + (i % WIDTH) as f32 / 256.0;
        }
        let blocks = BlockGrid::of(photo.width, photo.height).blocks();
        let states = look(&[], &picture, &photo).unwrap();
        assert!(states.iter().filter(|state| state.is_masked()).count() <= blocks / MASKED_MOST);
    }

    #[test]
    fn pictures_that_are_no_numbers_and_photos_of_another_size_say_nothing() {
        let (photo, mut picture) = scene(Some((20, 16)));
        let first = look(&[], &picture, &photo).unwrap();
        assert_eq!(look(&first[1..], &picture, &photo), Some(first.clone()), "blocks of another size are forgotten");
        assert_eq!(masked_pixels(&first[1..], &photo), [0; 0]);
        picture[5] = f32::NAN;
        assert_eq!(look(&first, &picture, &photo), None);
    }

    #[test]
    fn blocks_are_bounded_and_impossible_ones_refused() {
        for (width, height) in [(1, 1), (4000, 3000), (20_000, 20_000), (64, 65), (160, 112)] {
            let blocks = BlockGrid::of(width, height).blocks();
            assert!((1..=BlockGrid::BLOCKS_MOST).contains(&blocks), "{width}x{height}: {blocks}");
        }
        let of = |states: Vec<BlockState>| check_views(&[Vec::new(), states]);
        let (free, masked) = (BlockState::new(5, false), BlockState::new(9, true));
        assert_eq!(of(vec![free, free, masked, free]), Ok(()));
        assert!(of(vec![free, masked, masked, free]).is_err());
        assert!(of(vec![free, free, free, BlockState::new(NO_PIXELS, true)]).is_err());
        assert!(of(vec![free; BlockGrid::BLOCKS_MOST + 1]).is_err());
    }
}
