//! Whole runs through the programs that users start. A few tests drive the training loop itself.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is a failed test

mod support;

mod appearance;
mod bench_tool;
#[cfg(target_os = "linux")] // /proc shows the peak memory of a process
mod bombs;
#[cfg(unix)]
mod cells;
#[cfg(unix)]
mod ckpt;
mod cli;
mod clients;
mod diagnosis;
mod doctor;
#[cfg(unix)]
mod drive_faults;
mod dry_runs;
mod examples;
mod exports;
mod extremes;
mod files_of_others;
mod find_poses;
mod first_hour;
mod forecast;
mod foreign_files;
#[cfg(unix)]
mod full_memory_run;
mod gpu_bytes;
mod gpu_ends;
mod gpu_flights;
mod gpu_pages;
mod gpu_quality;
mod gpu_trace;
mod gpu_train;
mod growth;
mod matrix;
mod mcmc;
mod memory;
mod near_names;
mod one_command;
mod optimizers;
mod outgrown;
mod outliers;
mod plan_tool;
mod poses;
mod published;
mod real_scenes;
mod report;
#[cfg(unix)]
mod resume;
mod serve;
#[cfg(unix)]
mod soak;
mod sweeps;
#[cfg(target_os = "linux")] // /dev/full, and the options of GNU env
mod terminal;
mod tiers;
mod train;
mod upright;
