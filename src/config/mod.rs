//! What the user wrote ([`mod@file`]; its words: [`choice`]; what a change of a key means: [`key`]), what follows from it
//! ([`limits`], [`residence`]), and runs that were published ([`published`]).

pub mod choice;
pub mod file;
pub mod key;
pub mod limits;
pub mod published;
pub mod residence;
