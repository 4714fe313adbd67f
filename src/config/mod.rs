//! What the user wrote ([`mod@file`]) and what follows from it ([`limits`]).

pub mod file;
pub mod limits;
