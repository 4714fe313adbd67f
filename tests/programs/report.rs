//! The report of a real run: it exists, holds what a reader looks for, loads nothing from the network, and works in a
//! browser.

use crate::support::browser::check_page;
use crate::support::workdir::Workdir;
use gsscale::report::compare_report::compare_report;
use gsscale::report::run_files::PAGES_FILE;
use gsscale::report::run_report::run_report;

#[test]
fn every_run_ends_with_a_report_that_stands_alone() {
    let work = Workdir::city(12, 96, 64, 400);
    work.run("run", "--steps 30 --log-every 5 --eval-every 10");
    let parts =
        ["PSNR, held-out views", "and of the held-out views", "Gaussians", "data:image/jpeg;base64,", "ssim-lambda"];
    let html = check_page(&work, "run/report.html", &parts);
    assert!(html.contains("class=\"slider\""));
    let out = work.path("run");
    let both = compare_report(&[out.clone(), out.clone()]).unwrap();
    assert!(both.contains("PSNR of held-out views") && both.matches("<tr>").count() == 3);
    assert_eq!(both.matches("class=\"slider\"").count(), html.matches("class=\"slider\"").count());

    // An interrupted run: the last line of the metrics is incomplete, all other files are missing.
    let cut = work.path("cut <b>");
    std::fs::create_dir(&cut).unwrap();
    let metrics = work.text("run/metrics.jsonl");
    std::fs::write(cut.join("metrics.jsonl"), &metrics[..metrics.len() - 20]).unwrap();
    // Of fewer pages there is no map.
    let pages = [r#"{"lo":[0,0],"hi":[2,1],"rows":5,"views":3,"resident":true}"#; 16].join(",");
    std::fs::write(cut.join(PAGES_FILE), format!("[{pages}]")).unwrap();
    let html = run_report(&cut, &|_, _| {}).unwrap();
    assert!(html.contains("cut &lt;b&gt;") && html.contains("<h2>Pages</h2>"));
    assert!(run_report(&work.path(""), &|_, _| {}).unwrap_err().to_string().contains("metrics.jsonl"));
}
