//! Lines on standard output; a closed pipe is no error.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

/// As `println!`, except that a closed pipe (`| head`) is ignored and the program continues.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => { $crate::base::say::say_line(format_args!($($text)*)) };
}

/// Implementation of [`say!`](crate::say). If standard output fails for another reason (a file on a full drive), prints
/// the error and ends the program with a non-zero exit code by unwinding, so that destructors run.
pub fn say_line(text: Arguments<'_>) {
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            eprintln!("error: standard output: {error}\n  remedy: redirect it to a drive with free space");
            std::panic::resume_unwind(Box::new("standard output failed"));
        }
        _ => {}
    }
}
