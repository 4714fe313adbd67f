//! Pages for people: one self-contained HTML file with charts and pictures, that opens offline in any browser.
//!
//! Reads what a run left behind (metrics.jsonl, summary.json, config.toml, pictures), never the run itself; so a report
//! can be made again at any time, also of a run that was stopped.

pub mod bars;
pub mod chart;
pub mod compare_report;
pub mod front;
pub mod html;
pub mod ladder_page;
pub mod page_map;
pub mod picture;
pub mod record;
pub mod results_log;
pub mod run_report;
pub mod sweep_page;
