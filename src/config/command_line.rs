//! The keys on the command line and in configs/default.toml: help and defaults from the one list of keys.

use super::file::{KEYS, TrainConfig};

/// Parses the command line of a program with [`super::file::TrainOverrides`]; prints help and usage errors and exits.
pub fn parse_command_line<T: clap::CommandFactory + clap::FromArgMatches>() -> T {
    parse_arguments(&std::env::args_os().collect::<Vec<_>>())
}

/// As [`parse_command_line`], for given arguments, starting with the program's name.
pub fn parse_arguments<T: clap::CommandFactory + clap::FromArgMatches>(arguments: &[std::ffi::OsString]) -> T {
    let matches = help_with_defaults(T::command()).get_matches_from(arguments);
    T::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
}

/// Adds the default of each key to its help. Flags have no clap defaults, because an absent flag must keep the config
/// file's value.
fn help_with_defaults(mut command: clap::Command) -> clap::Command {
    let defaults = toml::Table::try_from(TrainConfig::default()).unwrap_or_default();
    for key in KEYS {
        let Some(value) = defaults.get(&key.name()) else { continue };
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_string);
        if value.is_empty() {
            continue;
        }
        command = command.mut_arg(key.field, |arg| {
            let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
            arg.help(format!("{help} [default: {value}]"))
        });
    }
    command
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
