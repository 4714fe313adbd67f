//! The glue, in one direction: [`run`] sets a run up and sees it through ([`tiers`] says where pages live, [`memory`] and
//! [`preflight`] whether that fits), [`budget`] keeps it fitting as the scene grows, and `outgrown` says when it cannot,
//! [`trainer`] loops over steps, [`step`] is one step from top to bottom,
//! [`checkpoint`] commits it (`first_commit` that of a run in memory), [`full_drive`] finds it space, [`resume`] goes on from a
//! commit if nothing changed (`changes`, [`dataset_print`]), [`pages`] has the rows of a run in pages and brings them to now with [`catch_up`],
//! `update` changes them, `dense` all of them at every step, [`costs`] counts what steps took, [`eval`] looks at
//! held-out views, [`report`] writes what happened, [`progress`] shows it, [`machine`] starts its threads, [`signals`]
//! hears Ctrl-C, [`start`] gives the first Gaussians
//! (`gaussian_pages` those of a file of any size), [`first_look`] looks at them for a plan, [`out_folder`] is where results go, `ownership` says which store belongs to which run and who may delete what, [`page_map`] draws where pages lie,
//! [`stores`] is what tools do with checkpoints.

pub mod batch;
pub mod budget;
pub mod catch_up;
mod changes;
pub mod checkpoint;
pub mod costs;
pub mod dataset_print;
mod dense;
pub mod error;
pub mod eval;
pub mod facts;
mod first_commit;
pub mod first_look;
mod fitting;
pub mod full_drive;
mod gaussian_pages;
pub mod machine;
pub mod memory;
pub mod out_folder;
mod outgrown;
mod ownership;
pub mod page_map;
pub mod pages;
mod places;
pub mod preflight;
pub mod prepare;
pub mod probe;
pub mod progress;
pub mod report;
pub mod resume;
pub mod run;
pub mod signals;
pub mod staging;
pub mod start;
pub mod step;
pub mod stores;
pub mod tiers;
pub mod trainer;
pub mod training_loop;
mod update;
pub mod view;
pub mod whole_file;
pub mod working_set;
