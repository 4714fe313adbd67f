//! The plan of a run as text, as a run prints it at its start.

use super::device_memory;
use super::forecast::{Forecast, Reach, first_pages};
use super::plan::{LargestView, with_margin};
use crate::base::units::{counted, format_bytes, format_bytes_up, format_grouped, format_seconds};
use crate::config::file::TrainConfig;
use crate::config::limits;
use crate::config::values::{Choice, Chosen, Residence};
use crate::dataset::loader::Dataset;
use crate::page::folder::file_system::free_bytes;
use crate::photos::diagnosis::Diagnosis;
use crate::photos::exposure::AppearanceMode;
use crate::train::commits::checkpoint::reserve_bytes;
use crate::train::inputs::machine::drive_of;
use crate::train::start::first_scene::Start;
use crate::train::start::tiers::Tiers;
use crate::train::state::trainer::Trainer;
use std::path::Path;

/// Rated endurance of a common drive of 500 GB, bytes written.
const ENDURANCE_BYTES: f64 = 300e12;
/// Share of the time that steps wait for the drive from which the plan names it.
const WAITS_WORTH_A_WORD: f64 = 0.1;

const COLUMNS: usize = 80;
/// Indent of wrapped lines: the width of the first column.
const INDENT: &str = "        ";

/// The growth of the number of Gaussians, as text of a plan.
fn growth(forecast: &Forecast) -> String {
    let last = format_grouped(forecast.gaussians[1]);
    let grows = forecast.gaussians[1] > forecast.gaussians[0];
    match forecast.reach {
        Reach::Constant => String::from(" (no densification)"),
        Reach::Kept => String::from(", which stays their number (too few photos to decide by)"),
        Reach::Cap => format!(", growing to at most {last}"),
        Reach::Guess => {
            format!(", growing to perhaps {last} (a guess; --max-gaussians caps them)")
        }
        Reach::Sparse => {
            let reach = if grows { format!("growing to perhaps {last}") } else { String::from("probably to stay") };
            format!(", {reach}: few photos see each place (held-out training photos decide; see --quality)")
        }
        Reach::Decided if !grows => String::from(", which probably stays their number (see --quality)"),
        Reach::Decided => {
            format!(
                ", growing as far as held-out training photos say that it pays, perhaps to {last} (a guess; see --quality)"
            )
        }
    }
}

/// What the photos say, and what the run switches on because of it: where the config left it open `before`.
pub fn describe_photos(diagnosis: Option<&Diagnosis>, before: &TrainConfig, now: &TrainConfig) -> String {
    let said = diagnosis.map(|diagnosis| diagnosis.text().join("\n        "));
    let mut text = format!("photos  {}", said.as_deref().unwrap_or("the scene has no points to examine them by"));
    let appearance = format!("--appearance {}", now.appearance.word());
    let switched_on = [
        (before.appearance.0.is_none() && now.appearance != Chosen(Some(AppearanceMode::Off)), appearance.as_str()),
        (before.robust_views.0.is_none() && now.robust_views.is_on(), "--robust-views"),
        (before.refine_poses.0.is_none() && now.refine_poses.is_on(), "--refine-poses"),
        (before.poor_points.0.is_none() && now.poor_points.is_on(), "--poor-points"),
    ];
    let flags: Vec<&str> = switched_on.into_iter().filter_map(|(is_on, flag)| is_on.then_some(flag)).collect();
    if !flags.is_empty() {
        text.push_str(&format!("\n        so this run has {}; each can be switched off", flags.join(" ")));
    }
    folded(&text)
}

/// The plan: dataset, start, tiers and device. `[scene, out]` are the scene and the output folder; without results the latter is empty.
pub fn describe(
    config: &TrainConfig,
    [scene, out]: [&Path; 2],
    dataset: &Dataset,
    trainer: &Trainer,
    forecast: &Forecast,
    tiers: &Tiers,
) -> String {
    let largest = dataset.views.iter().map(|v| &v.camera).max_by_key(|c| c.pixels());
    let size = largest.map_or(String::new(), |c| format!("{}x{} pixels", c.width, c.height));
    let results = match out.as_os_str().is_empty() {
        true => String::new(),
        false => format!(", results in {}", out.display()),
    };
    let commits = match config.residence() {
        Residence::Memory => "to checkpoint/ in the results (see --commit-every)",
        Residence::Frames => "nowhere: --frames without --spill-dir is for comparisons",
        Residence::SpillDir(_) => "to the spill directory (see --commit-every)",
    };
    let of_photos = trainer.photos.iter().filter_map(|parameter| parameter.plan_text());
    let photos: String = of_photos.map(|text| format!("photos  {text}\n")).collect();
    let text = format!(
        "scene   {}: {} to train on, {} held out, at most {size}\n\
         {photos}\
         start   {}, SH degree {}{}\n\
         run     {} on {} ({}), rendered by {}{results}\n\
         commit  {commits}\n\
         {}{}",
        scene.display(),
        counted(dataset.train_views().len() as u64, "view"),
        dataset.test_views().len(),
        counted(trainer.scene.rows(), "Gaussian"),
        config.sh_degree,
        growth(forecast),
        counted(config.steps.into(), "step"),
        counted(rayon::current_num_threads() as u64, "thread"),
        limits::simd_path(config).name(),
        trainer.renderer.device(),
        describe_tiers(forecast, tiers, config.host_mem.0 > 0),
        device_memory::describe(config, forecast.memory_at_end())
    );
    folded(text.trim_end())
}

