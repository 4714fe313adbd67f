//! The config of a run: its keys with their ranges ([`mod@file`], [`key`]), words ([`choice`]) and other values ([`values`]), the
//! command line ([`command_line`]), options derived from them ([`limits`]), values that a new run takes from its length
//! ([`new_run`]), the config.toml of a run ([`facts`]), and published runs ([`published`]).

pub mod choice;
pub mod command_line;
pub mod facts;
pub mod file;
pub mod key;
pub mod limits;
pub mod new_run;
pub mod published;
pub mod values;
