//! The config of a run: its keys ([`mod@file`], [`key`]) and their words ([`choice`]), options derived from them
//! ([`limits`], [`residence`]), values that follow from a run's length ([`schedule`]), and published runs ([`published`]).

pub mod choice;
pub mod file;
pub mod key;
pub mod limits;
pub mod published;
pub mod residence;
pub mod schedule;
