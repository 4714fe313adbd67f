//! Lines on standard output, for whoever still reads them.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

/// As `println!`, but a reader that has gone (`| head`) is no error: what is left to do is done.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => { $crate::base::say::say_line(format_args!($($text)*)) };
}

/// What [`say!`](crate::say) does. Panics as `println!` does where standard output fails for another reason.
pub fn say_line(text: Arguments<'_>) {
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => panic!("failed printing to standard output: {error}"),
        _ => {}
    }
}
