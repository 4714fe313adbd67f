//! The config of a run: its keys with their ranges and config.toml ([`mod@file`]), the command line ([`command_line`]) with the flags of
//! other trainers ([`habits`]), the values and words of keys ([`values`]), options derived from them ([`limits`]), values that a new run takes
//! from its length ([`new_run`]), and published runs ([`published`]).

pub mod command_line;
pub mod file;
pub mod habits;
pub mod limits;
pub mod new_run;
pub mod published;
pub mod values;
