//! The table of shaders that are part of the program. A shader file that is missing here fails `tests/shaders.rs`.

use super::shader::Source;

macro_rules! sources {
    ($($name:literal),* $(,)?) => {
        /// Every file under `shaders/`, by its path there.
        pub const SOURCES: &[Source] = &[
            $(Source { name: $name, text: include_str!(concat!("../../shaders/", $name)) }),*
        ];
    };
}

sources!["shared/constants.wgsl", "shared/dispatch.wgsl",];
