//! Reports: self-contained HTML pages with charts and pictures, which open offline in any browser.
//!
//! A report reads only the files of a run (metrics.jsonl, summary.json, config.toml, diagnosis.json, pages.json, pictures). It can be made again at
//! any time, also for a run that was stopped.

pub mod chart;
pub mod compare_report;
pub mod html;
pub mod live;
pub mod page_map;
pub mod picture;
pub mod run_files;
pub mod run_report;
