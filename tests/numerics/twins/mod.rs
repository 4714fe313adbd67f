//! The stages that only devices run, a second time on plain slices of the host: what the tests compare the shaders with. The
//! stages that the CPU renderer runs too are in `gsscale::kernels`.

pub mod deferred;
pub mod gate;
pub mod gather;
pub mod page_words;
pub mod update;
