//! Opens pages in a headless browser, if one is installed.

use std::path::Path;
use std::process::Command;

/// Opens the page in headless Chromium: scripts run without an error, and every slider was set up. How many there are;
/// `None` where there is no Chromium.
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
    // The script sets the width of the upper picture: it ran to its end for every slider.
    let sliders = dom.matches("class=\"slider\"").count();
    assert!(dom.contains("</main>"), "the page is whole");
    assert_eq!(dom.matches("style=\"width: 50%;\"").count(), sliders, "the sliders were not set up");
    Some(sliders)
}
