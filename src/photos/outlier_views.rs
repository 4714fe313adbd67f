//! Views whose photo contradicts the scene: [`crate::outliers::views`] in the steps of a run. Every run names them;
//! `--robust-views` leaves them out.
//!
//! Not here: the verdict.

use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter, PhotoStep, STEPS_AFTER_RESET};
use super::saved::{Encoded, ValuesError};
use crate::dataset::loader::Dataset;
use crate::outliers::views::{FIRST_EPOCHS, ViewOutliers, ViewState};
use crate::page::format::encoding::EncodingError;
use crate::report::html::{Cell, Page};
use crate::scene::image::Target;
use serde_json::{Value, json};
use std::path::Path;

/// In summary.json, the views whose photo contradicts the scene: `name`, `unexplained` (share of the photo's variance that its
/// picture leaves unexplained; above 1 where a grey picture would be closer) and `is_left_out` (whether the run has left it out).
const FIGURE: &str = "outlier_views";

pub(super) const KIND: Kind = Kind { name: "outliers", file: None, first, check, section };

/// Names that a warning lists.
const NAMES_LISTED: usize = 20;
/// In a group of at least so many views, a view is compared with earlier views of the group only. In a smaller group hardly a view would
/// come after the first eight, which are compared with nothing.
const COMPARED_WITHIN: usize = 16;
/// A view that is left out is measured once in this many epochs. In the others its turn goes to another view.
const MEASURED_EVERY: usize = 4;

/// A run that trains on such views warns of none before this many epochs, nor before half of its steps.
const WARNED_FROM_EPOCH: u32 = 10;

struct OutlierViews {
    state: ViewOutliers,
    are_left_out: bool,
    train_views: u32,
    /// The step looks at its picture.
    looks: bool,
    /// The step is a rehearsal, whose look judges nothing.
    is_rehearsal: bool,
    /// The picture contradicts its photo.
    is_contradicted: bool,
    /// Steps of the run.
    steps: u32,
    /// Views that this process has named, ascending.
    told: Vec<usize>,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    Some(Box::new(OutlierViews {
        state: ViewOutliers::new(dataset.views.len()),
        are_left_out: options.robust_views,
        train_views: dataset.train_views().len() as u32,
        looks: false,
        is_rehearsal: false,
        is_contradicted: false,
        steps: options.steps,
        told: Vec::new(),
    }))
}

/// Saved values, also those of programs that did not keep the measures of the last steps.
fn decoded(saved: &Encoded) -> Result<ViewOutliers, ValuesError> {
    match saved.decoded(ViewOutliers::check) {
        Err(ValuesError::Encoding(_)) => {
            let outliers = ViewOutliers::of_views(saved.decoded(|_: &Vec<ViewState>| Ok(()))?);
            outliers.check().map_err(ValuesError::Impossible)?;
            Ok(outliers)
        }
        decoded => decoded,
    }
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    decoded(saved).map(drop)
}

