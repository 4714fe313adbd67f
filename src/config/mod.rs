//! What the user wrote ([`mod@file`]) and what follows from it ([`limits`]); runs that were published ([`published`]).

pub mod file;
pub mod limits;
pub mod published;
