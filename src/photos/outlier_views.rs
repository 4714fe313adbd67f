//! Views whose photo contradicts the scene: [`crate::outliers::views`] in the steps of a run. Every run names them;
//! `--robust-views` leaves them out.
//!
//! Not here: the verdict.

use super::PhotoOptions;
use super::parameter::{Kind, PhotoOutcome, PhotoParameter};
use super::saved::{Encoded, ValuesError};
use crate::dataset::loader::Dataset;
use crate::outliers::views::ViewOutliers;
use crate::page::format::encoding::EncodingError;
use crate::report::html::{Cell, Page};
use serde_json::{Value, json};
use std::path::Path;

/// In summary.json, the views whose photo contradicts the scene: `name`, `unexplained` (share of the photo's variance that its
/// picture leaves unexplained; above 1 where a grey picture would be closer) and `is_left_out` (whether the run has left it out).
const FIGURE: &str = "outlier_views";

pub(super) const KIND: Kind = Kind { name: "outliers", file: None, first, check, section };

/// Names that a warning lists.
const NAMES_LISTED: usize = 20;

struct OutlierViews {
    state: ViewOutliers,
    are_left_out: bool,
    train_views: u32,
}

fn first(options: &PhotoOptions, dataset: &Dataset) -> Option<Box<dyn PhotoParameter>> {
    Some(Box::new(OutlierViews {
        state: ViewOutliers::new(dataset.views.len()),
        are_left_out: options.robust_views,
        train_views: dataset.train_views().len() as u32,
    }))
}

fn check(saved: &Encoded) -> Result<(), ValuesError> {
    saved.decoded(ViewOutliers::check).map(drop)
}

impl PhotoParameter for OutlierViews {
    fn name(&self) -> &'static str {
        KIND.name
    }

    fn save(&self) -> Result<Encoded, EncodingError> {
        Encoded::of(&self.state)
    }

    fn restore(&mut self, saved: &Encoded) -> Result<(), ValuesError> {
        saved.restore(&mut self.state, ViewOutliers::check, ViewOutliers::is_as_large_as)
    }

    fn leaves_out(&self, view: usize) -> bool {
        self.are_left_out && self.state.is_named(view)
    }

    fn needs_host(&self) -> bool {
        self.are_left_out
    }

    /// Notes the error of the view, also of a step that was skipped, and after an epoch names the views that have become outliers.
    fn end_step(&mut self, outcome: &PhotoOutcome<'_>) -> Vec<String> {
        self.state.measure(outcome.view, outcome.mse, outcome.photo);
        let (done, views) = (outcome.step + 1, self.train_views);
        if !done.is_multiple_of(views) {
            return Vec::new();
        }
        let found = self.state.end_epoch(done / views - 1);
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