impl PhotoParameter for OutlierViews {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded) -> Result<(), ValuesError> {
        let saved = decoded(saved)?;
        if saved.has_same_counts(&self.state) {
            self.state = saved;
        }
        Ok(())
    }

    fn leaves_out(&self, view: usize) -> bool {
        self.are_left_out && self.state.is_named(view)
    }

    /// Every [`MEASURED_EVERY`]th epoch such a view is compared with its photo, so that it can return.
    fn is_replaced_at(&self, view: usize, step: u32) -> bool {
        let epoch = step / self.train_views.max(1);
        self.leaves_out(view) && !(epoch as usize + view).is_multiple_of(MEASURED_EVERY)
    }

    fn needs_host(&self) -> bool {
        self.are_left_out
    }

    fn begin_step(&mut self, at: &PhotoStep<'_>) {
        let is_early = at.step < FIRST_EPOCHS * self.train_views && !at.follows_reset();
        self.looks = self.are_left_out && !at.is_left_out && (is_early || at.is_rehearsal);
        (self.is_rehearsal, self.is_contradicted) = (at.is_rehearsal, false);
    }

    fn needs_picture(&self) -> bool {
        self.looks
    }

    fn target<'a>(&'a mut self, picture: Option<&[f32]>, photo: &'a Target) -> &'a Target {
        if self.looks && !self.is_rehearsal {
            self.is_contradicted = picture.is_some_and(|picture| self.state.contradicts(picture, photo));
        }
        photo
    }

    fn leaves_out_now(&self) -> bool {
        self.is_contradicted
    }

    /// Notes the error of the view, also of a step that was skipped, and after an epoch names the views that have become outliers.
    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        if !self.is_dark(outcome.after_reset) {
            self.state.measure(outcome.view, outcome.mse, outcome.photo);
        }
        if outcome.ended_group.is_some_and(|views| views >= COMPARED_WITHIN) {
            self.state.forget_recent();
        }
        let (done, views) = (outcome.step + 1, self.train_views);
        if !done.is_multiple_of(views) {
            return Vec::new();
        }
        let mut found = self.state.end_epoch(done / views - 1);
        if !self.are_left_out {
            if !self.is_late(done) {
                return Vec::new();
            }
            found = self.state.named().filter(|view| self.told.binary_search(view).is_err()).collect();
            self.told.extend(&found);
            self.told.sort_unstable();
        }
        self.warning(&found, done, outcome.dataset).into_iter().collect()
    }

    fn figures(&self, dataset: &Dataset) -> Vec<(&'static str, Value)> {
        let of_view = |view: usize| {
            let (name, unexplained) = (&dataset.views[view].name, self.state.unexplained(view));
            json!({ "name": name, "unexplained": unexplained, "is_left_out": self.are_left_out })
        };
        let views: Vec<Value> = self.state.named().map(of_view).collect();
        if views.is_empty() { Vec::new() } else { vec![(FIGURE, views.into())] }
    }
}

impl OutlierViews {
    /// Whether a picture `after_reset` steps after an opacity reset is dark, whatever its photo shows. Such a picture is not measured: each
    /// view misses one turn, and in epochs of more than [`STEPS_AFTER_RESET`] steps only some do.
    fn is_dark(&self, after_reset: Option<u32>) -> bool {
        after_reset.is_some_and(|steps| steps <= STEPS_AFTER_RESET.min(self.train_views))
    }

    /// Whether the pictures after `done` steps say something about photos that only get a warning: early pictures are rough, and
    /// those of sound photos at the rim of the scene stay rough the longest.
    fn is_late(&self, done: u32) -> bool {
        done >= WARNED_FROM_EPOCH * self.train_views && done >= self.steps / 2
    }

    /// Names views that have become outliers.
    fn warning(&self, found: &[usize], step: u32, dataset: &Dataset) -> Option<String> {
        if found.is_empty() {
            return None;
        }
        let names: Vec<&str> = found.iter().take(NAMES_LISTED).map(|&view| dataset.views[view].name.as_str()).collect();
        let more = found.len().saturating_sub(NAMES_LISTED);
        let names = names.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() };
        let (are, remedy) = match self.are_left_out {
            true => ("are left out from here on", "check them"),
            false => ("contradict the scene", "check them, or leave such views out with --robust-views"),
        };
        Some(format!(
            "step {step}: the photos of {} {are}, because they differ from their pictures far more than \
             others do (a wrong pose, another place, another exposure); {remedy}: {names}",
            if found.len() == 1 { String::from("a view") } else { format!("{} views", found.len()) }
        ))
    }
}

/// The names of the views that a summary lists.
pub fn names_in(summary: &Value) -> Vec<String> {
    let views = summary[FIGURE].as_array().map_or(&[][..], Vec::as_slice);
    views.iter().filter_map(|view| Some(view["name"].as_str()?.to_string())).collect()
}

