//! Training: the module where all others meet. Dependencies between its files have no cycle.
//!
//! | task | files |
//! | --- | --- |
//! | set up and run | [`request`], [`run`], `run_folder` (a run in its output folder), [`prepare`], [`start`] (first Gaussians; `gaussian_pages` from a file of any size), [`tiers`] (where pages live), [`machine`] (threads, renderer), [`signals`] (Ctrl-C) |
//! | memory | [`memory`], [`probe`] and [`preflight`] (does the run fit: `largest_view`, `first_frames`, `drive_space`, `plan_text`), [`budget`] and `fitting` (frames of a growing scene), `outgrown` (a scene that no longer fits), [`staging`] |
//! | one step | [`step`], `soundness` (stops a run that diverged or trains nothing), [`comparison`] (from picture to loss and back; also for `view`, which renders without a step), [`batch`] (gather, update; [`device_rows`] on a device that holds pages, [`device_tier`]), [`working_set`], [`catch_up`] (cull, evaluate), `update`, `dense` (dense Adam) |
//! | state and loop | [`pages`], [`trainer`], `save` (as a file), [`training_loop`], [`eval`], [`costs`], `growth_checks` with `held_out` and `leave_out` (how many Gaussians the scene needs) |
//! | commits | [`checkpoint`], `first_commit` (of a run in memory), [`full_drive`], [`resume`] with `changes` and [`dataset_print`] (may the run resume) |
//! | results | `appearance_file`, [`out_folder`], [`report`], [`progress`], [`page_map`], [`facts`] |
//! | stores | `ownership` (which run owns a store, who may delete it), `places`, [`first_look`] (for a plan), [`stores`] (what tools do with checkpoints) |

mod appearance_file;
pub mod batch;
pub mod budget;
pub mod catch_up;
mod changes;
pub mod checkpoint;
pub mod comparison;
pub mod costs;
pub mod dataset_print;
mod dense;
#[cfg_attr(not(feature = "gpu"), path = "device_memory_absent.rs")]
mod device_memory;
pub mod device_rows;
pub mod device_tier;
mod drive_space;
pub mod error;
pub mod eval;
pub mod facts;
mod first_commit;
mod first_frames;
pub mod first_look;
mod fitting;
pub mod forecast;
pub mod full_drive;
mod gaussian_pages;
mod growth_checks;
mod held_out;
mod largest_view;
mod leave_out;
pub mod machine;
pub mod memory;
mod more_steps;
pub mod out_folder;
mod outgrown;
mod ownership;
pub mod page_map;
pub mod pages;
mod places;
mod plan_text;
pub mod preflight;
pub mod prepare;
pub mod probe;
pub mod progress;
pub mod report;
pub mod request;
pub mod resume;
pub mod run;
mod run_folder;
mod save;
pub mod signals;
mod soundness;
pub mod staging;
pub mod start;
pub mod step;
pub mod stores;
pub mod tiers;
pub mod trainer;
pub mod training_loop;
mod update;
pub mod view;
pub mod working_set;
