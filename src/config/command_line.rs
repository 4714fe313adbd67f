//! The keys on the command line and in configs/default.toml: help and defaults from the one list of keys.

use super::file::{KEYS, TrainConfig};
use super::key::Shown;

/// Parses the command line of a program with [`super::file::TrainOverrides`]; prints help and usage errors and exits.
pub fn parse_command_line<T: clap::CommandFactory + clap::FromArgMatches>() -> T {
    parse_arguments(&std::env::args_os().collect::<Vec<_>>())
}

/// As [`parse_command_line`], for given arguments, starting with the program's name.
pub fn parse_arguments<T: clap::CommandFactory + clap::FromArgMatches>(arguments: &[std::ffi::OsString]) -> T {
    let is_short = arguments.iter().any(|argument| argument == "-h");
    let matches = with_help_of_keys(T::command(), is_short).get_matches_from(arguments);
    T::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
}

/// Gives each key its help with its default, and its place in help: the first ones alone stand in `-h`, in one group and in few
/// words. Flags have no clap defaults, because an absent flag must keep the config file's value.
fn with_help_of_keys(mut command: clap::Command, is_short: bool) -> clap::Command {
    let defaults = toml::Table::try_from(TrainConfig::default()).unwrap_or_default();
    for key in KEYS {
        let value =
            defaults.get(&key.name()).map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_string));
        let default =
            value.filter(|value| !value.is_empty()).map_or(String::new(), |value| format!(" [default: {value}]"));
        command = command.mut_arg(key.field, |arg| {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            let end = [". ", "; "].iter().filter_map(|mark| help.find(mark)).min().unwrap_or(help.len());
            let arg = arg.help(format!("{}{default}", &help[..end])).long_help(format!("{help}{default}"));
            let arg = arg.hide(key.shown == Shown::Nowhere).hide_short_help(key.shown != Shown::First);
            let in_short =
                |arg: clap::Arg| arg.help_heading(None::<&str>).value_name("VALUE").hide_possible_values(true);
            if is_short { in_short(arg) } else { arg }
        });
    }
    // Of fewer columns, clap would make each flag two lines.
    if is_short {
        command = command.term_width(100);
    }
    let hidden = KEYS.iter().filter(|key| key.shown == Shown::Nowhere).count();
    let more = format!("{hidden} more keys, for work on the program and for comparisons, are in configs/README.md.");
    let last = command.get_after_help().map_or(more.clone(), |text| format!("{text}\n\n{more}"));
    command.after_long_help(last)
}

/// The text of configs/default.toml: every key with its meaning and default.
pub fn default_file() -> String {
    let defaults = toml::Table::try_from(TrainConfig::default()).unwrap_or_default();
    let mut text = String::from(
        "# Every key with its meaning and default. A config file needs only the keys that it changes;\n\
         # flags of the same name override it.\n",
    );
    let mut last_heading = "";
    for key in KEYS {
        if key.heading != last_heading {
            text.push_str(&format!("\n## {}\n", key.heading));
            last_heading = key.heading;
        }
        for line in key.meaning.lines() {
            text.push_str(&format!("\n#{line}"));
        }
        let name = key.name();
        let value = defaults.get(&name).map(ToString::to_string).unwrap_or_default();
        text.push_str(&format!("\n{name} = {value}\n"));
    }
    text
}
