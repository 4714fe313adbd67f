//! The command line of a program: help of its keys, names that users of other trainers type, and usage errors.
//!
//! Not here: the keys ([`super::file`]), and the names of others ([`super::habits`]).

use super::file::{KEYS, Shown, TrainConfig};
use super::habits::{ALIASES, advice_for, with_our_spelling};
use crate::base::error::InputError;
use crate::base::say::as_called;
use clap::builder::StyledStr;
use clap::error::{ContextKind, ContextValue};
use std::ffi::OsString;
use std::path::PathBuf;

/// Programs that draw Gaussians and train none. Their help shows the keys that say what is drawn, beside which photos and where.
const DRAWING_PROGRAMS: &[&str] = &["eval", "view"];
const DRAWING_KEYS: &[&str] = &[
    "images",
    "data_factor",
    "max_resolution",
    "test_every",
    "views_file",
    "masks",
    "invert_masks",
    "allow_missing",
    "image_cache",
    "background",
    "color_correct",
    "up",
    "host_mem",
    "spill_dir",
    "threads",
    "device",
    "device_mem",
];

/// Parses the command line of a program with [`TrainOverrides`](super::file::TrainOverrides), its name first; prints help and usage errors and
/// exits.
pub fn parse_arguments<T: clap::CommandFactory + clap::FromArgMatches>(arguments: &[OsString]) -> T {
    let arguments = with_our_spelling(arguments);
    let is_short = arguments.iter().any(|argument| argument == "-h");
    let command = with_help_of_keys(T::command(), is_short);
    let arguments = &with_joined_switches(&command, &arguments)[..];
    if let Some((flag, advice)) = advice_for(arguments).filter(|(flag, _)| find_flag(&command, flag).is_none()) {
        crate::tell!("error: {flag} is no flag of gsscale\n  remedy: {advice}");
        std::process::exit(2);
    }
    parse(command, arguments)
}

/// The arguments with the value of a switch joined to it: clap takes `--robust-views=off` alone, since a switch needs no value.
fn with_joined_switches(command: &clap::Command, arguments: &[OsString]) -> Vec<OsString> {
    let is_switch = |argument: &OsString| {
        argument.to_str().and_then(|flag| find_flag(command, flag)).is_some_and(clap::Arg::is_require_equals_set)
    };
    let mut joined: Vec<OsString> = Vec::with_capacity(arguments.len());
    for argument in arguments {
        let is_value = ["on", "off", "auto", "true", "false"].iter().any(|value| argument == value);
        match joined.last_mut() {
            Some(before) if is_value && is_switch(before) => {
                before.push("=");
                before.push(argument);
            }
            _ => joined.push(argument.clone()),
        }
    }
    joined
}

/// As [`parse_arguments`], for a program without keys: names that other trainers give to flags mean nothing to it.
pub fn parse_plain<T: clap::CommandFactory + clap::FromArgMatches>(arguments: &[OsString]) -> T {
    parse(T::command(), arguments)
}

fn parse<T: clap::FromArgMatches>(command: clap::Command, arguments: &[OsString]) -> T {
    let matches = in_words_of_caller(command.clone()).try_get_matches_from(arguments);
    if matches.as_ref().map_or_else(clap::Error::use_stderr, |_| true)
        && let Some(name) = not_utf8(arguments.get(1..).unwrap_or_default())
    {
        let problem = "the name is not UTF-8, so text files such as config.toml cannot hold it";
        crate::tell!("error: {}", InputError::new(name, problem, "rename the folder or file"));
        std::process::exit(2);
    }
    let matches = matches.unwrap_or_else(|error| without_odd_tips(error, &command).exit());
    T::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
}

/// An argument that is not UTF-8, or the working folder, which is a part of every relative path.
fn not_utf8(arguments: &[OsString]) -> Option<PathBuf> {
    let mut named = arguments.iter().map(PathBuf::from).chain(std::env::current_dir().ok());
    named.find(|path| path.to_str().is_none())
}

/// The flag of this name, with its dashes, of a command or of one of its commands.
fn find_flag<'a>(command: &'a clap::Command, flag: &str) -> Option<&'a clap::Arg> {
    let is = |arg: &clap::Arg| match flag.strip_prefix("--") {
        Some(long) => arg.get_long() == Some(long),
        None => arg.get_short().is_some_and(|short| flag == format!("-{short}")),
    };
    let own = command.get_arguments().find(|arg| is(arg));
    own.or_else(|| command.get_subcommands().find_map(|command| find_flag(command, flag)))
}

