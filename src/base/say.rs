//! All lines that programs print: results on standard output ([`say!`](crate::say)), words about the work on standard error
//! ([`tell!`](crate::tell)).
//!
//! Invariants: 1. a terminal that is gone, a closed pipe or a full drive behind standard error ends no program: such lines
//! are lost; 2. nothing that a file's name holds can move the cursor or turn the direction of a line: control characters
//! and direction marks are printed as escapes (`\u202e`, as in JSON); 3. a line names the programs as the user called this one:
//! texts say `gsscale-train`, and after `gsscale ...` the lines say `gsscale train` ([`as_called`]); 4. a path in a printed
//! command is one word for a shell ([`shell_word`]).

use std::borrow::Cow;
use std::fmt::{Arguments, Write as _};
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::sync::OnceLock;

/// The commands of `gsscale`, once a user has called it by that name.
static COMMANDS: OnceLock<Vec<&'static str>> = OnceLock::new();

/// As `println!`, except that a closed pipe (`| head`) is ignored and the program continues.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => { $crate::base::say::say_line(format_args!($($text)*)) };
}

/// As `eprintln!`, except that a failure is ignored: the work is worth more than a line about it.
#[macro_export]
macro_rules! tell {
    ($($text:tt)*) => { $crate::base::say::tell_line(format_args!($($text)*)) };
}

/// Implementation of [`say!`](crate::say). If standard output fails for another reason (a file on a full drive), prints
/// the error and ends the program with a non-zero exit code by unwinding, so that destructors run.
pub fn say_line(text: Arguments<'_>) {
    match write_line(&mut std::io::stdout(), text) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            crate::tell!("error: standard output: {error}\n  remedy: redirect it to a drive with free space");
            std::panic::resume_unwind(Box::new("standard output failed"));
        }
        _ => {}
    }
}

/// Implementation of [`tell!`](crate::tell).
pub fn tell_line(text: Arguments<'_>) {
    // Nobody is left to be told of a failure here.
    let _ = write_line(&mut std::io::stderr(), text);
}

/// One call of `write`, so that lines of several threads or processes do not mix.
fn write_line(stream: &mut dyn Write, text: Arguments<'_>) -> std::io::Result<()> {
    let line = format!("{text}\n");
    stream.write_all(visible(&as_called(&line)).as_bytes())
}

/// Says that this process is `gsscale` with these commands, each of which is also a program (`gsscale-train`).
pub fn set_commands(commands: Vec<&'static str>) {
    // The first word counts: a process is called once.
    let _ = COMMANDS.set(commands);
}

/// The text with the programs named as the user called this one.
pub fn as_called(text: &str) -> Cow<'_, str> {
    COMMANDS.get().map_or(Cow::Borrowed(text), |commands| with_commands(text, commands))
}

/// The text with `gsscale train` for the word `gsscale-train`, for each of `commands`. A part of a path is no word.
fn with_commands<'a>(text: &'a str, commands: &[&str]) -> Cow<'a, str> {
    const START: &str = "gsscale-";
    let is_of_word = |char: char| char.is_alphanumeric() || matches!(char, '-' | '_' | '/' | '\\' | '.');
    let mut named = String::new();
    let mut rest = text;
    while let Some(at) = rest.find(START) {
        let (before, from) = rest.split_at(at);
        let after = &from[START.len()..];
        let end = after.find(|char: char| !char.is_ascii_lowercase()).unwrap_or(after.len());
        // A point ends a sentence, unless a name goes on behind it.
        let next = after[end..].strip_prefix('.').unwrap_or(&after[end..]);
        let is_word = !before.ends_with(is_of_word) && !next.starts_with(is_of_word);
        named.push_str(before);
        named.push_str(if is_word && commands.contains(&&after[..end]) { "gsscale " } else { START });
        rest = after;
    }
    if named.is_empty() { Cow::Borrowed(text) } else { Cow::Owned(named + rest) }
}

/// The path as one word of a command that a user can paste into a shell: in quotes where it needs them.
pub fn shell_word(path: impl AsRef<Path>) -> String {
    let text = path.as_ref().to_string_lossy();
    let is_plain = |char: char| {
        char.is_alphanumeric() || "/._-+,:@%=".contains(char) || (cfg!(windows) && matches!(char, '\\' | '~'))
    };
    if !text.is_empty() && text.chars().all(is_plain) {
        text.into_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// The text with its control characters (but for line breaks and tabs) and direction marks as escapes.
pub fn visible(text: &str) -> Cow<'_, str> {
    if !text.chars().any(is_hidden) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for char in text.chars() {
        if is_hidden(char) {
            // A `String` takes every character.
            let _ = write!(shown, "\\u{:04x}", u32::from(char));
        } else {
            shown.push(char);
        }
    }
    Cow::Owned(shown)
}

fn is_hidden(char: char) -> bool {
    let is_direction =
        matches!(char, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    is_direction || (char.is_control() && !matches!(char, '\n' | '\t'))
}

/// The cells of a table, padded to the width of their column: the first column stands to the left, the others to the right.
pub fn aligned(rows: &[Vec<String>]) -> Vec<Vec<String>> {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..rows.first().map_or(0, Vec::len)).map(width).collect();
    let pad = |(column, (cell, &width)): (usize, (&String, &usize))| match column {
        0 => format!("{cell:<width$}"),
        _ => format!("{cell:>width$}"),
    };
    rows.iter().map(|row| row.iter().zip(&widths).enumerate().map(pad).collect()).collect()
}

/// The exit code of a program that has ended so; an error is printed with its remedy.
pub fn exit_code(done: Result<(), impl std::fmt::Display>) -> std::process::ExitCode {
    match done {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            crate::tell!("error: {error}");
            std::process::ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_are_named_as_commands_where_they_are_words() {
        let named = |text: &str| with_commands(text, &["train", "poses"]).into_owned();
        assert_eq!(named("`gsscale-train --resume a`, gsscale-poses."), "`gsscale train --resume a`, gsscale poses.");
        for other in
            ["/bin/gsscale-train a", "gsscale-trainer", "my-gsscale-train", "gsscale-poses.json", "gsscale-new"]
        {
            assert_eq!(named(other), other);
        }
        assert_eq!(named("gsscale-train"), "gsscale train");
        assert_eq!(as_called("gsscale-train"), "gsscale-train", "tests are not called gsscale");
    }

    #[test]
    fn paths_in_commands_are_one_word() {
        for (path, word) in [
            ("runs/a-1.5", "runs/a-1.5"),
            ("scans/straße", "scans/straße"),
            ("my runs/a", "'my runs/a'"),
            ("it's", r"'it'\''s'"),
            ("~/a;$b", "'~/a;$b'"),
            ("", "''"),
        ] {
            assert_eq!(shell_word(path), word);
        }
    }

    #[test]
    fn a_name_cannot_turn_the_line() {
        assert_eq!(visible("straße\tZürich 東京\n"), "straße\tZürich 東京\n");
        assert_eq!(visible("a\u{202e}gpj.b\u{1b}[2J\u{2066}"), "a\\u202egpj.b\\u001b[2J\\u2066");
    }
}
