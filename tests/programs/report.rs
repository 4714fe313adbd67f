//! The report of a real run: it exists, holds what a reader looks for, loads nothing from the network, and works in a
//! browser.

use crate::support::browser::in_a_browser;
use crate::support::scenes::{city, stderr, text, train};
use gsscale::report::compare_report::compare_report;
use gsscale::report::run_files::PAGES_FILE;
use gsscale::report::run_report::run_report;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn small_run(folder: &Path) -> PathBuf {
    let scene = city(folder, 12, 96, 64, 400);
    let out = folder.join("run");
    let keys = ["--steps", "30", "--log-every", "5", "--eval-every", "10", "--quiet"];
    let output = train(&[&[text(&scene), "--out", text(&out)], &keys[..]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    out
}

#[test]
fn every_run_ends_with_a_report_that_stands_alone() {
    let folder = TempDir::new().unwrap();
    let out = small_run(folder.path());
    let html = std::fs::read_to_string(out.join("report.html")).expect("the run wrote its report");
    for part in [
        "PSNR, held-out views",
        "and of the held-out views",
        "Gaussians",
        "<svg",
        "data:image/jpeg;base64,",
        "class=\"slider\"",
        "ssim-lambda",
    ] {
        assert!(html.contains(part), "{part} is missing");
    }
    // The SVG namespace is a name, not a fetched address.
    let addresses = html.replace("http://www.w3.org/2000/svg", "");
    assert!(!addresses.contains("http://") && !addresses.contains("https://") && !addresses.contains("src=\"/"));
    assert!(in_a_browser(&out.join("report.html"), folder.path()).is_none_or(|sliders| sliders > 0));
    let both = compare_report(&[out.clone(), out.clone()]).unwrap();
    assert!(both.contains("PSNR of held-out views") && both.matches("<tr>").count() == 3);
    assert_eq!(both.matches("class=\"slider\"").count(), html.matches("class=\"slider\"").count());

    // An interrupted run: the last line of the metrics is incomplete, all other files are missing.
    let cut = folder.path().join("cut <b>");
    std::fs::create_dir(&cut).unwrap();
    let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    std::fs::write(cut.join("metrics.jsonl"), &metrics[..metrics.len() - 20]).unwrap();
    std::fs::write(cut.join(PAGES_FILE), r#"[{"lo":[0,0],"hi":[2,1],"rows":5,"views":3,"resident":true}]"#).unwrap();
    let html = run_report(&cut, &|_, _| {}).unwrap();
    assert!(html.contains("cut &lt;b&gt;") && html.contains("<h2>Pages</h2>"));
    assert!(run_report(folder.path(), &|_, _| {}).unwrap_err().to_string().contains("metrics.jsonl"));
}
