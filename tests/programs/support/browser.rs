//! Opens pages in a headless browser, if one is installed.

use std::path::Path;
use std::process::Command;

/// Opens the page in headless Chromium and asserts that its scripts ran without an error and set up every slider.
/// Returns the number of sliders; `None` without Chromium.
pub fn in_a_browser(page: &Path, scratch: &Path) -> Option<usize> {
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
    Some(sliders)
}
