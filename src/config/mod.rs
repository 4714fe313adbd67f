//! The config of a run: its keys with their ranges, command line and config.toml ([`mod@file`]), their values and words ([`values`]), options
//! derived from them ([`limits`]), values that a new run takes from its length ([`new_run`]), and published runs ([`published`]).

pub mod file;
pub mod habits;
pub mod limits;
pub mod new_run;
pub mod published;
pub mod values;
