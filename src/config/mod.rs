//! The config of a run: its keys ([`mod@file`], [`key`]) with their words ([`choice`]), other values
//! ([`values`]) and ranges (`check`), the command line ([`command_line`]), options derived from them
//! ([`limits`], [`residence`]), values that a new run takes from its length ([`new_run`], [`schedule`]), the config.toml of a run ([`facts`]), and published
//! runs ([`published`]).

mod check;
pub mod choice;
pub mod command_line;
pub mod facts;
pub mod file;
pub mod key;
pub mod limits;
pub mod new_run;
pub mod published;
pub mod residence;
pub mod schedule;
pub mod values;