/// Help that names programs as the user called this one.
pub fn in_words_of_caller(mut command: clap::Command) -> clap::Command {
    let named = |text: Option<&StyledStr>| text.map(|text| as_called(&text.to_string()).into_owned());
    let of_arg = |mut arg: clap::Arg| {
        if let Some(text) = named(arg.get_help()) {
            arg = arg.help(text);
        }
        if let Some(text) = named(arg.get_long_help()) {
            arg = arg.long_help(text);
        }
        arg
    };
    if let Some(text) = named(command.get_about()) {
        command = command.about(text);
    }
    if let Some(text) = named(command.get_before_help()) {
        command = command.before_help(text);
    }
    if let Some(text) = named(command.get_before_long_help()) {
        command = command.before_long_help(text);
    }
    if let Some(text) = named(command.get_after_help()) {
        command = command.after_help(text);
    }
    if let Some(text) = named(command.get_after_long_help()) {
        command = command.after_long_help(text);
    }
    command.mut_args(of_arg).mut_subcommands(in_words_of_caller)
}

/// The error without a tip that names a flag which help does not show, or that an unknown flag may be a value: nobody meant either.
fn without_odd_tips(mut error: clap::Error, command: &clap::Command) -> clap::Error {
    let is_hidden = |long: &str| command.get_arguments().any(|arg| arg.get_long() == Some(long) && arg.is_hide_set());
    let names_hidden =
        |name: &String| is_hidden(name.trim_start_matches('-').split([' ', '=']).next().unwrap_or_default());
    if let Some(ContextValue::String(name)) = error.get(ContextKind::SuggestedArg)
        && names_hidden(name)
    {
        error.remove(ContextKind::SuggestedArg);
    }
    error.remove(ContextKind::Suggested);
    error
}

/// Gives each key its help with its default, and its place in help: the first ones alone stand in `-h`, in one group and in few
/// words (`is_short`). Flags have no clap defaults, because an absent flag must keep the config file's value.
pub fn with_help_of_keys(mut command: clap::Command, is_short: bool) -> clap::Command {
    let commands: Vec<String> = command.get_subcommands().map(|command| command.get_name().to_string()).collect();
    if !commands.is_empty() {
        let with_help = |command| with_help_of_keys(command, is_short);
        return commands.iter().fold(command, |command, name| command.mut_subcommand(name, with_help));
    }
    if !command.get_arguments().any(|argument| argument.get_id() == KEYS[0].field) {
        return command;
    }
    let defaults = toml::Table::try_from(TrainConfig::default()).unwrap_or_default();
    let draws_only = DRAWING_PROGRAMS.contains(&command.get_name().trim_start_matches("gsscale-"));
    for key in KEYS {
        let value =
            defaults.get(&key.name()).map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_string));
        let default =
            value.filter(|value| !value.is_empty()).map_or(String::new(), |value| format!(" [default: {value}]"));
        command = command.mut_arg(key.field, |arg| {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            let end = [". ", "; "].iter().filter_map(|mark| help.find(mark)).min().unwrap_or(help.len());
            let arg = arg.help(format!("{}{default}", &help[..end])).long_help(format!("{help}{default}"));
            let is_hidden = key.shown == Shown::Nowhere || draws_only && !DRAWING_KEYS.contains(&key.field);
            let arg = arg.hide(is_hidden).hide_short_help(key.shown != Shown::First);
            let in_short =
                |arg: clap::Arg| arg.help_heading(None::<&str>).value_name("VALUE").hide_possible_values(true);
            if is_short { in_short(arg) } else { arg }
        });
    }
    for (names, key) in ALIASES {
        command = command.mut_arg(key.replace('-', "_"), |arg| arg.aliases(*names));
    }
    // Of fewer columns, clap would make each flag two lines.
    if is_short {
        command = command.term_width(100);
    }
    let hidden = KEYS.iter().filter(|key| key.shown == Shown::Nowhere).count();
    let more = match draws_only {
        true => String::from("All other flags of gsscale-train are accepted, too."),
        false => format!("{hidden} more keys, for work on the program and for comparisons, are in configs/README.md."),
    };
    let last = command.get_after_help().map_or(more.clone(), |text| format!("{text}\n\n{more}"));
    command.after_long_help(last)
}
