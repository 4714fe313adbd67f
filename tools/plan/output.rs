//! The output of `gsscale-plan`: JSON, or text with a table.
//!
//! Not here: the plans.

use super::{Args, Row, Scene, state_bytes};
use gsscale::base::units::{format_bytes, format_grouped, format_seconds};
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::plan::batches::cut_views;
use gsscale::paging::simulation::replay::WINDOW_STEPS;
use gsscale::train::preflight::forecast::{Forecast, Reach};
use serde_json::{Value, json};

/// A line of the table.
pub fn json_of(args: &Args, scene: &Scene, row: &Row) -> Value {
    let (f, steps) = (&row.figures, f64::from(row.figures.steps));
    let (views, batches) = views_in_batches(scene, row.frames);
    let is_belady_bound = row.planned.is_exact && scene.config.evict == EvictPolicy::FarthestNextUse;
    json!({
        "view_order": row.order.to_string(), "automatic": row.is_automatic, "frames": row.frames,
        "steps_simulated": row.planned.steps.len(), "is_belady_bound": is_belady_bound,
        "views_in_batches": views, "batches_most": batches, "pages_per_step": f.pages_per_step, "hit_rate": f.hit_rate, "lru_hit_rate": row.lru.hit_rate,
        "bytes_read_per_step": f.read_per_step, "bytes_written_per_step": f.written_per_step,
        "heaviest_5_percent_share": f.heaviest_share,
        "worst_window": { "first_step": f.worst_window, "steps": WINDOW_STEPS, "bytes_per_step": f.worst_per_step },
        "stall_seconds_per_step": row.stall.seconds / steps, "stall_seconds_worst": row.stall.worst_seconds,
        "steps_that_wait": f64::from(row.stall.steps) / steps, "seconds": row.seconds,
        "bytes_read": row.total_read, "bytes_written": row.total_written,
        "share_of_endurance": row.total_written / args.endurance.0 as f64,
    })
}

/// What the run will take, with the Gaussians that it reaches.
pub fn json_of_forecast(forecast: &Forecast) -> Value {
    json!({
        "gaussians": forecast.gaussians, "gaussians_known_by": format!("{:?}", forecast.reach).to_lowercase(),
        "memory_bytes": forecast.memory_at_end().total(), "memory_bytes_at_start": forecast.memory[0].total(),
        "frames": forecast.tiers.frames, "drive_bytes": forecast.drive_bytes, "drive_bytes_peak": forecast.drive_bytes_peak,
        "ply_bytes": forecast.ply_bytes, "bytes_written": forecast.bytes_written,
        "if_growth_does_not_pay": forecast.if_kept.as_ref().map(|kept| json_of_forecast(kept)),
        "commit_bytes": forecast.commit_bytes, "seconds": forecast.seconds, "drive_seconds": forecast.drive_seconds,
    })
}

/// The same of a run whose growth will not pay.
fn text_of_kept(kept: &Forecast) -> String {
    format!(
        "  if growth does not pay: memory about {}, drive {}, time about {}\n",
        format_bytes(kept.memory_at_end().total()),
        format_bytes(kept.drive_bytes_peak),
        format_seconds(kept.seconds)
    )
}

/// The lines about the run; the table below them is about comparisons.
fn text_of_forecast(scene: &Scene) -> String {
    let forecast = match &scene.forecast {
        Ok(forecast) => forecast,
        Err(_) if scene.frames_within.is_none() => return String::new(),
        Err(why) => return format!("no forecast of the whole run: {why}\n"),
    };
    let drive = match forecast.frames_at_end {
        Some(_) => format!(
            "about {} ({} of pages and their versions of the last commits), about {} to write without commits",
            format_bytes(forecast.drive_bytes_peak),
            format_bytes(forecast.drive_bytes),
            format_bytes(forecast.bytes_written as u64)
        ),
        None => format!("checkpoint about {}", format_bytes(forecast.drive_bytes_peak)),
    };
    format!(
        "the run, as its dry run says it, with {} Gaussians at the end{}:\n  memory  about {} at the peak\n  \
         drive   {drive}, PLY {}; commits write about {}\n  time    about {}\n{}",
        format_grouped(forecast.gaussians[1]),
        if matches!(forecast.reach, Reach::Guess | Reach::Decided | Reach::Sparse) { " (a guess)" } else { "" },
        format_bytes(forecast.memory_at_end().total()),
        format_bytes(forecast.ply_bytes),
        format_bytes(forecast.commit_bytes as u64),
        format_seconds(forecast.seconds),
        forecast.if_kept.as_deref().map_or(String::new(), text_of_kept),
    )
}

