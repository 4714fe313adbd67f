//! The files in the output folder of a run: names, kinds, and the part of a run that each belongs to.
//!
//! Not here: their content, and the checkpoint, whose folder `config` names. [`RUN_FILES`] is the one list: whoever writes
//! another file into the folder adds it, and so it is removed with the rest when a run replaces an earlier one.

/// Every setting of the run, with the facts resolved at its start. A folder without it is not a run's.
pub const CONFIG_FILE: &str = "config.toml";
/// Settings of a run that has no config.toml yet. The run that writes it also removes it, so it is not in [`RUN_FILES`].
pub const BEGUN_FILE: &str = ".gsscale-begun.toml";
/// One line of JSON per logged step.
pub const METRICS_FILE: &str = "metrics.jsonl";
pub const EVENTS_FOLDER: &str = "tensorboard";
/// Figures of the whole run, written at its end.
pub const SUMMARY_FILE: &str = "summary.json";
/// The Gaussians at the end.
pub const PLY_FILE: &str = "point_cloud.ply";
/// The way from the coordinates of the Gaussians to those of the dataset, and back.
pub const TRANSFORM_FILE: &str = "point_cloud.transform.json";
/// The camera with which viewers start.
pub const SETTINGS_FILE: &str = "point_cloud.settings.json";
pub const REPORT_FILE: &str = "report.html";
/// The pages seen from above, for the report: a JSON list of [`super::page_map::PageTile`].
pub const PAGES_FILE: &str = "pages.json";
/// Folder of the pictures of the held-out views.
pub const PICTURES_FOLDER: &str = "renders/test";
/// PSNR and SSIM of each held-out view, beside its picture.
pub const VIEWS_FILE: &str = "renders/test/views.json";
/// Output of `gsscale-eval --json`, in place of the figures of the summary.
pub const EVALUATED_FILE: &str = "evaluated.json";
/// What the photos said before training.
pub const DIAGNOSIS_FILE: &str = "diagnosis.json";
/// Config of that evaluation.
pub const EVALUATED_AS_FILE: &str = "evaluated-as.toml";
/// Figures of a published run beside those that were published, of `gsscale-bench run`.
pub const PUBLISHED_FILE: &str = "published.json";
/// The same as a page.
pub const PUBLISHED_PAGE_FILE: &str = "published.html";

/// What stands under a name in the output folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunFile {
    File(&'static str),
    /// The files of `--save-every`, as [`saved_ply_name`] names them.
    SavedPlys,
    /// A folder of event files; other files in it are not ours.
    Events(&'static str),
    /// What `--export` writes beside [`PLY_FILE`], in any format. Nothing of a run is removed where a folder of an export holds
    /// files of others.
    Exports,
    /// What a run has learnt of its photos: a file of each kind of parameters.
    Photos,
    /// A folder tree of PNG files; other files in it are not ours.
    Pictures(&'static str),
}

/// The part of a run that a file describes. It decides when a later run in the folder removes the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tells {
    Start,
    Steps,
    Result,
    /// A later evaluation of its result.
    Evaluation,
}

/// All files, in the order in which they are removed: without the config, the rest is not taken for a run's.
pub const RUN_FILES: [(RunFile, Tells); 19] = [
    (RunFile::File(CONFIG_FILE), Tells::Start),
    (RunFile::File(DIAGNOSIS_FILE), Tells::Start),
    (RunFile::File(METRICS_FILE), Tells::Steps),
    (RunFile::Events(EVENTS_FOLDER), Tells::Steps),
    (RunFile::File(SUMMARY_FILE), Tells::Result),
    (RunFile::File(PLY_FILE), Tells::Result),
    (RunFile::File(TRANSFORM_FILE), Tells::Result),
    (RunFile::File(SETTINGS_FILE), Tells::Result),
    (RunFile::Exports, Tells::Result),
    (RunFile::File(REPORT_FILE), Tells::Result),
    (RunFile::File(PAGES_FILE), Tells::Result),
    (RunFile::Photos, Tells::Result),
    (RunFile::SavedPlys, Tells::Result),
    (RunFile::File(EVALUATED_FILE), Tells::Evaluation),
    (RunFile::File(EVALUATED_AS_FILE), Tells::Evaluation),
    (RunFile::File(PUBLISHED_FILE), Tells::Evaluation),
    (RunFile::File(PUBLISHED_PAGE_FILE), Tells::Evaluation),
    // First, so that the folder is empty when its pictures are removed.
    (RunFile::File(VIEWS_FILE), Tells::Result),
    (RunFile::Pictures(PICTURES_FOLDER), Tells::Result),
];

/// Name of the Gaussians that `--save-every` writes after `step`.
pub fn saved_ply_name(step: u32) -> String {
    format!("point_cloud_{step:06}.ply")
}

/// The step for which [`saved_ply_name`] makes this name; `None` for every other name.
pub fn saved_step(name: &str) -> Option<u32> {
    let step = name.strip_prefix("point_cloud_")?.strip_suffix(".ply")?;
    step.parse().ok().filter(|&step| saved_ply_name(step) == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_saved_gaussians_are_recognised() {
        for step in [0, 7, 1_234_567] {
            assert_eq!(saved_step(&saved_ply_name(step)), Some(step));
        }
        for other in [PLY_FILE, "point_cloud_1.ply", "point_cloud_00000a.ply", "point_cloud_000001.txt"] {
            assert_eq!(saved_step(other), None);
        }
    }
}
