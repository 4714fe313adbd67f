//! The config of a run: its keys ([`mod@file`], [`key`]) and their words ([`choice`]), options derived from them
//! ([`limits`], [`residence`]), values that a new run takes from its length ([`new_run`], [`schedule`]), and published
//! runs ([`published`]).

pub mod choice;
pub mod file;
pub mod key;
pub mod limits;
pub mod new_run;
pub mod published;
pub mod residence;
pub mod schedule;