/// The whole text: the run, then the table.
pub fn report(args: &Args, scene: &Scene, rows: &[Row]) -> String {
    let size = |bytes: f64| format_bytes(bytes as u64);
    let pages = scene.index.len();
    let mut text = text_of_forecast(scene);
    text += &format!(
        "{} Gaussians in {pages} pages of at most {} rows, {} on disk\n\
         {} views need {:.1} % of the pages on average, {:.1} % at most",
        scene.gaussians,
        scene.config.page_rows,
        format_bytes(state_bytes(scene)),
        scene.cameras.len(),
        100.0 * scene.views.total() as f64 / scene.cameras.len() as f64 / pages as f64,
        100.0 * scene.views.most() as f64 / pages as f64,
    );
    text += &format!(
        "\n{:12} {:>14} {:>9} {:>9} {:>10} {:>10} {:>12} {:>9} {:>8} {:>8} {:>10} {:>7}",
        "order",
        "frames",
        "hit rate",
        "of lru",
        "read/step",
        "write/step",
        "worst 20/step",
        "wait/step",
        "longest",
        "time",
        "written",
        "life"
    );
    for row in rows {
        let f = &row.figures;
        let mut name = row.order.to_string();
        if row.is_automatic {
            name += " *";
        }
        let memory = format!("{} {}", row.frames, size(row.frames as f64 * scene.frame_bytes as f64));
        text += &format!(
            "\n{name:12} {memory:>14} {:>9.3} {:>9.3} {:>10} {:>10} {:>13} {:>8.4}s {:>7.2}s {:>8} {:>10} {:>6.1}%",
            f.hit_rate,
            row.lru.hit_rate,
            size(f.read_per_step),
            size(f.written_per_step),
            size(f.worst_per_step),
            row.stall.seconds / f64::from(f.steps),
            row.stall.worst_seconds,
            format_seconds(row.seconds),
            size(row.total_written),
            100.0 * row.total_written / args.endurance.0 as f64,
        );
    }
    text += &format!(
        "\n*        chosen by auto\
         \nworst 20 bytes read and written\
         \nwait     for a drive that reads {}/s and writes {}/s,\
         \n         and steps of {:.4} s{}\
         \ntime     of all {} steps at the Gaussians of now: compares the rows{}\
         \nwritten  by import and all steps, without commits; life: share of {}",
        size(scene.drive.read_rate),
        size(scene.drive.write_rate),
        scene.drive.step_seconds,
        match (args.step_seconds, &scene.timed_on) {
            (Some(_), _) => String::new(),
            (None, Some(device)) => format!("\n         ({device}, median view)"),
            (None, None) => " (assumed: no view fits)".to_string(),
        },
        scene.config.steps,
        if scene.forecast.is_ok() { "; the run takes the time named at the top" } else { "" },
        format_bytes(args.endurance.0),
    );
    for (frames, views, batches) in in_batches(scene, rows) {
        text += &format!(
            "\nWith {frames} frames, steps on {views} views take up to {batches} batches, which read pages twice."
        );
    }
    if rows.iter().any(|row| !row.planned.is_exact) {
        text += "\nThe plan reached less than two epochs ahead: a larger --plan-mem may reduce reads.";
    }
    text
}

/// Each number of frames with which views need several batches, with the number of these views and the most batches.
fn in_batches(scene: &Scene, rows: &[Row]) -> Vec<(usize, usize, usize)> {
    let mut frames: Vec<usize> = rows.iter().map(|row| row.frames).collect();
    frames.dedup();
    let cut = |frames| {
        let (views, batches) = views_in_batches(scene, frames);
        (frames, views, batches)
    };
    frames.into_iter().map(cut).filter(|(_, views, _)| *views > 0).collect()
}

/// The number of views that need several batches, and the most batches of one of them.
fn views_in_batches(scene: &Scene, frames: usize) -> (usize, usize) {
    let pages = (0..scene.views.views()).map(|view| scene.views.of(view).len());
    cut_views(pages, frames, usize::MAX)
}
