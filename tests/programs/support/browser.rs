//! Pages that the programs write, and a headless browser that opens them, if one is installed.

use super::workdir::{Workdir, says};
use std::path::Path;
use std::process::Command;

/// Asserts that a page has all `parts` and figures, loads nothing from elsewhere, and opens; returns its text.
pub fn check_page(work: &Workdir, page: &str, parts: &[&str]) -> String {
    let html = work.text(page);
    says(&html, &[parts, &["<svg", "</html>"]].concat());
    // The SVG namespace is a name, not a fetched address.
    let addresses = html.replace("http://www.w3.org/2000/svg", "");
    assert!(!addresses.contains("http://") && !addresses.contains("https://") && !addresses.contains("src=\"/"));
    let sliders = in_a_browser(&work.path(page), &work.path(""));
    assert!(sliders.is_none_or(|sliders| sliders > 0 || !html.contains("class=\"slider\"")), "{page}");
    html
}

/// Opens the page in headless Chromium and asserts that its scripts ran without an error and set up every slider.
/// Returns the number of sliders; `None` without Chromium.
fn in_a_browser(page: &Path, scratch: &Path) -> Option<usize> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let Some(browser) = names.into_iter().find(|n| Command::new(n).arg("--version").output().is_ok()) else {
        println!("no Chromium here: {} was not opened in a browser", page.display());
        return None;
    };
    let profile = format!("--user-data-dir={}", scratch.join("profile").display());
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"])
        .args([&profile, "--virtual-time-budget=3000", "--dump-dom", &format!("file://{}", page.display())])
        .output()
        .unwrap();
    let dom = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // The script sets the width of the upper picture last, for every slider.
    let sliders = dom.matches("class=\"slider\"").count();
    assert!(dom.contains("</main>"), "the page is whole");
    assert_eq!(dom.matches("style=\"width: 50%;\"").count(), sliders, "the sliders were not set up");
    let charts = dom.matches("data-plot=").count();
    assert!(charts == 0 || dom.contains("class=\"pointed\""), "no chart shows its values");
    Some(sliders)
}