/// The lines about pages, memory, drive and time.
fn describe_tiers(forecast: &Forecast, tiers: &Tiers, has_named_limit: bool) -> String {
    let (plan, memory) = (&forecast.tiers, forecast.memory_at_end());
    let part = |name: &str, bytes: u64| format!("    {name:<44} {:>10}\n", format_bytes(bytes));
    let LargestView { pages: largest, mean, .. } = &plan.largest_view;
    let mut text = format!(
        "pages   {} of up to {}; a view needs {mean:.0} on average, {largest} at most\n",
        plan.pages[0],
        format_bytes(plan.frame_bytes)
    );
    if let (views @ 1.., most) = plan.cut_views {
        text.push_str(&format!(
            "        {views} views are larger than the frames: steps on them take up to {most} batches\n"
        ));
    }
    let frames = match forecast.frames_at_end {
        None => String::from("Gaussians with their optimizer state"),
        Some(_) if !plan.frames_are_named && forecast.holds_all_pages() => {
            String::from("frames of pages, one for every page")
        }
        Some(frames) => match plan.frames {
            Some(first) if first != frames => format!("{frames} frames of pages ({first} at the start)"),
            _ => format!("{frames} frames of pages"),
        },
    };
    let grows = forecast.gaussians[1] > forecast.gaussians[0];
    let at = if grows { format!(", with {} Gaussians", format_grouped(forecast.gaussians[1])) } else { String::new() };
    let start = match &forecast.if_kept {
        _ if !grows => String::new(),
        Some(kept) => or_kept(format_bytes(kept.memory_at_end().total())),
        None => format!(" ({} at the start)", format_bytes(forecast.memory[0].total())),
    };
    text.push_str(&format!("memory  about {} at the peak{at}{start}\n", format_bytes(memory.total())));
    let limit = forecast.host_mem.filter(|_| plan.frames.is_none() && forecast.frames_at_end.is_some());
    if let Some(limit) = limit {
        text.push_str(&format!(
            "        when the scene has outgrown {}, {}, its pages move to checkpoint/\n",
            format_bytes(limit),
            if has_named_limit { "--host-mem" } else { "the default share of the free memory, and what is free then" }
        ));
    }
    if let Some(limit) = forecast.host_mem.filter(|limit| has_named_limit && *limit < memory.total()) {
        text.push_str(&format!(
            "        more than --host-mem {}, also with the fewest frames: give at least {}, lower --max-gaussians, or make the photos smaller\n",
            format_bytes(limit),
            format_bytes_up(with_margin(memory.total(), memory))
        ));
    }
    text.push_str(&part(&frames, memory.frames));
    text.push_str(&part("one view: rows, gradients, images", memory.view));
    text.push_str(&part("decoded photos (--image-cache)", memory.targets));
    if memory.staging > 0 {
        text.push_str(&part("encoded pages in transfer, and the plan", memory.staging));
    }
    text.push_str(&part("index of the pages", memory.index));
    text.push_str(&part("program and tables", memory.base + memory.copies));
    text.push_str(&drive(forecast, tiers, &at));
    text.push_str(&format!(
        "time    about {} for {} steps{at}{}, without evaluation{}\n",
        format_seconds(forecast.seconds),
        format_grouped(forecast.steps.into()),
        forecast.if_kept.as_ref().map_or(String::new(), |kept| or_kept(format_seconds(kept.seconds))),
        waits(forecast)
    ));
    if !forecast.shorter.is_empty() {
        let of_run =
            |(steps, seconds): &(u32, f64)| format!("--steps {steps} takes about {}", format_seconds(*seconds));
        let runs: Vec<String> = forecast.shorter.iter().map(of_run).collect();
        text.push_str(&format!(
            "        shorter: {}; smaller photos (--max-resolution) are faster, too\n",
            runs.join(", ")
        ));
    }
    text
}

/// What a run takes whose growth will not pay, as the end of a sentence.
fn or_kept(what: String) -> String {
    format!(" ({what} if growth does not pay)")
}

/// The part of the time that is spent on the drive, if it is worth a word.
fn waits(forecast: &Forecast) -> String {
    match forecast.drive_seconds > WAITS_WORTH_A_WORD * forecast.seconds {
        true => format!(", {} of it waiting for a common drive", format_seconds(forecast.drive_seconds)),
        false => String::new(),
    }
}

/// Wraps the lines of a text at 80 columns, and indents the rest of each. Lines break only behind a comma, a semicolon or a colon, or
/// before a bracket; a line without such a place stays long.
fn folded(text: &str) -> String {
    let mut lines = Vec::new();
    for line in text.lines() {
        let mut rest = line.to_string();
        while rest.chars().count() > COLUMNS {
            let Some(at) = break_of(&rest) else { break };
            let after = format!("{INDENT}{}", rest[at..].trim_start());
            lines.push(rest[..at].trim_end().to_string());
            rest = after;
        }
        lines.push(rest);
    }
    lines.join("\n")
}