/// The training views whose photo contradicts the scene, if there are any.
fn section(page: &mut Page, _: &Path, summary: &Value) {
    let views = summary[FIGURE].as_array().map_or(&[][..], Vec::as_slice);
    if views.is_empty() {
        return;
    }
    page.heading("Photos that contradict the scene");
    page.paragraph(
        "These training photos differ from their pictures far more than others do: a wrong pose, another place, another \
         exposure. Unexplained is the squared error over the variance of the photo; it is above 1 where a plain grey would be \
         closer. Check these photos and their poses, or leave them out with --robust-views.",
    );
    let state = |view: &Value| if view["is_left_out"] == true { "left out" } else { "trained on" };
    page.table(
        views,
        &[
            ("photo", &|view| Cell::text(view["name"].as_str().unwrap_or_default())),
            ("unexplained", &|view| Cell::number(view["unexplained"].as_f64(), 2)),
            ("", &|view| Cell::text(state(view))),
        ],
    );
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::dataset::frame::Frame;
    use crate::scene::camera::Camera;
    use crate::scene::events::EventLog;
    use glam::DVec3;
    use std::path::PathBuf;

    fn outliers(named: &[usize]) -> OutlierViews {
        let is_named = |view: usize| named.contains(&view);
        // As a commit holds a view: measure, whether it is measured, strikes, whether it is an outlier.
        let views: Vec<(i32, bool, u8, bool)> =
            (0..10).map(|v| (5, false, 2 * u8::from(is_named(v)), is_named(v))).collect();
        let state = decoded(&Encoded::of(&views).unwrap()).unwrap();
        OutlierViews {
            state,
            are_left_out: true,
            train_views: 10,
            looks: false,
            is_rehearsal: false,
            is_contradicted: false,
            steps: 400,
            told: Vec::new(),
        }
    }

    #[test]
    fn a_warning_comes_after_ten_epochs_and_half_of_the_steps() {
        let of_steps = |steps: u32| OutlierViews { steps, ..outliers(&[3]) };
        assert!(!of_steps(400).is_late(199) && of_steps(400).is_late(200));
        assert!(!of_steps(90).is_late(90) && of_steps(0).is_late(100));
    }

    #[test]
    fn values_without_the_last_steps_are_read_and_saved_with_them() {
        let mut first = outliers(&[3]);
        assert!(first.leaves_out(3) && !first.leaves_out(4));
        let saved = first.save().unwrap();
        assert_eq!(decoded(&saved).unwrap(), first.state);
        first.restore(&Encoded::of(&vec![(0, false, 0u8, false); 10]).unwrap()).unwrap();
        assert!(!first.leaves_out(3));
        first.restore(&Encoded::of(&vec![(0, false, 2u8, true); 11]).unwrap()).unwrap();
        assert!(!first.leaves_out(3), "of other photos");
        assert!(check(&Encoded::of(&vec![(0, false, 9u8, false); 10]).unwrap()).is_err(), "nine strikes");
        assert!(check(&Encoded::of(&7u8).unwrap()).is_err());
    }

    #[test]
    fn a_step_leaves_a_clear_contradiction_out_in_the_first_epochs_alone() {
        let viewmat = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let (width, height, near_plane, far_plane) = (4, 4, 0.01, 100.0);
        let camera = Camera { viewmat, fx: 20.0, fy: 20.0, cx: 2.0, cy: 2.0, width, height, near_plane, far_plane };
        // Black and white in turn; a picture with both exchanged leaves four times the variance.
        let photo =
            Target { width, height, rgb: (0..48).map(|i| if i / 3 % 2 == 0 { 0 } else { 255 }).collect(), mask: None };
        let exchanged: Vec<f32> = (0..48).map(|i| if i % 2 == 0 { 1.0 } else { 0.0 }).collect();
        let mut outliers = outliers(&[]);
        (0..10).for_each(|view| outliers.state.measure(view, 0.02, &photo));
        let events = EventLog::default();
        let mut leaves_out = |step: u32, is_rehearsal: bool, picture: &[f32]| {
            let at = PhotoStep { view: 7, step, camera: &camera, events: &events, is_left_out: false, is_rehearsal };
            outliers.begin_step(&at);
            let picture = outliers.needs_picture().then_some(picture);
            outliers.target(picture, &photo);
            outliers.leaves_out_now()
        };
        assert!(leaves_out(29, false, &exchanged), "three epochs of ten views");
        assert!(!leaves_out(30, false, &exchanged));
        assert!(!leaves_out(29, true, &exchanged), "a rehearsal takes the whole step");
    }

    /// Ends a step on a view, whose picture has this error.
    fn end(outliers: &mut OutlierViews, step: u32, mse: f64, (ended_group, after_reset): (Option<usize>, Option<u32>)) {
        let photo = Target { width: 4, height: 4, rgb: (0..48).map(|i| 5 * i).collect(), mask: None };
        let dataset = Dataset {
            views: Vec::new(),
            points: Vec::new(),
            colors: Vec::new(),
            frame: Frame { origin: DVec3::ZERO, scale: 1.0 },
            scene_scale: 1.0,
            warnings: Vec::new(),
            image_folder: PathBuf::new(),
        };
        let (view, photo, dataset) = (step as usize % 10, &photo, &dataset);
        let [is_skipped, is_left_out] = [false; 2];
        let outcome =
            PhotoOutcome { view, step, is_skipped, is_left_out, ended_group, after_reset, mse, photo, dataset };
        outliers.end_step(&outcome);
    }

    #[test]
    fn steps_soon_after_an_opacity_reset_measure_nothing() {
        let unexplained = |after_reset: Option<u32>| {
            let mut outliers = outliers(&[]);
            end(&mut outliers, 3, 0.02, (None, None));
            end(&mut outliers, 13, 0.5, (None, after_reset));
            outliers.state.unexplained(3)
        };
        assert!(unexplained(Some(10)) < 0.5, "dark");
        assert!(unexplained(Some(11)) > 0.5 && unexplained(None) > 0.5);
    }

    #[test]
    fn the_views_of_a_large_group_are_not_compared_with_those_of_the_group_before() {
        let swapped: Vec<f32> = vec![1.0; 48];
        let photo = Target { width: 4, height: 4, rgb: vec![0; 48], mask: None };
        let contradicts = |ended_group: Option<usize>| {
            let mut outliers = outliers(&[]);
            (0..9).for_each(|step| end(&mut outliers, step, 0.02, (None, None)));
            end(&mut outliers, 9, 0.02, (ended_group, None));
            outliers.state.contradicts(&swapped, &photo)
        };
        assert!(contradicts(None) && contradicts(Some(COMPARED_WITHIN - 1)));
        assert!(!contradicts(Some(COMPARED_WITHIN)));
    }

    #[test]
    fn pictures_soon_after_an_opacity_reset_are_dark() {
        let short = outliers(&[]);
        assert!(!short.is_dark(None) && short.is_dark(Some(1)) && short.is_dark(Some(10)) && !short.is_dark(Some(11)));
        let long = OutlierViews { train_views: 2000, ..outliers(&[]) };
        assert!(long.is_dark(Some(STEPS_AFTER_RESET)) && !long.is_dark(Some(STEPS_AFTER_RESET + 1)));
    }

    #[test]
    fn a_view_that_is_left_out_keeps_one_turn_in_four() {
        let outliers = outliers(&[3]);
        let kept: Vec<u32> = (0..8).filter(|epoch| !outliers.is_replaced_at(3, 10 * epoch + 7)).collect();
        assert_eq!(kept, [1, 5]);
        assert!((0..80).all(|step| !outliers.is_replaced_at(4, step)));
    }
}
