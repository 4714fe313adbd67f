//! What the user wrote ([`file`]) and what follows from it ([`limits`]).

pub mod file;
pub mod limits;