/// The byte at which a line is wrapped: the last such place within the columns; inside brackets only if there is no other place.
fn break_of(line: &str) -> Option<usize> {
    let is_break = |at: &usize| {
        let (before, after) = line.split_at(*at);
        before.len() > INDENT.len()
            && after.starts_with(' ')
            && (before.ends_with([',', ';', ':']) || after.starts_with(" ("))
    };
    let is_inside = |at: &usize| line[..*at].matches('(').count() > line[..*at].matches(')').count();
    let ends = line.char_indices().take(COLUMNS + 1).map(|(at, _)| at);
    let breaks: Vec<usize> = ends.filter(is_break).collect();
    breaks.iter().rfind(|at| !is_inside(at)).or(breaks.last()).copied()
}

/// What the steps write to the drive.
fn written_text(forecast: &Forecast) -> String {
    let (written, life) = (forecast.bytes_written, 100.0 * forecast.bytes_written / ENDURANCE_BYTES);
    format!(
        "about {} to write without commits, {life:.2} % of the rated life of a common drive",
        format_bytes(written as u64)
    )
}

/// The lines about drives.
fn drive(forecast: &Forecast, tiers: &Tiers, at: &str) -> String {
    let (plan, commits) = (&forecast.tiers, forecast.commit_bytes);
    let kept = forecast.if_kept.as_ref().map_or(String::new(), |kept| or_kept(format_bytes(kept.drive_bytes_peak)));
    let commits = match commits > 0.0 {
        true => format!("commits write about {}", format_bytes(commits as u64)),
        false => String::from("no periodic commits"),
    };
    if !tiers.spills() {
        let [checkpoint, ply] = [forecast.drive_bytes_peak, forecast.ply_bytes].map(format_bytes);
        let written = match forecast.bytes_written > 0.0 {
            true => format!("        {}\n", written_text(forecast)),
            false => String::new(),
        };
        return format!("drive   checkpoint about {checkpoint}{kept}, PLY {ply}{at}; {commits}\n{written}");
    }
    let now = if at.is_empty() {
        String::new()
    } else {
        format!(" ({} at the start)", format_bytes(plan.pages[0] * plan.frame_bytes))
    };
    // A dry run keeps the pages in memory, whatever the run will use.
    let by = if tiers.engine == "memory" { String::new() } else { format!(" by {}", tiers.engine) };
    format!(
        "drive   about {} with the versions of the last commits{at}{kept}, {} free\n        \
         one version is {} of pages{now}{by} ({})\n        \
         each new segment file takes {}; a reserve file of {} is given up when the drive is full\n        \
         {}; {commits}\n",
        format_bytes(forecast.drive_bytes_peak),
        plan.free_bytes.map_or(String::from("unknown"), format_bytes),
        format_bytes(forecast.drive_bytes),
        tiers.codec,
        format_bytes(tiers.segment_bytes),
        format_bytes(reserve_bytes(tiers.segment_bytes)),
        written_text(forecast)
    )
}

/// Describes a scene that a dry run cannot plan because its pages exceed half of the budget; `None` if they fit. A dry
/// run writes no pages: it keeps the pages of the drive in memory, in at most half of the budget.
pub fn too_large_for_a_dry_run(config: &TrainConfig, start: &Start, host_mem: Option<u64>) -> Option<String> {
    let (spill_dir, budget) = (config.residence().spill_dir()?, host_mem?);
    let [pages, frame] = first_pages(config, start.rows);
    if pages.saturating_mul(frame) <= budget / 2 {
        return None;
    }
    let free = free_bytes(&drive_of(spill_dir)).ok().flatten();
    Some(format!(
        "scene   {} views to train on, {} held out\n\
         start   {} Gaussians\n\
         pages   about {pages} of up to {}, {} in all; the drive has {} free\n\
         memory  {} in all, fewer than {} at once\n\
         views   unknown: their needs follow from pages on the drive, and a dry run writes none.\n        \
         gsscale-plan with the same flags checks them, and so does the run before its first step.",
        start.dataset.train_views().len(),
        start.dataset.test_views().len(),
        start.rows,
        format_bytes(frame),
        format_bytes(pages.saturating_mul(frame)),
        free.map_or(String::from("unknown"), format_bytes),
        format_bytes(budget),
        counted((budget / frame).max(1), "page"),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_folded_at_their_marks() {
        let start =
            "start   41321 Gaussians, SH degree 3, growing to perhaps 146,904 (a guess; --max-gaussians caps them)";
        let halves = "start   41321 Gaussians, SH degree 3, growing to perhaps 146,904\n        (a guess; --max-gaussians caps them)";
        assert_eq!(folded(start), halves);
        assert_eq!(folded(halves), halves);
        let path = format!("scene   /{}: 21 views", "a".repeat(90));
        assert_eq!(folded(&path), path, "a path has no place to break it");
    }
}
