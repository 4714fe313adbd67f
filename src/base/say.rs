//! Lines on standard output, for whoever still reads them.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

/// As `println!`, but a reader that has gone (`| head`) is no error: what is left to do is done.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => { $crate::base::say::say_line(format_args!($($text)*)) };
}

/// What [`say!`](crate::say) does. Where standard output fails for another reason (it is a file on a full drive), says so and
/// ends the program with an exit code that is not 0, by unwinding: what has to be given back at an end is given back.
pub fn say_line(text: Arguments<'_>) {
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            eprintln!("error: standard output: {error}\n  remedy: send it where there is space");
            std::panic::resume_unwind(Box::new("standard output failed"));
        }
        _ => {}
    }
}
