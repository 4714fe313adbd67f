//! What the report of a run says of its photos: their exposures, refined poses, and what contradicts the scene.
//!
//! Not here: the values, which the run writes beside its summary ([`crate::photos`] in `appearance.json` and `poses.json`).

use super::chart::{Chart, Mark};
use super::html::{Cell, Page};
use super::run_report::{POINTS_MAX, read_json};
use serde_json::Value;
use std::path::Path;

/// Adds the sections of what the run has learnt of its photos.
pub(super) fn add_photos(page: &mut Page, folder: &Path, summary: &Value) {
    add_appearance(page, &read_json(&folder.join("appearance.json")).unwrap_or_default());
    add_poses(page, &read_json(&folder.join("poses.json")).unwrap_or_default());
    add_outlier_views(page, summary);
    add_masked_blocks(page, summary);
}

/// A chart of the exposures of the photos, if the run has trained them.
fn add_appearance(page: &mut Page, values: &Value) {
    let images = values["images"].as_array().map_or(&[][..], Vec::as_slice);
    let stops = |(i, image): (usize, &Value)| Some((i as f64, image["exposure"].as_f64()?));
    let points: Vec<(f64, f64)> = images.iter().enumerate().filter_map(stops).collect();
    if points.is_empty() {
        return;
    }
    page.heading("Appearance");
    let stride = points.len().div_ceil(POINTS_MAX);
    let points = points.into_iter().step_by(stride).collect();
    let chart = Chart::new("Exposure", "photo, by name", "stops").with("", points, Mark::LineAndDots);
    let first = match values["exposures_from_exif"].as_u64() {
        None | Some(0) => String::new(),
        Some(count) => format!(" {count} exposures started from EXIF data."),
    };
    let caption = format!(
        "Exposure of each training photo against the mean of all, as trained.{first} appearance.json has the numbers."
    );
    page.charts(&[(chart.svg(), caption)]);
}

/// How far the run has moved the cameras of its photos, if it refines poses.
fn add_poses(page: &mut Page, file: &Value) {
    let of = |what: &str, which: &str| file[what][which].as_f64();
    let (Some(median), Some(largest), Some(scale)) =
        (of("shift", "median"), of("shift", "largest"), file["scene_scale"].as_f64())
    else {
        return;
    };
    let [turn, most] = ["median", "largest"].map(|which| of("turn_degrees", which).unwrap_or_default());
    page.heading("Poses");
    page.paragraph(&format!(
        "The run has refined the poses of {} training photos (--refine-poses): against the dataset their cameras moved by {:.2} % \
         of the scene's scale (median; {:.2} % at most) and turned by {turn:.2} degrees ({most:.2} at most). poses.json has the \
         refined poses.",
        file["refined"],
        100.0 * median / scale,
        100.0 * largest / scale,
    ));
}

/// The training views whose photo contradicts the scene, if there are any.
fn add_outlier_views(page: &mut Page, summary: &Value) {
    let views = summary["outlier_views"].as_array().map_or(&[][..], Vec::as_slice);
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

/// How much of the photos is masked because it shows what the scene does not, if the run masks such blocks.
fn add_masked_blocks(page: &mut Page, summary: &Value) {
    let Some(share) = summary["masked_share"].as_f64() else { return };
    page.heading("Parts of photos that contradict the scene");
    page.paragraph(&format!(
        "At the end, blocks of {:.1} % of the area of the training photos did not count (--robust-pixels), because they differ \
         from the pictures as cars, people or shadows that moved do; rims of objects come on top. Much more than such things \
         take suggests wrong poses or changing exposures.",
        100.0 * share
    ));
}
